"""Gravity: force m g on each vertex's lumped mass, potential energy −Σ m g·x."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Load


class Gravity(Load):
    """Gravity on the owned vertices.

    Parameters
    ----------
    mass : (n_owned,) [kg]
    acceleration : (3,) [m/s²]
    """

    def __init__(self, mass: Array, acceleration: Array) -> None:
        super().__init__(Elements(np.empty((0, 1), dtype=np.int32)))
        self._mass, self._acceleration = mass, np.asarray(acceleration, dtype=np.float64)

    def add_force(self, x: Array, t0: float, t1: float, out: Array) -> None:
        out[: len(self._mass)] += self._mass[:, None] * self._acceleration

    def potential(self, x: Array) -> float:
        return -float(self._mass @ x[: len(self._mass)] @ self._acceleration)


def elements(rest: RestShape) -> None:
    """None: gravity needs only the lumped mass."""
    return None


def make(elements: None, scene: Scene, mass: Array) -> Gravity:
    """The load on one rank."""
    assert scene.gravity is not None
    return Gravity(mass, np.array(scene.gravity))
