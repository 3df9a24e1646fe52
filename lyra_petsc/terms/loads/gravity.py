"""Gravity: force m g on each vertex's lumped mass, potential energy −Σ m g·x."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import TimeCurve, is_curve
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Load, UpcomingStep


class Gravity(Load):
    """Gravity on the owned vertices, a load that does work where it changes in time.

    Parameters
    ----------
    mass : (n_owned,) [kg]
    acceleration : TimeCurve
        (3,) [m/s²].
    """

    def __init__(self, mass: Array, acceleration: TimeCurve) -> None:
        super().__init__(Elements(np.empty((0, 1), dtype=np.int32)))
        self._mass, self._acceleration = mass, acceleration
        self.varies = acceleration.varies

    def add_force(self, step: UpcomingStep, out: Array) -> None:
        out[: len(self._mass)] += self._mass[:, None] * self._acceleration.at(step.target_time)


class ConstantGravity(Gravity):
    """Gravity with a potential energy."""

    def potential(self, x: Array) -> float:
        return -float(self._mass @ x[: len(self._mass)] @ self._acceleration.largest)


def elements(rest: RestShape) -> None:
    """None: gravity needs only the lumped mass."""
    return None


def make(elements: None, scene: Scene, mass: Array) -> Gravity:
    """The load on one rank."""
    assert scene.gravity is not None
    kind = Gravity if is_curve(scene.gravity) else ConstantGravity
    return kind(mass, TimeCurve.of(scene.gravity, grows=scene.time.static))
