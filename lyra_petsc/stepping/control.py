"""Which step comes next: the nominal Δt, shortened to land on events and after failures."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable

SLACK = 1e-6
"""Fraction of Δt by which a step may differ from its length to avoid an extra tiny one."""

GROW_AFTER = 2
"""Successful steps after which a shortened Δt is doubled."""


class StepControl:
    """Plans the end of each step.

    Parameters
    ----------
    step : float
        Nominal and largest Δt [s].
    end : float
        Last time [s].
    every : float or None
        States are written at its multiples [s]; None: at every step.
    events : iterable of float
        Further times [s] on which a step must end.
    smallest : float
        Δt [s] below which no retry is made.

    Attributes
    ----------
    factor : float
        Present Δt over the nominal one.
    good : int
        Successful steps since it last changed.
    """

    def __init__(
        self, step: float, end: float, every: float | None, events: Iterable[float], smallest: float
    ) -> None:
        self.step, self.end, self._every, self.smallest = step, end, every, smallest
        self._events = sorted({t for t in events if 0.0 < t < end} | {end})
        self.factor = 1.0
        self.good = 0

    def next_end(self, time: float) -> float:
        """End of the step that starts at ``time`` [s]."""
        dt = self.step * self.factor
        target = min(self._next_event(time), self._next_state(time))
        # landing exactly on the event also when it lies a rounding beyond the step
        return target if target - time <= dt * (1.0 + SLACK) else time + dt

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
        """Whether the run is over."""
        return time >= self.end - SLACK * min(self.step, self.smallest)

    def failed(self) -> bool:
        """Halve Δt after a failed attempt; False if it is as small as it may be."""
        self.good = 0
        if 0.5 * self.factor * self.step < self.smallest:
            return False
        self.factor *= 0.5
        return True

    def succeeded(self) -> None:
        """Let a shortened Δt recover."""
        self.good += 1
        if self.factor < 1.0 and self.good >= GROW_AFTER:
            self.factor = min(1.0, 2.0 * self.factor)
            self.good = 0
