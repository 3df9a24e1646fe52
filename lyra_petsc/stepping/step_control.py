"""Step control: the length of the next step, from output times, events, failures and estimated errors."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Mapping

import numpy as np

ROUND_OFF = 1e-9
"""Fraction of Δt by which times differ that are computed in different ways."""

SLACK = 1e-4
"""Fraction of Δt by which a step may be longer to avoid an extra tiny one, and times count as one: above the
round-off of times in single precision."""

LEAST_REST = 0.1
"""Fraction of Δt below which no step is left over before a time on which one must end."""

GROW_AFTER = 2
"""Successful steps after which a shortened Δt is doubled."""

HALVINGS = 6
"""How many times a step is halved that was solved, but rejected for its energy."""

MAX_PATIENCE = 128
"""Upper bound of the successful steps before a Δt shortened because of energy is doubled."""

SAFETY = 0.85
SHRINK, GROW = 0.2, 2.0
"""Bounds of the ratio of successive Δt in adaptive steps; BDF2 is stable up to 2.4."""

NEAR_MINIMUM = 1.05
"""Δt over the smallest one up to which steps in contact are accepted whatever their error."""

IN_VAIN = 2.0
"""Error over the allowed one up to which a repeated step in contact is accepted if that has not fallen."""


class StepControl:
    """Plans the end of each step from a nominal Δt, which is halved after a failure.

    Parameters
    ----------
    step : float
        Nominal and largest Δt [s].
    end : float
        Last time [s].
    every : float or None
        States are written at multiples of this time [s]; None: at every step.
    events : iterable of float
        Further times [s] on which a step must end; of two that count as one, the first is kept.
    smallest : float
        Smallest Δt [s] of a retry.

    Attributes
    ----------
    factor : float
        Present Δt over the nominal one.
    successes : int
        Successful steps since the factor last changed.
    patience : int
        Successful steps after which a shortened Δt is doubled.
    """

    def __init__(
        self, step: float, end: float, every: float | None, events: Iterable[float], smallest: float
    ) -> None:
        self.step, self.end, self._every, self.smallest = step, end, every, smallest
        self._events = [end]
        for time in events:
            self.add_event(time)
        self.factor = 1.0
        self.successes, self.patience = 0, GROW_AFTER

    def next_end(self, time: float) -> float:
        """End of the step that starts at ``time`` [s]."""
        dt = self.step * self.factor
        event, state = self._next_event(time), self._next_state(time)
        same = SLACK * min(self.step, self._every or self.step)
        target = event if event <= state + same else self._rounded(state)
        # end exactly at the event even if it is a round-off error beyond the step
        if target - time <= dt * (1.0 + SLACK):
            return target
        return self._rounded(time + self._partial_step(dt, target - time))

    def _rounded(self, time: float) -> float:
        """A time [s] that is a multiple of Δt up to round-off as that multiple, however it was computed.

        In contact, round-off of Δt grows to other motions, which then depended on the interval between
        states.
        """
        dt = self.step * self.factor
        multiple = round(time / dt) * dt if math.isfinite(time) else math.inf
        return multiple if abs(multiple - time) <= ROUND_OFF * dt else time

    def add_event(self, time: float) -> None:
        """Let a step end at a further time [s], unless one does already."""
        place = bisect.bisect_left(self._events, time)
        near = self._events[max(place - 1, 0) : place + 1]
        if 0.0 < time < self.end and all(abs(time - event) > SLACK * self.step for event in near):
            self._events.insert(place, time)

    def planned_steps(self) -> int:
        """Number of steps to the end, all of the full Δt but for those cut to end at states and events."""
        every = self._every or self.end
        stops = np.unique([0.0, *self._events, *np.arange(1.0, self.end / every) * every])
        return int(np.ceil(np.diff(stops) / self.step - SLACK).sum())

    def _partial_step(self, dt: float, remaining: float) -> float:
        """Length [s] of a step of at most dt that ends before the next target, ``remaining`` [s] ahead."""
        return 0.5 * remaining if remaining < (1.0 + LEAST_REST) * dt else dt

    def _next_event(self, time: float) -> float:
        index = bisect.bisect_right(self._events, time + SLACK * self.smallest)
        return self._events[index] if index < len(self._events) else self.end

    def _next_state(self, time: float) -> float:
        if self._every is None:
            return math.inf
        return (math.floor(time / self._every + SLACK) + 1) * self._every

    def writes_at(self, time: float) -> bool:
        """Whether a state is written at ``time`` [s], the end of a step."""
        if self._every is None or self.is_end(time):
            return True
        multiple = time / self._every
        return abs(multiple - round(multiple)) <= SLACK

    def is_end(self, time: float) -> bool:
        """Whether ``time`` [s] is the end of the run."""
        return time >= self.end - SLACK * min(self.step, self.smallest)

    def can_halve(self) -> bool:
        """Whether Δt may be half as long."""
        return 0.5 * self.factor * self.step >= self.smallest

    def halve(self) -> None:
        """Halve Δt after a failed attempt."""
        self.successes = 0
        self.factor *= 0.5

    def limit(self, dt: float) -> None:
        """Let the next steps be no longer than dt [s]."""
        self.factor = min(self.factor, dt / self.step)

    def can_shorten(self, dt: float) -> bool:
        """Whether a step of dt [s], which may have been cut to end at an event, may be half as long."""
        return 0.5 * dt >= self.smallest and self._halvings(dt) < HALVINGS

    def _halvings(self, dt: float) -> int:
        """Halvings from the nominal step to dt [s]; 0 for a step that was cut to end at an event."""
        return round(math.log2(self.step / dt)) if dt >= self.factor * self.step * (1.0 - SLACK) else 0

    def shorten(self, dt: float, *, first: bool) -> None:
        """Halve a step of dt [s] that was solved, but rejected for its energy. ``first``: it is the step's
        first halving, after which a larger Δt is tried later.
        """
        self.successes = 0
        if first:
            self.patience = min(2 * self.patience, MAX_PATIENCE)
        self.factor = 0.5 * dt / self.step

    def record_success(self, iterations: int) -> None:
        """Double a shortened Δt after enough successful steps."""
        self.successes += 1
        if self.factor < 1.0 and self.successes >= self.patience:
            self.factor = min(1.0, 2.0 * self.factor)
            self.successes = 0

    def saved_state(self) -> dict[str, float]:
        """Numbers of a checkpoint."""
        return {
            "factor": self.factor,
            "good": self.successes,
            "patience": self.patience,
            "nominal": self.step,
        }

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`, unless its nominal step is another."""
        if saved["nominal"] == self.step:
            self.factor = max(saved["factor"], self.smallest / self.step)
            self.successes, self.patience = int(saved["good"]), int(saved["patience"])


class ToleranceControl(StepControl):
    """Chooses Δt such that local errors add up to a tolerance by the end.

    ``first`` and ``step`` are the first and the largest Δt [s].
    """

    def __init__(
        self,
        first: float,
        step: float,
        end: float,
        every: float | None,
        events: Iterable[float],
        smallest: float,
    ) -> None:
        super().__init__(step, end, every, events, smallest)
        self.factor = min(1.0, first / step)
        self._refused: float | None = None  # the error over the allowed one in the last attempt at this step

    def _partial_step(self, dt: float, remaining: float) -> float:
        # two equal steps rather than a full one and a tiny one
        return 0.5 * remaining if remaining < 2.0 * dt else dt

    def accept(
        self, dt: float, ratio: float, order: int, minimum: float = 0.0, *, touches: bool = False
    ) -> bool:
        """Whether to accept a step of dt [s], ``ratio`` its error over the allowed one; plans the next.

        A step that cannot be shortened, or not below ``minimum`` [s], is accepted whatever its error.

        While something ``touches``, the minimum follows the velocities, so that a step planned to be as short
        may be a little longer. Impulses change velocities by amounts that do not depend on Δt; ``ratio`` then
        is not lessened by a shorter step, and one repetition is enough. The error often grows faster there
        than with Δt to the power ``order`` + 1, so after a repeated step the next is not longer: else every
        other attempt would fail. (Hairer, Nørsett & Wanner, Solving ODEs I, sec. II.4.)
        """
        minimum = max(minimum, self.smallest)
        planned = self.factor * self.step
        allowed = math.inf if ratio == 0.0 else dt * SAFETY * ratio ** (-1.0 / order)
        accepted = ratio <= 1.0 or dt <= minimum * (NEAR_MINIMUM if touches else 1.0 + SLACK)
        growth = GROW
        if touches and self._refused is not None:
            accepted = accepted or self._refused <= ratio <= IN_VAIN
            growth = 1.0
        self._refused = None if accepted else ratio
        # a step that was cut to end at an output time does not shorten the planned one
        maximum = max(growth * dt, planned) if accepted else 0.9 * dt
        self.factor = max(min(max(allowed, SHRINK * dt), maximum, self.step), minimum) / self.step
        return accepted

    def record_success(self, iterations: int) -> None:
        """Do nothing: the error alone determines Δt."""

    def _halvings(self, dt: float) -> int:
        return 0

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`; if its largest step is another, only the length of the next step."""
        super().restore(saved)
        if saved["nominal"] != self.step:
            planned = saved["factor"] * saved["nominal"]
            self.factor = min(max(planned, self.smallest) / self.step, 1.0)


class LoadControl(StepControl):
    """Plans increments of the load factor: doubled after an easy step, halved after a failure.

    ``step`` is the first increment and the largest one after an event, ``largest`` the largest of all;
    ``factor`` may exceed 1.

    Attributes
    ----------
    stays : bool
        Whether the next step is without an increment, as something has broken at the last equilibrium.
    """

    stays = False

    EASY = 12
    """Newton iterations of a load step after which the next is twice as large."""

    def __init__(
        self, step: float, end: float, events: Iterable[float], smallest: float, largest: float
    ) -> None:
        super().__init__(step, end, None, events, smallest)
        self._largest = largest

    def next_end(self, time: float) -> float:
        if self.stays:
            return time
        if time in self._events:  # motions and loads may turn here, and with them the path of equilibria
            self.factor = min(self.factor, 1.0)
        return super().next_end(time)

    def is_end(self, time: float) -> bool:
        return not self.stays and super().is_end(time)

    def can_halve(self) -> bool:
        return not self.stays and super().can_halve()

    def writes_at(self, time: float) -> bool:
        return not self.stays and super().writes_at(time)

    def stay(self) -> None:
        """Let the next step be without an increment."""
        self.stays, self.factor = True, min(self.factor, 1.0)

    def record_success(self, iterations: int) -> None:
        if self.stays:
            self.stays = False
            return
        larger = 2.0 * self.factor if iterations <= self.EASY else self.factor
        self.factor = min(larger, self._largest / self.step)

    def saved_state(self) -> dict[str, float]:
        return super().saved_state() | {"stays": self.stays}

    def restore(self, saved: Mapping[str, float]) -> None:
        super().restore(saved)
        self.stays = bool(saved.get("stays"))
