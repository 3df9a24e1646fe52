"""Data types of meshes on rank 0 during set-up: a source as read (`Sheet`), and the whole mesh (`Mesh`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask


@dataclass
class Group:
    """A named group of the mesh: a physical group of gmsh, a group of an .obj file, or a sheet.

    Attributes
    ----------
    dimension : int
        0 points, 1 curves, 2 surfaces.
    vertices : (n,) int64
        Vertices, ascending, each once.
    triangles : (m,) int64
        Triangles of a surface group, else empty.
    edges : (k, 2) int64
        Edges of a curve group as pairs of vertices, else empty.
    """

    dimension: int
    vertices: Ints
    triangles: Ints
    edges: Ints


@dataclass(frozen=True)
class Source:
    """One source of a mesh: its name or file name, and its numbers of vertices and triangles."""

    label: str
    n_vertices: int
    n_triangles: int


class FrameSums(NamedTuple):
    """Times (T,) float64 [s] of frames, and check sums (T,) int64 of their positions."""

    time: Array
    sums: Ints


class TriangleSurface(NamedTuple):
    """Points (n, 3) float64 [m], and triangles (m, 3) int64 as indices of points."""

    points: Array
    triangles: Ints


@dataclass
class Mesh:
    """Triangle mesh of all sheets of a scene.

    Attributes
    ----------
    positions : (V, 3) float64
        Start positions [m], after the transform of the source.
    rest : (V, 3) float64
        Rest positions [m]: the scaled mesh; in a sheet with ``vt`` the ``vt`` with z = 0 if each vertex has
        one ``vt``, else (at seams) the scaled mesh.
    triangles : (F, 3) int64
        Vertices of each triangle, consistently oriented within a sheet.
    triangle_uv : (F, 3, 2) float64
        Material coordinates [m] of the corners of each triangle; the first axis is the warp. They are the
        ``vt``, or without ``vt`` coordinates in the plane of the rest triangle
        (`measures.plane_coordinates`).
    flat_rest : (F,) bool
        Whether the rest shape is flat by definition, as with ``vt``: rest angles are 0.
    groups : dict[str, Group]
        Named groups; names are unique over all sources (`build.build_mesh`).
    notes : list[str]
        Lines for the user on what was repaired or dropped.
    has_uv : bool
        Whether any sheet has ``vt``.
    sources : list of Source
        Sources in the order of their vertices.
    tags : (V,) int64 or None
        Node tags of .msh files, 0 for other sources; None if all tags are 1, 2, 3, ….
    obstacles : dict of str to TriangleSurface
        Obstacles of the scene that are meshes, at t = 0; not part of the sheets.
    frames : dict of str to FrameSums
        What frames of obstacles and handles were, by their keys.
    coincident : (n, 2) int64
        Vertices of one source that coincide at the start without being connected: each with the lowest one
        there.
    tied : (n, 2) int64
        Pairs of vertices that seams hold together although they are not one: they may coincide.
    unconnected : str
        Text for the user on these and those of different sources; empty if there are none.
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
    frames: dict[str, FrameSums] = field(default_factory=dict)
    coincident: Ints = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    tied: Ints = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    unconnected: str = ""

    @property
    def n_vertices(self) -> int:
        return len(self.positions)

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)


class ElementBlock(NamedTuple):
    """Elements of one type, as read from a source.

    Attributes
    ----------
    kind : int
        gmsh element type.
    nodes : (n, corners) int64
        Tags of the corner nodes.
    entity : (n,) int64
        Tag of the geometrical entity.
    groups : (m, 2) int64
        For each membership in a physical group the element (index in the block) and the tag of the group.
    """

    kind: int
    nodes: Ints
    entity: Ints
    groups: Ints


@dataclass
class NamedSet:
    """A group as read from a source.

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
    """Vertices and triangles of one source, before checks and transform.

    Attributes
    ----------
    points : (V, 3) float64
        Positions in units of the file.
    triangles : (F, 3) int64
    uv : (F, 3, 2) float64 or None
        ``vt`` [m] of the corners of each triangle, if the file has any.
    groups : list of NamedSet
    notes : list of str
        Lines for the user on what the reader dropped or split.
    tags : (V,) int64 or None
        Node tags of the file, unless they are 1, 2, 3, ….
    """

    points: Array
    triangles: Ints
    uv: Array | None = None
    groups: list[NamedSet] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tags: Ints | None = None
