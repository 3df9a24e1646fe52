"""Values written directly into PETSc's arrays are those that MatSetValues would set."""

from __future__ import annotations

import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from patience import run_program
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.points import Points


def symmetric(points: Points, pattern: BlockPattern, shift: float) -> np.ndarray:
    """Block rows of a symmetric matrix, the same on any number of ranks."""
    rows = points.start + np.repeat(np.arange(points.n_owned), np.diff(pattern.indptr))
    columns = points.global_number[pattern.columns]
    i, j = (3 * number[:, None] + np.arange(1, 4) for number in (rows, columns))
    return np.sin(shift + i[:, :, None] * j[:, None, :])


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij"])
def test_new_values_replace_old_ones(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        first, second = symmetric(points, pattern, 0.0), symmetric(points, pattern, 1.0)
        once, twice = (AssembledMatrix(points, pattern, kind) for _ in range(2))
        assert once.kind == kind
        once.set(second)  # the first time through MatSetValues
        twice.set(first)
        state = twice.mat.stateGet()
        twice.set(second)
        assert twice.mat.stateGet() > state  # or preconditioners would not be set up again
        assert twice.mat.equal(once.mat)
        x = PETSc.Vec().createMPI((3 * points.n_owned, 3 * points.n_global), bsize=3, comm=points.comm)
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        y = x.duplicate()
        twice.mat.mult(x, y)
        local = np.empty((points.n_local, 3))
        local[: points.n_owned] = x.getArray().reshape(-1, 3)
        points.update_ghosts(local)
        expected = simulation.problem.discretisation.rows.product(second, local)
        np.testing.assert_allclose(y.getArray().reshape(-1, 3), expected, rtol=0.0, atol=1e-12)
        for matrix in (once, twice):
            matrix.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["baij", "sbaij"])
def test_copies_of_a_matrix_multiply_by_their_own_values(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        matrix = AssembledMatrix(points, pattern, kind)
        matrix.set(symmetric(points, pattern, 0.5))
        copy = matrix.mat.duplicate(copy=True)
        copy.scale(3.0)
        x, y = matrix.mat.createVecs()
        z = y.duplicate()
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        matrix.mat.mult(x, y)
        copy.mult(x, z)
        np.testing.assert_allclose(z.getArray(), 3.0 * y.getArray(), rtol=0.0, atol=1e-11)
        for item in (matrix, copy):
            item.destroy()


@pytest.mark.parallel
def test_products_of_block_rows_agree_with_petscs(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        assembled, ours = AssembledMatrix(points, pattern, "baij"), BlockMatrix(points, pattern)
        received = []
        ours.observers.append(lambda rows: received.append(rows.copy()))
        x, y = ours.mat.createVecs()
        z, t = y.duplicate(), y.duplicate()
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        for shift in (0.5, 1.5):
            state = ours.mat.stateGet()
            for matrix in (assembled, ours):
                matrix.rows[:] = symmetric(points, pattern, shift)
                matrix.set(matrix.rows)
            assert ours.mat.stateGet() > state  # or preconditioners would not be set up again
            np.testing.assert_array_equal(received[-1], symmetric(points, pattern, shift))
            assembled.mat.mult(x, y)
            ours.mat.mult(x, z)
            ours.mat.multTranspose(x, t)
            np.testing.assert_allclose(z.getArray(), y.getArray(), rtol=0.0, atol=1e-12)
            np.testing.assert_array_equal(z.getArray(), t.getArray())
        for item in (assembled, ours, x, y, z, t):
            item.destroy()


@pytest.mark.parallel
def test_a_viewed_matrix_keeps_no_objects_alive(comm: MPI.Comm, shared_tmp: Path) -> None:
    # PETSc would free it at the end, when MPI is gone
    class Teller:
        def lines(self) -> list[str]:
            return ["one line more"]

    def seen(name: str) -> str:
        viewer = PETSc.Viewer().createASCII(str(shared_tmp / name), comm=comm)
        viewer.pushFormat(PETSc.Viewer.Format.ASCII_INFO)
        matrix.mat.view(viewer)
        viewer.destroy()
        return (shared_tmp / name).read_text() if comm.rank == 0 else ""

    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        teller = Teller()
        matrix = BlockMatrix(simulation.problem.points, simulation.problem.pattern, teller.lines)
        assert ("one line more" in seen("with")) == (comm.rank == 0)
        kept = weakref.ref(teller)
        del teller
        assert kept() is None
        assert "one line more" not in seen("without")
        matrix.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["baij", "aij", "sbaij"])
def test_an_enlarged_diagonal_is_that_of_the_enlarged_rows(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        values = symmetric(points, pattern, 0.5)
        enlarged = values.copy()
        enlarged[pattern.indptr[:-1]] *= 1.3
        matrix, larger = (AssembledMatrix(points, pattern, kind) for _ in range(2))
        larger.set(enlarged)
        before = values.copy()
        matrix.set(values, 0.3)
        np.testing.assert_array_equal(values, before)  # the operator's values are unchanged
        assert matrix.mat.equal(larger.mat)
        ours = BlockMatrix(points, pattern)
        ours.set(values, 0.3)
        np.testing.assert_allclose(ours.rows, enlarged, rtol=1e-15)
        for item in (matrix, larger, ours):
            item.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["baij", "aij"])
def test_a_diagonal_matrix_stores_diagonal_blocks_only(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        values = symmetric(points, pattern, 0.5)
        part = AssembledMatrix(points, pattern, kind, diagonal=True)
        assert part.rows.shape == values.shape
        for _ in range(2):  # through MatSetValues, and straight into the arrays
            part.set(values)
        found = part.mat.getDiagonalBlock().getValuesCSR()[2].reshape(-1, 3, 3)
        # PETSc stores blocks by rows, the program by columns
        np.testing.assert_array_equal(found, values[pattern.indptr[:-1]].transpose(0, 2, 1))
        assert part.mat.getInfo()["nz_used"] == 9 * points.n_global


SCRIPT = """
import petsc4py
petsc4py.init(["test", "-pc_type", "{kind}"])
from mpi4py import MPI
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene

scene = Scene.model_validate({scene})
for destroy in (True, False):
    simulation = SteppedScene(MPI.COMM_SELF, scene)
    simulation.step()
    if destroy:
        simulation.destroy()
"""


@pytest.mark.parametrize("kind", ["gamg", "mg"])
def test_a_program_may_end_before_its_solvers_are_freed(kind: str) -> None:
    """PETSc frees them after Python has ended, and must not call matrices of type python then."""
    scene = {"mesh": grid(1, 1, 8, 8), "material": CLOTH, "time": {"end": 1, "step": 0.01}}
    script = SCRIPT.format(kind=kind, scene=scene)
    done = run_program([sys.executable, "-c", script], seconds=120)
    assert done.returncode == 0, done.stderr
