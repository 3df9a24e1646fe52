"""Constants of the barrier from the scene, the same on all ranks, and marks of the triangles (rank 0)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import surface_shares
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.measures import edge_lengths
from lyra_petsc.mesh.obstacles import Container
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.mesh.symmetry import symmetry_walls
from lyra_petsc.mesh.topology import connected_pieces, edge_table
from lyra_petsc.scene.values import AXES
from lyra_petsc.terms.rest import RestShape

NEARLY_PARALLEL = 1e-3
"""Squared sine of the angle of two edges below which their energy is multiplied by the mollifier."""

HALFWAY_CURVATURE = 14.0
"""b″ / k in the middle of the gap."""

SAG = 0.01
"""Part of the gap by which a sheet's edges may sag between its vertices on a sphere or rod for the obstacle
to count as nearly flat: there, as on planes, vertices carry the contact, and edges and triangles have the gap
of two edges only, because their nearest points are not well defined."""

MIN_STRAIN = 0.01
"""Least strain of an edge under the force k · gap. With a softer barrier a small force would nearly close a
small gap, which takes Newton's method many iterations."""

AREA_UNITS = 1_000_000_000
"""Area factors of vertices are stored as multiples of 1 / `AREA_UNITS`: integers are sent to other ranks with
the triangles."""

MIN_AREA_FACTOR, MAX_AREA_FACTOR = 1e-3, 1e3
"""Bounds of the area factors."""

MAX_NARROWING = 1e6
"""Bound of the factor by which the gap is smaller at small triangles."""


class Barrier(NamedTuple):
    """Constants of the barrier, the same on all ranks.

    Attributes
    ----------
    gap, thickness : float [m]
    stiffness : float [N/m]
        k in the interior of a regular mesh.
    parallel : float
        Squared sine of the angle of edges below which their energy is mollified.
    flat : float
        Radius [m] of spheres and rods from which on they count as nearly flat (`SAG`).
    walls : tuple of Container
        Symmetry planes, one for each side with sheets.
    of_sheets : bool
        Whether sheets repel each other and themselves.
    static : bool
        Whether an equilibrium is computed.
    """

    gap: float
    thickness: float
    stiffness: float
    parallel: float
    flat: float = np.inf
    walls: tuple[Container, ...] = ()
    of_sheets: bool = True
    static: bool = False


def surface_elements(rest: RestShape) -> Elements:
    """The triangles of the sheets (rank 0)."""
    triangles = rest.mesh.triangles.astype(np.int64)
    rings, areas = surface_shares.rings(triangles), area_factors(triangles, rest.area)
    walled = []
    for wall in symmetry_walls(rest.scene, rest.mesh):
        acts = np.zeros(rest.mesh.n_vertices, dtype=np.int64)
        acts[wall.vertices] = 1
        walled.append(acts[triangles] @ (1 << np.arange(3)))
    narrow = np.rint(AREA_UNITS * _gap_and_narrowing(rest)[1]).astype(np.int64)[triangles]
    marks = np.column_stack([rings, areas, narrow, _plane_codes(rest), *walled])
    uv = rest.mesh.triangle_uv.reshape(-1, 6)
    return Elements(rest.mesh.triangles, {"uv": uv, "marks": marks.astype(np.float64)})


def area_factors(triangles: Ints, area: Array) -> Ints:
    """Factors of k, in units of 1 / `AREA_UNITS`, for pairs of the corners of triangles (F, 3): the area of a
    vertex over its mean in a regular mesh with as many triangles as the sheet.

    An even pressure so leads to the same distance everywhere, whatever the size of the triangles. With the
    mean over all sheets the few vertices of a coarse sheet would carry most of the load of a fine one on it,
    and friction would oscillate.
    """
    sheet = connected_pieces(triangles)
    mean = np.bincount(sheet, area) / np.bincount(sheet)
    of_vertex = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3))
    factor = np.clip(of_vertex[triangles] / (2.0 * mean[sheet])[:, None], MIN_AREA_FACTOR, MAX_AREA_FACTOR)
    return np.rint(AREA_UNITS * factor).astype(np.int64)


def _plane_codes(rest: RestShape) -> Ints:
    """For each triangle (F,) the bits 3 i + k: whether corner i lies in a symmetry plane normal to axis k.

    Edges in a symmetry plane belong to both halves of the sheet, and so their energy counts by half.
    """
    on_planes = np.zeros((rest.mesh.n_vertices, 3), dtype=np.int64)
    for number, handle in enumerate(rest.scene.handles):
        if handle.symmetry is not None:
            held = select_vertices(rest.mesh, handle, key=f"handles[{number}]", file=rest.scene.source)
            on_planes[held, AXES.index(handle.symmetry)] = 1
    codes: Ints = on_planes[rest.mesh.triangles].reshape(-1, 9) @ (1 << np.arange(9))
    return codes


def barrier(rest: RestShape) -> Barrier:
    """The constants of a scene's barrier (rank 0).

    Raises
    ------
    InputError
        If the gap is so large that neighbours in most of the mesh would repel each other.
    """
    scene = rest.scene
    assert scene.contact is not None
    length, thickness = edge_lengths(rest.mesh), scene.contact.thickness
    (gap, narrowing), shortest = _gap_and_narrowing(rest), _low(length.min(axis=1))
    if gap + thickness >= shortest:
        raise InputError(
            f"gap + thickness = {gap + thickness:.3g} m is not below the shorter edges, {shortest:.3g} m: "
            "neighbours in the mesh would touch; give smaller ones, or a coarser mesh",
            file=scene.source,
            key="contact",
        )
    if (narrowing > 1.0).any():
        rest.notes.append(
            f"contact: gap {gap:.3g} m, but less at {np.count_nonzero(narrowing > 1.0)} vertices of "
            f"triangles with short sides or heights, down to {gap / narrowing.max():.3g} m at vertex "
            f"{narrowing.argmax()}"
        )
    stiffness = max(max(shell.c11, shell.c22) for shell in rest.shells)
    stiffness *= max(1.0 / HALFWAY_CURVATURE, MIN_STRAIN * float(length.mean()) / gap)
    flat = float(length.max()) ** 2 / (8.0 * SAG * gap)
    walls = tuple(wall.container for wall in symmetry_walls(scene, rest.mesh))
    acts = scene.contact.self, scene.time.static
    return Barrier(gap, thickness, stiffness, NEARLY_PARALLEL, flat, walls, *acts)


def _gap_and_narrowing(rest: RestShape) -> tuple[float, Array]:
    """The gap [m] of a scene with contact, and for each vertex (V,) the factor >= 1 by which gap and
    thickness are less.

    Vertices of triangles that are smaller than gap and thickness would else repel their neighbours in the
    mesh at rest.
    """
    contact, factor = rest.scene.contact, np.ones(rest.mesh.n_vertices)
    assert contact is not None
    length = edge_lengths(rest.mesh)
    side = length.min(axis=1)
    height = _least_heights(rest, length) if contact.self else np.full(len(side), np.inf)
    gap = contact.gap or min(0.25 * float(length.mean()), 0.5 * _low(side), 0.7 * _low(height))
    if contact.self:
        reach = gap + contact.thickness
        small = np.flatnonzero(np.minimum(side, height) <= reach)
        needed = np.minimum(reach / np.minimum(0.5 * side, 0.7 * height)[small], MAX_NARROWING)
        np.maximum.at(factor, rest.mesh.triangles[small], needed[:, None])
    return gap, factor


def _low(values: Array) -> float:
    """A low percentile of the values (F,) of triangles, which few bad ones do not decide."""
    order = max(len(values) // 20, min(2, len(values) // 4))
    return float(np.partition(values, order)[order])


def _least_heights(rest: RestShape, length: Array) -> Array:
    """Least distance (F,) [m] of a corner of each triangle from those behind its opposite side, in the flat
    rest shape; infinite if there are none. ``length`` (F, 3) [m] are the sides.
    """
    table = edge_table(rest.mesh.triangles.astype(np.int64))
    at_side = np.empty(length.size, dtype=np.int64)
    at_side[table.sides] = np.repeat(table.sizes, table.sizes)
    square, height = length**2, 2.0 * rest.area[:, None] / length
    others = np.abs(np.roll(square, 1, axis=1) - np.roll(square, -1, axis=1))
    inner = (at_side.reshape(-1, 3) > 1) & (others <= square)  # the foot of the height is on the side
    return np.where(inner, height, np.inf).min(axis=1)
