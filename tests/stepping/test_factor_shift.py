"""Incomplete factors: the diagonal is enlarged where they would be indefinite."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import grid, options, scene_of, shape, stepped

from lyra_petsc.stepping.newton import linear_system
from lyra_petsc.stepping.newton.linear_system import DiagonalShift

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
