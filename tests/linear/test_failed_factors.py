"""Recovery from factorisations that failed."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import grid, shape, stepped

from lyra_petsc.errors import SolverError
from lyra_petsc.linear.failed_factors import replace_failed
from lyra_petsc.linear.hierarchy import Level
from lyra_petsc.linear.pattern import BlockPattern, diagonal_keys
from lyra_petsc.linear.presets import PRESETS
from lyra_petsc.linear.vcycle import Coarsest
from lyra_petsc.mesh.points import Points
from lyra_petsc.stepping.stepper import Stepper

FAILED = PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
WORKSPACE = "mat_mumps_icntl_14"


@pytest.mark.parametrize("kind", ["ilu", "bjacobi", "cholesky", "redundant"])
def test_a_regular_matrix_is_factored_after_a_failure(kind: str) -> None:
    mat = PETSc.Mat().createBAIJ(((12, 12), (12, 12)), 3, nnz=4, comm=PETSc.COMM_SELF)

    def fill(diagonal: float) -> None:
        values = np.ones((12, 12))
        np.fill_diagonal(values, diagonal)
        for i, row in enumerate(values):
            mat.setValues(i, np.arange(12, dtype=PETSc.IntType), row)
        mat.assemble()

    fill(1.0)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setType("cg")
    ksp.getPC().setType(kind)
    b, x = mat.createVecs()
    b.set(1.0)
    ksp.setOperators(mat)
    ksp.solve(b, x)
    assert ksp.getConvergedReason() == FAILED
    assert not replace_failed(ksp)
    assert ksp.getConvergedReason() == FAILED
    fill(3.0)
    ksp.setOperators(mat)
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    np.testing.assert_allclose(x.getArray(), 1.0 / 14.0, rtol=1e-4)
    # nothing failed
    pc = ksp.getPC()
    assert not replace_failed(ksp)
    assert ksp.getPC() == pc


@pytest.mark.parallel
def test_the_coarsest_level_is_solved_again(comm: MPI.Comm) -> None:
    for name, value in PRESETS["multigrid"].items():
        if name.startswith("mg_coarse_"):
            PETSc.Options().setValue(name, value)
    points = Points(comm, 4 * np.arange(comm.size + 1), np.empty(0, dtype=np.int64))
    level = Coarsest(Level(points, BlockPattern.of_keys(diagonal_keys(4, 4), 4, 4)))
    found = []
    for stiffness in (0.0, 2.0):
        level.set(np.tile(stiffness * np.eye(3), (4, 1, 1)), np.ones((4, 3)))
        level.b[:] = 1.0
        level.solve()
        found.append(level.x.copy())
    level.destroy()
    points.destroy()
    assert not np.isfinite(found[0]).any()
    np.testing.assert_allclose(found[1], 0.5)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit"])
def test_mumps_gets_more_workspace(comm: MPI.Comm, integrator: str) -> None:
    if not PETSc.Sys.hasExternalPackage("mumps"):
        pytest.skip("this PETSc has no MUMPS")
    scene = {
        "mesh": grid(1.0, 1.0, 20, 20),
        "material": {"cloth": "gray-interlock"},
        "gravity": [0, 0, -9.81],
        "handles": [{"nodes": [0, 20]}],
        "time": {"end": 0.02, "step": 0.01, "integrator": integrator},
    }
    asked = {"mat_type": "aij", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
    ends = []
    for margin in (200, -50):
        with stepped(comm, scene, **asked, **{WORKSPACE: margin}) as simulation:
            simulation.step()
            simulation.step()
            assert simulation.notes == []
            used = PETSc.Options().getInt(WORKSPACE)
            assert used == margin if margin > 0 else used >= 20
            ends.append(shape(simulation))
    np.testing.assert_allclose(*ends, atol=1e-9)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit"])
def test_an_error_in_the_set_up_is_left_to_the_next_solver(
    comm: MPI.Comm, integrator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = {"mesh": grid(1.0, 1.0, 20, 20), "gravity": [0, 0, -9.81], "handles": [{"nodes": [0, 20]}]}
    scene["time"] = {"end": 0.02, "step": 0.01, "integrator": integrator}
    monkeypatch.setattr(Stepper, "_candidates", lambda stepper: ["gamg", "block-jacobi"])
    asked_for = {"mg_levels_pc_type": "unknown"}
    with (
        stepped(comm, scene, **asked_for) as simulation,
        pytest.raises(SolverError, match="check -mg_levels_pc_type"),
    ):
        simulation.step()
    monkeypatch.setitem(PRESETS, "gamg", PRESETS["gamg"] | asked_for)
    with stepped(comm, scene) as simulation:
        simulation.step()
        assert simulation.notes == ["step 1: linear solver 'gamg' broke down, going on with 'block-jacobi'"]
