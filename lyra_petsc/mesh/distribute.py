"""Distribution of the mesh from rank 0: each rank gets its block rows and elements with their constants.

Each rank gets every element that couples a row it owns, so that assembly needs no communication but the
update of ghosts. Its counted elements come first: each element is counted (in energies) on one rank only.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI
from mpi4py.util import pkl5

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.partitioner import Graph, locality_order, partition, vertex_graph
from lyra_petsc.mesh.points import Layout, Numbering, Unknowns
from lyra_petsc.mesh.topology import connected_components

TIED = "tied vertices"
"""Name of the elements (n, 2) of vertices that are held together without being one, as by seams."""


@dataclass
class GlobalMesh:
    """The mesh with its elements before distribution, on rank 0.

    Attributes
    ----------
    n_vertices : int
    triangles : (F, 3) int64
        Vertices of the triangles, for the graph of the partitioner.
    elements : dict of name → Elements
        Elements in the numbering of the mesh.
    vertex_data : dict of name → (V, …) array
    vertex_sets : dict of key → (n,) int64
        Vertices that are chosen for something, as those of a handle.
    edges : (N, 2) int64 or None
        Vertices of the edges of the mesh; needed where elements couple unknowns of edges.
    owner : (V,) int64 or None
        Rank of each vertex; None: a partitioner determines it.
    positions : (V, 3) or None
        Start positions [m] if vertices may touch, for a partition by bisection of space.
    """

    n_vertices: int
    triangles: Ints
    elements: dict[str, Elements]
    vertex_data: dict[str, Array]
    edges: Ints | None = None
    owner: Ints | None = None
    positions: Array | None = None
    vertex_sets: dict[Hashable, Ints] = field(default_factory=dict)


@dataclass
class LocalMesh:
    """The part of the mesh that one rank has.

    Attributes
    ----------
    layout : Layout
    elements : dict of name → Elements
        Elements in local numbering, those that this rank counts first.
    vertex_data : dict of name → (n_vertices, …) array
    vertex_sets : dict of key → (n,) int64
        The owned vertices of each set, ascending.
    partitioner : str
        Name of the partitioner.
    """

    layout: Layout
    elements: dict[str, Elements]
    vertex_data: dict[str, Array]
    vertex_sets: dict[Hashable, Ints]
    partitioner: str


@dataclass(frozen=True)
class Rows:
    """Block rows of all ranks, on rank 0.

    Attributes
    ----------
    bounds : (ranks + 1,) int64
        First row of each rank.
    vertex, vertex_owner : (V,) int64
        Row of each vertex, and the rank that owns it.
    edge, edge_owner, component : (N,) int64
        Row and owner of the unknown of each edge, and which of the three of its row it is; −1 for edges
        without unknown.
    unknowns : list of Unknowns
        One for each rank.
    """

    bounds: Ints
    vertex: Ints
    vertex_owner: Ints
    edge: Ints
    edge_owner: Ints
    component: Ints
    unknowns: list[Unknowns]

    @classmethod
    def build(cls, vertices: Numbering, whole: GlobalMesh) -> Rows:
        """The rows of the numbered vertices, and of the edges whose unknowns are coupled by elements."""
        n_ranks = len(vertices.bounds) - 1
        n_vertices = np.diff(vertices.bounds)
        n_edges, edges_of = np.zeros_like(n_vertices), [np.empty(0, dtype=np.int64)] * n_ranks
        edge = edge_owner = component = np.empty(0, dtype=np.int64)
        used = [elements.edges.ravel() for elements in whole.elements.values() if elements.edges is not None]
        bounds, vertex = vertices.bounds, vertices.number
        if used:
            assert whole.edges is not None
            chosen = np.unique(np.concatenate(used))
            # the rank of its vertex of lower number owns an edge: the edges of a row surround one vertex
            ends = np.sort(vertices.number[whole.edges[chosen]], axis=1)
            owner = np.searchsorted(vertices.bounds, ends[:, 0], side="right") - 1
            order = np.lexsort((ends[:, 1], ends[:, 0], owner))
            chosen, owner = chosen[order], owner[order]
            n_edges = np.bincount(owner, minlength=n_ranks)
            edges_of = np.split(order, np.cumsum(n_edges)[:-1])
            bounds = np.concatenate([[0], np.cumsum(n_vertices + -(-n_edges // 3))])
            vertex = vertices.number + (bounds - vertices.bounds)[vertices.owner]
            number = np.arange(len(chosen)) - (np.cumsum(n_edges) - n_edges)[owner]
            edge, edge_owner, component = (np.full(len(whole.edges), -1, dtype=np.int64) for _ in range(3))
            edge[chosen] = bounds[owner] + n_vertices[owner] + number // 3
            edge_owner[chosen], component[chosen] = owner, number % 3
        by_number = np.argsort(vertices.number)
        unknowns = [
            Unknowns(n_vertices, n_edges, by_number[lo:hi], edges)
            for lo, hi, edges in zip(vertices.bounds, vertices.bounds[1:], edges_of, strict=False)
        ]
        return cls(bounds, vertex, vertices.owner, edge, edge_owner, component, unknowns)


def gather_stencils(
    elements: Elements, at_vertex: Ints, at_edge: Ints, index: Ints | slice = slice(None)
) -> Ints:
    """Values (n, m) at the vertices, then at the edges, that the elements ``index`` (n,) couple."""
    vertices: Ints = at_vertex[elements.stencil[index]]
    if elements.edges is None:
        return vertices
    return np.concatenate([vertices, at_edge[elements.edges[index]]], axis=1)


def split_elements(owner: Ints, n_ranks: int) -> list[tuple[Ints, int]]:
    """Elements of each rank, from the owners (E, n) of the rows of their stencils.

    Returns
    -------
    list of (indices, n_owned)
        For each rank the elements that couple a row it owns, the ``n_owned`` counted ones first. An element
        is counted by the owner of its first vertex.
    """
    n_elements = len(owner)
    pairs = (
        np.unique((owner * n_elements + np.arange(n_elements)[:, None]).ravel())
        if n_elements
        else owner.ravel()
    )
    ranks, elements = np.divmod(pairs, max(n_elements, 1))
    ends = np.searchsorted(ranks, np.arange(n_ranks + 1))
    pieces = []
    for rank in range(n_ranks):
        own = elements[ends[rank] : ends[rank + 1]]
        counted = owner[own, 0] == rank
        pieces.append((np.concatenate([own[counted], own[~counted]]), int(counted.sum())))
    return pieces


def _partition(
    comm: MPI.Comm, whole: GlobalMesh | None, graph: Graph | None, n_vertices: int
) -> tuple[Ints | None, str]:
    """As `partition`, but with each tied vertex on the rank of the first one that it is tied to."""
    if whole is None or TIED not in whole.elements:
        return partition(comm, graph, n_vertices, whole.positions if whole else None)
    ties = whole.elements[TIED].stencil.astype(np.int64)
    first = ties[np.unique(ties[:, 0], return_index=True)[1]]
    chosen, group = np.unique(connected_components(n_vertices, first), return_inverse=True)
    corners = group[whole.triangles]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    positions = None if whole.positions is None else whole.positions[chosen]
    owner, name = partition(comm, vertex_graph([corners], len(chosen)), len(chosen), positions)
    return None if owner is None else owner[group], name


def distribute(comm: MPI.Comm, whole: GlobalMesh | None) -> LocalMesh:
    """Partition the mesh and send each rank its part; collective. ``whole`` is needed on rank 0 only."""
    n_vertices = comm.bcast(whole.n_vertices if whole else 0, root=0)
    graph = vertex_graph([whole.triangles], n_vertices) if whole else None
    if comm.bcast(whole is not None and whole.owner is not None):
        owner, name = (whole.owner if whole else None), "given"
    else:
        owner, name = _partition(comm, whole, graph, n_vertices)
    messages = pkl5.Intracomm(comm)  # sends arrays without a copy, also those of more than 2 GiB
    if comm.rank == 0:
        assert whole is not None
        assert owner is not None
        assert graph is not None
        rows = Rows.build(Numbering.build(owner, locality_order(graph), comm.size), whole)
        del graph
        pieces = _pieces(whole, rows, comm.size)
        for rank in range(1, comm.size):
            piece = next(pieces)
            messages.send(piece, dest=rank)
            del piece  # frees its memory before the next one is made
        piece = next(pieces)
    else:
        piece = messages.recv(source=0)
    bounds, ghosts, unknowns, elements, vertex_data, sets = piece
    return LocalMesh(Layout(comm, bounds, ghosts, unknowns), elements, vertex_data, sets, name)


def _pieces(whole: GlobalMesh, rows: Rows, n_ranks: int):  # type: ignore[no-untyped-def]
    """Yield the piece of each rank, rank 0's last: only one at a time is in memory."""
    split = {
        name: split_elements(gather_stencils(kind, rows.vertex_owner, rows.edge_owner), n_ranks)
        for name, kind in whole.elements.items()
    }
    for rank in (*range(1, n_ranks), 0):
        lo, hi = rows.bounds[rank], rows.bounds[rank + 1]
        elements = {}
        coupled = {
            name: gather_stencils(kind, rows.vertex, rows.edge, split[name][rank][0])
            for name, kind in whole.elements.items()
        }
        every = np.unique(np.concatenate([*map(np.unique, coupled.values()), np.empty(0, np.int64)]))
        ghosts = every[(every < lo) | (every >= hi)]
        for name, (index, n_owned) in ((n, s[rank]) for n, s in split.items()):
            kind = whole.elements[name]
            n = kind.stencil.shape[1]
            local = local_numbers(coupled[name], ghosts, lo, hi)
            order = _locality_order(local[:, :n], n_owned)
            index, local = index[order], local[order]
            data = {key: np.ascontiguousarray(v[index]) for key, v in kind.data.items()}
            counts = np.promote_types(np.int32, np.min_scalar_type(-len(kind.stencil)))
            edges = None
            if kind.edges is not None:
                edges = (3 * local[:, n:] + rows.component[kind.edges[index]]).astype(np.int32)
            stencil = local[:, :n].astype(np.int32)
            elements[name] = Elements(stencil, data, n_owned, index.astype(counts), edges)
        own = rows.unknowns[rank]
        vertex_data = {key: np.ascontiguousarray(v[own.vertices]) for key, v in whole.vertex_data.items()}
        sets = {key: np.sort(rows.vertex[vertices]) for key, vertices in whole.vertex_sets.items()}
        sets = {key: row[(row >= lo) & (row < hi)] - lo for key, row in sets.items()}
        yield rows.bounds, ghosts, own, elements, vertex_data, sets


def local_numbers(numbers: Ints, ghosts: Ints, lo: int, hi: int) -> Ints:
    """Local numbers of global ``numbers``: owned rows (lo to before hi) from 0, then the ascending ghosts."""
    inside = (numbers >= lo) & (numbers < hi)
    return np.where(inside, numbers - lo, (hi - lo) + np.searchsorted(ghosts, numbers))


def _locality_order(stencil: Ints, n_owned: int) -> Ints:
    """Order of the elements by their lowest rows, counted ones first, for locality in memory."""
    if len(stencil) == 0:
        return np.empty(0, dtype=np.int64)
    points = np.sort(stencil, axis=1).T
    return np.lexsort((*points[::-1], np.arange(len(stencil)) >= n_owned))
