"""Positions and velocities between two steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.linear.discretisation import Discretisation

if TYPE_CHECKING:
    from lyra_petsc.stepping.time_step import Evaluation


class State:
    """This rank's rows of a state, ghosts up to date.

    Attributes
    ----------
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s]; rows of edges hold their unknowns and the rates of these.
    evaluation : Evaluation or None
        The stage of the last step, if it is at these positions.
    """

    evaluation: Evaluation | None = None

    def __init__(self, discretisation: Discretisation) -> None:
        self._discretisation = discretisation
        n_local = discretisation.layout.n_local
        self.x, self.v = np.zeros((n_local, 3)), np.zeros((n_local, 3))

    def update_ghosts(self) -> None:
        """Copy the owners' values to the ghost rows; collective."""
        layout = self._discretisation.layout
        for values in (self.x, self.v):
            layout.update_ghosts(values)

    def set_edges(self, x: Array) -> None:
        """Take the unknowns of edges from x (n_local, 3); collective."""
        layout = self._discretisation.layout
        rows = slice(layout.n_vertices, layout.n_owned)
        self.x[rows] = x[rows]
        self.update_ghosts()

    def resize(self) -> None:
        """Resize to the layout's present ghosts; collective."""
        self.set(self.x, self.v)

    def set(self, x: Array, v: Array) -> None:
        """Set positions and velocities (n_owned, 3), in new arrays; collective."""
        layout, self.evaluation = self._discretisation.layout, None
        self.x, self.v = (resized(values, layout.n_owned, layout.n_local) for values in (x, v))
        self.update_ghosts()


def resized(values: Array, n_owned: int, n_local: int) -> Array:
    """Copy of an array's owned rows, followed by zeros up to n_local rows."""
    out = np.zeros((n_local, 3))
    out[:n_owned] = values[:n_owned]
    return out


def kinetic_energy(mass: Array, velocity: Array) -> float:
    """½ Σ m |v|² [J] of these rows, mass (n,) and velocity (n, 3)."""
    return 0.5 * float(np.sum(mass @ np.square(velocity)))
