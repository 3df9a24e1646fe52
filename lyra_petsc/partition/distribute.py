"""Hand each rank its part of the mesh: its points, its elements, their constants.

Each rank gets every element that touches a point it owns, so that assembly needs no communication
beyond the ghost update; elements it counts (energies) come first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from mpi4py.util import pkl5
from numpy.typing import NDArray

from lyra_petsc.partition.elements import Elements
from lyra_petsc.partition.partitioner import locality_order, partition, vertex_graph
from lyra_petsc.partition.points import Ints, Numbering, Points

Array = NDArray[np.float64]


@dataclass
class Whole:
    """What there is to distribute, on rank 0.

    Attributes
    ----------
    n_vertices : int
    triangles : (F, 3) int64
        For the partitioner's graph.
    elements : dict of name → Elements
        In mesh numbering.
    vertex_data : dict of name → (V, …) array
    """

    n_vertices: int
    triangles: Ints
    elements: dict[str, Elements]
    vertex_data: dict[str, Array]


@dataclass
class Part:
    """One rank's share.

    Attributes
    ----------
    points : Points
    elements : dict of name → Elements
        In local numbering; counted elements first.
    vertex_data : dict of name → (n_owned, …) array
    partitioner : str
        What cut the mesh.
    """

    points: Points
    elements: dict[str, Elements]
    vertex_data: dict[str, Array]
    partitioner: str


def split_elements(owner: NDArray[np.int64], n_ranks: int) -> list[tuple[Ints, int]]:
    """Elements of each rank from the owners (E, n) of their points.

    Returns
    -------
    list of (indices, n_owned)
        Per rank the elements that touch a point it owns, those it counts first. An element is counted
        by the owner of its first point.
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
        mine = elements[ends[rank] : ends[rank + 1]]
        counted = owner[mine, 0] == rank
        pieces.append((np.concatenate([mine[counted], mine[~counted]]), int(counted.sum())))
    return pieces


def distribute(comm: MPI.Comm, whole: Whole | None) -> Part:
    """Partition the mesh and give each rank its part; collective. ``whole`` is read on rank 0 only."""
    n_vertices = comm.bcast(whole.n_vertices if whole else 0, root=0)
    graph = vertex_graph([whole.triangles], n_vertices) if whole else None
    owner, name = partition(comm, graph, n_vertices)
    post = pkl5.Intracomm(comm)  # sends arrays without a copy, also those of more than 2 GiB
    if comm.rank == 0:
        assert whole is not None
        assert owner is not None
        assert graph is not None
        numbering = Numbering.build(owner, locality_order(graph), comm.size)
        del graph
        pieces = _pieces(whole, numbering, comm.size)
        own = None
        for rank, piece in enumerate(pieces):
            if rank == 0:
                own = piece
            else:
                post.send(piece, dest=rank)
        piece = own
    else:
        piece = post.recv(source=0)
    bounds, ghosts, original, elements, vertex_data = piece
    return Part(Points(comm, bounds, ghosts, original), elements, vertex_data, name)


def _pieces(whole: Whole, numbering: Numbering, n_ranks: int):  # type: ignore[no-untyped-def]
    """One picklable piece after the other, so that rank 0 holds one at a time."""
    split = {name: split_elements(numbering.owner[e.stencil], n_ranks) for name, e in whole.elements.items()}
    by_number = np.argsort(numbering.number)
    for rank in range(n_ranks):
        lo, hi = numbering.bounds[rank], numbering.bounds[rank + 1]
        stencils = {
            name: numbering.number[whole.elements[name].stencil[mine[rank][0]]]
            for name, mine in split.items()
        }
        touched = np.unique(np.concatenate([s.ravel() for s in stencils.values()] or [np.empty(0, np.int64)]))
        ghosts = touched[(touched < lo) | (touched >= hi)]
        elements = {}
        for name, (index, n_owned) in ((n, s[rank]) for n, s in split.items()):
            stencil = local_numbers(stencils[name], ghosts, lo, hi)
            order = _by_locality(stencil, n_owned)
            index = index[order]
            data = {key: np.ascontiguousarray(v[index]) for key, v in whole.elements[name].data.items()}
            counts = np.promote_types(np.int32, np.min_scalar_type(-len(whole.elements[name].stencil)))
            elements[name] = Elements(stencil[order].astype(np.int32), data, n_owned, index.astype(counts))
        original = by_number[lo:hi]
        vertex_data = {key: np.ascontiguousarray(v[original]) for key, v in whole.vertex_data.items()}
        yield numbering.bounds, ghosts, original, elements, vertex_data


def local_numbers(numbers: Ints, ghosts: Ints, lo: int, hi: int) -> Ints:
    """Local numbers of global ones: owned from 0, ghosts after them."""
    inside = (numbers >= lo) & (numbers < hi)
    local: Ints = np.where(inside, numbers - lo, (hi - lo) + np.searchsorted(ghosts, numbers))
    return local


def _by_locality(stencil: Ints, n_owned: int) -> Ints:
    """An order of the elements, counted ones first, that walks through memory."""
    if len(stencil) == 0:
        return np.empty(0, dtype=np.int64)
    points = np.sort(stencil, axis=1).T
    order: Ints = np.lexsort((*points[::-1], np.arange(len(stencil)) >= n_owned))
    return order
