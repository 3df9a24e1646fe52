"""Numbering of points over ranks, owned and ghost points of a rank, and the layout of unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints, Mask


@dataclass(frozen=True)
class Numbering:
    """Global numbering of one kind of point on rank 0: contiguous per rank.

    Attributes
    ----------
    owner : (N,) int64
        Owning rank of each point of the mesh.
    number : (N,) int64
        New global number of each; rank r owns ``bounds[r]`` to ``bounds[r + 1]``.
    bounds : (ranks + 1,) int64
    """

    owner: Ints
    number: Ints
    bounds: Ints

    @classmethod
    def build(cls, owner: Ints, position: Ints, n_ranks: int) -> Numbering:
        """Number by owner, within an owner by ``position`` (N,), an order that keeps neighbours near."""
        order = np.lexsort((position, owner))
        number = np.empty(len(owner), dtype=np.int64)
        number[order] = np.arange(len(owner))
        bounds = np.zeros(n_ranks + 1, dtype=np.int64)
        np.cumsum(np.bincount(owner, minlength=n_ranks), out=bounds[1:])
        return cls(owner, number, bounds)


class Points:
    """Points of one kind on a rank: owned first, then ghosts (others' points that its elements touch).

    Parameters
    ----------
    comm : MPI.Comm
    bounds : (ranks + 1,) int64
        First global number of each rank's points, and N.
    ghosts : (n_ghost,) int64
        Global numbers of the ghosts, in any order.
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, ghosts: Ints) -> None:
        self.comm, self.bounds, self.ghosts = comm, bounds, ghosts
        self.n_global = int(bounds[-1])
        self.start = int(bounds[comm.rank])
        self.n_owned = int(bounds[comm.rank + 1]) - self.start
        self.n_local = self.n_owned + len(ghosts)
        ranks = np.searchsorted(bounds, ghosts, side="right") - 1
        remote = np.column_stack([ranks, ghosts - bounds[ranks]]).astype(PETSc.IntType)
        self._forest = PETSc.SF().create(comm)
        self._forest.setGraph(self.n_owned, None, remote)
        types = {np.dtype(np.float64): MPI.DOUBLE, np.dtype(np.float32): MPI.FLOAT}
        self._triples = {kind: unit.Create_contiguous(3).Commit() for kind, unit in types.items()}

    @property
    def global_number(self) -> Ints:
        """Global number of each local point, (n_local,)."""
        owned = np.arange(self.start, self.start + self.n_owned, dtype=np.int64)
        return np.concatenate([owned, self.ghosts])

    def local(self, numbers: Ints) -> Ints:
        """Local numbers of points given by their global ones, all of them owned or ghosts."""
        end = self.start + self.n_owned
        order = np.argsort(self.ghosts, kind="stable")
        inside = (numbers >= self.start) & (numbers < end)
        found = np.searchsorted(self.ghosts, np.where(inside, -1, numbers), sorter=order)
        ghost = order[np.minimum(found, len(order) - 1)] if len(order) else found
        return np.where(inside, numbers - self.start, self.n_owned + ghost)

    def update_ghosts(self, values: Array | NDArray[np.float32]) -> None:
        """Copy the owners' rows of ``values`` (n_local, 3) into the ghost rows; collective."""
        if self.comm.size == 1:
            return
        owned, ghosts = values[: self.n_owned], values[self.n_owned :]
        triple = self._triples[values.dtype]
        self._forest.bcastBegin(triple, owned, ghosts, MPI.REPLACE)
        self._forest.bcastEnd(triple, owned, ghosts, MPI.REPLACE)

    def add_to_owners(self, values: Array | NDArray[np.float32]) -> None:
        """Add the ghost rows of ``values`` (n_local, 3) to the owners' rows; collective."""
        if self.comm.size == 1:
            return
        wide = values.astype(np.float64)  # PETSc has no sums of single precision
        owned, ghosts = wide[: self.n_owned], wide[self.n_owned :]
        triple = self._triples[wide.dtype]
        self._forest.reduceBegin(triple, ghosts, owned, MPI.SUM)
        self._forest.reduceEnd(triple, ghosts, owned, MPI.SUM)
        values[: self.n_owned] = owned

    def summed(self, *numbers: float) -> Array:
        """Sums over all ranks of each rank's numbers; collective."""
        sums = np.array(numbers)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def largest(self, *numbers: float) -> list[float]:
        """The largest of all ranks' each of the numbers; collective."""
        if self.comm.size == 1:
            return list(numbers)
        most = np.array(numbers, dtype=np.float64)
        self.comm.Allreduce(MPI.IN_PLACE, most, MPI.MAX)
        return most.tolist()

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        self._forest.destroy()
        for triple in self._triples.values():
            triple.Free()


@dataclass(frozen=True)
class Unknowns:
    """What the block rows of all ranks hold.

    Attributes
    ----------
    n_vertices, n_edges : (ranks,) int64
        Vertices, and edges that carry an unknown, of each rank.
    vertices : (n,) int64
        Index in the mesh of each vertex of this rank.
    edges : (n,) int64
        Of each edge of this rank, its position among the edges that carry an unknown, in the mesh's order.
    """

    n_vertices: Ints
    n_edges: Ints
    vertices: Ints
    edges: Ints


class Layout(Points):
    """Unknowns of a scene in block rows of three: the coordinates of a vertex, or the unknowns of three
    edges.

    Each rank owns the rows of its vertices first, then those of its edges; the last of these may end with
    unknowns that nothing uses (`padding`), which solvers hold at zero. An array over the local rows (n_local,
    3) has the unknown of an edge at ``edge_places`` of its flat form. All unknowns have the unit of a length:
    an angle on an edge is stored times the rest length of the edge, so that its force is a moment per length
    [N].

    Parameters
    ----------
    comm, bounds, ghosts
        As for `Points`, of block rows.
    unknowns : Unknowns

    Attributes
    ----------
    n_vertices, n_edges : int
        That this rank owns; vertices are its rows 0 to n_vertices.
    n_vertices_global, n_edges_global : int
    original, edges : (n_vertices,), (n_edges,) int64
        Their positions in files: among the mesh's vertices, and among its edges that carry an unknown.
    edge_places, padding : (n_edges,), (m,) int64
        Of edge unknowns, and of unused ones, in the flat form of an array of owned rows.
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, ghosts: Ints, unknowns: Unknowns) -> None:
        super().__init__(comm, bounds, ghosts)
        self.unknowns = unknowns
        self.n_vertices, self.n_edges = (int(n[comm.rank]) for n in (unknowns.n_vertices, unknowns.n_edges))
        self.n_vertices_global, self.n_edges_global = (
            int(unknowns.n_vertices.sum()),
            int(unknowns.n_edges.sum()),
        )
        self.original, self.edges = unknowns.vertices, unknowns.edges
        first = 3 * self.n_vertices
        self.padding: Ints = np.arange(first + self.n_edges, 3 * self.n_owned)

    @property
    def edge_places(self) -> Ints:
        return 3 * self.n_vertices + np.arange(self.n_edges)

    @property
    def n_unknowns(self) -> int:
        """Unknowns of all ranks: three of each vertex, one of each edge that carries one."""
        return 3 * self.n_vertices_global + self.n_edges_global

    def with_ghosts(self, more: Ints) -> Layout:
        """The same rows with further ghosts (n,) after the present ones, which keep their local numbers."""
        return Layout(self.comm, self.bounds, np.concatenate([self.ghosts, more]), self.unknowns)

    def split(self, rows: Array) -> tuple[Array, Array]:
        """What owned rows (n_owned, 3) hold of vertices (n_vertices, 3), and of edges (n_edges,)."""
        return rows[: self.n_vertices], rows.ravel()[self.edge_places]

    def joined(self, vertices: Array, edges: Array | None) -> Array:
        """Owned rows (n_owned, 3) of what is known of vertices and of edges."""
        if edges is None or self.n_owned == self.n_vertices:
            return vertices
        rows = np.zeros((self.n_owned, 3))
        rows[: self.n_vertices] = vertices
        rows.ravel()[self.edge_places] = edges
        return rows

    def gathered(self, owned: Array) -> Array:
        """Rows of the owned vertices (n_vertices or more, …) in the mesh's order (V, …), on every rank;
        collective.
        """
        pieces = self.comm.allgather((self.original, np.array(owned[: self.n_vertices])))
        out = np.empty((self.n_vertices_global, *owned.shape[1:]))
        for original, rows in pieces:
            out[original] = rows
        return out

    def in_mesh(self) -> Ints:
        """Position among the mesh's vertices of each local one, (n_local,), ghosts too; 0 of edges;
        collective.
        """
        known = np.zeros((self.n_local, 3))
        known[: self.n_vertices, 0] = self.original
        self.update_ghosts(known)
        return known[:, 0].astype(np.int64)

    def are_vertices(self, rows: Ints) -> Mask:
        """Which of these rows, given by global numbers, are vertices."""
        rank = np.searchsorted(self.bounds, rows, side="right") - 1
        return rows - self.bounds[rank] < self.unknowns.n_vertices[rank]

    @property
    def vertex_bounds(self) -> Ints:
        """First vertex (ranks + 1,) of each rank where vertices alone are numbered."""
        return np.concatenate([[0], np.cumsum(self.unknowns.n_vertices)]).astype(np.int64)

    def vertex_numbers(self, rows: Ints) -> Ints:
        """Numbers among vertices alone of vertices given by the global numbers of their rows."""
        rank = np.searchsorted(self.bounds, rows, side="right") - 1
        return rows - self.bounds[rank] + self.vertex_bounds[rank]
