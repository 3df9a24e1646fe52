"""What the mesh of sheets that bend by directors does not resolve: notes for ``check`` and runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.materials.library import is_isotropic
from lyra_petsc.terms.midedge_shape import unit
from lyra_petsc.terms.prescribed_handles import is_exact
from lyra_petsc.terms.rest import RestShape

NARROW = 0.02
"""Part of the stiffness against twist from which on it is said that free edges would have less."""

CREASED = np.radians(30.0)
"""α of directors at rest, from which on an edge is a crease and no part of a smooth surface."""

CORNER = np.radians(20.0)
"""Turn of a boundary from which on it has a corner there, if it turns half as much beside it at most."""

OBTUSE = np.radians(100.0)
"""Angle between supported edges from which on moments in the corner matter."""

LOCAL = 1.8
"""Measured at the vertices of four triangles in spheres of two meshes."""

NOTABLE = 0.03
"""Error of a vertex's displacement from which on it is noted."""

UNRESOLVED, REENTRANT = 0.065, 0.008
"""(h/L)^p from which on it is said that edges h at a corner are long for a sheet of size L, below and beyond
180 degrees: about 1 % of the deflection of skew plates of 30 and 60 degrees, and of an L."""


class Sides(NamedTuple):
    """Of triangles, opposite their corners.

    Attributes
    ----------
    ends : (F, 3, 2) int64
        Vertices.
    alone : (F, 3) bool
        Whether no other of the triangles has the edge.
    supported, clamped : (F, 3) bool
        Whether handles hold it against deflection, and whether they keep its slope.
    """

    ends: Ints
    alone: Mask
    supported: Mask
    clamped: Mask


def coarse(
    rest: RestShape, chosen: Ints, number: Ints, size: Array, of_tangents: Array, angle: Array
) -> list[str]:
    """What to say of triangles ``chosen`` with these edges, their lengths (n, 3) [m], curvatures of tangents
    (n, 3, 3) and angles (n, 3) at rest.

    Flat triangles resolve a shell of thickness t and radius R with edges below √(t R); t = √(12 B / C) is
    that of a sheet of bending stiffness B and membrane stiffness C. Where walls meet they count as a crease:
    a smooth surface bends at most triangles about each corner.
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
    about = np.bincount(corners.ravel(), minlength=n), np.bincount(corners[bent].ravel(), minlength=n)
    bent &= (2 * about[1] > about[0])[corners].all(axis=1)
    coarse = bent & (largest * longest**2 > thickness)
    if not 2 * coarse.sum() > bent.sum():
        return _irregular(rest, chosen, number, size, np.where(bent, largest / thickness, 0.0))
    fine = float(np.median(np.sqrt(thickness[coarse] / largest[coarse])))
    return [
        f"{coarse.sum()} triangles are large for the curvature of their rest shape, with edges of "
        f"{np.median(longest[coarse]):.3g} m: flat triangles make such a shell too stiff, or too soft under "
        f"point loads, unless their edges are well below √(t R) = {fine:.3g} m"
    ]


def _irregular(rest: RestShape, chosen: Ints, number: Ints, size: Array, sharpness: Array) -> list[str]:
    """What to say of vertices where three or four triangles of a curved surface meet, among others where six
    do; ``sharpness`` (n,) is 1/(t R) [1/m²], 0 where the surface is flat.

    In a sphere under pressure p the tension of n alike triangles holds 3 p / (4 cos²(π/n)) a vertex, p where
    n = 6. The rest acts as a force on a point: of the shell's displacement the vertex lacks that force over
    p h² times ``LOCAL`` h²/(t R). Where vertices of four and eight triangles take turns, as in patterns of
    grids, the forces cancel.
    """
    mesh, triangles = rest.mesh, rest.mesh.triangles[chosen]
    n, sides = mesh.n_vertices, _sides(rest, triangles, number)

    def mean(values: Array) -> Array:
        """Mean (V,) of the values (F, 3) of sides at their ends."""
        count = np.maximum(np.bincount(sides.ends.ravel(), minlength=n), 1)
        return np.bincount(sides.ends.ravel(), np.repeat(values.ravel(), 2), n) / count

    opening = np.maximum(_openings(triangles, size, n), 1e-9)
    meet = 2.0 * np.pi / opening * np.bincount(triangles.ravel(), minlength=n)  # images by symmetry, too
    alone = mean(meet[sides.ends].sum(axis=2)) - meet < 7.0
    alone[sides.ends[sides.alone & ~sides.clamped]] = False
    found = np.flatnonzero(alone & (meet > 2.5) & (meet < 4.5))
    half = np.pi / meet[found]
    load = (0.75 / np.cos(half) ** 2 - 1.0) * np.sin(2.0 * half) / 6.0 * meet[found]
    error = LOCAL * load * (mean(size) ** 2 * mean(np.repeat(sharpness[:, None], 3, axis=1)))[found]
    if not (error > NOTABLE).any():
        return []
    worst = int(np.argmax(error))
    count = np.sum(error > NOTABLE)
    more = f" (and {count - 1} more)" if count > 1 else ""
    return [
        f"at vertex {found[worst]}{more} only {meet[found[worst]]:.0f} triangles of a curved shell meet: "
        f"under pressure it moves by about {min(error[worst], 1.0):.0%} too little; let five to seven meet, "
        "or refine"
    ]


def narrow(rest: RestShape, chosen: Ints, number: Ints, size: Array, area: Array) -> list[str]:
    """What to say of sheets with free edges that are hardly wider than thick.

    Beside a free edge a shell of thickness t twists as if 0.315 t of its width were missing, which needs
    transverse shear: a strip of width b has the torsional stiffness G b t³/3 (1 − 0.63 t/b).

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
    _, alone, supported, clamped = _sides(rest, rest.mesh.triangles[chosen], number)
    free = alone & ~supported & ~clamped
    lost = 0.315 * float(thickness @ np.sum(size * free, axis=1)) / float(area[thickness > 0.0].sum() or 1.0)
    if lost < NARROW:
        return []
    return [
        f"sheets as thick for their width as these resist twist by {lost:.0%} too much: without transverse "
        "shear, which is left out, they are not softer beside free edges"
    ]


def corners(rest: RestShape, chosen: Ints, number: Ints, size: Array, area: Array) -> list[str]:
    """What to say of obtuse corners between supported edges of triangles ``chosen`` with these edges, their
    lengths (n, 3) and areas (n,).

    At a corner of angle ω moments grow as r^(π/ω − 2), or r^(−π/ω) where it is re-entrant, and deflections
    converge with the power p = 2 |1 − π/ω| of the length of edges there. A polygon in place of a curve turns
    alike at neighbouring vertices and has no such corners.

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
    found = np.flatnonzero(simple & (opening > OBTUSE) & (turn > np.maximum(CORNER, 2.0 * nearby)))
    length = 0.5 * np.bincount(ends[boundary].ravel(), np.repeat(size[boundary], 2), n)[found]
    part = np.where(opening[found] < np.pi, UNRESOLVED, REENTRANT)
    fine = np.sqrt(area.sum()) * part ** (0.5 / np.abs(1.0 - np.pi / opening[found]))
    long = length > 1.5 * fine
    found, length, fine = (values[long] for values in (found, length, fine))
    if not len(found):
        return []
    worst, more = int(np.argmin(fine)), f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return [
        f"the corner of {np.degrees(opening[found[worst]]):.0f}° between supported edges at vertex "
        f"{found[worst]}{more} has unbounded moments, for which edges of {length[worst]:.2g} m are long: "
        f"refine the mesh towards it, to {fine[worst]:.1g} m"
    ]


def _openings(triangles: Ints, size: Array, n: int) -> Array:
    """Sum (n,) of the angles at rest of triangles with edges ``size`` (F, 3) [m] about each vertex."""
    square = size * size
    cosine = (square.sum(axis=1, keepdims=True) - 2.0 * square) * size
    cosine /= 2.0 * size.prod(axis=1, keepdims=True)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(np.bincount(triangles.ravel(), angle.ravel(), n), dtype=np.float64)


def _sides(rest: RestShape, triangles: Ints, number: Ints) -> Sides:
    """Of ``triangles`` (F, 3), whose edges opposite corners have the numbers (F, 3)."""
    mesh, scene = rest.mesh, rest.scene
    axes, ends = np.zeros((mesh.n_vertices, 3), dtype=bool), triangles[:, [[1, 2], [2, 0], [0, 1]]]
    slope = np.zeros(triangles.shape, dtype=bool)
    for place, handle in enumerate(scene.handles):
        held = select_vertices(mesh, handle, key=f"handles[{place}]", file=scene.source)
        if is_exact(handle):
            axes[held[:, None], list(handle.axis_numbers)] = True
        if handle.holds_slope:
            slope |= np.isin(ends, held).all(axis=2)
    x = mesh.positions[triangles]
    normal = unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]))
    across = np.sum(axes[ends] * normal[:, None, None, :] ** 2, axis=3)
    alone = np.bincount(number.ravel())[number] == 1
    return Sides(ends, alone, (across > 0.9).all(axis=2), slope)
