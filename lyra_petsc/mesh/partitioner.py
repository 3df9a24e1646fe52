"""Which rank owns which vertex: a graph partitioner run by PETSc, or cuts through space where sheets may
touch; and an ordering for locality.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.parallel import on_root

Graph = tuple[Ints, Ints]

PREFERRED = ("ptscotch", "parmetis", "chaco", "party")
PARTS = "mat_partitioning_nparts"


def vertex_graph(stencils: list[Ints], n_vertices: int) -> Graph:
    """Adjacency (row offsets (V+1,), neighbours) of vertices that share an element, without loops."""
    keys = []
    for stencil in stencils:
        n = stencil.shape[1]
        for a in range(n):
            for b in range(n):
                if a != b:
                    keys.append(stencil[:, a].astype(np.int64) * n_vertices + stencil[:, b])
    unique = np.unique(np.concatenate(keys)) if keys else np.empty(0, dtype=np.int64)
    rows, columns = np.divmod(unique, max(n_vertices, 1))
    offsets = np.zeros(n_vertices + 1, dtype=np.int64)
    np.cumsum(np.bincount(rows, minlength=n_vertices), out=offsets[1:])
    return offsets, columns


def _matrix(graph: Graph) -> PETSc.Mat:
    offsets, neighbours = (part.astype(PETSc.IntType) for part in graph)
    rows = len(offsets) - 1
    csr = (offsets, neighbours, np.ones(len(neighbours)))
    return PETSc.Mat().createAIJ((rows, rows), csr=csr, comm=PETSc.COMM_SELF)


def locality_order(graph: Graph) -> Ints:
    """Reverse Cuthill-McKee: position of each vertex in an order that keeps neighbours near."""
    n = len(graph[0]) - 1
    matrix = _matrix(graph)
    permutation, other = matrix.getOrdering("rcm")
    order = permutation.getIndices().astype(np.int64)
    for item in (permutation, other, matrix):
        item.destroy()
    position = np.empty(n, dtype=np.int64)
    position[order] = np.arange(n)
    return position


def bisection(places: Array, n_ranks: int) -> Ints:
    """Owner (V,) of vertices at ``places`` (V, 3) by recursive bisection of space, always across the longest
    side of what is left (Berger & Bokhari, IEEE Trans. Comput. 36 (1987) 570-580).
    """
    owner = np.zeros(len(places), dtype=np.int64)
    parts = [(np.arange(len(places)), range(n_ranks))]
    while parts:
        vertices, ranks = parts.pop()
        if len(ranks) == 1 or not len(vertices):
            owner[vertices] = ranks[0]
            continue
        at, left = places[vertices], len(ranks) // 2
        sides = np.argsort(np.ptp(at, axis=0), kind="stable")
        vertices = vertices[np.lexsort([at[:, side] for side in sides])]
        cut = len(vertices) * left // len(ranks)
        parts += [(vertices[:cut], ranks[:left]), (vertices[cut:], ranks[left:])]
    return owner


def partition(
    comm: MPI.Comm, graph: Graph | None, n_vertices: int, places: Array | None = None
) -> tuple[Ints | None, str]:
    """Owning rank of each vertex; collective.

    The partitioner is the best that this PETSc has (PT-Scotch, ParMETIS, …), or what
    ``-mat_partitioning_type`` says. It works on rank 0, where the mesh is: on several ranks the answer of
    PT-Scotch would depend on the order in which messages arrive, here it is the same in every run. With
    ``places``, and without that option, it is `bisection`: a graph of the meshes does not know which sheets
    lie on each other, and would cut between them.

    Parameters
    ----------
    comm : MPI.Comm
    graph : (offsets, neighbours)
        The whole graph, on rank 0; None elsewhere.
    n_vertices : int
        V, on all ranks.
    places : (V, 3)
        Positions [m] of vertices that may touch, on rank 0.

    Returns
    -------
    owner : (V,) int64 on rank 0, None elsewhere
    name : str
        The partitioner used.

    Raises
    ------
    InputError
        On all ranks, if PETSc has not the partitioner that was asked for.
    """
    if comm.size == 1:
        return np.zeros(n_vertices, dtype=np.int64), "none (one rank)"
    if not PETSc.Options().hasName("mat_partitioning_type") and comm.bcast(places is not None):
        return (None if places is None else bisection(places, comm.size)), "bisection of space"
    owner: Ints | None = None

    def on_rank_0() -> str:
        nonlocal owner
        assert graph is not None
        matrix, parts = _matrix(graph), PETSc.IS()
        partitioning = PETSc.MatPartitioning().create(PETSc.COMM_SELF)
        partitioning.setAdjacency(matrix)
        name = _choose(partitioning, comm.size)
        partitioning.apply(parts)
        owner = parts.getIndices().astype(np.int64)
        for item in (parts, partitioning, matrix):
            item.destroy()
        return name

    name = on_root(comm, on_rank_0)
    return owner, name


def _choose(partitioning: PETSc.MatPartitioning, n_ranks: int) -> str:
    database = PETSc.Options()
    asked = database.getString("mat_partitioning_type", "")
    # petsc4py has no other way to say how many parts there are to be
    database.setValue(PARTS, n_ranks)
    try:
        # "average" cuts the numbering into equal pieces, which the locality order makes compact
        for name in (asked,) if asked else (*PREFERRED, "average"):
            try:
                partitioning.setType(name)
            except PETSc.Error:
                continue
            partitioning.setFromOptions()
            return str(partitioning.getType())
    finally:
        database.delValue(PARTS)
    raise InputError(
        f"this PETSc has no partitioner '{asked}'; leave it out or try {', '.join(PREFERRED)}, average",
        key="-mat_partitioning_type",
    )
