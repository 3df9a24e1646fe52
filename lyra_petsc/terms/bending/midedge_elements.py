"""The triangles that bend by ``midedge`` and their constants, from the rest shape (rank 0)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.values import AXES
from lyra_petsc.terms.bending import midedge_mesh
from lyra_petsc.terms.bending.hinge_energy import fading_limit
from lyra_petsc.terms.bending.midedge_geometry import (
    NO_REST_ROTATION,
    curvatures_of_tangents,
    director_angles,
    edge_normals,
    mean_directors,
    normals_of,
)
from lyra_petsc.terms.bending.midedge_shape import tangents_at, unit
from lyra_petsc.terms.rest import RestShape

LARGEST_FOLD = np.radians(89.95)
"""Angle [rad] of a director at the start from which a scene is refused: the direction of the fold would
depend on round-off."""


def edge_numbers(rest: RestShape, triangles: Ints) -> tuple[Ints, NDArray[np.int8]]:
    """Numbers (F, 3) of the edges opposite the corners of triangles (F, 3), and their signs (F, 3).

    A sign is 1 where the triangle runs along the edge from the smaller vertex number, else −1.
    """
    tail, head = triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]
    n = rest.mesh.n_vertices
    keys = rest.edges[:, 0] * n + rest.edges[:, 1]
    number = np.searchsorted(keys, np.minimum(tail, head) * n + np.maximum(tail, head))
    return number, np.where(tail < head, 1, -1).astype(np.int8)


def elements(rest: RestShape) -> Elements:
    """All triangles whose material bends by this model, with their constants (rank 0).

    Raises
    ------
    InputError
        If the start shape is folded by 180° at an edge and the rest shape is not, or the rest curvature is
        too large for the mesh.
    """
    chosen = np.flatnonzero(rest.bends_with("midedge"))
    mesh, triangles = rest.mesh, rest.mesh.triangles[chosen]
    number, sign = edge_numbers(rest, triangles)
    edges, n_edges = rest.edges, len(rest.edges)
    material = np.linalg.inv(rest.inverse[chosen]).transpose(0, 2, 1)  # x1 − x0, x2 − x0
    size, area = edge_normals(material)[1], rest.area[chosen]
    curvature = curvatures_of_tangents(material)
    stiffness = np.array([shell.plate_matrix for shell in rest.shells])[rest.shell_of[chosen]]
    elastic = area * rest.per_triangle("elastic_share")[chosen]
    form = elastic[:, None, None] * np.einsum("eki,ekl,elj->eij", curvature, stiffness, curvature)
    rest.notes += midedge_mesh.narrow_sheet_notes(rest, chosen, number, size, area)
    rest.notes += midedge_mesh.corner_notes(rest, chosen, number, size, area)
    # the edge of a seam may have different lengths in its two triangles
    count = np.bincount(number.ravel(), minlength=n_edges)
    length = np.bincount(number.ravel(), size.ravel(), n_edges) / np.maximum(count, 1)

    surface = ~mesh.flat_rest[chosen]
    angle = np.zeros_like(size)  # ᾱ
    if surface.any():
        # where three or more triangles meet the first one keeps its normal as director
        on_surface = triangles[surface], number[surface]
        director = mean_directors(mesh.rest, *on_surface, n_edges, NO_REST_ROTATION, limit=2)
        _align_with_symmetry(director, rest, triangles, number, mesh.rest)
        angle[surface] = _angles_at(mesh.rest, triangles[surface], director[number[surface]])
        rest.notes += midedge_mesh.coarse_surface_notes(rest, chosen, number, size, curvature, angle)
    if rest.scene.seams:
        sewn = _of_edges(rest, ~np.isnan(rest.seam_angles), 0.5 * rest.seam_angles, np.nan)[number]
        angle = np.where(np.isnan(sewn), angle, sewn)
    rest_rotation = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    rest_tangent = np.zeros_like(size)
    curved = np.array([shell.rest_curvature or (0.0, 0.0, 0.0) for shell in rest.shells]) * [1.0, 1.0, 2.0]
    if curved.any():
        rest_tangent[:] = np.linalg.solve(curvature, curved[rest.shell_of[chosen]][:, :, None])[:, :, 0]
        _check_rest_curvature(rest_tangent, rest, chosen, size)
    director = mean_directors(mesh.positions, triangles, number, n_edges, rest_rotation)
    if rest.scene.creases or rest.scene.seams:
        _release_creases(form, director, rest, chosen, number, rest_rotation)
    _align_with_symmetry(director, rest, triangles, number, mesh.positions)
    director = director[number]
    _check_folds(_angles_at(mesh.positions, triangles, director) - angle, number, edges, rest)
    ends: Array = mesh.positions[edges[number]]
    data = {
        "stiffness": np.stack([form[:, i, j] for i in range(3) for j in range(i, 3)], axis=1),
        "rest": rest_tangent,
        "rest_rotation": rest_rotation,
        "sign": sign,
        "length": length[number],
        "direction": unit(ends[:, :, 1] - ends[:, :, 0]),
        "director": director,
        "material": material,
        "triangle": chosen.astype(np.int32),
        "height": 2.0 * area / size.max(axis=1),
        "limit": fading_limit(area),
        "damping": rest.per_triangle("damping")[chosen],
    }
    return Elements(triangles, data, edges=number)


def _release_creases(
    form: Array, director: Array, rest: RestShape, chosen: Ints, number: Ints, rotation: Array
) -> None:
    """Let triangles ``chosen`` (F,) with edges ``number`` (F, 3) end at creases as at free edges, in place.

    Each of the two triangles at a crease would have a director of its own there, which its forms (F, 3, 3)
    no longer contain (`condense_creases`). The one director (n_edges, 3) that there is turns with the first
    triangle, whose form keeps its square alone, and is without energy in equilibrium.
    """
    first = _first_triangles_at_creases(rest)
    sides = first[number] == chosen[:, None]
    face, side = np.nonzero(sides)
    square = form[face, side, side].copy()
    condense_creases(form, rest, number)
    form[face, side, side] = square
    x, triangles = rest.mesh.positions, rest.mesh.triangles[chosen]
    own = np.where(sides, number, len(rest.edges))
    alone = mean_directors(x, triangles, own, len(rest.edges) + 1, rotation)
    director[number[sides]] = alone[number[sides]]


def _first_triangles_at_creases(rest: RestShape) -> Ints:
    """The first triangle at each edge of the mesh, (n_edges,); −1 for edges that are no creases."""
    return _of_edges(rest, rest.own_bending, rest.hinges.triangles[:, 0], -1)


def _of_edges(rest: RestShape, chosen: Mask, values: NDArray[Any], missing: float) -> NDArray[Any]:
    """The values (H,) of the chosen hinges (H,) on all edges of the mesh, (n_edges,)."""
    keys = rest.edges[:, 0] * rest.mesh.n_vertices + rest.edges[:, 1]
    low, high = np.sort(rest.hinges.vertices[chosen, :2], axis=1).T
    out = np.full(len(rest.edges), missing, dtype=values.dtype)
    out[np.searchsorted(keys, low * rest.mesh.n_vertices + high)] = values[chosen]
    return out


def condense_creases(form: Array, rest: RestShape, number: Ints) -> None:
    """Replace the forms (F, 3, 3) of triangles with edges ``number`` (F, 3) by their least values over the
    directors at creases, in place.
    """
    creased = _first_triangles_at_creases(rest)[number] >= 0
    for triangle in np.flatnonzero(creased.any(axis=1)):
        gone, kept = np.flatnonzero(creased[triangle]), np.flatnonzero(~creased[triangle])
        whole = form[triangle].copy()
        form[triangle] = 0.0
        to_gone = np.linalg.solve(whole[np.ix_(gone, gone)], whole[np.ix_(gone, kept)])
        form[triangle][np.ix_(kept, kept)] = whole[np.ix_(kept, kept)] - whole[np.ix_(kept, gone)] @ to_gone


def _align_with_symmetry(director: Array, rest: RestShape, triangles: Ints, number: Ints, x: Array) -> None:
    """Rotate directors (n_edges, 3) of edges in symmetry planes of handles into these planes, in place.

    A symmetry plane is given in the start shape. At other positions x (the rest shape) it is taken to have
    the same orientation relative to each triangle.
    """
    mesh = rest.mesh
    for index, handle in enumerate(rest.scene.handles):
        if handle.symmetry is None:
            continue
        held = select_vertices(mesh, handle, key=f"handles[{index}]", file=rest.scene.source)
        ends = triangles[:, [[1, 2], [2, 0], [0, 1]]]
        face, side = np.nonzero(np.isin(ends, held).all(axis=2))
        edges, corners = number[face, side], ends[face, side]

        def axes(at: Array, face: Ints = face, corners: Ints = corners) -> Array:
            """Edge, direction in the triangle normal to it, and normal, (n, 3, 3)."""
            normal, along = normals_of(at, triangles[face]), unit(at[corners[:, 1]] - at[corners[:, 0]])
            return np.stack([along, np.cross(normal, along), normal], axis=1)

        start, here = axes(mesh.positions), axes(x)
        plane = np.einsum("eik,ei->ek", here, start[:, :, AXES.index(handle.symmetry)])
        inside = unit(np.cross(plane, here[:, 0]))
        towards = np.sum(inside * director[edges], axis=1, keepdims=True)
        director[edges] = np.where(towards < 0.0, -inside, inside)


def _angles_at(x: Array, triangles: Ints, director: Array) -> Array:
    """Angles α (n, 3) [rad] of directors (n, 3, 3) of the edges of triangles (n, 3) at positions x."""
    return director_angles(x[triangles], director)[0]


def _check_folds(angle: Array, number: Ints, edges: Ints, rest: RestShape) -> None:
    """Refuse a start shape that is folded by nearly 180° relative to the rest shape at an edge."""
    fold = np.abs(np.remainder(angle.ravel() + np.pi, 2.0 * np.pi) - np.pi)
    folded = np.flatnonzero(~(fold < LARGEST_FOLD))
    if len(folded):
        a, b = edges[number.ravel()[folded[0]]]
        raise InputError(
            f"the start shape is folded by 179.9° or more at the edge of vertices {a} and {b}, the rest "
            "shape is not, and bending_model: midedge cannot tell to which side; open the fold (or, where "
            "sheets meet, turn one over), or take bending_model: hinge",
            file=rest.scene.source,
            key="mesh",
        )


def _check_rest_curvature(rest_tangent: Array, rest: RestShape, chosen: Ints, size: Array) -> None:
    """Refuse triangles ``chosen`` with edges ``size`` (n, 3) [m] if their tangents T̄ ``rest_tangent`` (n, 3)
    belong to angles beyond 180°.
    """
    largest, limit = np.abs(rest_tangent).max(axis=1), float(tangents_at(np.array(np.pi)))
    worst = int(largest.argmax())
    if largest[worst] > limit:
        raise InputError(
            f"turns triangle {chosen[worst]} by more than 180° against its edges, of up to "
            f"{size[worst].max():.3g} m, which no edge can; take a mesh finer by "
            f"{largest[worst] / limit:.2g}, or less curvature",
            file=rest.scene.source,
            key=f"material[{rest.shell_of[chosen[worst]]}].rest_curvature",
        )
