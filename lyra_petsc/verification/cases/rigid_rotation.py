"""A triangle spinning in its plane by backward Euler."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data, farthest
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact

DATA = data("rigid_rotation")
STEPS = 10
DENSITY, RADIUS, DT = 0.2, 1.0, 1e-2
"""kg/m², m, s"""

STRAIN = 1e-6
"""ρ ω² R²/c11: how far from rigid the triangle is."""

RIGID = "angle of a step, of a rigid body"
ELASTIC = "angle of a step, of the elastic triangle"
SIZE = "radius at the end"


def _stiffness(n: float) -> float:
    return DENSITY * (RADIUS / (n * DT)) ** 2 / STRAIN


def _scene(mesh: dict[str, Any], n: float) -> dict[str, Any]:
    stiffness = _stiffness(n)
    membrane = {"c11": stiffness, "c22": stiffness, "c12": 0.0, "c33": 0.5 * stiffness}
    return {
        "mesh": mesh,
        "material": {"density": DENSITY, "membrane": membrane},
        "time": {"end": STEPS * DT, "step": DT},
    }


def _first_velocity(n: float) -> complex:
    """Radial and tangential velocity [m/s] that a step of the full angle, 1/n, has left behind."""
    return RADIUS / DT * (1.0 - cmath.exp(-1j / n))


def _backward_euler(n: float) -> tuple[float, float]:
    """Last step's angle [rad] and radius [m] of the triangle as three points with one common radius.

    The force of a radius r points to the centre: the point x + Δt v turns no further, it only
    shrinks to the radius at which m (|x + Δt v| − r)/Δt² is the force.
    """
    area = 0.75 * math.sqrt(3.0) * RADIUS**2
    mass = DENSITY * area / 3.0
    stiffness = _stiffness(n)

    def force(r: float) -> float:
        stretch = r / RADIUS
        return area * stiffness * (stretch**3 - stretch) / RADIUS / 3.0

    x, v = complex(RADIUS, 0.0), _first_velocity(n)
    angle = 0.0
    for _ in range(STEPS):
        free = x + DT * v
        r = abs(x)
        for _ in range(100):
            change = (abs(free) - r - DT**2 / mass * force(r)) / (
                1.0 + DT**2 / mass * area * stiffness * (3.0 * (r / RADIUS) ** 2 - 1.0) / RADIUS**2 / 3.0
            )
            r += change
            if abs(change) < 1e-15 * RADIUS:
                break
        after = free * r / abs(free)
        angle = math.atan2((after / x).imag, (after / x).real)
        x, v = after, (after - x) / DT
    return angle, abs(x)


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    corners = 0.5 * np.pi + 2.0 / 3.0 * np.pi * np.arange(3)
    vertices = RADIUS * np.column_stack([np.cos(corners), np.sin(corners), np.zeros(3)])
    with bench.simulation(_scene(bench.mesh(vertices, np.array([[0, 1, 2]])), n)) as trial:
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
    row = next(row for row in DATA["sequences"] if abs(row["omega_h"] * n - 1.0) < 1e-9)
    rigid = row["angle_after_steps"][str(STEPS)]
    angle = farthest(angles, exact)
    return [
        Measured(ELASTIC, angle, exact, "rad"),
        Measured(SIZE, float(np.linalg.norm(x, axis=1).max()), radius, "m"),
        Measured(RIGID, angle, rigid, "rad"),
    ]


CASE = Case(
    name="rigid-rotation",
    title="A stiff triangle spinning freely, backward Euler: angle of the tenth step",
    source=DATA["source"],
    resolutions=(1, 2, 10, 100, 1000),
    measure=_measure,
    claim=Exact(1e-10),
    claims={RIGID: Exact(1e-5)},
    quick=3,
    counts="1/(ωΔt)",
)
