"""Residuals below round-off: steps are still taken, with a note."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, gathered, grid

pytestmark = pytest.mark.parallel(2)

GRAVITY = 9.81


def after_a_step(stiffness: float, comm: MPI.Comm) -> tuple[float, list[str]]:
    """Lowest z [m] of a light sheet after one step, and the notes."""
    c = 120.0 * stiffness
    scene: dict[str, Any] = {
        "mesh": grid(1.0, 1.0, 8, 8, "alternating"),
        "material": CLOTH | {"density": 1.5e-4, "membrane": {"c11": c, "c22": c, "c12": c / 3, "c33": c / 4}},
        "gravity": [0.0, 0.0, -GRAVITY],
        "handles": [{"nodes": [0, 8]}],
        "time": {"end": 0.005, "step": 0.005},
    }
    with finished(comm, scene) as simulation:
        points = simulation.problem.points
        lowest = float(gathered(points, simulation.problem.equations.x)[:, 2].min())
        notes = [note for note in simulation.notes if "round-off" in note]
    return lowest, notes


def test_a_sheet_whose_weight_is_below_the_floor_still_falls(comm: MPI.Comm) -> None:
    lowest, notes = after_a_step(1e9, comm)
    assert lowest < -0.1 * GRAVITY * 0.005**2
    assert len(notes) == 1
    assert "times the loads" in notes[0]


def test_an_equilibrium_with_a_residual_as_large_as_the_loads_is_doubted(comm: MPI.Comm) -> None:
    scene = {
        "mesh": grid(1.0, 0.25, 8, 2, "alternating"),
        "material": {"young": 1e13, "poisson": 0.3, "thickness": 1e-3, "density": 1e-5},
        "gravity": [0.0, 0.0, -GRAVITY],
        "handles": [{"group": "left", "clamp": True}],
        "time": {"analysis": "static", "step": 1.0},
    }
    with finished(comm, scene) as simulation:
        assert any("may make it wrong" in note for note in simulation.notes)


def test_soft_sheets_converge_without_a_note(comm: MPI.Comm) -> None:
    lowest, notes = after_a_step(1.0, comm)
    assert np.isclose(lowest, -GRAVITY * 0.005**2, rtol=0.05)
    assert notes == []


def test_a_strongly_pressed_sheet_needs_no_shorter_steps(comm: MPI.Comm) -> None:
    """Contact forces are far above all others, and their round-off above the scene's tolerance."""
    low, height, gap = -0.0049, 5e-5, 0.005
    plates = {
        "low": {"plane": {"point": [0.0, 0.0, low], "normal": [0.0, 0.0, 1.0]}},
        "high": {
            "plane": {"point": [0.0, 0.0, 0.01], "normal": [0.0, 0.0, -1.0]},
            "motion": [{"time": 0.0}, {"time": 0.3, "translate": [0.0, 0.0, low + height - 0.01]}],
        },
    }
    scene: dict[str, Any] = {
        "mesh": grid(0.2, 0.2, 4, 4, "alternating") | {"transform": {"translate": [0.9, 0.9, 0.0]}},
        "material": {"cloth": "gray-interlock", "damping": 0.01},
        "gravity": [0.0, 0.0, -GRAVITY],
        "contact": {"gap": gap, "friction": 0.3},
        "obstacles": plates,
        "time": {"end": 0.35, "step": 0.01},
        "solver": {},
    }
    with finished(comm, scene) as simulation:
        force = simulation.energy_balance.obstacle_forces(2)[:, 2]
        newton, steps = simulation.totals["newton_iterations"], simulation.step_number
        notes = [note for note in simulation.notes if "round-off" in note]
    assert force[1] > 2e4
    assert np.isclose(force[0], -force[1], rtol=1e-4)
    assert steps <= 40
    assert newton <= 4 * steps
    assert len(notes) == 1
