"""A sheet on a slope: it stands below the angle of friction, and slides by Coulomb's law above it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import CLOTH, grid, scene_of

from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel

SLOPE, GAP, G = math.radians(30.0), 0.01, 9.81
NORMAL = [math.sin(SLOPE), 0.0, math.cos(SLOPE)]
DOWN = np.array([math.cos(SLOPE), 0.0, -math.sin(SLOPE)])


def on_slope(comm: MPI.Comm, friction: float, end: float) -> tuple[float, float, Array, float, float]:
    """Mean way and speed down the slope, force on it, weight and friction's work of a sheet let go."""
    place = [0.9 * GAP * component for component in NORMAL]
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}
    content = {
        "mesh": grid(0.4, 0.4, 3, 3) | {"transform": {"rotate": turn, "translate": place}},
        "material": CLOTH | {"bending": 1e-4, "damping": 0.0},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": friction, "self": False},
        "obstacles": {"slope": {"plane": {"point": [0.0, 0.0, 0.0], "normal": NORMAL}}},
        "time": {"end": end, "step": 0.01},
    }
    simulation = SteppedScene(comm, scene_of(content))
    system, n = simulation.problem.system, simulation.problem.points.n_owned
    start = system.x[:n].copy()
    while not simulation.finished:
        simulation.step()
    mass = system.points.summed(float(system.mass.sum()))[0]
    way, speed = (
        float(system.points.summed(float(system.mass @ (values @ DOWN)))[0]) / mass
        for values in (system.x[:n] - start, system.v[:n])
    )
    force = simulation.ledger.obstacle_forces(1)[0]
    work = simulation.ledger.columns()["friction_work"]
    simulation.destroy()
    return way, speed, np.asarray(force), mass * G, work


def test_it_slides_by_coulombs_law(comm: MPI.Comm) -> None:
    friction, end = 0.5 * math.tan(SLOPE), 0.4
    way, speed, force, weight, work = on_slope(comm, friction, end)
    pull = G * 0.5 * math.sin(SLOPE)
    assert speed == pytest.approx(pull * end, rel=0.05)  # it settles on the barrier at first
    pressed = weight * math.cos(SLOPE)
    np.testing.assert_allclose(force[:3] @ NORMAL, -pressed, rtol=1e-3)
    np.testing.assert_allclose(force[:3] @ DOWN, friction * pressed, rtol=1e-3)
    assert work == pytest.approx(friction * pressed * way, rel=0.05)


def test_it_stands(comm: MPI.Comm) -> None:
    way, speed, force, weight, _ = on_slope(comm, 1.2 * math.tan(SLOPE), 1.0)
    assert abs(speed) < 1e-5
    assert 0.0 < way < 2e-3
    np.testing.assert_allclose(force[:3], [0.0, 0.0, -weight], atol=2e-4 * weight)
