"""Friction within the fabric: hysteresis of bending and shear, permanent folds, energy, ranks, resumption."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import end_on_one_rank, gathered, grid, scene_of

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

B, MOMENT, SHEAR, FORCE = 1e-5, 2e-4, 40.0, 0.5
FABRIC: dict[str, Any] = {
    "density": 0.15,
    "membrane": {"c11": 1000.0, "c22": 1000.0, "c12": 0.0, "c33": SHEAR},
    "bending": B,
}
LENGTH, WIDTH = 0.01, 0.002
PATH = [0.0, 50.0, 150.0, 250.0, 150.0, 50.0, 0.0, -50.0, -150.0, -250.0, -150.0, -50.0, 0.0, 50.0, 150.0]
"""Curvatures [1/m] of KES-F 2, from the second 50 on a closed loop."""


def bent(curvature: float) -> dict[str, Any]:
    """Positions of the end of a strip that is bent to an arc."""
    angle = curvature * LENGTH
    x = math.sin(angle) / curvature if curvature else LENGTH
    z = (1.0 - math.cos(angle)) / curvature if curvature else 0.0
    turned = LENGTH * math.cos(angle), LENGTH * math.sin(angle)
    return {
        "rotate": {"axis": [0.0, 1.0, 0.0], "degrees": -math.degrees(angle)},
        "translate": [x - turned[0], 0.0, z - turned[1]],
    }


def test_cyclic_bending_has_the_hysteresis_of_kes() -> None:
    share = 1.0 / (len(PATH) - 1)
    content = {
        "mesh": grid(LENGTH, WIDTH, 6, 1, "criss-cross"),
        "material": FABRIC | {"friction_moment": MOMENT},
        "handles": [
            {"group": "left", "clamp": True},
            {"group": "right", "clamp": True, "motion": "chuck", "interpolation": "linear"},
        ],
        "motions": {"chuck": [{"time": k * share, **bent(kappa)} for k, kappa in enumerate(PATH)]},
        "time": {"analysis": "static", "step": share},
    }
    moments, heats = [0.0], [0.0]
    with Bench(MPI.COMM_SELF) as bench, bench.simulation(content) as trial:
        while not trial.simulation.finished:
            trial.step()
            moments.append(float(trial.simulation.energy_balance.handle_moments()[0][1]) / WIDTH)
            heats.append(trial.simulation.energy_balance.budget.dissipation / (LENGTH * WIDTH))
    m = np.array(moments) if moments[1] > 0.0 else -np.array(moments)
    for up, down in ((13, 5), (14, 4), (11, 7)):  # 50, 150, −50
        assert PATH[up] == PATH[down]
        assert m[up] - m[down] == pytest.approx(2.0 * MOMENT, rel=0.01)
    assert (m[4] - m[5]) / 100.0 == pytest.approx(B, rel=0.03)  # coarse
    # ∮ m dκ from 50 to 50; at each reversal 4 1/m are elastic
    assert heats[13] - heats[1] == pytest.approx(2.0 * MOMENT * (500.0 - 4.0), rel=0.01)


def test_a_fold_remains() -> None:
    content = {
        "mesh": grid(0.06, 0.01, 6, 1),
        "material": FABRIC | {"friction_moment": MOMENT},
        "handles": [
            {"group": "left", "clamp": True},
            {"group": "right", "motion": "lift", "until": 0.5, "interpolation": "linear"},
        ],
        "motions": {"lift": [{"time": 0.0}, {"time": 0.5, "translate": [-0.03, 0.0, 0.04]}]},
        "time": {"analysis": "static", "step": 0.125},
    }
    with Bench(MPI.COMM_SELF) as bench, bench.simulation(content) as trial:
        x = trial.run().x
        budget = trial.simulation.energy_balance.budget
    # B κ = M_f at 20 1/m: larger curvatures return to this one
    assert x[:, 2].max() > 0.01
    assert budget.dissipation > 0.0
    assert budget.bending <= 0.55 * MOMENT * 20.0 * 0.06 * 0.01 + MOMENT * 0.06 * 0.01


def test_cyclic_shear_has_the_hysteresis_of_kes() -> None:
    side, path = 0.05, [0.0, 0.02, 0.04, 0.02, 0.0, -0.02, -0.04, -0.02, 0.0, 0.02]
    share = 1.0 / (len(path) - 1)
    content = {
        "mesh": grid(side, side, 2, 2),
        "material": FABRIC | {"bending": 0.0, "friction_force": FORCE},
        "handles": [
            {"group": "left"},
            {"group": "right", "motion": "sheared", "interpolation": "linear"},
            {"group": "bottom", "axes": ["x", "z"]},
            {"group": "top", "axes": ["x", "z"]},
        ],
        "motions": {
            "sheared": [{"time": k * share, "translate": [0.0, g * side, 0.0]} for k, g in enumerate(path)]
        },
        "time": {"analysis": "static", "step": share},
        "petsc": {"ts_adapt_dt_max": share},
    }
    with Bench(MPI.COMM_SELF) as bench, bench.simulation(content) as trial:
        forces = [0.0]
        while not trial.simulation.finished:
            trial.step()
            forces.append(-trial.simulation.energy_balance.handle_forces(4)[0][1] / side)
    f = np.array(forces) * np.sign(forces[1])
    assert f[9] - f[3] == pytest.approx(2.0 * FORCE, rel=1e-3)
    assert f[9] == pytest.approx(SHEAR * 0.02 + FORCE, rel=2e-2)


def falling(integrator: str, step: float = 0.002) -> dict[str, Any]:
    return {
        "mesh": grid(0.1, 0.03, 5, 2, "alternating"),
        "material": FABRIC | {"friction_moment": MOMENT, "friction_force": FORCE},
        "gravity": [0.0, 0.0, -9.81],
        "handles": [{"group": "left", "clamp": True}],
        "time": {"end": 0.05, "step": step, "integrator": integrator},
        "solver": {"force_tolerance": 1e-11, "step_tolerance": 1e-10},
        "petsc": {"ksp_rtol": 1e-10},
    }


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "bdf2", "alpha2"])
def test_the_energy_balance_closes(integrator: str) -> None:
    lost = []
    for step in (0.002, 0.001):
        simulation = SteppedScene(MPI.COMM_SELF, scene_of(falling(integrator, step)))
        start = simulation.energy_balance.budget.total
        while not simulation.finished:
            simulation.step()
        budget = simulation.energy_balance.budget
        assert budget.dissipation > 2e-6
        lost.append((budget.total - start + budget.dissipation - budget.external_work) / budget.dissipation)
        simulation.destroy()
    assert abs(lost[1]) < 0.75 * abs(lost[0]) or abs(lost[1]) < 0.02


@pytest.mark.parallel(3)
def test_a_run_resumes_on_another_number_of_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = scene_of(falling("beuler"))
    simulation = SteppedScene(comm, scene)
    while not simulation.finished:
        simulation.step()
    unbroken = gathered(simulation.problem.points, simulation.problem.equations.x)
    heat = simulation.energy_balance.budget.dissipation
    simulation.destroy()
    x = end_on_one_rank(comm, scene, shared_tmp / "run", 20)
    if x is not None:
        np.testing.assert_allclose(x, unbroken, rtol=0.0, atol=1e-8)
        lines = (shared_tmp / "run" / "history.csv").read_text(encoding="utf-8").splitlines()
        history = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
        assert float(history["dissipation"]) == pytest.approx(heat, rel=1e-5)
