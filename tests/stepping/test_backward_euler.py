"""Exact discrete answers of backward Euler."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, equilateral, grid, reference

from lyra_petsc.arrays import Array

EXACT = reference("backward_euler")


@pytest.mark.parallel(2)
@pytest.mark.parametrize(("dt", "steps", "z"), [row for row in EXACT["free_fall"]["rows"] if row[1] <= 10])
def test_free_fall(comm: MPI.Comm, dt: float, steps: int, z: float) -> None:
    content = {"mesh": grid(1, 1, 3, 2), "gravity": [0, 0, -EXACT["free_fall"]["g"]]}
    with Simulation(content, comm) as simulation:
        before = simulation.x
        after = simulation.run(dt, steps)
        np.testing.assert_allclose(
            after - before, np.tile([0.0, 0.0, z], (12, 1)), atol=1e-12 * abs(z) + 1e-14
        )


def eigenvalue(matrix: Array) -> complex:
    """Eigenvalue of a real 2 × 2 matrix in the upper half plane, or the larger one if both are real."""
    values = np.linalg.eigvals(matrix)
    return complex(values[np.argmax(values.imag + 1e-9 * values.real)])


# above 1e4 the answer drowns in the round-off of the first velocity
UNDAMPED = [row for row in EXACT["oscillator"]["rows"] if row[1] == 0 and row[0] <= 1e4]
DAMPED = [row for row in EXACT["oscillator"]["rows"] if row[0] <= 10.0]


@pytest.mark.parametrize(("omega_dt", "zeta", "amplification", "phase"), UNDAMPED)
def test_spring_and_mass(
    tmp_path: Path, omega_dt: float, zeta: float, amplification: float, phase: float
) -> None:
    omega, triangle = 20.0, equilateral(tmp_path / "triangle.obj")
    mass = 0.2 * 3 * np.sqrt(3) / 4 / 3
    handle = {"nodes": [0, 1, 2], "stiffness": mass * omega**2}
    columns = []
    for amplitude, speed in ((1.0, 0.0), (0.0, omega)):
        with Simulation({"mesh": triangle, "handles": [handle]}, MPI.COMM_SELF) as simulation:
            x = simulation.x
            simulation.equations.reference.record_starts(
                0.0, simulation.equations.x
            )  # the springs set out from here
            simulation.set_state(x=x + [0, 0, amplitude], v=np.tile([0.0, 0.0, speed], (3, 1)))
            simulation.step(omega_dt / omega)
            shift, velocity = simulation.x - x, simulation.v
            assert np.ptp(shift[:, 2]) <= 1e-12
            columns.append([shift[0, 2], velocity[0, 2] / omega])
    found = eigenvalue(np.array(columns).T)
    assert abs(found) == pytest.approx(amplification, rel=1e-7)
    assert np.angle(found) == pytest.approx(phase, rel=1e-7)


@pytest.mark.parametrize(("omega_dt", "zeta", "amplification", "phase"), DAMPED)
def test_breathing_triangle(
    tmp_path: Path, omega_dt: float, zeta: float, amplification: float, phase: float
) -> None:
    """Small radial vibration of an equilateral isotropic triangle, ω² = 2 A (c11 + c12)/(m R²), ζ = γω/2."""
    c11, c12, density, radius = 300.0, 60.0, 0.2, 1.0
    omega = np.sqrt(2 * (c11 + c12) / density) / radius
    membrane = {"c11": c11, "c22": c11, "c12": c12, "c33": 0.5 * (c11 - c12)}
    material = {"density": density, "membrane": membrane, "damping": 2.0 * zeta / omega}
    small = 1e-7  # relative error of the linearisation
    columns = []
    for stretch, rate in ((small, 0.0), (0.0, small * omega)):
        content = {"mesh": equilateral(tmp_path / "triangle.obj", radius), "material": material}
        with Simulation(content, MPI.COMM_SELF) as simulation:
            x = simulation.x
            simulation.set_state(x=(1.0 + stretch) * x, v=rate * x)
            simulation.step(omega_dt / omega)
            radial = x / np.linalg.norm(x, axis=1)[:, None]
            grown = ((simulation.x - x) * radial).sum(axis=1) / (small * radius)
            speed = (simulation.v * radial).sum(axis=1) / (small * radius * omega)
            columns.append([grown.mean(), speed.mean()])
    found = np.array(columns).T
    if zeta < 1.0:
        value = eigenvalue(found)
        assert abs(value) == pytest.approx(amplification, rel=2e-6)
        assert np.angle(value) == pytest.approx(phase, rel=2e-6)
    else:  # a double eigenvalue is ill-conditioned, its mean and its square are not
        assert np.trace(found) / 2 == pytest.approx(amplification, rel=2e-6)
        assert np.linalg.det(found) == pytest.approx(amplification**2, rel=2e-6)


@pytest.mark.parametrize("first", [0.01, 0.1, 0.5, 1.0])
def test_spin_of_a_stiff_triangle_decays_as_the_rigid_limit(tmp_path: Path, first: float) -> None:
    angles = {steps: angle for start, steps, angle in EXACT["spin"]["rows"] if start == first}
    stiff = {"c11": 1e7, "c22": 1e7, "c12": 0.0, "c33": 5e6}
    content = {
        "mesh": equilateral(tmp_path / "triangle.obj", 0.5),
        "material": {"density": 0.1, "membrane": stiff},
    }
    dt = 0.01
    with Simulation(content, MPI.COMM_SELF) as simulation:
        x = simulation.x
        before = np.array([[np.cos(first), np.sin(first)], [-np.sin(first), np.cos(first)]])
        simulation.set_state(v=np.column_stack([(x[:, :2] - x[:, :2] @ before.T) / dt, np.zeros(3)]))
        for step in range(1, max(angles) + 1):
            old, new = x, simulation.run(dt, 1)
            if step in angles:
                turned = np.arctan2(
                    old[:, 0] * new[:, 1] - old[:, 1] * new[:, 0], (old[:, :2] * new[:, :2]).sum(axis=1)
                )
                np.testing.assert_allclose(turned, angles[step], rtol=1e-4 * first + 1e-6)
            x = new


@pytest.mark.parallel(2)
def test_fall_of_a_flat_sheet_through_air(comm: MPI.Comm) -> None:
    drop = EXACT["terminal_velocity"]
    content = {
        "mesh": grid(1, 0.5, 3, 2, "criss-cross"),
        "material": CLOTH | {"density": drop["density"]},
        "gravity": [0, 0, -drop["g"]],
        "wind": {"velocity": [0, 0, 0], "density": drop["air_density"]},
    }
    rows = {steps: (v, z) for steps, v, z in drop["rows"] if steps <= 50}
    with Simulation(content, comm) as simulation:
        x = simulation.x
        for step in range(1, max(rows) + 1):
            simulation.step(drop["dt"])
            if step in rows:
                v, z = rows[step]
                np.testing.assert_allclose(simulation.v[:, 2], -v, rtol=1e-11)
                np.testing.assert_allclose(
                    simulation.x - x, np.tile([0, 0, z], (len(x), 1)), rtol=1e-11, atol=1e-13
                )


def test_edge_on_drag_is_linear_in_the_velocity() -> None:
    density, drag, g, dt = 0.2, 0.7, 9.81, 0.05
    content = {
        "mesh": grid(1, 0.5, 2, 2),
        "gravity": [-g, 0, 0],
        "wind": {"velocity": [0, 0, 0], "density": 1.0, "drag": drag},
    }
    v = z = 0.0
    with Simulation(content, MPI.COMM_SELF) as simulation:
        x = simulation.x
        for _ in range(20):
            simulation.step(dt)
            v = (v + g * dt) / (1.0 + drag * dt / density)
            z -= v * dt
        np.testing.assert_allclose(simulation.v[:, 0], -v, rtol=1e-11)
        np.testing.assert_allclose(simulation.x[:, 0] - x[:, 0], z, rtol=1e-11)
        assert v == pytest.approx(density * g / drag, rel=0.05)  # near its end value


def test_a_free_sheet_keeps_its_momentum_and_does_not_gain_spin() -> None:
    content = {
        "mesh": grid(1, 1, 4, 4),
        "material": CLOTH | {"bending": 1e-3, "damping": 0.01},
        "initial": {
            "velocity": [0.3, 0.0, 1.0],
            "angular_velocity": [2.0, 1.0, 3.0],
            "noise": 0.01,
            "seed": 4,
        },
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        mass = simulation.mass[:, None]
        centre, momentum = (mass * simulation.x).sum(axis=0) / mass.sum(), (mass * simulation.v).sum(axis=0)
        np.testing.assert_allclose(momentum / mass.sum(), [0.3, 0.0, 1.0], atol=1e-3)

        def spin() -> float:
            arm = simulation.x - (mass * simulation.x).sum(axis=0) / mass.sum()
            return float(np.linalg.norm((mass * np.cross(arm, simulation.v)).sum(axis=0)))

        spins = [spin()]
        for _ in range(20):
            simulation.step(0.01)
            spins.append(spin())
        np.testing.assert_allclose((mass * simulation.v).sum(axis=0), momentum, atol=1e-12)
        moved = (mass * simulation.x).sum(axis=0) / mass.sum() - centre
        np.testing.assert_allclose(moved, 0.2 * momentum / mass.sum(), atol=1e-12)
        assert np.all(np.diff(spins) < 0.0)
        assert spins[-1] > 0.7 * spins[0]


@pytest.mark.parametrize("pattern", ["diagonal", "criss-cross"])
def test_strong_wind_at_a_large_step_stays_bounded(pattern: str) -> None:
    content = {
        "mesh": grid(1, 1, 8, 8, pattern),
        "material": CLOTH | {"bending": 1e-4, "damping": 0.03},
        "gravity": [0, 0, -9.81],
        "wind": {"velocity": [0, 0, 50.0], "density": 1.2, "drag": 0.5},
        "handles": [{"box": [[-0.01, -0.01, -0.01], [0.01, 2.0, 0.01]]}],
        "solver": {"max_iterations": 100},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        for _ in range(25):
            simulation.step(0.04)
        x, v = simulation.x, simulation.v
        assert np.isfinite(x).all()
        assert np.linalg.norm(x, axis=1).max() < 5.0  # a metre of cloth under 3 kN stretches, not more
        assert np.linalg.norm(v, axis=1).max() < 60.0
