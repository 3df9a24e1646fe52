"""Prescribed unknowns of a step: their indices, final positions, and velocities at the stage."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.linear.block_rows import BlockRows, ConstrainedEntries
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles


class Prescribed:
    """Unknowns that exact handles prescribe in a step on one rank, and the unused ones of the padding row.

    Attributes
    ----------
    mask : (n_local, 3) bool
        True for prescribed unknowns.
    free : (n_owned, 3) bool
        True for owned unknowns that are not prescribed.
    indices : (m,) int
        Prescribed unknowns among the owned ones, numbered row by row, ascending.
    not_counted : (k,) int
        Unknowns whose forces do not count in the scale of the residual: ``indices`` without the vertices of
        `hold_vertices`.
    goal : (m,)
        Positions [m] of the prescribed unknowns at the end of the step.
    velocity : (m,)
        Their velocities [m/s] at the stage.
    """

    def __init__(
        self, discretisation: Discretisation, held: ExactHandles, reference: ReferencePositions
    ) -> None:
        self._discretisation, self.held, self._reference = discretisation, held, reference
        self._active: tuple[int, ...] | None = None
        self._span = (0.0, 0.0)
        self._constrained: tuple[BlockRows, ConstrainedEntries] | None = None
        own = np.zeros((discretisation.layout.n_owned, 3), dtype=bool)
        own.ravel()[discretisation.layout.padding] = True
        self._set(own)
        self.not_counted = self.indices
        self.goal = self.velocity = np.zeros(len(self.indices))

    def _set(self, own: Mask) -> None:
        """Prescribe these owned unknowns (n_owned, 3); collective."""
        layout = self._discretisation.layout
        flags = np.zeros((layout.n_local, 3))
        flags[: layout.n_owned] = own
        layout.update_ghosts(flags)
        self.mask: Mask = flags > 0.5
        self.free: Mask = ~own
        self.indices: Ints = np.flatnonzero(own)
        self._constrained = None

    def resize(self) -> None:
        """Resize to the layout's present ghosts; collective."""
        self._set(~self.free)

    @property
    def constrained(self) -> ConstrainedEntries:
        """Entries of the present matrix in rows and columns of prescribed unknowns."""
        rows = self._discretisation.rows
        if self._constrained is None or self._constrained[0] is not rows:
            self._constrained = rows, rows.constrained_entries(self.mask)
        return self._constrained[1]

    def begin_step(self, t0: float, t1: float, x: Array) -> None:
        """Prescribe what handles hold in the step t0..t1 [s] from positions x (n_owned, 3); collective."""
        if not self.held:
            return
        self._x = x
        layout = self._discretisation.layout
        self._span = t0, t1
        active = self.held.active(t0, t1)
        if active != self._active:
            self._active = active
            # ranks own different vertices of a handle, but all agree on which handles hold
            own = self.held.mask(t0, t1, layout.n_owned)
            own.ravel()[layout.padding] = True
            self._set(own)
            self.not_counted = self.indices
        self.goal = self._positions(t1)

    def hold_vertices(self, x: Array) -> None:
        """Prescribe all vertices at positions x (n_owned, 3), too, until `release_vertices`; collective."""
        layout = self._discretisation.layout
        self._kept = ~self.free, self.goal, self.velocity
        own = ~self.free
        own[: layout.n_vertices] = True
        self._set(own)
        self.goal = x.take(self.indices)

    def release_vertices(self) -> None:
        """Prescribe only the unknowns from before `hold_vertices`; collective."""
        own, self.goal, self.velocity = self._kept
        self._set(own)

    def set_velocity_to_goal(self, x_h: Array, c: float) -> None:
        """Set the velocities that lead from the history x_h (n_owned, 3) to the goal: (goal − x_h) / c."""
        self.velocity = (self.goal - x_h.take(self.indices)) / c

    def set_motion_at(self, time: float, x_h: Array, c: float) -> None:
        """Set velocities to those of handles at ``time`` [s], and x_h (n_owned, 3) to fit positions on the
        straight line between both ends of the step, as those of free vertices.

        A handle on its curved path would stretch the elements beside it.
        """
        self.velocity = self._rates(time)
        start, (t0, t1) = self._x[: len(x_h)].take(self.indices), self._span
        line = start + (time - t0) / (t1 - t0) * (self.goal - start)
        self.overwrite(x_h, line - c * self.velocity)

    def overwrite(self, values: Array, prescribed: Array) -> None:
        """Overwrite the prescribed unknowns of ``values`` (n_owned, 3) by ``prescribed`` (m,)."""
        np.put(values, self.indices, prescribed)

    def overwrite_with_end_velocity(self, velocity: Array) -> None:
        """Overwrite prescribed unknowns of ``velocity`` by the handles' velocities at the end of the step."""
        if self.held and self._span[1] > self._span[0]:
            self.overwrite(velocity, self._rates(self._span[1]))

    def overwrite_with_start_velocity(self, velocity: Array) -> None:
        """Overwrite them by the handles' velocities just after the start of the step, where they may jump."""
        if self.held and self._span[1] > self._span[0]:
            start, end = self._span
            self.overwrite(velocity, self._rates(start + 1e-3 * (end - start)))

    def targets(self, t0: float, t1: float, at: float, out: Array) -> None:
        """Overwrite positions in ``out`` (n_owned, 3) by those that handles prescribe at time ``at`` [s]."""
        self.held.targets(t0, t1, at, self._reference.at, out)

    def _positions(self, at: float) -> Array:
        out = self._x[: self._discretisation.layout.n_owned].copy()
        self.targets(*self._span, at, out)
        return out.take(self.indices)

    def _rates(self, at: float) -> Array:
        out = np.zeros((self._discretisation.layout.n_owned, 3))
        self.held.velocities(*self._span, at, self._reference.at, out)
        return out.take(self.indices)
