"""The triangle mesh of a scene as it exists on rank 0 during set-up: one source of it, and the whole."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from lyra_petsc.arrays import Array, Ints, Mask


@dataclass
class Group:
    """A named set from the mesh (gmsh physical group, OBJ group, or a sheet's name).

    Attributes
    ----------
    dimension : int
        0 points, 1 curves, 2 surfaces.
    vertices : (n,) int64
        Its vertices, ascending, each once.
    triangles : (m,) int64
        Its triangles (dimension 2), else empty.
    edges : (k, 2) int64
        Its edges as vertex pairs (dimension 1), else empty.
    """

    dimension: int
    vertices: Ints
    triangles: Ints
    edges: Ints


@dataclass(frozen=True)
class Source:
    """One source of a mesh: its name or file, and its numbers of vertices and triangles."""

    label: str
    n_vertices: int
    n_triangles: int


class TriangleSurface(NamedTuple):
    """Points (n, 3) float64 [m], and the numbers (m, 3) int64 of those of each triangle."""

    points: Array
    triangles: Ints


@dataclass
class Mesh:
    """Triangle mesh of all sheets of a scene.

    Attributes
    ----------
    positions : (V, 3) float64
        Start positions [m], after the source's transform.
    rest : (V, 3) float64
        Rest surface [m]: the mesh as it stands after scaling; of a sheet with ``vt`` the
        ``vt`` with z = 0 where each vertex has one, else (seams) the scaled position.
    triangles : (F, 3) int64
        Vertices of each triangle, consistently oriented within a sheet.
    triangle_uv : (F, 3, 2) float64
        Material coordinates of each triangle's corners [m], in a frame whose first axis is
        the warp direction: the ``vt``, or for a sheet without, the rest triangle laid out in
        its own plane (first axis: x, or where the plane is nearly normal to x, y, projected
        into it; a sheet flat in xy gets its x, y).
    flat_rest : (F,) bool
        True where the rest shape is flat by definition (``vt`` given): rest angles are 0.
    groups : dict[str, Group]
        Named groups; names are unique over all sources (see ``build``).
    notes : list[str]
        What was repaired or dropped, one line each, for the user.
    has_uv : bool
        True if any sheet came with ``vt``.
    sources : list of Source
        In the order of the numbering.
    tags : (V,) int64 or None
        Node tags of .msh files, 0 elsewhere; None where they only count the vertices.
    obstacles : dict of str to TriangleSurface
        The scene's obstacles that are meshes, at t = 0; no part of the sheets.
    """

    positions: Array
    rest: Array
    triangles: Ints
    triangle_uv: Array
    flat_rest: Mask
    groups: dict[str, Group] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    has_uv: bool = False
    sources: list[Source] = field(default_factory=list)
    tags: Ints | None = None
    obstacles: dict[str, TriangleSurface] = field(default_factory=dict)

    @property
    def n_vertices(self) -> int:
        return len(self.positions)

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)


@dataclass
class NamedSet:
    """A group as read.

    Attributes
    ----------
    name : str
    dimension : int
        0 points, 1 curves, 2 surfaces.
    members : int64
        Points: vertices (n,); curves: vertex pairs (n, 2); surfaces: triangle indices (n,).
    """

    name: str
    dimension: int
    members: Ints


@dataclass
class Sheet:
    """Vertices and triangles of one source, before transform and checks.

    Attributes
    ----------
    points : (V, 3) float64
        As in the file.
    triangles : (F, 3) int64
    uv : (F, 3, 2) float64 or None
        ``vt`` of each triangle's corners [m], where the file has them.
    groups : list of NamedSet
    notes : list of str
        What the reader dropped or split.
    tags : (V,) int64 or None
        Numbers that the file itself gives its vertices, where they are not 1, 2, 3, …
    """

    points: Array
    triangles: Ints
    uv: Array | None = None
    groups: list[NamedSet] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tags: Ints | None = None
