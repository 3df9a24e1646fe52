"""The paper scene against an ensemble of explicit calculations.

It is chaotic, so that means are compared, with tolerances above the ensemble's spread.
References: ``tests/reference/paper.json``, made by ``scripts/references/paper.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from module_of import module_of
from mpi4py import MPI
from physics import finished, reference

from lyra_petsc.scene.load import load_scene

ROOT = Path(__file__).resolve().parents[2]
ANSWERS = reference("paper")


def end_of(integrator: str, step: float) -> tuple[float, float]:
    """Relative error of the kinetic energy and distance [m] of the centre of mass at t = 0.48 s."""
    settings = (f"time.integrator={integrator}", f"time.step={step}")
    with finished(MPI.COMM_SELF, load_scene(ROOT / "configs" / "paper.yaml", settings)) as simulation:
        equations, mean = simulation.problem.equations, ANSWERS["mean"]
        centre = equations.mass @ equations.x / equations.mass.sum()
        apart = np.linalg.norm(centre[1:] - [mean["mean_y"][-1], mean["mean_z"][-1]])
        return simulation.budget.kinetic / mean["kinetic_energy"][-1] - 1.0, float(apart)


@pytest.mark.slow
def test_bdf2_agrees_with_the_ensemble() -> None:
    energy, apart = end_of("bdf2", 0.005)
    assert abs(energy) < 0.07
    assert apart < 0.01


def test_semi_implicit_steps_lock() -> None:
    energy, apart = end_of("semi-implicit", 0.005)
    assert energy < -0.7
    assert apart > 0.2


def test_reference_is_reproduced_by_its_script(monkeypatch: pytest.MonkeyPatch) -> None:
    script = module_of(ROOT / "scripts" / "references" / "paper.py")
    monkeypatch.setattr(script, "TIMES", tuple(ANSWERS["times"][:3]))
    rows = script.motion(1e-9, seed=1)
    for column in ("kinetic_energy", "mean_y", "mean_z", "edge_y", "edge_z"):
        found = rows[:, script.COLUMNS.index(column)]
        np.testing.assert_allclose(found, ANSWERS["mean"][column][:3], atol=2e-5, err_msg=column)
    np.testing.assert_allclose(rows[:, script.COLUMNS.index("total_energy")], 0.0, atol=1e-8)
