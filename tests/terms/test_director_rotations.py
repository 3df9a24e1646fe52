"""How directors follow vertices between the levels of multigrid."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, grid

from lyra_petsc.terms.bending.director_rotations import DirectorRotations
from lyra_petsc.terms.bending.midedge import MidEdge

pytestmark = pytest.mark.parallel

SHEET = {
    "mesh": grid(0.6, 0.4, 7, 5, "alternating"),
    "material": CLOTH | {"bending": 2e-2, "bending_model": "midedge"},
}


@pytest.fixture
def bent(comm: MPI.Comm) -> Iterator[tuple[Simulation, MidEdge, DirectorRotations]]:
    """A sheet with waves, and the map at its positions."""
    with Simulation(SHEET, comm) as simulation:
        term, x = simulation.problem.terms["midedge"], simulation.system.x
        assert isinstance(term, MidEdge)
        layout = simulation.problem.points
        rows = layout.are_vertices(layout.global_number)
        x[rows, 2] += 0.03 * np.cos(9.0 * x[rows, 0]) * np.sin(7.0 * x[rows, 1])
        term.initialise(x)
        turns = DirectorRotations(term, layout.n_owned)
        turns.update(x)
        yield simulation, term, turns


def test_rigid_motions_bend_nothing(
    bent: tuple[Simulation, MidEdge, DirectorRotations], comm: MPI.Comm
) -> None:
    simulation, term, turns = bent
    layout, x = simulation.problem.points, simulation.system.x
    rows = layout.are_vertices(layout.global_number)
    blocks = simulation.system.discretisation.rows
    blocks.add_stiffness(term, x, term.frames, 1.0, 1.0, values := blocks.zeros())
    for axis in np.eye(3):
        moved = np.zeros_like(x, dtype=np.float32)
        moved[rows] = np.cross(axis, x[rows])
        stiff = np.abs(blocks.product(values, moved.astype(np.float64))).max(initial=0.0)
        turns.mult_add(moved)
        layout.update_ghosts(moved)
        left = np.abs(blocks.product(values, moved.astype(np.float64))).max(initial=0.0)
        assert comm.allreduce(left, MPI.MAX) < 1e-5 * comm.allreduce(stiff, MPI.MAX)


def test_mult_transpose_add_is_the_transpose(bent: tuple[Simulation, MidEdge, DirectorRotations]) -> None:
    simulation, _, turns = bent
    x = simulation.system.x
    layout = simulation.problem.points
    vertices = layout.are_vertices(layout.global_number)[:, None]
    movement = np.where(vertices, np.cos(31.0 * np.arange(x.size)).reshape(x.shape), 0.0).astype(np.float32)
    force = np.where(vertices, 0.0, np.sin(17.0 * np.arange(x.size)).reshape(x.shape)).astype(np.float32)
    followed, gathered = movement.copy(), np.column_stack([force, np.zeros(len(x), dtype=np.float32)])
    turns.mult_add(followed)
    turns.mult_transpose_add(force, gathered)
    there, back = np.vdot(followed - movement, force), np.vdot(movement, gathered[:, :3] - force)
    assert there == pytest.approx(back, rel=1e-4)
    assert abs(there) > 0.1


def test_prescribed_directors_do_not_rotate(bent: tuple[Simulation, MidEdge, DirectorRotations]) -> None:
    simulation, term, turns = bent
    x = simulation.system.x
    held = np.zeros(x.shape, dtype=bool)
    held.ravel()[term.of_edges.indices[::2]] = True
    turns.exclude(held)
    turns.update(x)
    followed = np.ones_like(x, dtype=np.float32)
    followed[:, 2] = x[:, 0]
    before = followed.copy()
    turns.mult_add(followed)
    np.testing.assert_array_equal(followed[held], before[held])
    assert np.abs(followed - before)[~held].max() > 0.1 * term.of_edges.length.min()
