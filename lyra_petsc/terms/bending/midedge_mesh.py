"""Notes for ``check`` and runs on meshes that are too coarse for sheets with directors on edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.materials.library import is_isotropic
from lyra_petsc.terms.bending.midedge_shape import unit
from lyra_petsc.terms.handles.prescribed_handles import is_exact
from lyra_petsc.terms.rest import RestShape

NOTED_LOSS = 0.02
"""Relative error of the torsional stiffness, due to missing transverse shear, from which it is noted."""

CREASED = np.radians(30.0)
"""Angle α [rad] in the rest shape from which an edge counts as a crease, not part of a smooth surface."""

CORNER = np.radians(20.0)
"""Smallest turn [rad] of a boundary at a corner; at the neighbours it turns at most half as much."""

LARGEST_CORNER = np.radians(100.0)
"""Angle [rad] between supported edges up to which singular moments in the corner are negligible."""

LOAD_FACTOR = 1.8
"""Factor in the error at an irregular vertex, measured at vertices of four triangles on two spheres."""

NOTED_ERROR = 0.03
"""Relative error of a vertex's displacement from which it is noted."""

COARSE_CORNER, COARSE_REENTRANT = 0.065, 0.008
"""(h/L)^p from which edges of length h at a corner are noted as too long for a sheet of size L, for angles
below and above 180°: about 1 % error in the deflection of skew plates of 30° and 60°, and of an L."""


class Sides(NamedTuple):
    """The sides of triangles, opposite their corners.

    Attributes
    ----------
    ends : (F, 3, 2) int64
        Vertices.
    boundary : (F, 3) bool
        Whether no other triangle has the edge.
    supported, clamped : (F, 3) bool
        Whether handles hold the edge against deflection, and whether they hold its slope.
    """

    ends: Ints
    boundary: Mask
    supported: Mask
    clamped: Mask


def coarse_surface_notes(
    rest: RestShape, chosen: Ints, number: Ints, size: Array, of_tangents: Array, angle: Array
) -> list[str]:
    """Notes on curved rest shapes that the mesh does not resolve.

    ``chosen`` are the triangles (n,), ``number`` (n, 3) their edges, ``size`` (n, 3) the edges' lengths [m],
    ``of_tangents`` (n, 3, 3) as by `midedge_geometry.curvatures_of_tangents`, and ``angle`` (n, 3) the
    angles ᾱ [rad].

    Flat triangles resolve a shell of thickness t and radius R with edges below √(t R); t = √(12 B / C) for
    bending stiffness B and membrane stiffness C. Folds between plane walls are not counted as curvature: on a
    smooth surface most triangles around each vertex are bent.
    """
    creased, longest = np.abs(angle).max(axis=1) >= CREASED, size.max(axis=1)
    curvature = np.einsum("eki,ei->ek", of_tangents, np.tan(np.where(creased[:, None], 0.0, angle)))
    mean, half = 0.5 * (curvature[:, 0] + curvature[:, 1]), 0.5 * (curvature[:, 0] - curvature[:, 1])
    largest = np.abs(mean) + np.hypot(half, 0.5 * curvature[:, 2])
    thickness = np.array(
        [np.sqrt(12.0 * max(s.plate[0], s.plate[2]) / max(s.c11, s.c22)) for s in rest.shells]
    )[rest.shell_of[chosen]]
    bent = largest * longest > 1e-3
    corners, n = rest.mesh.triangles[chosen], rest.mesh.n_vertices
    n_around, n_bent = (np.bincount(c.ravel(), minlength=n) for c in (corners, corners[bent]))
    bent &= (2 * n_bent > n_around)[corners].all(axis=1)
    coarse = bent & (largest * longest**2 > thickness)
    if not 2 * coarse.sum() > bent.sum():
        return _irregular_notes(rest, chosen, number, size, np.where(bent, largest / thickness, 0.0))
    fine = float(np.median(np.sqrt(thickness[coarse] / largest[coarse])))
    return [
        f"{coarse.sum()} triangles are large for the curvature of their rest shape, with edges of "
        f"{np.median(longest[coarse]):.3g} m: flat triangles make such a shell too stiff, or too soft under "
        f"point loads, unless their edges are well below √(t R) = {fine:.3g} m"
    ]


def _irregular_notes(rest: RestShape, chosen: Ints, number: Ints, size: Array, sharpness: Array) -> list[str]:
    """Notes on vertices of three or four triangles on a curved surface, among others of six.

    ``sharpness`` (n,) is 1/(t R) [1/m²], 0 where the surface is flat. In a sphere under pressure p the
    tension of n equal triangles balances the load 3 p / (4 cos²(π/n)) at their vertex, which is p for n = 6.
    The difference acts as a point force F: the error of the vertex's displacement, relative to that of the
    shell, is F / (p h²) times ``LOAD_FACTOR`` h²/(t R). Where vertices of four and eight triangles alternate,
    as in patterns of grids, the forces cancel.
    """
    mesh, triangles = rest.mesh, rest.mesh.triangles[chosen]
    n, sides = mesh.n_vertices, _sides(rest, triangles, number)

    def mean(values: Array) -> Array:
        """Mean (V,) of the values (F, 3) of sides at their ends."""
        count = np.maximum(np.bincount(sides.ends.ravel(), minlength=n), 1)
        return np.bincount(sides.ends.ravel(), np.repeat(values.ravel(), 2), n) / count

    opening = np.maximum(_openings(triangles, size, n), 1e-9)
    # number of triangles around each vertex, including mirror images in symmetry planes
    valence = 2.0 * np.pi / opening * np.bincount(triangles.ravel(), minlength=n)
    isolated = mean(valence[sides.ends].sum(axis=2)) - valence < 7.0
    isolated[sides.ends[sides.boundary & ~sides.clamped]] = False
    vertices = np.flatnonzero(isolated & (valence > 2.5) & (valence < 4.5))
    half = np.pi / valence[vertices]
    load = (0.75 / np.cos(half) ** 2 - 1.0) * np.sin(2.0 * half) / 6.0 * valence[vertices]
    error = LOAD_FACTOR * load * (mean(size) ** 2 * mean(np.repeat(sharpness[:, None], 3, axis=1)))[vertices]
    if not (error > NOTED_ERROR).any():
        return []
    worst = int(np.argmax(error))
    vertex, count = vertices[worst], np.sum(error > NOTED_ERROR)
    more = f" (and {count - 1} more)" if count > 1 else ""
    return [
        f"at vertex {vertex}{more} only {valence[vertex]:.0f} triangles of a curved shell meet: "
        f"under pressure it moves by about {min(error[worst], 1.0):.0%} too little; let five to seven meet, "
        "or refine"
    ]


def narrow_sheet_notes(rest: RestShape, chosen: Ints, number: Ints, size: Array, area: Array) -> list[str]:
    """Notes on sheets with free edges that are narrow for their thickness.

    Due to transverse shear, which is neglected here, a shell of thickness t is softer in torsion at a free
    edge, as if 0.315 t of its width were missing: a strip of width b has the torsional stiffness
    G b t³/3 (1 − 0.63 t/b).

    Source: S. P. Timoshenko, J. N. Goodier, Theory of Elasticity, 3rd ed. 1970, § 109.
    """
    thickness = np.array(
        [
            np.sqrt(12.0 * shell.plate[0] / shell.c11)
            if material.young is not None or is_isotropic(material.cloth)
            else 0.0
            for shell, material in zip(rest.shells, rest.scene.material, strict=True)
        ]
    )[rest.shell_of[chosen]]
    _, boundary, supported, clamped = _sides(rest, rest.mesh.triangles[chosen], number)
    free = boundary & ~supported & ~clamped
    lost = 0.315 * float(thickness @ np.sum(size * free, axis=1)) / float(area[thickness > 0.0].sum() or 1.0)
    if lost < NOTED_LOSS:
        return []
    return [
        f"these sheets are narrow for their thickness: their torsional stiffness is about {lost:.0%} too "
        "large, since transverse shear, which softens them at free edges, is neglected"
    ]


def corner_notes(rest: RestShape, chosen: Ints, number: Ints, size: Array, area: Array) -> list[str]:
    """Notes on obtuse corners between supported edges of triangles ``chosen``, with long edges.

    ``size`` (n, 3) [m] and ``area`` (n,) [m²] are those of the triangles. At a corner of angle ω moments grow
    as r^(π/ω − 2), or r^(−π/ω) where it is re-entrant, and deflections converge with the power
    p = 2 |1 − π/ω| of the edge length there. A polygon that approximates a curve turns by similar angles at
    neighbouring vertices and has no such corners.

    Source: M. L. Williams, Proceedings of the First US National Congress of Applied Mechanics (1951) 325-329.
    """
    triangles, n = rest.mesh.triangles[chosen], rest.mesh.n_vertices
    ends, boundary, supported, clamped = _sides(rest, triangles, number)
    opening = _openings(triangles, size, n)

    turn, nearby = np.abs(np.pi - opening), np.zeros(n)
    for one, other in ((0, 1), (1, 0)):
        np.maximum.at(nearby, ends[boundary][:, one], turn[ends[boundary][:, other]])
    simple = np.bincount(ends[boundary & supported & ~clamped].ravel(), minlength=n) == 2
    simple &= np.bincount(ends[boundary].ravel(), minlength=n) == 2
    simple &= np.bincount(ends[~boundary & ~supported].ravel(), minlength=n) > 0  # no sheet held in its plane
    vertices = np.flatnonzero(simple & (opening > LARGEST_CORNER) & (turn > np.maximum(CORNER, 2.0 * nearby)))
    length = 0.5 * np.bincount(ends[boundary].ravel(), np.repeat(size[boundary], 2), n)[vertices]
    part = np.where(opening[vertices] < np.pi, COARSE_CORNER, COARSE_REENTRANT)
    fine = np.sqrt(area.sum()) * part ** (0.5 / np.abs(1.0 - np.pi / opening[vertices]))
    long = length > 1.5 * fine
    vertices, length, fine = (values[long] for values in (vertices, length, fine))
    if not len(vertices):
        return []
    worst, more = int(np.argmin(fine)), f" (and {len(vertices) - 1} more)" if len(vertices) > 1 else ""
    return [
        f"the corner of {np.degrees(opening[vertices[worst]]):.0f}° between supported edges at vertex "
        f"{vertices[worst]}{more} has unbounded moments, for which edges of {length[worst]:.2g} m are long: "
        f"refine the mesh towards it, to {fine[worst]:.1g} m"
    ]


def _openings(triangles: Ints, size: Array, n: int) -> Array:
    """Sum (n,) [rad] of the rest angles around each vertex of triangles with edge lengths ``size`` (F, 3)."""
    square = size * size
    cosine = (square.sum(axis=1, keepdims=True) - 2.0 * square) * size
    cosine /= 2.0 * size.prod(axis=1, keepdims=True)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(np.bincount(triangles.ravel(), angle.ravel(), n), dtype=np.float64)


def _sides(rest: RestShape, triangles: Ints, number: Ints) -> Sides:
    """The sides of ``triangles`` (F, 3), whose edges opposite the corners have the numbers (F, 3)."""
    mesh, scene = rest.mesh, rest.scene
    axes, ends = np.zeros((mesh.n_vertices, 3), dtype=bool), triangles[:, [[1, 2], [2, 0], [0, 1]]]
    slope = np.zeros(triangles.shape, dtype=bool)
    for i, handle in enumerate(scene.handles):
        held = select_vertices(mesh, handle, key=f"handles[{i}]", file=scene.source)
        if is_exact(handle):
            axes[held[:, None], list(handle.axis_numbers)] = True
        if handle.holds_slope:
            slope |= np.isin(ends, held).all(axis=2)
    x = mesh.positions[triangles]
    normal = unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]))
    across = np.sum(axes[ends] * normal[:, None, None, :] ** 2, axis=3)
    boundary = np.bincount(number.ravel())[number] == 1
    return Sides(ends, boundary, (across > 0.9).all(axis=2), slope)
