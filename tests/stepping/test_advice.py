"""Advice after a failed step: it fits the cause, and names the key or option to change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from petsc4py import PETSc
from physics import grid, scene_of

from lyra_petsc.stepping.failure.failure_advice import FailedStep, advice, failure_kind
from lyra_petsc.stepping.failure.failure_diagnosis import Diagnosis, Triangle, Vertex
from lyra_petsc.stepping.newton.newton_trace import FailedSolve, Iteration

SNES = PETSc.SNES.ConvergedReason
KSP = PETSc.KSP.ConvergedReason

NOW = FailedStep(
    dt=1e-6, nominal=0.01, spacing=0.1, floor=1e-12, max_iterations=50,
    iterations_key="solver.max_iterations",
    linear_iterations=5000, preconditioner="pbjacobi", ranks=1,
)  # fmt: skip
VERTEX = Vertex(
    number=4, tag=0, position=(0.0, 0.0, 0.0), before=(0.0, 0.0, 0.0), residual=(1.0, 0.0, 0.0),
    forces={"inertia": 1.0, "internal": 2.0, "loads": 1.0}, moved=0.0, mass=1.0,
)  # fmt: skip
TRIANGLE = Triangle(
    number=7, vertices=(1, 2, 4), centre=(0.0, 0.0, 0.0), residual=1.0, aspect=2.0, stretches=(0.9, 1.1)
)
DIAGNOSIS = Diagnosis(
    norm=1.0, scale=2.0, not_finite=0, iterate_finite=True, overflowing=[], vertex=VERTEX, triangle=TRIANGLE,
    handle=None, jump=0.0,
)  # fmt: skip
NONE = np.empty((0, 3))
STUCK = FailedSolve(
    iterations=(), norm=1.0, time=0.0, velocity=NONE, position=NONE, residual=NONE, forces={},
    prescribed=np.empty((0, 3), dtype=bool), goal=NONE, snes_reason=SNES.DIVERGED_LINE_SEARCH, ksp_reason=2,
    linear_residuals=np.empty(0),
)  # fmt: skip


def iterations(*norms: float, linear: int = 2) -> tuple[Iteration, ...]:
    return tuple(Iteration(norm, 3, linear if n else 0, 1.0 if n else None) for n, norm in enumerate(norms))


def advised(
    diagnosis: Diagnosis = DIAGNOSIS,
    solve: FailedSolve = STUCK,
    now: FailedStep = NOW,
    **scene: Any,
) -> list[str]:
    content = {"mesh": grid(1, 1, 2, 2), "handles": [{"nodes": [0]}, {"nodes": [8], "motion": "lift"}],
               "motions": {"lift": [{"time": 0}, {"time": 1, "translate": [0, 0, 1]}]}}  # fmt: skip
    return advice(diagnosis, solve, scene_of(content | scene), now)


@pytest.mark.parametrize(
    ("diagnosis", "now", "words"),
    [
        (replace(DIAGNOSIS, handle=1, jump=0.2), NOW, "motions.lift (handles[1] moves 0.2 m in this step"),
        (replace(DIAGNOSIS, handle=0, jump=0.2), NOW, "a motion without jumps (handles[0]"),
        (replace(DIAGNOSIS, triangle=replace(TRIANGLE, stretches=(0.5, 1.0))), NOW, "triangle 7 is at 0.5"),
        (replace(DIAGNOSIS, triangle=replace(TRIANGLE, stretches=(1.0, 3.0))), NOW, "more material.membrane"),
        (replace(DIAGNOSIS, triangle=replace(TRIANGLE, aspect=1e3)), NOW, "aspect ratio of 1e+03"),
        (replace(DIAGNOSIS, vertex=replace(VERTEX, forces={"wind": 10.0})), replace(NOW, dt=0.1),
         "less wind.velocity, or a smaller time.step (wind alone would move vertex 4 by 0.1 m"),
        (replace(DIAGNOSIS, norm=1e-5), NOW, "solver.force_tolerance: 1e-05, if that is accurate enough"),
        (replace(DIAGNOSIS, norm=1e-7, scale=1.0), NOW, "solver.step_tolerance above 1e-09"),
        (replace(DIAGNOSIS, norm=1e-11), NOW, "the residual is near its round-off"),
        (DIAGNOSIS, replace(NOW, dt=0.005), "-ts_adapt_dt_min below 0.005"),
    ],
)  # fmt: skip
def test_advice_after_a_nonlinear_failure(diagnosis: Diagnosis, now: FailedStep, words: str) -> None:
    tolerances = {"force_tolerance": 1e-6, "step_tolerance": 1e-9}
    lines = advised(diagnosis, now=now, solver=tolerances)
    assert failure_kind(diagnosis, STUCK) == "nonlinear trouble"
    assert words in lines[0]


def test_causes_that_do_not_apply_are_not_mentioned() -> None:
    assert advised() == ["more material.damping, or a finer mesh"]


def test_advice_if_the_maximum_of_iterations_is_reached() -> None:
    ran_out = replace(STUCK, snes_reason=SNES.DIVERGED_MAX_IT, iterations=iterations(1.0, 1.0, 1.0, 1.0, 0.9))
    falling = replace(ran_out, iterations=iterations(1.0, 0.5, 0.3, 0.1, 0.01))
    assert advised(solve=falling)[0] == "solver.max_iterations above 50 (the residual was still falling)"
    assert "more material.damping" in advised(solve=ran_out)[0]
    few = replace(NOW, max_iterations=4, iterations_key="-snes_max_it")
    assert advised(solve=ran_out, now=few)[0] == "-snes_max_it above 4"


@pytest.mark.parametrize(
    ("reason", "now", "words"),
    [
        (KSP.DIVERGED_MAX_IT, replace(NOW, linear_iterations=10), "-ksp_max_it above 10"),
        (KSP.DIVERGED_MAX_IT, replace(NOW, ranks=2), "-pc_type lu -pc_factor_mat_solver_type mumps"),
        (KSP.DIVERGED_INDEFINITE_MAT, NOW, "solver.hessian: regularised"),
        (KSP.DIVERGED_INDEFINITE_PC, NOW, "a direct solver: -pc_type lu"),
        (-11, replace(NOW, preconditioner="cholesky"), "-pc_factor_shift_type positive_definite"),
    ],
)
def test_advice_after_a_linear_failure(reason: int, now: FailedStep, words: str) -> None:
    stuck = replace(STUCK, snes_reason=SNES.DIVERGED_LINEAR_SOLVE, ksp_reason=int(reason))
    assert failure_kind(DIAGNOSIS, stuck) == "linear trouble"
    assert words in advised(solve=stuck, now=now)[0]


def test_occasional_linear_failures_are_not_the_cause() -> None:
    stuck = replace(STUCK, snes_reason=SNES.DIVERGED_MAX_IT, ksp_reason=int(KSP.DIVERGED_INDEFINITE_MAT))
    mixed = (*iterations(1.0, 1.0, 1.0, 1.0), *iterations(1.0, 1.0, linear=-10)[1:])
    assert failure_kind(DIAGNOSIS, replace(stuck, iterations=mixed)) == "nonlinear trouble"
    assert (
        failure_kind(DIAGNOSIS, replace(stuck, iterations=iterations(1.0, 1.0, linear=-10)))
        == "linear trouble"
    )


@pytest.mark.parametrize(
    ("diagnosis", "words"),
    [
        (replace(DIAGNOSIS, not_finite=1, overflowing=["wind"]), "wind.velocity"),
        (
            replace(DIAGNOSIS, norm=float("inf"), overflowing=["internal"]),
            "material and the units of the mesh",
        ),
        (replace(DIAGNOSIS, not_finite=9, iterate_finite=False), "mesh.transform.scale"),
        (replace(DIAGNOSIS, not_finite=9, vertex=replace(VERTEX, moved=1e9)), "initial"),
    ],
)
def test_advice_after_an_overflow(diagnosis: Diagnosis, words: str) -> None:
    assert failure_kind(diagnosis, STUCK) == "overflow"
    assert words in advised(diagnosis)[0]


def test_advice_for_a_static_analysis_without_handles() -> None:
    lines = advised(handles=[], motions={}, time={"analysis": "static"})
    assert lines[0] == "handles (nothing holds the sheet)"
