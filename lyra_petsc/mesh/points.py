"""Global numbering of points over the ranks, owned and ghost points of a rank, layout of the unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints, Mask

Result = TypeVar("Result")

TIE = 1e-6
"""Relative difference up to which two sizes count as equal."""


@dataclass(frozen=True)
class Numbering:
    """Global numbering, contiguous per rank, of all points of one kind; exists on rank 0.

    Attributes
    ----------
    owner : (N,) int64
        Owning rank of each point of the mesh.
    number : (N,) int64
        Global number of each point.
    bounds : (ranks + 1,) int64
        Rank r owns the numbers from ``bounds[r]`` to before ``bounds[r + 1]``.
    """

    owner: Ints
    number: Ints
    bounds: Ints

    @classmethod
    def build(cls, owner: Ints, position: Ints, n_ranks: int) -> Numbering:
        """Number points by ``owner`` (N,), then by ``position`` (N,), as of `partitioner.locality_order`."""
        order = np.lexsort((position, owner))
        number = np.empty(len(owner), dtype=np.int64)
        number[order] = np.arange(len(owner))
        bounds = np.zeros(n_ranks + 1, dtype=np.int64)
        np.cumsum(np.bincount(owner, minlength=n_ranks), out=bounds[1:])
        return cls(owner, number, bounds)


class Points:
    """Points of one kind on a rank: the owned ones first, then the ghosts.

    Ghosts are points of other ranks that elements of this rank couple.

    Parameters
    ----------
    comm : MPI.Comm
    bounds : (ranks + 1,) int64
        First global number of each rank, and the number of all points.
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
        """Local numbers of points given by global ``numbers``; each must be owned or a ghost."""
        end = self.start + self.n_owned
        order = np.argsort(self.ghosts, kind="stable")
        inside = (numbers >= self.start) & (numbers < end)
        place = np.searchsorted(self.ghosts, np.where(inside, -1, numbers), sorter=order)
        ghost = order[np.minimum(place, len(order) - 1)] if len(order) else place
        return np.where(inside, numbers - self.start, self.n_owned + ghost)

    def extended(self, owned: Array) -> Array:
        """Copy (n_local, 3) of the first n_owned rows of ``owned``, followed by those of the ghosts;
        collective.
        """
        out = np.empty((self.n_local, 3))
        out[: self.n_owned] = owned[: self.n_owned]
        self.update_ghosts(out)
        return out

    def update_ghosts(self, values: Array | NDArray[np.float32]) -> None:
        """Copy the owners' rows of ``values`` (n_local, 3) into the ghost rows; collective."""
        if self.comm.size == 1:
            return
        assert len(values) == self.n_local  # the forest would write beyond the array
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

    def global_sum(self, *numbers: float) -> Array:
        """Sum of each number over all ranks; collective."""
        sums = np.array(numbers)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def global_max(self, *numbers: float) -> list[float]:
        """Maximum of each number over all ranks; collective."""
        if self.comm.size == 1:
            return list(numbers)
        maxima = np.array(numbers, dtype=np.float64)
        self.comm.Allreduce(MPI.IN_PLACE, maxima, MPI.MAX)
        return maxima.tolist()

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        self._forest.destroy()
        for triple in self._triples.values():
            triple.Free()


@dataclass(frozen=True)
class Unknowns:
    """Vertices and edges whose unknowns the block rows hold.

    Attributes
    ----------
    n_vertices, n_edges : (ranks,) int64
        Numbers of vertices, and of edges with an unknown, that each rank owns.
    vertices : (n,) int64
        Index in the mesh of each vertex of this rank.
    edges : (n,) int64
        Index of each edge of this rank, counting only edges with an unknown, in the order of the mesh.
    """

    n_vertices: Ints
    n_edges: Ints
    vertices: Ints
    edges: Ints


class Layout(Points):
    """Unknowns of a scene in block rows of three: coordinates of a vertex, or unknowns of three edges.

    The rows that a rank owns are those of its vertices, then those of its edges. The last row of edges may
    end with unused unknowns (`padding`), which solvers hold at zero. In an array of local rows (n_local, 3),
    flattened, the unknowns of the edges are at ``edge_indices``. All unknowns have the unit of a length: an
    angle on an edge is stored times the rest length of the edge, so that its force is a moment per length
    [N].

    Parameters
    ----------
    comm, bounds, ghosts
        As for `Points`; the points are block rows.
    unknowns : Unknowns

    Attributes
    ----------
    n_vertices, n_edges : int
        Numbers of owned vertices and edges; the vertices are rows 0 to n_vertices.
    n_vertices_global, n_edges_global : int
        The same over all ranks.
    mesh_vertices, edges : (n_vertices,), (n_edges,) int64
        ``vertices`` and ``edges`` of `Unknowns`: the order in files.
    edge_indices, padding : (n_edges,), (m,) int64
        Indices of the unknowns of edges, and of unused unknowns, in a flattened array of owned rows.
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, ghosts: Ints, unknowns: Unknowns) -> None:
        super().__init__(comm, bounds, ghosts)
        self.unknowns = unknowns
        self.n_vertices, self.n_edges = (int(n[comm.rank]) for n in (unknowns.n_vertices, unknowns.n_edges))
        self.n_vertices_global, self.n_edges_global = (
            int(unknowns.n_vertices.sum()),
            int(unknowns.n_edges.sum()),
        )
        self.mesh_vertices, self.edges = unknowns.vertices, unknowns.edges
        first = 3 * self.n_vertices
        self.padding: Ints = np.arange(first + self.n_edges, 3 * self.n_owned)

    @property
    def edge_indices(self) -> Ints:
        return 3 * self.n_vertices + np.arange(self.n_edges)

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns of all ranks, without padding."""
        return 3 * self.n_vertices_global + self.n_edges_global

    def with_ghosts(self, more: Ints) -> Layout:
        """The same rows with further ghosts (n,) after the present ones, which keep their local numbers."""
        return Layout(self.comm, self.bounds, np.concatenate([self.ghosts, more]), self.unknowns)

    def split(self, rows: Array) -> tuple[Array, Array]:
        """Split owned rows (n_owned, 3) into those of vertices and the unknowns of edges (n_edges,)."""
        return rows[: self.n_vertices], rows.ravel()[self.edge_indices]

    def join(self, vertices: Array, edges: Array | None) -> Array:
        """Inverse of `split`: owned rows (n_owned, 3), with zeros for padding; None for no edges."""
        if edges is None or self.n_owned == self.n_vertices:
            return vertices
        rows = np.zeros((self.n_owned, 3))
        rows[: self.n_vertices] = vertices
        rows.ravel()[self.edge_indices] = edges
        return rows

    def gather(self, owned: Array) -> Array:
        """Values of all vertices (V, …) in the order of the mesh, on every rank; collective.

        ``owned`` (n, …) begins with the values of this rank's n_vertices vertices.
        """
        pieces = self.comm.allgather((self.mesh_vertices, np.array(owned[: self.n_vertices])))
        out = np.empty((self.n_vertices_global, *owned.shape[1:]))
        for vertices, rows in pieces:
            out[vertices] = rows
        return out

    def mesh_vertex_of_local(self) -> Ints:
        """Index in the mesh of the vertex of each local row (n_local,), 0 for rows of edges; collective."""
        indices = np.zeros((self.n_local, 3))
        indices[: self.n_vertices, 0] = self.mesh_vertices
        self.update_ghosts(indices)
        return indices[:, 0].astype(np.int64)

    def are_vertices(self, rows: Ints) -> Mask:
        """Whether each of ``rows``, given by global numbers, belongs to a vertex and not to edges."""
        rank = np.searchsorted(self.bounds, rows, side="right") - 1
        return rows - self.bounds[rank] < self.unknowns.n_vertices[rank]

    @property
    def vertex_bounds(self) -> Ints:
        """First vertex of each rank (ranks + 1,), if only vertices are numbered and not rows of edges."""
        return np.concatenate([[0], np.cumsum(self.unknowns.n_vertices)]).astype(np.int64)

    def vertex_numbers(self, rows: Ints) -> Ints:
        """Numbers, counting only vertices, of vertices given by the global numbers of their rows."""
        rank = np.searchsorted(self.bounds, rows, side="right") - 1
        return rows - self.bounds[rank] + self.vertex_bounds[rank]


def describe_worst(comm: MPI.Comm, sizes: Array, numbers: Ints, describe: Callable[[int], Result]) -> Result:
    """Describe the row with the largest size, among equals that with the smallest number; collective.

    Parameters
    ----------
    comm : MPI.Comm
    sizes : (n,)
        Sizes of this rank's rows; not NaN, may be infinite. At least one rank has a row.
    numbers : (n,) int64
        Numbers of the rows, unique over all ranks.
    describe : callable
        Returns the description of a row; called on the rank that has the row, and broadcast.
    """
    largest = comm.allreduce(float(sizes.max(initial=-np.inf)), MPI.MAX)
    bad = np.flatnonzero(sizes >= largest * (1.0 - TIE)) if len(sizes) else np.empty(0, np.int64)
    none = np.iinfo(np.int64).max
    first = int(numbers[bad].min()) if len(bad) else none
    number, rank = comm.allreduce((first, comm.rank), MPI.MIN)
    mine = describe(int(bad[np.argmin(numbers[bad])])) if rank == comm.rank and number != none else None
    result: Result | None = comm.bcast(mine, root=rank)
    assert result is not None
    return result
