"""Positions and velocities between two steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.linear.discretisation import Discretisation

if TYPE_CHECKING:
    from lyra_petsc.stepping.active_terms import Frozen
    from lyra_petsc.stepping.prescribed import PrescribedUnknowns
    from lyra_petsc.stepping.time_step import Evaluation, TimeStep
    from lyra_petsc.terms.protocols import Located


class State:
    """This rank's rows of a state, ghosts up to date.

    Attributes
    ----------
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s]; rows of edges hold their unknowns and the rates of these.
    evaluation : Evaluation or None
        A point of the last step at these positions, if one is known.
    """

    _past_velocity: Array | None = None
    evaluation: Evaluation | None = None

    def __init__(self, discretisation: Discretisation) -> None:
        self._discretisation = discretisation
        n_local = discretisation.layout.n_local
        self.x, self.v = np.zeros((n_local, 3)), np.zeros((n_local, 3))

    def update_ghosts(self) -> None:
        """Copy the owners' values to the ghost rows, after the values have changed; collective."""
        self.evaluation = None
        layout = self._discretisation.layout
        for values in (self.x, self.v):
            layout.update_ghosts(values)

    def set_edges(self, x: Array) -> None:
        """Take the unknowns of edges from x (n_local, 3); collective."""
        layout = self._discretisation.layout
        rows = slice(layout.n_vertices, layout.n_owned)
        self.x[rows] = x[rows]
        self.update_ghosts()

    def set_edge_rates(self, v: Array) -> None:
        """Take the rates of edges from v (n_local, 3), ghosts up to date."""
        layout = self._discretisation.layout
        edges = ~layout.are_vertices(layout.global_number)
        self.v[edges] = v[edges]

    def resize(self) -> None:
        """Resize to the layout's present ghosts; collective."""
        self.set(self.x, self.v)

    def moved(self, duration: float) -> Array:
        """Positions (n_local, 3) [m] after a time [s] at these velocities; unknowns of edges stay."""
        layout, x = self._discretisation.layout, self.x + duration * self.v
        if layout.n_edges_global:
            edges = ~layout.are_vertices(layout.global_number)
            x[edges] = self.x[edges]
        return x

    def expected_displacement(self, dt: float, held: PrescribedUnknowns, steps: int) -> Array:
        """Displacements (n_local, 3) [m] of a step of dt [s] at constant velocities, of handles exactly;
        collective.

        Those of several ``steps`` are with the accelerations of the last step.
        """
        layout, displacement = self._discretisation.layout, steps * dt * self.v
        n = layout.n_owned
        if steps > 1 and self._past_velocity is not None:
            displacement[:n] += 0.5 * steps**2 * dt * (self.v[:n] - self._past_velocity)
        held.overwrite(displacement[:n], float(steps) * (held.goal - self.x[:n].take(held.indices)))
        layout.update_ghosts(displacement)
        return displacement

    def starts(self, step: TimeStep) -> Evaluation | None:
        """The `evaluation`, if it is the end of the last step and ``step`` follows."""
        known = self.evaluation
        return known if known is not None and known.step.end == step.start else None

    def geometry(self, frozen: Frozen) -> Mapping[Any, Located] | None:
        """The terms' geometry at these positions, if it is known with these frozen data."""
        return None if self.evaluation is None else self.evaluation.geometry_with(frozen)

    def forget(self) -> None:
        """Free what is known at these positions, which the step has left."""
        self.evaluation = None

    def keep_past(self, velocity: Array) -> None:
        """Keep the velocities (n_owned, 3) [m/s] before the last step, for `expected_displacement`."""
        self._past_velocity = velocity

    def set(self, x: Array, v: Array) -> None:
        """Set positions and velocities (n_owned, 3), in new arrays; collective."""
        extended, self.evaluation = self._discretisation.layout.extended, None
        self.x, self.v = extended(x), extended(v)

    def set_velocity(self, v: Array) -> None:
        """Set velocities (n_owned, 3), in a new array, at the same positions; collective."""
        self.v = self._discretisation.layout.extended(v)


def kinetic_energy(mass: Array, velocity: Array) -> float:
    """½ Σ m |v|² [J] of these rows, mass (n,) and velocity (n, 3)."""
    return 0.5 * float(np.sum(mass @ np.square(velocity)))
