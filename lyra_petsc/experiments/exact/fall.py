"""Sheets that fall as a whole: freely, flat in still air, edge-on in still air.

With lumped masses (a third of each triangle's mass to each corner) and nodal wind forces (a third of
each triangle's force to each corner), gravity and drag of a uniform flat sheet accelerate every vertex
alike, on any mesh. The sheet stays undeformed, and the motion solves the spatially discrete equations
exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.exact.body import SAME, Body
from lyra_petsc.experiments.exact.motion import Motion, Translation

Array = NDArray[np.float64]


def _translation(body: Body, path: Callable[[float], tuple[Array, Array]]) -> Motion:
    return Translation(body.mass, body.gravity, body.potential, path)


def free_fall_obstacles(body: Body) -> list[str]:
    """What of a scene contradicts a free fall, in words."""
    return [*body.forced(), *(["wind"] if body.has_wind else []), *body.strained()]


def free_fall(body: Body) -> Motion:
    """A sheet that falls or flies freely without deforming: x = X + v₀ t + g t²/2."""
    return _translation(body, partial(_freely, body.start_velocity, body.gravity))


def _freely(start: Array, g: Array, t: float) -> tuple[Array, Array]:
    return start * t + 0.5 * g * t * t, start + g * t


def _in_still_air(body: Body) -> list[str]:
    found = body.forced()
    if not body.gravity.any():
        found.append("no gravity")
    if body.start_velocity.any():
        found.append("initial.velocity")
    if not body.has_wind:
        found.append("no air (wind with velocity [0, 0, 0])")
    elif body.scene.wind is not None and any(body.scene.wind.velocity):
        found.append("wind that is not still")
    densities = body.rest.per_triangle("density")
    if np.ptp(densities) > SAME * densities.max():
        found.append("materials of different densities")
    return found + body.strained()


def _cosines(body: Body) -> Array:
    """Between normals and gravity, (F,)."""
    g = body.gravity
    return np.asarray(body.normals @ (g / np.linalg.norm(g)))


def flat_fall_obstacles(body: Body) -> list[str]:
    """What of a scene contradicts a level sheet falling flat in still air, in words."""
    found = _in_still_air(body)
    if body.gravity.any() and np.abs(np.abs(_cosines(body)) - 1.0).max() > SAME:
        found.append("a sheet that is not flat and level")
    if body.scene.wind is not None and body.scene.wind.density == 0.0:
        found.append("wind.density 0")
    return found


def flat_fall(body: Body) -> Motion:
    """A level sheet released at rest: v = vt tanh(g t / vt), vt = √(ρ_sheet g / ρ_air).

    Drag grows with the square of the velocity.
    """
    assert body.scene.wind is not None
    density = float(body.rest.per_triangle("density")[0])
    terminal = math.sqrt(density * float(np.linalg.norm(body.gravity)) / body.scene.wind.density)
    return _translation(body, partial(_flat, terminal, body.gravity))


def _flat(terminal: float, gravity: Array, t: float) -> tuple[Array, Array]:
    g = math.hypot(*gravity)
    a = g * t / terminal
    # ln cosh a, without the overflow of cosh
    fallen = terminal**2 / g * (a + math.log1p(math.exp(-2.0 * a)) - math.log(2.0))
    return fallen / g * gravity, terminal * math.tanh(a) / g * gravity


def edge_fall_obstacles(body: Body) -> list[str]:
    """What of a scene contradicts an upright sheet falling edge-on in still air, in words."""
    found = _in_still_air(body)
    if body.gravity.any() and np.abs(_cosines(body)).max() > SAME:
        found.append("a sheet that is not upright")
    if body.scene.wind is not None and body.scene.wind.drag == 0.0:
        found.append("wind.drag 0")
    return found


def edge_fall(body: Body) -> Motion:
    """An upright flat sheet released at rest: v = vt (1 − exp(−g t / vt)), vt = ρ_sheet g / drag.

    Drag grows with the velocity.
    """
    assert body.scene.wind is not None
    density = float(body.rest.per_triangle("density")[0])
    terminal = density * float(np.linalg.norm(body.gravity)) / body.scene.wind.drag
    return _translation(body, partial(_edge_on, terminal, body.gravity))


def _edge_on(terminal: float, gravity: Array, t: float) -> tuple[Array, Array]:
    g = math.hypot(*gravity)
    rate = g / terminal
    fallen = terminal * (t + math.expm1(-rate * t) / rate)
    return fallen / g * gravity, -terminal * math.expm1(-rate * t) / g * gravity
