"""The end of a step, as contact sees it, and what contact does there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.mesh.points import Layout

INSTANT = 1e-3
"""Part of a step by whose motion the velocities of handles at its start, and of obstacles at the end of a
step of second order, are measured."""


class StepEnd(NamedTuple):
    """The end of a step, or with ``v`` alone its start.

    Attributes
    ----------
    layout : Layout
    mass : (n_owned,)
        Of each row [kg].
    free : (n_owned, 3)
        Unknowns that are not prescribed.
    held : (m,)
        Prescribed unknowns, in flattened owned rows.
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s], ghosts up to date.
    start, end : float
        Times [s].
    order : int
        Of the integrator.
    """

    layout: Layout
    mass: Array
    free: Mask
    held: Ints
    x: Array
    v: Array
    start: float
    end: float
    order: int

    @property
    def dt(self) -> float:
        """Length of the step [s]."""
        return self.end - self.start

    @property
    def last_times(self) -> tuple[float, float]:
        """Times [s] between which the mean velocity of obstacles is comparable with velocities after the
        step, which are means of the step under backward Euler.
        """
        return self.end - (INSTANT if self.order > 1 else 1.0) * self.dt, self.end

    def accelerations(self, force: Array) -> Array:
        """Forces (n_local, 3) [N], or impulses, over the masses of free unknowns, (n_owned, 3).

        ``force`` gets the sums over ranks in its owned rows.
        """
        self.layout.add_to_owners(force)
        own, mass = force[: self.layout.n_owned], self.mass[:, None]
        return np.divide(own, mass, out=np.zeros_like(own), where=self.free & (mass > 0.0))

    def handle_force(self, impulse: Array) -> Array:
        """Mean reaction forces (m,) [N] of handles by impulses [N s], whose owned rows come first."""
        return -impulse.take(self.held) / self.dt


class ContactImpulses(NamedTuple):
    """Effects of the impulses at the end of a step, on this rank; as it is, those of none.

    Attributes
    ----------
    change : (n_owned, 3)
        Of the velocities [m/s].
    handle_force : (m,)
        Mean reaction forces [N] of handles, at the prescribed unknowns.
    work, heat : float
        Work of the obstacles by the impulses, and energy that became heat [J].
    obstacle, loads : (m,), (m, 8)
        Numbers of obstacles, and loads on them as from `obstacle_points.obstacle_loads`.
    """

    change: Array = np.zeros((1, 3))
    handle_force: Array = np.zeros(1)
    work: float = 0.0
    heat: float = 0.0
    obstacle: Ints = np.empty(0, dtype=np.int64)
    loads: Array = np.empty((0, 8))


class ContactEnd(NamedTuple):
    """Contact at the end of a step, the same on all ranks but for the arrays; as it is, with nothing near.

    Attributes
    ----------
    touches : bool
        Whether anything touches: forces then change too abruptly for integrators of smooth motions.
    resolved : bool
        Whether the normal forces changed so little in the step that integrators of second order follow them.
    normal_force : (n_vertices,)
        Sum of the normal forces [N] at each owned vertex.
    impulses : ContactImpulses
    """

    touches: bool = False
    resolved: bool = True
    normal_force: Array = np.zeros(1)
    impulses: ContactImpulses = ContactImpulses()
