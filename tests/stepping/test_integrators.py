"""Integrators: their weights, what they conserve and damp, and handles under all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, equilateral, grid

from lyra_petsc.arrays import Array
from lyra_petsc.scene.schema import INTEGRATORS
from lyra_petsc.stepping.integrators.alpha2 import GeneralisedAlpha
from lyra_petsc.stepping.integrators.bdf2 import Bdf2

SECOND_ORDER = ("midpoint", "alpha2", "bdf2")


def timed(integrator: str, **more: Any) -> dict[str, Any]:
    return {"time": {"end": 100.0, "step": 1.0, "integrator": integrator, **more}}


def parabola(t: float) -> Array:
    return np.array([[3.0 - 2.0 * t + 5.0 * t * t, t * t, 1.0]])


@pytest.mark.parametrize("steps", [(0.1, 0.03), (0.1, 0.2), (0.1, 0.1, 0.1), (0.1, 0.1, 0.15)])
def test_bdf2_differentiates_parabolas_exactly(steps: tuple[float, ...]) -> None:
    scheme, times = Bdf2(), np.concatenate([[0.0], np.cumsum(steps)])
    for i, step in enumerate(steps[:-1]):
        scheme.record_step(parabola(times[i]), parabola(times[i]), np.ones((1, 3), dtype=bool), step)
    stage = scheme.stage(parabola(times[-2]), parabola(times[-2]), steps[-1])
    assert stage.x is not None
    slope = stage.sigma * (parabola(times[-1]) - stage.x)
    assert slope == pytest.approx(np.array([[-2.0 + 10.0 * times[-1], 2.0 * times[-1], 0.0]]), abs=1e-12)
    assert sum(scheme.weights(steps[-1])[1]) == pytest.approx(1.0, abs=1e-14)


def amplification(radius: float, omega_dt: float) -> float:
    """Spectral radius of generalised-α on an oscillator, from its recurrences."""
    columns = []
    for unit in np.eye(3):
        x, v, a = (np.array([[value]]) for value in unit)
        scheme = GeneralisedAlpha(radius)
        scheme.set_acceleration(a)
        stage = scheme.stage(x, v, 1.0)
        assert stage.x is not None
        assert stage.v is not None
        # σ (u − v_h) + ω² (x_h + c u) = 0
        u = (stage.sigma * stage.v - omega_dt**2 * stage.x) / (stage.sigma + omega_dt**2 * stage.c)
        end_x, end_v = scheme.end(x, v, u, 1.0)
        scheme.record_step(x, v, np.ones((1, 1), dtype=bool), 1.0)
        columns.append([end_x[0, 0], end_v[0, 0], scheme.saved_state()[0]["acceleration"][0, 0]])
    return float(np.abs(np.linalg.eigvals(np.array(columns).T)).max())


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_alpha2_damps_high_frequencies_to_its_spectral_radius(radius: float) -> None:
    # a triple eigenvalue at infinity: its root is only reached slowly
    assert amplification(radius, 1e7) == pytest.approx(radius, abs=2e-2)
    assert amplification(radius, 1e-3) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", SECOND_ORDER)
def test_free_fall_is_exact(integrator: str, comm: MPI.Comm) -> None:
    content = {"mesh": grid(1, 1, 2, 2), "gravity": [0, 0, -9.81]} | timed(integrator)
    with Simulation(content, comm) as simulation:
        x = simulation.run(0.1, 7)
        assert x[:, 2] == pytest.approx(-9.81 * 0.7**2 / 2, abs=1e-10)
        assert simulation.v[:, 2] == pytest.approx(-9.81 * 0.7, abs=1e-10)


def energy_left(integrator: str, folder: Path, **more: float) -> float:
    """Share of the energy of a breathing triangle after 40 steps of 0.3 rad."""
    stiffness, radius = 1000.0, 1.0
    membrane = {"c11": stiffness, "c22": stiffness, "c12": 0.0, "c33": 0.5 * stiffness}
    content: dict[str, Any] = {
        "mesh": equilateral(folder / "triangle.obj", radius),
        "material": {"density": 0.2, "membrane": membrane},
    }
    with Simulation(content | timed(integrator, **more), MPI.COMM_SELF) as simulation:
        mass = simulation.mass[0]
        area = 3.0 * np.sqrt(3.0) / 4.0
        omega = np.sqrt(2.0 * stiffness * area / (3.0 * mass * radius**2))
        simulation.set_state(x=1.01 * simulation.x)
        before = simulation.energy("membrane")
        simulation.run(0.3 / omega, 40)
        kinetic = 0.5 * float(np.sum(simulation.mass[:, None] * simulation.v**2))
        return (simulation.energy("membrane") + kinetic) / before


def test_midpoint_conserves_energy_and_the_others_damp(tmp_path: Path) -> None:
    kept = {name: energy_left(name, tmp_path) for name in ("beuler", *SECOND_ORDER)}
    assert kept["midpoint"] == pytest.approx(1.0, abs=2e-3)
    assert kept["beuler"] < 0.1 < kept["bdf2"] < kept["alpha2"] < 0.999
    assert energy_left("alpha2", tmp_path, spectral_radius=1.0) == pytest.approx(1.0, abs=2e-3)
    assert energy_left("alpha2", tmp_path, spectral_radius=0.0) < kept["alpha2"]


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_handles_follow_their_motion_exactly(integrator: str, comm: MPI.Comm) -> None:
    turn = [{"time": 0}, {"time": 1, "rotate": {"axis": [0, 1, 0], "degrees": 90}, "translate": [0, 0, 1]}]
    content: dict[str, Any] = {
        "mesh": grid(1, 1, 3, 3),
        "material": CLOTH | {"damping": 0.01},
        "handles": [
            {"nodes": [0, 4, 8], "motion": "turn", "interpolation": "linear"},
            {"nodes": [15], "until": 0.15},
        ],
        "motions": {"turn": turn},
    } | timed(integrator)
    with Simulation(content, comm) as simulation:
        start = simulation.x
        simulation.run(0.05, 5)
        held = simulation.equations.held
        points = simulation.problem.points
        goal = start[points.mesh_vertices].copy()
        goal[:] = simulation.equations.prescriptions.positions(
            simulation.time, simulation.time, simulation.time, goal
        )
        for number in held.active(simulation.time, simulation.time):
            rows = held.vertices(number)
            np.testing.assert_allclose(simulation.equations.x[rows], goal[rows], rtol=0, atol=1e-14)
        moved = np.abs(simulation.x - start).max()
        assert 0.1 < moved < 1.0
