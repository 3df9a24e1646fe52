"""Distribution: every vertex owned once, every element where it is needed and counted once."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.grids import grid_sheet
from lyra_petsc.meshing.topology import hinges
from lyra_petsc.partition.distribute import Part, Whole, distribute, split_elements
from lyra_petsc.partition.elements import Elements
from lyra_petsc.partition.partitioner import locality_order, partition, vertex_graph
from lyra_petsc.partition.points import Layout, Numbering, Points
from lyra_petsc.scene.sheet import Grid

Ints = NDArray[np.int64]

pytestmark = pytest.mark.parallel

SIZES = [(1, 1), (2, 1), (7, 5), (20, 20)]


def whole_of(triangles: Ints, n_vertices: int) -> Whole:
    elements = {"triangles": Elements(triangles, {"number": np.arange(len(triangles), dtype=float)})}
    quads = hinges(triangles).vertices
    elements["hinges"] = Elements(quads, {"number": np.arange(len(quads), dtype=float)})
    elements["some"] = Elements(np.array([[0], [n_vertices - 1]]))
    elements["none"] = Elements(np.empty((0, 2), dtype=np.int64))
    return Whole(n_vertices, triangles, elements, {"number": np.arange(n_vertices, dtype=float)})


def meshes() -> list[tuple[Ints, int]]:
    one = (np.array([[0, 1, 2]]), 3)
    apart = (np.array([[0, 1, 2], [3, 4, 5]]), 6)  # two sheets that share nothing
    return [one, apart, *(square(nx, ny) for nx, ny in SIZES)]


def square(nx: int, ny: int) -> tuple[Ints, int]:
    """Triangles of a unit square's grid, and its number of vertices."""
    sheet = grid_sheet(Grid(width=1, height=1, nx=nx, ny=ny, pattern="alternating"))
    return sheet.triangles, len(sheet.points)


@pytest.fixture(params=range(6), ids=["triangle", "apart", *(f"{nx}x{ny}" for nx, ny in SIZES)])
def mesh(request: pytest.FixtureRequest) -> tuple[Ints, int]:
    return meshes()[request.param]


@pytest.fixture
def part(comm: MPI.Comm, mesh: tuple[Ints, int]) -> Part:
    return distribute(comm, whole_of(*mesh) if comm.rank == 0 else None)


def test_every_vertex_has_one_owner_and_contiguous_numbers(
    comm: MPI.Comm, mesh: tuple[Ints, int], part: Part
) -> None:
    points = part.points
    originals = np.concatenate(comm.allgather(points.original))
    np.testing.assert_array_equal(np.sort(originals), np.arange(mesh[1]))
    assert points.n_owned == len(points.original) == points.bounds[comm.rank + 1] - points.start
    assert points.bounds[0] == 0
    assert points.bounds[-1] == points.n_global == mesh[1]
    np.testing.assert_array_equal(part.vertex_data["number"], points.original)


def test_a_rank_has_every_element_that_touches_what_it_owns(
    comm: MPI.Comm, mesh: tuple[Ints, int], part: Part
) -> None:
    triangles, n_vertices = mesh
    whole = whole_of(triangles, n_vertices)
    mine = np.zeros(n_vertices, dtype=bool)
    mine[part.points.original] = True
    numbers = np.empty(part.points.n_global, dtype=np.int64)  # mesh index of each global number
    for start, original in comm.allgather((part.points.start, part.points.original)):
        numbers[start : start + len(original)] = original
    for name, elements in part.elements.items():
        expected = np.flatnonzero(mine[whole.elements[name].stencil].any(axis=1))
        np.testing.assert_array_equal(np.sort(elements.index), expected)
        # local numbers lead back to the vertices of the mesh, in the same order within the element
        back = numbers[part.points.global_number[elements.stencil]]
        np.testing.assert_array_equal(back, whole.elements[name].stencil[elements.index])
        if "number" in elements.data:
            np.testing.assert_array_equal(elements.data["number"], elements.index)


def test_every_element_is_counted_on_one_rank(comm: MPI.Comm, mesh: tuple[Ints, int], part: Part) -> None:
    whole = whole_of(*mesh)
    for name, elements in part.elements.items():
        counted = np.concatenate(comm.allgather(elements.index[: elements.n_owned]))
        np.testing.assert_array_equal(np.sort(counted), np.arange(len(whole.elements[name].stencil)))


def test_ghosts_are_what_elements_touch_and_get_their_owners_values(comm: MPI.Comm, part: Part) -> None:
    points = part.points
    touched = np.unique(np.concatenate([e.stencil.ravel() for e in part.elements.values()]))
    ghosts = touched[touched >= points.n_owned]
    np.testing.assert_array_equal(ghosts, np.arange(points.n_owned, points.n_local))
    assert not np.any((points.ghosts >= points.start) & (points.ghosts < points.start + points.n_owned))
    values = np.full((points.n_local, 3), np.nan)
    values[: points.n_owned] = points.global_number[: points.n_owned, None] + [0.0, 0.25, 0.5]
    points.update_ghosts(values)
    np.testing.assert_array_equal(values, points.global_number[:, None] + [0.0, 0.25, 0.5])


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_owners_get_the_sum_of_what_ranks_have(comm: MPI.Comm, part: Part, kind: type) -> None:
    points = part.points
    values = np.ones((points.n_local, 3), dtype=kind)
    values[:, 1] = comm.rank
    points.add_to_owners(values)
    everywhere = comm.allgather((points.global_number, comm.rank))
    seen, ranks = np.zeros(points.n_global), np.zeros(points.n_global)
    for numbers, rank in everywhere:
        seen[numbers] += 1
        ranks[numbers] += rank
    own = points.global_number[: points.n_owned]
    np.testing.assert_array_equal(values[: points.n_owned, 0], seen[own])
    np.testing.assert_array_equal(values[: points.n_owned, 1], ranks[own])


def test_a_large_mesh_is_cut_evenly_with_few_ghosts(comm: MPI.Comm) -> None:
    mesh = square(40, 40)
    part = distribute(comm, whole_of(*mesh) if comm.rank == 0 else None)
    sizes = comm.allgather(part.points.n_owned)
    assert max(sizes) <= 1.15 * mesh[1] / comm.size
    # a straight cut has 41 vertices a side, hinges reach one row further
    assert len(part.points.ghosts) <= (0 if comm.size == 1 else 4 * 41)


def test_the_partitioner_can_be_chosen(comm: MPI.Comm) -> None:
    graph = vertex_graph([np.array([[i, i + 1] for i in range(11)])], 12) if comm.rank == 0 else None
    database = PETSc.Options()
    database.setValue("mat_partitioning_type", "average")
    try:
        owner, name = partition(comm, graph, 12)
    finally:
        database.delValue("mat_partitioning_type")
    if comm.size > 1:
        assert name == "average"
    if comm.rank == 0:
        np.testing.assert_array_equal(np.sort(np.unique(owner)), np.arange(comm.size))


def test_a_partitioner_that_petsc_has_not_is_refused(comm: MPI.Comm) -> None:
    if comm.size == 1:  # nothing is cut, hence nothing asked for
        return
    database = PETSc.Options()
    database.setValue("mat_partitioning_type", "scissors")
    try:
        with pytest.raises(InputError, match="scissors"):
            partition(comm, vertex_graph([np.array([[0, 1]])], 2) if comm.rank == 0 else None, 2)
    finally:
        database.delValue("mat_partitioning_type")


def test_locality_order_is_a_permutation_that_keeps_neighbours_near() -> None:
    rng = np.random.default_rng(1)
    names = rng.permutation(200)  # a path whose vertices are numbered at random
    graph = vertex_graph([np.column_stack([names[:-1], names[1:]])], 200)
    position = locality_order(graph)
    np.testing.assert_array_equal(np.sort(position), np.arange(200))
    assert np.abs(np.diff(position[names])).max() == 1


def test_numbering_is_by_owner_then_by_position() -> None:
    numbering = Numbering.build(np.array([1, 0, 1, 0, 3]), np.array([4, 3, 2, 1, 0]), 4)
    np.testing.assert_array_equal(numbering.bounds, [0, 2, 4, 4, 5])
    np.testing.assert_array_equal(numbering.number, [3, 1, 2, 0, 4])


def test_split_counts_an_element_where_its_first_point_is_owned() -> None:
    split = split_elements(np.array([[0, 1], [1, 0], [2, 2]]), 4)
    assert [(sorted(index), n) for index, n in split] == [([0, 1], 1), ([0, 1], 1), ([2], 1), ([], 0)]
    assert split[1][0][0] == 1  # what a rank counts comes first


def test_layout_with_unknowns_on_vertices_and_edges(comm: MPI.Comm) -> None:
    # 3 unknowns a vertex, 1 an edge: unique, and contiguous on each rank
    vertices = np.array([0, 4, 4, 9])
    edges = np.array([0, 3, 10, 12])
    layout = Layout([(vertices, 3), (edges, 1)])
    np.testing.assert_array_equal(layout.bounds, [0, 15, 22, 39])
    on_vertices, on_edges = layout.unknowns(0, np.arange(9)), layout.unknowns(1, np.arange(12))
    assert on_vertices.shape == (9, 3)
    assert on_edges.shape == (12, 1)
    taken = np.concatenate([on_vertices.ravel(), on_edges.ravel()])
    np.testing.assert_array_equal(np.sort(taken), np.arange(39))
    for rank in range(3):
        own = np.concatenate(
            [
                on_vertices[vertices[rank] : vertices[rank + 1]].ravel(),
                on_edges[edges[rank] : edges[rank + 1]].ravel(),
            ]
        )
        np.testing.assert_array_equal(np.sort(own), np.arange(layout.bounds[rank], layout.bounds[rank + 1]))


def test_edges_are_numbered_and_exchanged_by_the_same_code(comm: MPI.Comm) -> None:
    # a ring of edges dealt out to the ranks; each rank sees the next edge as a ghost
    n = 4 * comm.size
    owner = np.arange(n) // 4
    numbering = Numbering.build(owner, np.arange(n), comm.size)
    first_foreign = np.array([(4 * (comm.rank + 1)) % n] if comm.size > 1 else [], dtype=np.int64)
    original = np.arange(4 * comm.rank, 4 * comm.rank + 4)
    edges = Points(comm, numbering.bounds, numbering.number[first_foreign], original)
    values = np.zeros((edges.n_local, 3))
    values[:4] = original[:, None]
    edges.update_ghosts(values)
    np.testing.assert_array_equal(values[4:, 0], first_foreign)
    layout = Layout([(2 * numbering.bounds, 3), (numbering.bounds, 1)])
    mine = layout.unknowns(1, edges.global_number[:4]).ravel()
    assert mine[0] == layout.bounds[comm.rank] + 3 * 8
    assert mine[-1] == layout.bounds[comm.rank + 1] - 1
    edges.destroy()


def test_a_constant_that_is_one_number_takes_no_memory() -> None:
    stencil = np.arange(12).reshape(4, 3)
    data = {"same": np.full(4, 0.3), "other": np.arange(4.0), "wide": np.ones((4, 2))}
    elements = Elements(stencil, data)
    for name in (*data, "missing"):
        assert elements.once(name).data.keys() == data.keys()
    assert elements.once("other") is elements.once("wide") is elements.once("missing") is elements
    once = elements.once("same").data["same"]
    assert once.strides == (0,)
    np.testing.assert_array_equal(once, data["same"])
