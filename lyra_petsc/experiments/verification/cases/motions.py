"""Motions for which backward Euler reduces to a few scalar equations: falls, a spring, a spin."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.verification_case import (
    G,
    Measured,
    grid,
    isotropic,
    scene,
    worst_value,
)

# -- falls -----------------------------------------------------------------------------------------------


def _sheet(nx: int, n: float, end: float, density: float, **more: Any) -> dict[str, Any]:
    """A free sheet, Δt = 1/n s."""
    material = {"density": density, "membrane": {"c11": 1200, "c22": 800, "c12": 300, "c33": 250}}
    time = {"end": end, "step": 1.0 / n}
    return scene(grid(1.0, 0.6, nx, 3, "alternating"), material, time, **more)


def free_fall(bench: Bench, n: float) -> Sequence[Measured]:
    end = 0.1
    with bench.simulation(_sheet(5, n, end, 0.2, gravity=[0, 0, -G])) as trial:
        z = trial.run().x[:, 2]
    steps = round(end * n)
    discrete, exact = -0.5 * G * steps * (steps + 1) / n**2, -0.5 * G * end**2
    return [
        Measured("z of the vertex farthest off, discrete answer", worst_value(z, discrete), discrete, "m"),
        Measured("mean z, continuous answer", float(z.mean()), exact, "m"),
    ]


DENSITY, AIR = 0.2, 1.0
"""Densities of sheet [kg/m²] and air [kg/m³]"""


def level_fall(n: float, end: float) -> tuple[float, float]:
    """Speed [m/s] and depth [m] after backward Euler steps of 1/n s; v solves a quadratic equation."""
    dt, v, z = 1.0 / n, 0.0, 0.0
    a = dt * AIR / DENSITY
    for _ in range(round(end * n)):
        b = v + dt * G
        v = 2.0 * b / (1.0 + math.sqrt(1.0 + 4.0 * a * b))
        z += dt * v
    return v, z


def wind_drag(bench: Bench, n: float) -> Iterator[Measured]:
    # end [s], tangential drag coefficient [kg/(m² s)]
    end, tangential = 0.5, 2.0

    def scene(gravity: list[float], air: float, drag: float) -> dict[str, Any]:
        wind = {"velocity": [0, 0, 0], "density": air, "drag": drag}
        return _sheet(4, n, end, DENSITY, gravity=gravity, wind=wind)

    speed, depth = level_fall(n, end)
    with bench.simulation(scene([0, 0, -G], AIR, 0.0)) as trial:
        start = trial.x[0, 2]
        trial.run()
        level = worst_value(-trial.v[:, 2], speed)
        fallen = float(start - trial.x[0, 2])
    terminal = math.sqrt(DENSITY * G / AIR)
    exact = terminal**2 / G * math.log(math.cosh(G * end / terminal))
    yield Measured("speed of a level sheet, backward Euler", level, speed, "m/s")
    yield Measured("depth of a level sheet, backward Euler", fallen, depth, "m")
    yield Measured("depth of a level sheet, exact in time", fallen, exact, "m")
    terminal = DENSITY * G / tangential
    with bench.simulation(scene([0, -G, 0], AIR, tangential)) as trial:
        # each step divides the difference from the terminal speed by 1 + Δt drag/density
        slow = terminal * (1.0 - (1.0 + tangential / DENSITY / n) ** -round(end * n))
        edge_on = worst_value(-trial.run().v[:, 1], slow)
    exact = terminal * (1.0 - math.exp(-G * end / terminal))
    yield Measured("speed of a sheet edge-on, backward Euler", edge_on, slow, "m/s")
    yield Measured("speed of a sheet edge-on, exact in time", edge_on, exact, "m/s")


# -- a sheet on springs ----------------------------------------------------------------------------------

OMEGA = 5.0
"""rad/s"""


def _sprung_sheet(time: dict[str, Any]) -> dict[str, Any]:
    """One cell of two triangles that starts at 1 m/s along z from the rest position of its springs.

    The sheet moves rigidly as one linear oscillator, as masses and spring stiffnesses of the vertices have
    the same ratio: both are a third of those of each adjacent triangle.
    """
    # kg/m²
    spring_density = 0.3
    third = spring_density * 0.5 / 3.0 * OMEGA**2
    material = {"density": spring_density, "membrane": {"c11": 50, "c22": 50, "c12": 0, "c33": 20}}
    springs = [{"nodes": [0, 3], "stiffness": 2.0 * third}, {"nodes": [1, 2], "stiffness": third}]
    initial = {"velocity": [0, 0, 1]}
    return scene(grid(1.0, 1.0, 1, 1), material, time, handles=springs, initial=initial)


def _states(trial: Trial) -> NDArray[np.complex128]:
    return np.asarray(trial.x[:, 2] + 1j * trial.v[:, 2] / OMEGA)


def oscillator(bench: Bench, n: float) -> Sequence[Measured]:
    spring_steps = 3
    amplification, phase = 1.0 / math.hypot(1.0, 1.0 / n), math.atan(1.0 / n)
    time = {"end": spring_steps / (n * OMEGA), "step": 1.0 / (n * OMEGA)}
    with bench.simulation(_sprung_sheet(time)) as trial:
        for _ in range(spring_steps):
            before = _states(trial)
            trial.step()
        # z + i v/ω rotates and shrinks in the complex plane
        ratios = _states(trial) / before
    size, turn = np.abs(ratios), -np.angle(ratios)
    return [
        Measured("amplification per step", worst_value(size, amplification), amplification),
        Measured("phase per step", worst_value(turn, phase), phase, "rad"),
    ]


# -- a spinning triangle ---------------------------------------------------------------------------------

STEPS = 10
TRIANGLE_DENSITY, RADIUS, DT = 0.2, 1.0, 1e-2
"""Density [kg/m²], radius [m], Δt [s]"""


def _stiffness(n: float) -> float:
    # ρ ω² R²/c11, the size of the strain of the nearly rigid triangle
    return TRIANGLE_DENSITY * (RADIUS / (n * DT)) ** 2 / 1e-6


def _first_velocity(n: float) -> complex:
    """Radial and tangential velocity [m/s] after an imagined step that rotated by the angle 1/n."""
    return RADIUS / DT * (1.0 - cmath.exp(-1j / n))


def _backward_euler(n: float) -> tuple[float, float]:
    """Angle of the last step [rad] and final radius [m] of three points with a common radius.

    The elastic force is radial: a step keeps the angle of x + Δt v and reduces its radius to the r at which
    m (|x + Δt v| − r)/Δt² equals the force.
    """
    from scipy.optimize import brentq

    # Δt²/m times the force is λ³ − λ over this, for the stretch λ
    softness = TRIANGLE_DENSITY * RADIUS / (DT**2 * _stiffness(n))
    x, v, angle = complex(RADIUS, 0.0), _first_velocity(n), 0.0
    for _ in range(STEPS):
        free = x + DT * v

        def off(r: float, free: float = abs(free)) -> float:
            return softness * (free - r) - ((r / RADIUS) ** 3 - r / RADIUS)

        after = free * (brentq(off, 0.6 * RADIUS, 2.0 * abs(free), xtol=1e-15) / abs(free))
        angle = cmath.phase(after / x)
        x, v = after, (after - x) / DT
    return angle, abs(x)


def rigid_rotation(bench: Bench, n: float) -> Sequence[Measured]:
    corners = 0.5 * np.pi + 2.0 / 3.0 * np.pi * np.arange(3)
    vertices = RADIUS * np.column_stack([np.cos(corners), np.sin(corners), np.zeros(3)])
    mesh = bench.mesh(vertices, np.array([[0, 1, 2]]))
    material = {"density": TRIANGLE_DENSITY, "membrane": isotropic(_stiffness(n))}
    with bench.simulation(scene(mesh, material, {"end": STEPS * DT, "step": DT})) as trial:
        v = _first_velocity(n)
        radial = vertices / RADIUS
        trial.set_state(v=v.real * radial + v.imag * np.cross([0.0, 0.0, 1.0], radial))
        before = trial.x
        while not trial.simulation.finished:
            before = trial.x
            trial.step()
        x = trial.x
    cross = before[:, 0] * x[:, 1] - before[:, 1] * x[:, 0]
    angles = np.arctan2(cross, np.einsum("vi,vi->v", before, x))
    exact, radius = _backward_euler(n)
    rigid = 1.0 / n
    for _ in range(STEPS):
        rigid = math.atan(math.sin(rigid) / (2.0 - math.cos(rigid)))
    angle = worst_value(angles, exact)
    return [
        Measured("angle of a step, of the elastic triangle", angle, exact, "rad"),
        Measured("radius at the end", float(np.linalg.norm(x, axis=1).max()), radius, "m"),
        Measured("angle of a step, of a rigid body", angle, rigid, "rad"),
    ]
