"""Prescribed unknowns of a step: their indices, final positions, and velocities at the stage."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.protocols import FollowsHandles
from lyra_petsc.terms.term import Term

if TYPE_CHECKING:
    from lyra_petsc.stepping.time_step import TimeStep

_numbers = itertools.count()


@dataclass(frozen=True, eq=False)
class PrescribedUnknowns:
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
        `Prescriptions.with_vertices`.
    goal : (m,)
        Positions [m] of the prescribed unknowns at the end of the step.
    velocity : (m,)
        Their velocities [m/s] at the stage.
    number : int
        Another one for each set of unknowns and ghosts.
    """

    mask: Mask
    free: Mask
    indices: Ints
    not_counted: Ints
    goal: Array
    velocity: Array
    number: int

    def overwrite(self, values: Array, prescribed: Array) -> None:
        """Overwrite the prescribed unknowns of ``values`` (n_owned, 3) by ``prescribed`` (m,)."""
        np.put(values, self.indices, prescribed)

    def reaching(self, x_h: Array, c: float) -> PrescribedUnknowns:
        """With the velocities that lead from the history x_h (n_owned, 3) to the goal: (goal − x_h) / c."""
        return replace(self, velocity=(self.goal - x_h.take(self.indices)) / c)


class Prescriptions:
    """What exact handles prescribe in the steps of one rank.

    Parameters
    ----------
    discretisation : Discretisation
    held : ExactHandles
    terms : iterable of Term
    starts : iterable of float
        Times [s] at which handles and springs start.

    Attributes
    ----------
    reference : ReferencePositions
    none : PrescribedUnknowns
        Those of the padding row.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        held: ExactHandles,
        terms: Iterable[Term],
        starts: Iterable[float],
    ) -> None:
        self._discretisation, self._held, layout = discretisation, held, discretisation.layout
        following = [term.reference_rows for term in terms if isinstance(term, FollowsHandles)]
        rows = np.concatenate([held.reference_rows, *following])
        self.reference = ReferencePositions(layout, rows, starts)
        self.none = self._unknowns(np.zeros((layout.n_owned, 3), dtype=np.bool_))
        self._active: tuple[tuple[int, ...], PrescribedUnknowns] | None = None

    def _unknowns(self, own: Mask) -> PrescribedUnknowns:
        """These owned unknowns (n_owned, 3) and those of the padding row, without a goal; collective."""
        layout = self._discretisation.layout
        own.ravel()[layout.padding] = True
        indices: Ints = np.flatnonzero(own)
        nowhere = np.zeros(len(indices))
        mask = layout.extended(own.astype(np.float64)) > 0.5
        return PrescribedUnknowns(mask, ~own, indices, indices, nowhere, nowhere, next(_numbers))

    def resized(self, unknowns: PrescribedUnknowns) -> PrescribedUnknowns:
        """The same with the layout's present ghosts; collective."""
        self._active = None
        flags = self._discretisation.layout.extended((~unknowns.free).astype(np.float64))
        return replace(unknowns, mask=flags > 0.5, number=next(_numbers))

    def of_step(self, t0: float, t1: float, x: Array) -> PrescribedUnknowns:
        """What handles prescribe in the step t0..t1 [s] from positions x (n_local, 3); collective."""
        active = self._held.active(t0, t1)
        # ranks own different vertices of a handle, but all agree on which handles hold
        if self._active is None or self._active[0] != active:
            self._active = (
                active,
                self._unknowns(self._held.mask(t0, t1, self._discretisation.layout.n_owned)),
            )
        unknowns = self._active[1]
        return replace(unknowns, goal=self.positions(t0, t1, t1, x).take(unknowns.indices))

    def with_vertices(self, unknowns: PrescribedUnknowns, x: Array) -> PrescribedUnknowns:
        """Prescribe all vertices at positions x (n_owned, 3), too; collective."""
        own = ~unknowns.free
        own[: self._discretisation.layout.n_vertices] = True
        held = self._unknowns(own)
        return replace(held, not_counted=unknowns.not_counted, goal=x.take(held.indices))

    def at_stage(
        self, unknowns: PrescribedUnknowns, span: tuple[float, float], time: float, x: Array, c: float
    ) -> tuple[PrescribedUnknowns, Array]:
        """With the velocities of handles at ``time`` [s], and the history (m,) [m] that fits positions on the
        straight line between both ends of the step, as those of free vertices.

        A handle on its curved path would stretch the elements beside it.
        """
        velocity = self.rates(unknowns, *span, time)
        start, part = x.take(unknowns.indices), (time - span[0]) / (span[1] - span[0])
        line = start + part * (unknowns.goal - start)
        return replace(unknowns, velocity=velocity), line - c * velocity

    def positions(self, t0: float, t1: float, at: float, x: Array) -> Array:
        """Positions (n_owned, 3) that handles prescribe at time ``at`` [s], elsewhere x (n_local, 3)."""
        out = x[: self._discretisation.layout.n_owned].copy()
        self._held.targets(t0, t1, at, self.reference.at, out)
        return out

    def end_rates(self, step: TimeStep) -> Array:
        """Velocities (m,) [m/s] of the prescribed unknowns at the end of a step."""
        return self.rates(step.prescribed, step.start, step.end, step.end)

    def rates(self, unknowns: PrescribedUnknowns, t0: float, t1: float, at: float) -> Array:
        """Velocities (m,) [m/s] of the prescribed unknowns at time ``at`` [s] of the step t0..t1 [s]."""
        out = np.zeros((self._discretisation.layout.n_owned, 3))
        self._held.velocities(t0, t1, at, self.reference.at, out)
        return out.take(unknowns.indices)
