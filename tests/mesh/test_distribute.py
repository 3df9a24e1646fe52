"""Distribution: every vertex has one owner; elements are on all ranks that need them, and counted on one."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import grid_sheet
from lyra_petsc.mesh.distribute import TIED, GlobalMesh, LocalMesh, distribute
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.partitioner import partition, vertex_graph
from lyra_petsc.mesh.topology import hinges
from lyra_petsc.scene.schema import Grid

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

SIZES = [(1, 1), (2, 1), (7, 5), (20, 20)]


def whole_of(triangles: Ints, n_vertices: int) -> GlobalMesh:
    elements = {"triangles": Elements(triangles, {"number": np.arange(len(triangles), dtype=float)})}
    quads = hinges(triangles).vertices
    elements["hinges"] = Elements(quads, {"number": np.arange(len(quads), dtype=float)})
    elements["some"] = Elements(np.array([[0], [n_vertices - 1]]))
    elements["none"] = Elements(np.empty((0, 2), dtype=np.int64))
    return GlobalMesh(n_vertices, triangles, elements, {"number": np.arange(n_vertices, dtype=float)})


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
def part(comm: MPI.Comm, mesh: tuple[Ints, int]) -> LocalMesh:
    return distribute(comm, whole_of(*mesh) if comm.rank == 0 else None)


def test_ghosts_are_coupled_rows_with_the_values_of_their_owners(comm: MPI.Comm, part: LocalMesh) -> None:
    points = part.layout
    coupled = np.unique(np.concatenate([e.stencil.ravel() for e in part.elements.values()]))
    ghosts = coupled[coupled >= points.n_owned]
    np.testing.assert_array_equal(ghosts, np.arange(points.n_owned, points.n_local))
    assert not np.any((points.ghosts >= points.start) & (points.ghosts < points.start + points.n_owned))
    values = np.full((points.n_local, 3), np.nan)
    values[: points.n_owned] = points.global_number[: points.n_owned, None] + [0.0, 0.25, 0.5]
    points.update_ghosts(values)
    np.testing.assert_array_equal(values, points.global_number[:, None] + [0.0, 0.25, 0.5])


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_owners_get_the_sum_over_ranks(comm: MPI.Comm, part: LocalMesh, kind: type) -> None:
    points = part.layout
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
    sizes = comm.allgather(part.layout.n_owned)
    assert max(sizes) <= 1.15 * mesh[1] / comm.size
    # a straight cut has 41 vertices on each side; hinges couple one row more
    assert len(part.layout.ghosts) <= (0 if comm.size == 1 else 4 * 41)


def layers() -> GlobalMesh:
    """Four square sheets, 0.01 apart."""
    triangles, n = square(12, 12)
    flat = grid_sheet(Grid(width=1, height=1, nx=12, ny=12, pattern="alternating")).points
    whole = whole_of(np.concatenate([triangles + n * layer for layer in range(4)]), 4 * n)
    whole.positions = np.concatenate([flat + [0.0, 0.0, 0.01 * layer] for layer in range(4)])
    return whole


def test_each_rank_has_an_equal_part_of_all_layers(comm: MPI.Comm) -> None:
    part = distribute(comm, layers() if comm.rank == 0 else None)
    layer = part.layout.mesh_vertices // 169
    fraction = np.bincount(layer, minlength=4) / 169.0
    assert np.abs(fraction - 1.0 / comm.size).max() < 13.0 / 169.0  # within a row of vertices


def test_the_partitioner_can_be_chosen(comm: MPI.Comm) -> None:
    graph = vertex_graph([np.array([[i, i + 1] for i in range(11)])], 12) if comm.rank == 0 else None
    PETSc.Options()["mat_partitioning_type"] = "average"
    owner, name = partition(comm, graph, 12)
    if comm.size > 1:
        assert name == "average"
    if comm.rank == 0:
        np.testing.assert_array_equal(np.sort(np.unique(owner)), np.arange(comm.size))


def test_a_partitioner_that_petsc_lacks_is_refused(comm: MPI.Comm) -> None:
    if comm.size == 1:  # one rank needs no partitioner
        return
    PETSc.Options()["mat_partitioning_type"] = "scissors"
    with pytest.raises(InputError, match="scissors"):
        partition(comm, vertex_graph([np.array([[0, 1]])], 2) if comm.rank == 0 else None, 2)


def with_edges(triangles: Ints, n_vertices: int) -> GlobalMesh:
    """The mesh with an unknown on every other interior edge, coupled to the four vertices of its hinge."""
    quads = hinges(triangles).vertices[::2]
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    chosen = np.flatnonzero((np.sort(quads[:, :2], axis=1)[:, None] == edges).all(axis=2))
    index = (chosen % len(edges))[:, None]
    whole = whole_of(triangles, n_vertices)
    whole.elements["angles"] = Elements(quads, {"number": np.arange(len(quads), dtype=float)}, edges=index)
    whole.edges = edges
    return whole


@pytest.fixture
def mixed(comm: MPI.Comm, mesh: tuple[Ints, int]) -> LocalMesh:
    return distribute(comm, with_edges(*mesh) if comm.rank == 0 else None)


def test_rows_of_vertices_and_of_edges(comm: MPI.Comm, mesh: tuple[Ints, int], mixed: LocalMesh) -> None:
    layout, whole = mixed.layout, with_edges(*mesh)
    indices = whole.elements["angles"].edges
    assert indices is not None
    n_edges = len(np.unique(indices))
    assert (layout.n_vertices_global, layout.n_edges_global) == (mesh[1], n_edges)
    # every vertex, and every edge with an unknown, once
    for own, count in ((layout.mesh_vertices, mesh[1]), (layout.edges, n_edges)):
        np.testing.assert_array_equal(np.sort(np.concatenate(comm.allgather(own))), np.arange(count))
    assert layout.n_owned == layout.n_vertices + -(-layout.n_edges // 3)
    # a rank's unknowns are contiguous: those of its vertices, of its edges, and padding
    vertices = np.arange(3 * layout.n_vertices)
    indices = np.concatenate([vertices, layout.edge_indices, layout.padding])
    np.testing.assert_array_equal(indices, np.arange(3 * layout.n_owned))
    assert len(layout.padding) < 3
    np.testing.assert_array_equal(mixed.vertex_data["number"], layout.mesh_vertices)
    numbers = np.arange(layout.n_global)
    assert np.count_nonzero(layout.are_vertices(numbers)) == mesh[1]
    own = layout.start + np.arange(layout.n_owned)
    np.testing.assert_array_equal(layout.are_vertices(own), np.arange(layout.n_owned) < layout.n_vertices)
    # numbers that count only vertices are contiguous on each rank, too
    numbers = layout.vertex_numbers(own[: layout.n_vertices])
    bounds = layout.vertex_bounds
    np.testing.assert_array_equal(numbers, np.arange(bounds[comm.rank], bounds[comm.rank + 1]))
    np.testing.assert_array_equal(layout.local(layout.global_number), np.arange(layout.n_local))


def test_elements_find_the_unknowns_of_their_edges(
    comm: MPI.Comm, mesh: tuple[Ints, int], mixed: LocalMesh
) -> None:
    layout, whole = mixed.layout, with_edges(*mesh)
    indices = whole.elements["angles"].edges
    assert indices is not None
    assert whole.edges is not None
    carrying = np.unique(indices)
    # the value of a vertex is its number in the mesh, the value of an edge its index
    vertices = np.repeat(layout.mesh_vertices[:, None], 3, axis=1).astype(float)
    owned = layout.join(vertices, carrying[layout.edges].astype(float))
    found = layout.split(owned)
    np.testing.assert_array_equal(found[0], vertices)
    np.testing.assert_array_equal(found[1], carrying[layout.edges])
    values = np.full((layout.n_local, 3), np.nan)
    values[: layout.n_owned] = owned
    layout.update_ghosts(values)
    mine = np.zeros(mesh[1], dtype=bool)
    mine[layout.mesh_vertices] = True
    my_edges = np.zeros(len(whole.edges), dtype=bool)
    my_edges[carrying[layout.edges]] = True
    for name, elements in mixed.elements.items():
        of_mesh = whole.elements[name]
        touches = mine[of_mesh.stencil].any(axis=1)
        if of_mesh.edges is not None:
            touches |= my_edges[of_mesh.edges].any(axis=1)
        np.testing.assert_array_equal(np.sort(elements.index), np.flatnonzero(touches))
        np.testing.assert_array_equal(values[elements.stencil, 0], of_mesh.stencil[elements.index])
        if "number" in elements.data:
            np.testing.assert_array_equal(elements.data["number"], elements.index)
        if elements.edges is not None:
            assert of_mesh.edges is not None
            np.testing.assert_array_equal(values.ravel()[elements.edges], of_mesh.edges[elements.index])
        counted = np.concatenate(comm.allgather(elements.index[: elements.n_owned]))
        np.testing.assert_array_equal(np.sort(counted), np.arange(len(of_mesh.stencil)))


def test_further_ghosts_come_after_the_present_ones(comm: MPI.Comm, part: LocalMesh) -> None:
    layout = part.layout
    others = np.setdiff1d(np.arange(layout.n_global), layout.global_number)[::2]
    more = layout.with_ghosts(others)
    np.testing.assert_array_equal(more.global_number, np.concatenate([layout.global_number, others]))
    np.testing.assert_array_equal(more.local(more.global_number), np.arange(more.n_local))
    values = np.full((more.n_local, 3), np.nan)
    values[: more.n_owned] = more.global_number[: more.n_owned, None]
    more.update_ghosts(values)
    np.testing.assert_array_equal(values[:, 0], more.global_number)
    assert (more.n_vertices, more.n_edges) == (layout.n_vertices, layout.n_edges)
    more.destroy()


@pytest.mark.parametrize("near", [False, True], ids=["graph", "space"])
def test_tied_vertices_are_on_one_rank(near: bool, comm: MPI.Comm) -> None:
    """Otherwise the cheapest cut of two sheets would be their seam; the last vertex is tied to two."""
    triangles, n = square(20, 20)
    sheet = grid_sheet(Grid(width=1, height=1, nx=20, ny=20, pattern="alternating")).points
    right, left = (np.flatnonzero(sheet[:, 0] == x) for x in (1.0, 0.0))
    pairs = np.column_stack([n + left, right])
    ties = np.concatenate([pairs, [[n + left[-1], right[-2]]]])
    whole = whole_of(np.concatenate([triangles, n + triangles]), 2 * n)
    whole.elements |= {TIED: Elements(ties), "pairs": Elements(pairs)}
    whole.positions = np.concatenate([sheet, sheet + [1.5, 0.0, 0.0]]) if near else None
    part = distribute(comm, whole if comm.rank == 0 else None)
    own = part.elements["pairs"].stencil < part.layout.n_owned
    assert (own[:, 0] == own[:, 1]).all()
    assert comm.allreduce(int(own[:, 0].sum())) == 21
    sizes = comm.allgather(part.layout.n_owned)
    assert max(sizes) <= 1.1 * min(sizes)
