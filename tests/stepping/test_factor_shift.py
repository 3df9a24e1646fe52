"""Incomplete factors: the diagonal is enlarged where they would be indefinite."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import grid, options, scene_of, shape, stepped

from lyra_petsc import phases as profiling
from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix
from lyra_petsc.linear.presets import INCOMPLETE
from lyra_petsc.stepping.newton import linear_system
from lyra_petsc.stepping.newton.linear_system import MAX_SHIFT, MIN_SHIFT, DiagonalShift

KERSHAW = np.array([[3.0, -2, 0, 2], [-2, 3, -2, 0], [0, -2, 3, -2], [2, 0, -2, 3]])
"""A positive-definite matrix with indefinite incomplete factors (Kershaw, J. Comput. Phys. 26, 1978, 43-65).

"""

HANGING: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 29, 29),
    "material": {"cloth": "gray-interlock", "damping": 0.03},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [870, 899]}],
}
"""A scene in which factors without a shift break down in step 22 of 40 ms."""


def solver(kind: str) -> tuple[PETSc.KSP, PETSc.Mat]:
    """CG, with incomplete factors of a matrix other than that of the system."""
    rows, columns = np.nonzero(KERSHAW)
    mats = []
    for _ in range(2):
        mat = PETSc.Mat().createAIJ((4, 4), nnz=3, comm=PETSc.COMM_SELF)
        for i, j in zip(rows, columns, strict=True):
            mat.setValue(i, j, KERSHAW[i, j])
        mat.assemble()
        mats.append(mat)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOperators(*mats)
    ksp.setType("cg")
    ksp.getPC().setType(kind)
    return ksp, mats[1]


def test_the_shift_grows_until_factors_exist_and_decreases_again() -> None:
    ksp, preconditioner = solver("ilu")
    b, y = preconditioner.createVecs()
    b.setArray([1.0, 2.0, -1.0, 3.0])
    growing = DiagonalShift(ksp, enabled=True)
    assert growing.value == MIN_SHIFT
    tries = 0
    while True:
        diagonal = np.diag(KERSHAW) * (1.0 + growing.value)
        for i in range(4):
            preconditioner.setValue(i, i, diagonal[i])
        preconditioner.assemble()
        ksp.solve(b, y)
        if ksp.getConvergedReason() > 0:
            break
        tries += 1
        assert growing.increase()
    assert tries > 0
    assert MIN_SHIFT < growing.value <= MAX_SHIFT
    np.testing.assert_allclose(KERSHAW @ y.getArray(), b.getArray(), atol=1e-4)
    # without a failure the shift does not grow
    assert not growing.increase()
    before = growing.value
    growing.decrease()
    assert MIN_SHIFT <= growing.value < before


@pytest.mark.parametrize(("kind", "acts"), [("ilu", False), ("jacobi", True)])
def test_other_preconditioners_have_no_shift(kind: str, acts: bool) -> None:
    ksp, _ = solver(kind)
    idle = DiagonalShift(ksp, enabled=acts)
    assert idle.value == 0.0
    assert not idle.increase()


def journey(comm: MPI.Comm, integrator: str, step: float = 0.04) -> tuple[Any, list[str], str]:
    """Positions after 25 steps, notes on the solver, and the linear solver at the end."""
    scene = scene_of(HANGING | {"time": {"end": 1.0, "step": step, "integrator": integrator}})
    tight = {"ksp_rtol": "1e-10"} if integrator == "semi-implicit" else {}
    with stepped(comm, scene, **tight) as simulation:
        for _ in range(25):
            simulation.step()
        x = shape(simulation)
    # semi-implicit steps as long as these make energy, which is noted too
    notes = [note for note in simulation.notes if "energy" not in note]
    return x, notes, simulation.stepper.preset


@pytest.mark.parallel(2)
def test_no_other_solver_is_needed(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    incomplete = "ilu" if comm.size == 1 else "block-ilu"
    x, notes, preset = journey(comm, "semi-implicit")
    assert (notes, preset) == ([], incomplete)
    if comm.size == 1:
        monkeypatch.setattr(linear_system, "MIN_SHIFT", 0.0)
        monkeypatch.setattr(DiagonalShift, "increase", lambda self: False)
        other, notes, preset = journey(comm, "semi-implicit")
        assert preset != "ilu"
        assert "linear solver 'ilu' broke down" in notes[0]
        np.testing.assert_allclose(x, other, atol=2e-5)


@pytest.mark.parallel(2)
def test_newton_converges_to_the_same_state_as_with_a_direct_solver(comm: MPI.Comm) -> None:
    ends = []
    for kind in ("cholesky", "ilu" if comm.size == 1 else "bjacobi"):
        with options({"pc_type": kind}):
            x, notes, preset = journey(comm, "beuler", 0.005)
        assert (notes, preset) == ([], "user")
        ends.append(x)
    np.testing.assert_allclose(*ends, atol=1e-5)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("lag", [1, 2, None])
def test_factors_are_computed_as_often_as_lagging_allows(comm: MPI.Comm, lag: int | None) -> None:
    scene = HANGING | {"time": {"end": 1.0, "step": 0.005, "integrator": "semi-implicit"}}
    # SNES decides after the Jacobian whether factors are due
    given = {"snes_lag_preconditioner": f"{lag}", "snes_lag_preconditioner_persists": "true"} if lag else {}
    PETSc.Log.begin()
    made, stage = PETSc.Log.Event("MatLUFactorNum"), profiling.STAGES["solve"].id
    with stepped(comm, scene, **given) as simulation:
        assert simulation.stepper.preset in INCOMPLETE
        linear = simulation.stepper.linear
        assert isinstance(linear.operator, BlockMatrix)
        assert isinstance(linear.preconditioner, AssembledMatrix)
        before = made.getPerfInfo(stage)["count"]
        for _ in range(12):
            simulation.step()
        times = made.getPerfInfo(stage)["count"] - before
        # without the option as often as iterations ask for it
        assert times == 12 / lag if lag else 1 <= times <= 6
