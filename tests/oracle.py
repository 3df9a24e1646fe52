"""Plain, slow versions of the results of terms: dense Hessians and finite differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.bending.hinge import Bending, dihedral_angles
from lyra_petsc.terms.bending.hinge_energy import add_square_hessian, fade, hinge_hessian
from lyra_petsc.terms.bending.midedge import NO_REST_ROTATION, MidEdge, mean_directors
from lyra_petsc.terms.bending.midedge_friction import MidEdgeFriction
from lyra_petsc.terms.bending.midedge_shape import (
    Frames,
    coupling_tangent,
    derivatives,
    tangent_of,
    transported,
    unit,
)
from lyra_petsc.terms.loads.wind import Wind
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.stretch_limit import StretchLimit
from lyra_petsc.terms.term import Elastic, UpcomingStep, Viscous

Ints = NDArray[np.int64] | NDArray[np.int32]


def frozen_by(term: Elastic | Viscous, system: StageEquations, x: Array | None = None) -> Any:
    """Frozen data of a term for a step from 0 s to 0.01 s, at positions x instead of the state's."""
    return term.freeze(UpcomingStep(0.0, 0.01, 0.01, system.x if x is None else x, system.reference.at))


def gradient(term: Elastic | Viscous, at: Array, frozen: Any) -> Array:
    """The term's gradient (n, 3) at positions or velocities (n, 3)."""
    out = np.zeros_like(at)
    term.add_gradient(at, frozen, out)
    return out


def differences(f: Callable[[Array], Array | float], y: Array, h: float) -> Array:
    """Derivative of f (…) with respect to y (n, 3) by fourth-order central differences, (n, 3, …)."""
    rows = []
    for index in np.ndindex(y.shape):
        e = np.zeros_like(y)
        e[index] = h
        rows.append((8.0 * (f(y + e) - f(y - e)) - (f(y + 2 * e) - f(y - 2 * e))) / (12.0 * h))
    return np.array(rows).reshape(*y.shape, *np.shape(rows[0]))


def expanded(pattern: BlockPattern, values: Array, n_local: int) -> Array:
    """Block rows of which one half is stored as a dense matrix (n_owned, 3, n_local, 3)."""
    out = np.zeros((pattern.n_owned, 3, n_local, 3))
    pattern, values = pattern.whole, pattern.in_blocks(values)
    rows = np.repeat(np.arange(pattern.n_owned), np.diff(pattern.indptr))
    for row, column, block in zip(rows, pattern.columns, values, strict=True):
        out[row, :, column, :] = block.T  # stored column by column
        if column < pattern.n_owned:
            out[column, :, row, :] = block
    return out


def hessian(
    term: Elastic | Viscous,
    at: Array,
    frozen: Any,
    blend: float = 0.0,
    *,
    weight: Array | None = None,
    predicted: tuple[Array, Array] | None = None,
    n_owned: int | None = None,
) -> Array:
    """What a term adds to block rows, as a dense matrix (n_owned, 3, n, 3), at positions or velocities."""
    n = len(at)
    pattern = BlockPattern(term.couplings, n if n_owned is None else n_owned, n)
    values = np.zeros((pattern.n_stored, 3, 3))
    if isinstance(term, Viscous):
        term.add_hessian(at, frozen, pattern.offsets, values)
    else:
        weight = np.ones(term.n_elements) if weight is None else weight
        term.add_hessian(at, frozen, blend, weight, pattern.offsets, values, predicted)
    return expanded(pattern, values, n)


def element_hessians(term: Elastic, x: Array, frozen: Any, blend: float = 0.0) -> Array:
    """Hessian of each element alone, (E, 3 n, 3 n) for all n points."""
    size = x.size
    return np.array(
        [hessian(term, x, frozen, blend, weight=w).reshape(size, size) for w in np.eye(term.n_elements)]
    )


def summed(stencil: Ints, blocks: Array, n: int) -> Array:
    """Sum of element blocks (E, k, k, 3, 3) as a matrix (n, 3, n, 3)."""
    out = np.zeros((n, 3, n, 3))
    for points, block in zip(stencil, blocks, strict=True):
        for a, i in enumerate(points):
            for b, j in enumerate(points):
                out[i, :, j, :] += block[a, b]
    return out


def directors_along_normals(term: MidEdge, x: Array) -> Array:
    """Unknowns (n,) of edges whose directors are the means of the normals of their triangles."""
    edges = term.of_edges
    tangent = unit(x[edges.ends[:, 1]] - x[edges.ends[:, 0]])
    across = transported(term.frames, tangent)
    mean = mean_directors(x, term.stencil, edges.of_triangles, len(edges.length), NO_REST_ROTATION)
    sine = np.sum(np.cross(tangent, across) * mean, axis=1)
    return np.asarray(edges.length * np.arctan2(sine, np.sum(across * mean, axis=1)))


# -- formulas ------------------------------------------------------------------------------------------


def membrane_blocks(
    term: Membrane, x: Array, blend: float, predicted: tuple[Array, Array] | None = None
) -> Array:
    """Element Hessians (E, 3, 3, 3, 3) of St. Venant-Kirchhoff membranes.

    A (∂E/∂x : C : ∂E/∂x + S : ∂²E/∂x²), with S of the strain at z linearised at y, ``predicted``, and
    regularised of what extension along the material axes alone makes, none of it compressive.
    """
    out = np.empty((term.n_elements, 3, 3, 3, 3))
    area, inverse, (laws, law) = term.elements.data["area"], term.elements.data["inverse"], term.laws
    before, there = (x, x) if predicted is None else predicted
    for e, points in enumerate(term.stencil):
        c11, c12, c22, c33 = laws[law[e]]
        c = np.array([[c11, c12, 0.0], [c12, c22, 0.0], [0.0, 0.0, c33]])
        shape = np.vstack([-inverse[e].sum(axis=0), inverse[e]])  # ∂F/∂x of each corner
        f = x[points].T @ shape
        g = there[points].T @ shape
        change = g - before[points].T @ shape
        green = 0.5 * (g.T @ g - np.eye(2) - change.T @ change)
        strain = np.array([green[0, 0], green[1, 1], 2.0 * green[0, 1]])
        extension = np.maximum(strain, 0.0) * [1.0, 1.0, 0.0]
        s = (1.0 - blend) * (c @ strain) + blend * np.maximum(c @ extension, 0.0) * [1.0, 1.0, 0.0]
        stress = np.array([[s[0], s[2]], [s[2], s[1]]])
        slopes = np.array(
            [
                [f[:, 0] * g[0], f[:, 1] * g[1], f[:, 0] * g[1] + f[:, 1] * g[0]]  # ∂E/∂x of a corner
                for g in shape
            ]
        )
        out[e] = area[e] * np.einsum("aki,kl,blj->abij", slopes, c, slopes)
        out[e] += area[e] * np.einsum("ab,ij->abij", shape @ stress @ shape.T, np.eye(3))
    return out


def bending_blocks(term: Bending, x: Array, blend: float) -> Array:
    """Element Hessians (E, 4, 4, 3, 3) of hinges, each computed from its four points."""
    sides = term._triangles.sides
    out, g = np.empty((term.n_elements, 4, 4, 3, 3)), np.empty((4, 3))
    angles, limits = dihedral_angles(x, term.stencil), term._limit[sides[:-1] >> 2]
    stiffness, rest = term.elements.data["k"], term.elements.data["rest_angle"]
    for e, points in enumerate(term.stencil):
        corners = [tuple(x[p].tolist()) for p in points]
        law = stiffness[e], rest[e], (limits[e, 0], limits[e, 1])
        hinge_hessian(*corners, angles[e], *law, blend, g, out[e])
    return out


def midedge_blocks(
    term: MidEdge | MidEdgeFriction, x: Array, frames: Frames, blend: float, out: Array
) -> None:
    """Element Hessians (E, 12, 12) of triangles with directors, each computed separately."""
    data, friction = term.elements.data, np.zeros((term.n_elements, 2))
    if isinstance(term, MidEdge):
        (stiffness, rest, limit, _), edges = term._constants, term.of_edges.of_triangles
        sheet, rotation = term, term._rest_rotation
    else:
        _, stiffness, rest, limit, friction = term._constants(term._sliding(x, frames))
        edges, sheet = term._edges, term._sheet
        rotation = sheet._rest_rotation
        rotation = rotation[term._rows] if len(rotation) else rotation
    directors, length = sheet._directors(x, frames), sheet.of_edges.length
    rest = rest if len(rest) else np.zeros((term.n_elements, 3))
    for e, points in enumerate(term.stencil):
        corners, k = x[points], np.empty((3, 3))
        k[np.triu_indices(3)] = k.T[np.triu_indices(3)] = stiffness[e]
        sides = corners[[2, 0, 1]] - corners[[1, 2, 0]]
        area = np.cross(sides[1], sides[2])  # 2A n
        double = np.linalg.norm(area)
        n, along = area / double, np.linalg.norm(sides, axis=1)
        director = directors[edges[e]]
        if len(rotation):
            cosine, sine = rotation[e].T[:, :, None]
            director = cosine * director - sine * np.cross(sides / along[:, None], director)
        tangent, before = data["sign"][e][:, None] * sides / along[:, None], frames.direction[edges[e]]
        beside = 1.0 + np.sum(tangent * before, axis=1, keepdims=True)
        spin = -np.cross(before, tangent) / (along[:, None] * beside)
        about = ((1.0 + beside) * tangent + before) / (along[:, None] * beside)
        t = [tangent_of(*rows, tuple(area)) for rows in zip(director, sides, strict=True)]
        t1, t2, s, s1, s2 = np.array([derivatives(each) for each in t]).T
        omega, inward = -(sides @ sides.T) / along[:, None] / double, np.cross(n, sides) / double
        ends = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]])
        own, between = np.diag(np.diag(k)), k - np.diag(np.diag(k))
        further = s - [coupling_tangent(tangent) for tangent in rest[e]]
        pull = own @ (t - rest[e]) * t1 + between @ further * s1
        gradients, curved = np.zeros((3, 12)), np.zeros((12, 12))
        for i in range(3):
            for c in range(3):
                at = slice(3 * c, 3 * c + 3)
                gradients[i, at] = omega[i, c] * n + ends[i, c] * spin[i]
                for d in range(3):
                    tau = -np.cross(sides[i], n) / (2.0 * along[i] ** 3)
                    block = -omega[i, d] * np.outer(n, inward[c]) - omega[i, c] * np.outer(inward[d], n)
                    both = np.outer(n, tau) - 0.5 * data["sign"][e, i] * np.outer(spin[i], about[i])
                    block += ends[i, c] * ends[i, d] * (both + both.T)
                    curved[at, 3 * d : 3 * d + 3] += pull[i] * block
            gradients[i, 9 + i] = data["sign"][e, i] / length[edges[e, i]]
        bend = own @ (t - rest[e]) * t2 + between @ further * s2
        curved += gradients.T * bend @ gradients
        curved += friction[e, 0] * np.outer(pull @ gradients, pull @ gradients)
        stiff = t1[:, None] * own * t1 + s1[:, None] * between * s1
        found = gradients.T @ stiff @ gradients + (1.0 - blend) * curved
        if double**2 < limit[e]:
            weight, first, second = fade(double**2, limit[e])
            energy = 0.5 * ((t - rest[e]) @ own @ (t - rest[e]) + further @ between @ further)
            energy += friction[e, 1]
            force = pull @ gradients
            bent, slopes = np.zeros((4, 4, 3, 3)), np.zeros(12)
            slopes[:9] = 2.0 * np.cross(area, sides).ravel()
            add_square_hessian(tuple(map(tuple, corners)), tuple(area), (0, 1, 2), first * energy, bent)
            more = first * (np.outer(force, slopes) + np.outer(slopes, force))
            more += energy * second * np.outer(slopes, slopes)
            more[:9, :9] += bent[:3, :3].transpose(0, 2, 1, 3).reshape(9, 9)
            found = weight * found + (1.0 - blend) * more
        out[e] = found


def wind_blocks(term: Wind, v: Array, normals: Array) -> Array:
    """Element Hessians (E, 3, 3, 3, 3): a ninth of ∂²P/∂v_rel² to each pair of corners."""
    out = np.empty((term.n_elements, 3, 3, 3, 3))
    wind, density, drag = term._law
    for e, points in enumerate(term.stencil):
        n = normals[e]
        across = np.outer(n, n)
        speed = abs((wind - v[points].mean(axis=0)) @ n)
        whole = 2.0 * density * speed * across + drag * (np.eye(3) - across)
        out[e] = term.elements.data["area"][e] / 9.0 * whole
    return out


def stretch_limit_blocks(term: StretchLimit, x: Array) -> Array:
    """Element Hessians (E, 3, 3, 3, 3), from the eigenvectors of the Hessian with respect to F."""
    out, data = np.zeros((term.n_elements, 3, 3, 3, 3)), term.elements.data
    for e, corners in enumerate(term.stencil):
        inverse, limit, scale = data["inverse"][e], data["limit"][e], data["area"][e] * data["stiffness"][e]
        gradients = np.vstack([-inverse.sum(axis=0), inverse])
        n, stretch, m = np.linalg.svd(x[corners].T @ gradients)
        width = 0.5 * (limit - 1.0)
        t = np.minimum((limit - stretch) / width, 1.0)
        p, q = scale * width * (t**-2 - 3.0 + 2.0 * t), 2.0 * scale * (t**-3 - 1.0)

        def outer(i: int, k: int, n: Array = n, m: Array = m) -> Array:
            return np.outer(n[:, i], m[k])

        modes = [
            (q[0], outer(0, 0)),
            (q[1], outer(1, 1)),
            ((p[0] - p[1]) / (stretch[0] - stretch[1]), (outer(0, 1) + outer(1, 0)) / np.sqrt(2.0)),
            ((p[0] + p[1]) / stretch.sum(), (outer(0, 1) - outer(1, 0)) / np.sqrt(2.0)),
            (p[0] / stretch[0], outer(2, 0)),
            (p[1] / stretch[1], outer(2, 1)),
        ]
        for value, mode in modes:
            forces = gradients @ mode.T
            out[e] += value * np.einsum("ai,bj->abij", forces, forces)
    return out


def blocks_of(
    term: Elastic | Viscous,
    at: Array,
    frozen: Any,
    blend: float = 0.0,
    predicted: tuple[Array, Array] | None = None,
) -> Array:
    """Element Hessians (E, k, k, 3, 3) by plain formulas, or by the term itself for single elements."""
    if isinstance(term, Membrane):
        return membrane_blocks(term, at, blend, predicted)
    if isinstance(term, Bending):
        return bending_blocks(term, at, blend)
    if isinstance(term, StretchLimit):
        return stretch_limit_blocks(term, at)
    if isinstance(term, Wind):
        return wind_blocks(term, at, frozen)
    assert isinstance(term, Elastic)
    k = term.stencil.shape[1]
    out = np.full((term.n_elements, k, k, 3, 3), np.nan)
    term.hessians(at, frozen, 0, term.n_elements, blend, out)
    return out


def plain_hessian(term: Elastic, at: Array, frozen: Any, blend: float) -> Array:
    """The Hessian of an elastic term (n, 3, n, 3), element by element from ``blocks_of``."""
    if term.edges is None:
        return summed(term.stencil, blocks_of(term, at, frozen, blend), len(at))
    points, unknowns = 3 * term.stencil[:, :, None] + np.arange(3), term.edges
    index = np.concatenate([points.reshape(len(points), -1), unknowns], axis=1)
    out, blocks = np.zeros((at.size, at.size)), np.empty((len(index), index.shape[1], index.shape[1]))
    if isinstance(term, (MidEdge, MidEdgeFriction)):
        midedge_blocks(term, at, frozen, blend, blocks)
    else:
        term.hessians(at, frozen, 0, term.n_elements, blend, blocks)
    for rows, block in zip(index, blocks, strict=True):
        out[np.ix_(rows, rows)] += block
    return out.reshape(*at.shape, *at.shape)
