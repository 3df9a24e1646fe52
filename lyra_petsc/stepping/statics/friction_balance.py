"""Consistency of friction with the normal forces of an equilibrium, and with the path to it.

Friction in a solve takes the normal forces of the solve before. Solves in which points slip far while normal
forces change are therefore repeated with a shorter Δτ, and a load step repeats its solves until these are
close to the normal forces in the equilibrium. If all contacts slide there may be none.

So a state in balance is found, but points have slipped along the way of the solves. From there on the slip of
all that touched at the start of the load step counts from that start, with the normal forces of the state:
the solves are corrected until these are those in the equilibrium, which does not depend on their way. Where
this fails the first state in balance is kept. Points that land in the load step stick, and slide, along the
way of the solves: if much lands in a large increment, it is repeated with a smaller one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.directors import transport_frames
from lyra_petsc.stepping.stage_equations import StageEquations

LAG, ROUGH_LAG, MAX_ROUNDS = 1e-6, 1e-3, 20
"""Fraction by which friction may differ from what the normal forces of the equilibrium allow; that before
slip counts from the start of the load step; and largest number of updates to reach each."""

MAX_SLIP = 0.1
"""Largest slip in a solve times the change of normal forces, over these and the mean edge length."""

MAX_LANDED, LANDING_PARTS = 0.1, 8
"""Part of the normal forces that points may have which land in an increment that is longer than a run's
length over the second number."""

NOTABLE = 0.01
"""Heat of points that landed, over the elastic energy, from which on a note tells it."""

SLIDES, MAX_SLIDING = 0.95, 5
"""Fraction of the allowed friction from which on all contacts slide, and number of failed load steps with
sliding after which smaller ones are not tried."""


class FrictionBalance:
    """The friction of a load step, and the number of failed steps in which all contacts slid; collective.

    Attributes
    ----------
    lag : float
        Error of the friction in the last equilibrium, as a fraction of what its normal forces allow.
    contacts : dict of CoulombFriction
        The contacts at the start of the load step.
    is_rough : bool
        Whether the first state in balance is kept.
    lands : bool
        Whether the load step is to be repeated with a smaller increment, as much landed in it.
    in_vain : bool
        Whether so many load steps failed with sliding that a smaller one would not help.
    """

    def __init__(self, equations: StageEquations, spacing: float, end: float) -> None:
        self._equations, self._spacing = equations, spacing
        self._longest = end / LANDING_PARTS
        self._acts = bool(equations.active.sliding)
        self.lag, self.is_rough, self.lands = 0.0, False, False
        self._rounds = self._sliding_steps = 0
        self._sliding_increment = 0.0  # the last increment of the load factor in which all slid
        self._landed_heat, self._heat, self._rough_steps = 0.0, 0.0, 0  # in a load step, and in all before
        self._start: tuple[Array, Mapping[Any, Any]] | None = None  # from which slip counts
        self._landed = np.zeros(3)  # as from `ActiveTerms.accept_substep`
        self.contacts: Mapping[Any, Any] = {}

    def begin_step(self) -> None:
        """Begin a load step at the present positions."""
        self.lag, self.is_rough, self.lands = 0.0, False, False
        self._rounds, self._landed_heat, self._start = 0, 0.0, None
        equations = self._equations
        self._begin = equations.x[: equations.points.n_owned].copy()
        self.contacts = equations.active.contact_state()

    def lags(self, begin: Array) -> bool:
        """Whether points slipped too far in the solve from positions ``begin`` (n_owned, 3) [m]; collective.

        Friction may have been far from what the normal forces allow.
        """
        if not (self._acts and self._equations.near):
            return False
        x, points = self._equations.x, self._equations.points
        displacement = x.copy()
        displacement[: len(begin)] -= begin
        points.update_ghosts(displacement)
        slip, normal = points.global_sum(
            *self._equations.active.slip_under_changed_forces(x, displacement, self._equations.step.frozen)
        )
        return bool(slip > MAX_SLIP * self._spacing * normal)

    def is_settled(self) -> bool:
        """Whether friction needs no further update in a state that is balanced otherwise; collective.

        In the first such state slip begins to count from the start of the load step.
        """
        equations = self._equations
        self.lag = self._sums()[0]
        self._rounds += 1
        if self._start is not None:
            return self.lag <= LAG or (self.lag <= ROUGH_LAG and self._rounds > MAX_ROUNDS)
        settled = self.lag <= ROUGH_LAG or self._rounds > MAX_ROUNDS
        if not (settled and self._acts and equations.near):
            return settled
        self._start, self._rounds = (self._begin, self.contacts), 0
        self._first = (
            equations.x[: equations.points.n_owned].copy(),
            equations.active.contact_state(),
            self.lag,
        )
        return False

    def accept_substep(self) -> None:
        """Accept the part of the load step that ends at the present positions; collective."""
        equations, start = self._equations, self._start
        if start is not None:  # the search for pairs may have added ghosts since
            start = equations.points.extended(start[0]), start[1]
        self._landed = equations.active.accept_substep(equations.x, equations.step.frozen, start)

    def keeps_first_state(self, *, failed: bool) -> bool:
        """Go back to the first state in balance, and return True, if corrections from there fail; collective.

        ``failed``: the last solve did, or proximal steps lead no further.
        """
        if self._start is None or not (failed or self._rounds > MAX_ROUNDS):
            return False
        x, contacts, self.lag = self._first
        self._equations.state.set(x, np.zeros_like(x))
        transport_frames(self._equations)
        self._equations.active.restore_contacts(contacts)
        self.is_rough = True
        return True

    def judge_landing(self, increment: float, *, limited: bool) -> None:
        """Set `lands` for the equilibrium of a load step of this increment; collective.

        ``limited``: it may be repeated.
        """
        if self._start is not None:
            heat, landed, force = self._equations.points.global_sum(*self._landed).tolist()
            self._landed_heat = heat
            self.lands = limited and increment > self._longest and landed > MAX_LANDED * force

    def _elastic_energy(self) -> float:
        equations, frozen = self._equations, self._equations.here().frozen
        terms = [term for term in equations.active.elastic if term not in equations.active.sliding]
        energy = sum(float(term.energies(equations.x, frozen[term]).sum()) for term in terms)
        return float(equations.points.global_sum(energy)[0])

    def note(self) -> str:
        """What is not known of friction at the end, or an empty text; collective."""
        notes = []
        if self.lag > LAG:
            notes.append(f"friction is known to {100.0 * self.lag:.1g} % of what normal forces allow")
        if self._rough_steps:
            notes.append(f"increments in which points slid along the way of the solves: {self._rough_steps}")
        if self._heat > NOTABLE * self._elastic_energy():
            part = 100.0 * self._heat / max(self._elastic_energy(), float(np.finfo(float).tiny))
            notes.append(
                f"points slid with {self._heat:.2g} J of friction in the increments in which they landed, "
                f"{part:.2g} % of the elastic energy: the shape may depend on the increments"
            )
        return "; ".join(notes)

    def record_success(self, increment: float) -> None:
        """Note that a load step of this increment of the load factor found an equilibrium."""
        self._heat, self._rough_steps = self._heat + self._landed_heat, self._rough_steps + self.is_rough
        if increment >= self._sliding_increment:
            self._sliding_steps, self._sliding_increment = 0, 0.0

    def record_failure(self, increment: float) -> str:
        """Note that a load step of this increment failed; a message if all contacts slide, else ''."""
        self.lag = 0.0
        message = "" if self.lands else self.sliding_message()
        if message:
            self._sliding_steps, self._sliding_increment = self._sliding_steps + 1, increment
        return message

    def sliding_message(self) -> str:
        """Text that names the contacts which slide now, or an empty one; collective."""
        return self._sums()[1]

    @property
    def in_vain(self) -> bool:
        return self._sliding_steps >= MAX_SLIDING

    def saved_state(self) -> dict[str, Any]:
        """Entries of a checkpoint, for `restore`."""
        numbers = {"slid": self._sliding_steps, "slid_in": self._sliding_increment}
        return numbers | {"landed": self._heat, "rough": self._rough_steps}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore a `saved_state`."""
        self._sliding_steps, self._sliding_increment = saved["slid"], saved["slid_in"]
        self._heat, self._rough_steps = saved["landed"], saved["rough"]

    def _sums(self) -> tuple[float, str]:
        """Error of the friction as in `lag`, and the text of `sliding_message`; collective."""
        sums = self._equations.active.friction_lag(self._equations.x, self._equations.step.frozen)
        if not sums:
            return 0.0, ""
        by_partner = self._equations.points.global_sum(*np.concatenate(list(sums.values()))).reshape(-1, 3)
        slides = [
            f"it slides on {name}" if name else "sheets slide on each other"
            for name, (_, friction, allowed) in zip(sums, by_partner, strict=True)
            if friction > SLIDES * allowed > 0.0
        ]
        wrong, friction, allowed = by_partner.sum(axis=0)
        message = f"{' and '.join(slides)}, with {friction:.3g} N of friction" if slides else ""
        return float(wrong / max(allowed, np.finfo(float).tiny)), message
