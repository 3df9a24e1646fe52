"""Partition of the vertices over the ranks, and an order of the vertices in which neighbours are close.

The partition is that of a graph partitioner of PETSc, or where sheets may touch a bisection of space.
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
    """Adjacency of vertices that share an element: row offsets (V + 1,) and neighbours, no vertex its own."""
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
    """Position (V,) of each vertex in the reverse Cuthill-McKee order, which keeps neighbours close."""
    n = len(graph[0]) - 1
    matrix = _matrix(graph)
    permutation, other = matrix.getOrdering("rcm")
    order = permutation.getIndices().astype(np.int64)
    for item in (permutation, other, matrix):
        item.destroy()
    position = np.empty(n, dtype=np.int64)
    position[order] = np.arange(n)
    return position


def bisection(positions: Array, n_ranks: int) -> Ints:
    """Owner (V,) of vertices at ``positions`` (V, 3) by recursive bisection of space.

    Each part is cut across the longest side of its bounding box (Berger & Bokhari, IEEE Trans. Comput. 36
    (1987) 570-580).
    """
    owner = np.zeros(len(positions), dtype=np.int64)
    parts = [(np.arange(len(positions)), range(n_ranks))]
    while parts:
        vertices, ranks = parts.pop()
        if len(ranks) == 1 or not len(vertices):
            owner[vertices] = ranks[0]
            continue
        x, half = positions[vertices], len(ranks) // 2
        axes = np.argsort(np.ptp(x, axis=0), kind="stable")
        vertices = vertices[np.lexsort([x[:, axis] for axis in axes])]
        cut = len(vertices) * half // len(ranks)
        parts += [(vertices[:cut], ranks[:half]), (vertices[cut:], ranks[half:])]
    return owner


def partition(
    comm: MPI.Comm, graph: Graph | None, n_vertices: int, positions: Array | None = None
) -> tuple[Ints | None, str]:
    """Owning rank of each vertex; collective.

    ``-mat_partitioning_type`` chooses a graph partitioner. Without this option it is the first that PETSc
    has of `PREFERRED`, or, where ``positions`` are given, `bisection`: the graph of the meshes does not
    contain which sheets lie on each other, so that a graph partitioner would cut between them. Graph
    partitioners run on rank 0 alone: on several ranks the result of PT-Scotch depends on the order in which
    messages arrive.

    Parameters
    ----------
    comm : MPI.Comm
    graph : (offsets, neighbours)
        The whole graph, on rank 0; None elsewhere.
    n_vertices : int
        V, on all ranks.
    positions : (V, 3)
        Positions [m] of vertices that may touch, on rank 0.

    Returns
    -------
    owner : (V,) int64 on rank 0, None elsewhere
    name : str
        The partitioner used.

    Raises
    ------
    InputError
        On all ranks, if PETSc lacks the partitioner of ``-mat_partitioning_type``.
    """
    if comm.size == 1:
        return np.zeros(n_vertices, dtype=np.int64), "none (one rank)"
    if not PETSc.Options().hasName("mat_partitioning_type") and comm.bcast(positions is not None):
        return (None if positions is None else bisection(positions, comm.size)), "bisection of space"
    owner: Ints | None = None

    def on_rank_0() -> str:
        nonlocal owner
        assert graph is not None
        matrix, parts = _matrix(graph), PETSc.IS()
        partitioning = PETSc.MatPartitioning().create(PETSc.COMM_SELF)
        partitioning.setAdjacency(matrix)
        name = _set_partitioner(partitioning, comm.size)
        partitioning.apply(parts)
        owner = parts.getIndices().astype(np.int64)
        for item in (parts, partitioning, matrix):
            item.destroy()
        return name

    name = on_root(comm, on_rank_0)
    return owner, name


def _set_partitioner(partitioning: PETSc.MatPartitioning, n_ranks: int) -> str:
    """Set the partitioner and the number of parts; returns the partitioner's name."""
    database = PETSc.Options()
    asked = database.getString("mat_partitioning_type", "")
    # petsc4py has no other way to set the number of parts
    database.setValue(PARTS, n_ranks)
    try:
        # "average" cuts the numbering, which follows `locality_order`, into equal pieces
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
