"""What an exact solution gives: positions and energies at any time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Energies:
    """Energies [J] at one time, as in ``history.csv``."""

    kinetic: float
    membrane: float
    potential: float


class Motion(ABC):
    """A motion that maps start positions affinely, so that means of vertices follow it too."""

    @abstractmethod
    def positions(self, start: Array, t: float) -> Array:
        """Positions (n, 3) [m] at t [s] of points that start at ``start`` (n, 3) [m]."""

    @abstractmethod
    def energies(self, t: float) -> Energies:
        """Energies of the whole scene at t [s]."""


@dataclass(frozen=True, eq=False)
class Translation(Motion):
    """Every point moves alike, under uniform gravity.

    Attributes
    ----------
    mass : float [kg]
    gravity : (3,) [m/s²]
    potential : float [J]
        −Σ m g·x at t = 0.
    path : callable t [s] → displacement (3,) [m], velocity (3,) [m/s]
    """

    mass: float
    gravity: Array
    potential: float
    path: Callable[[float], tuple[Array, Array]]

    def positions(self, start: Array, t: float) -> Array:
        """Start positions plus the displacement."""
        return np.asarray(start + self.path(t)[0])

    def energies(self, t: float) -> Energies:
        """½ m v² and the potential of gravity."""
        displacement, v = self.path(t)
        fallen = float(np.dot(self.gravity, displacement))
        return Energies(0.5 * self.mass * float(v @ v), 0.0, self.potential - self.mass * fallen)
