"""Selection of vertices and triangles by group, number or box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lyra_petsc.arrays import Ints, Mask
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.mesh.mesh import Group, Mesh
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.scene.vertex_choice import VertexChoice

DIMENSION_NAMES = ("point", "curve", "surface", "volume")


def select_vertices(mesh: Mesh, selector: VertexChoice, *, key: str, file: object | None = None) -> Ints:
    """Vertices that a selector names, ascending, each once.

    Parameters
    ----------
    mesh : Mesh
    selector : VertexChoice
        A group, numbers or a box; the box includes its faces, with a tolerance of 1e-9 of the mesh's size.
    key : str
        The key of the selector in the scene, for messages (``handles[0]``).
    file : optional
        The scene file, for messages.

    Returns
    -------
    (n,) int64

    Raises
    ------
    InputError
        Unknown group, vertex out of range, or no vertex in the box.
    """
    if selector.group is not None:
        return find_group(mesh, selector.group, key=f"{key}.group", file=file).vertices
    if selector.nodes is not None:
        return _check_numbers(mesh, selector.nodes, key=f"{key}.nodes", file=file)
    assert selector.box is not None
    return _vertices_in_box(mesh, selector.box, key=f"{key}.box", file=file)


def select_triangles(mesh: Mesh, group: str | None, *, key: str, file: object | None = None) -> Ints:
    """Triangles of a surface group, ascending; all triangles for ``None``.

    Raises
    ------
    InputError
        Unknown group, or a group of points or curves.
    """
    if group is None:
        return np.arange(mesh.n_triangles, dtype=np.int64)
    surface = find_group(mesh, group, key=key, file=file)
    if surface.dimension != 2:
        surfaces = [name for name, candidate in mesh.groups.items() if candidate.dimension == 2]
        raise InputError(
            f"group '{group}' is a {DIMENSION_NAMES[surface.dimension]} group and has no triangles; "
            f"surface groups: {first_few(sorted(surfaces), 20) or 'none'}",
            key=key,
            file=file,
        )
    return surface.triangles


def in_group(mesh: Mesh, edges: Ints, group: str, *, key: str, file: object | None = None) -> Mask:
    """Whether edges (n, 2) of the mesh are in a group, (n,): in one of curves; of others with both ends.

    Raises
    ------
    InputError
        Unknown group.
    """
    named = find_group(mesh, group, key=key, file=file)
    if named.dimension != 1:
        return np.asarray(np.isin(edges, named.vertices).all(axis=1))
    keys = [pairs.min(axis=1) * mesh.n_vertices + pairs.max(axis=1) for pairs in (edges, named.edges)]
    return np.isin(*keys)


def find_group(mesh: Mesh, name: str, *, key: str, file: object | None = None) -> Group:
    """The group of this name.

    Raises
    ------
    InputError
        No such group; the message gives the most similar name and all names.
    """
    if name in mesh.groups:
        return mesh.groups[name]
    raise InputError(f"no group '{name}' in the mesh; {suggest(name, mesh.groups)}", key=key, file=file)


def _check_numbers(mesh: Mesh, nodes: Sequence[int], *, key: str, file: object | None) -> Ints:
    wrong = [node for node in nodes if node >= mesh.n_vertices]
    if wrong:
        raise InputError(
            f"no vertex {first_few(wrong)}; the mesh has vertices 0 to {mesh.n_vertices - 1}",
            key=key,
            file=file,
        )
    return np.unique(np.asarray(nodes, dtype=np.int64))


def _vertices_in_box(mesh: Mesh, box: Sequence[Sequence[float]], *, key: str, file: object | None) -> Ints:
    corners = np.asarray(box, dtype=np.float64)
    tolerance = 1e-9 * bounding_diagonal(mesh.positions)
    low, high = corners.min(axis=0) - tolerance, corners.max(axis=0) + tolerance
    inside = np.flatnonzero(((mesh.positions >= low) & (mesh.positions <= high)).all(axis=1))
    if inside.size == 0:
        first, last = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
        span = " to ".join("[" + ", ".join(f"{x:.6g}" for x in point) + "]" for point in (first, last))
        raise InputError(f"no vertex lies in the box; the mesh spans {span}", key=key, file=file)
    return inside.astype(np.int64)
