"""Matrices of PETSc: enlarged diagonals, and the end of a program that has not freed them."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from mpi4py import MPI
from patience import run_program
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
