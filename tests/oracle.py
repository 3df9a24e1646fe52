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
from lyra_petsc.terms.bending.hinge_energy import hinge_hessian
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_geometry import NO_REST_ROTATION, mean_directors
from lyra_petsc.terms.bending.midedge_shape import (
    transported,
    unit,
)
from lyra_petsc.terms.loads.wind import Air, Wind
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.protocols import GlobalSums
from lyra_petsc.terms.stretch_limit import StretchLimit
from lyra_petsc.terms.term import Assembly, Elastic, UpcomingStep, Viscous

Ints = NDArray[np.int64] | NDArray[np.int32]


def frozen_by(term: Elastic | Viscous, equations: StageEquations, x: Array | None = None) -> Any:
    """Frozen data of a term for a step from 0 s to 0.01 s, at positions x instead of the state's."""
    return term.freeze(UpcomingStep(0.0, 0.01, 0.01, equations.x if x is None else x, equations.reference.at))


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
    convexity: float = 0.0,
    *,
    weight: Array | None = None,
    predicted: tuple[Array, Array] | None = None,
    n_owned: int | None = None,
) -> Array:
    """What a term adds to block rows, as a dense matrix (n_owned, 3, n, 3), at positions or velocities.

    With the part that is not in block rows, unless elements have a weight.
    """
    n, weighted = len(at), weight is not None
    pattern = BlockPattern(term.couplings, n if n_owned is None else n_owned, n)
    values = np.zeros((pattern.n_stored, 3, 3))
    if isinstance(term, Viscous):
        term.add_hessian(at, frozen, pattern.offsets, values)
    else:
        weight = np.ones(term.n_elements) if weight is None else weight
        term.add_hessian(at, frozen, Assembly(weight, pattern.offsets, values, convexity, predicted))
    out = expanded(pattern, values, n)
    if isinstance(term, GlobalSums) and not weighted:
        weights, vectors = term.dense_hessian(at, frozen)
        out += np.einsum("k,kia,kjb->iajb", weights, vectors[:, : len(out)], vectors)
    return out


def element_hessians(term: Elastic, x: Array, frozen: Any, convexity: float = 0.0) -> Array:
    """Hessian of each element alone, (E, 3 n, 3 n) for all n points."""
    size = x.size
    return np.array(
        [hessian(term, x, frozen, convexity, weight=w).reshape(size, size) for w in np.eye(term.n_elements)]
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
    term: Membrane, x: Array, convexity: float, predicted: tuple[Array, Array] | None = None
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
        s = (1.0 - convexity) * (c @ strain) + convexity * np.maximum(c @ extension, 0.0) * [1.0, 1.0, 0.0]
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


def bending_blocks(term: Bending, x: Array, convexity: float) -> Array:
    """Element Hessians (E, 4, 4, 3, 3) of hinges, each computed from its four points."""
    sides = term._triangles.sides
    out, g = np.empty((term.n_elements, 4, 4, 3, 3)), np.empty((4, 3))
    angles, limits = dihedral_angles(x, term.stencil), term._limit[sides[:-1] >> 2]
    stiffness, rest = term.elements.data["k"], term.elements.data["rest_angle"]
    for e, points in enumerate(term.stencil):
        corners = [tuple(x[p].tolist()) for p in points]
        law = stiffness[e], rest[e], (limits[e, 0], limits[e, 1])
        hinge_hessian(*corners, angles[e], *law, convexity, g, out[e])
    return out


def wind_blocks(term: Wind, v: Array, air: Air) -> Array:
    """Element Hessians (E, 3, 3, 3, 3): a ninth of ∂²P/∂v_rel² to each pair of corners."""
    out = np.empty((term.n_elements, 3, 3, 3, 3))
    normals, wind, density, drag = air
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
    convexity: float = 0.0,
    predicted: tuple[Array, Array] | None = None,
) -> Array:
    """Element Hessians (E, k, k, 3, 3) by plain formulas, or by the term itself for single elements."""
    if isinstance(term, Membrane):
        return membrane_blocks(term, at, convexity, predicted)
    if isinstance(term, Bending):
        return bending_blocks(term, at, convexity)
    if isinstance(term, StretchLimit):
        return stretch_limit_blocks(term, at)
    if isinstance(term, Wind):
        return wind_blocks(term, at, frozen)
    assert isinstance(term, Elastic)
    k = term.stencil.shape[1]
    out = np.full((term.n_elements, k, k, 3, 3), np.nan)
    term.hessians(at, frozen, 0, term.n_elements, convexity, out)
    return out
