"""Which step comes next: its length, where it must land, and what a failure or an error makes of it."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Mapping

SLACK = 1e-6
"""Fraction of Δt by which a step may differ from its length to avoid an extra tiny one."""

GROW_AFTER = 2
"""Successful steps after which a shortened Δt is doubled."""

HALVINGS = 6
"""How many times a step that was solved and is not good is halved."""

MOST_PATIENCE = 128
"""The most such steps, after others that were repeated because of their energy."""

SAFETY = 0.85
SHRINK, GROW = 0.2, 2.0
"""By how much a tolerance may change Δt at once; BDF2 is stable up to a factor of 2.4."""


class StepControl:
    """Plans the end of each step of a nominal length; halved after a failure.

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
    patience : int
        Successful steps after which a shortened Δt is doubled.
    """

    def __init__(
        self, step: float, end: float, every: float | None, events: Iterable[float], smallest: float
    ) -> None:
        self.step, self.end, self._every, self.smallest = step, end, every, smallest
        self._events = sorted({t for t in events if 0.0 < t < end} | {end})
        self.factor = 1.0
        self.good, self.patience = 0, GROW_AFTER

    def next_end(self, time: float) -> float:
        """End of the step that starts at ``time`` [s]."""
        dt = self.step * self.factor
        target = min(self._next_event(time), self._next_state(time))
        # landing exactly on the event also when it lies a rounding beyond the step
        return target if target - time <= dt * (1.0 + SLACK) else time + self._part(dt, target - time)

    def _part(self, dt: float, left: float) -> float:
        """Length of a step that does not reach what lies ``left`` [s] ahead."""
        return dt

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

    def shorten(self, dt: float, *, first: bool) -> bool:
        """Halve a step of dt [s] that was solved and is not good; False if it is as small as it may be.

        After each step for which that is the ``first`` time a larger Δt is tried later.
        """
        self.good = 0
        if first:
            self.patience = min(2 * self.patience, MOST_PATIENCE)
        if 0.5 * dt < self.smallest or self._halved(dt) >= HALVINGS:
            return False
        self.factor = 0.5 * dt / self.step
        return True

    def _halved(self, dt: float) -> int:
        """How many times the nominal step was halved to dt [s], unless it was cut short to land somewhere."""
        return round(math.log2(self.step / dt)) if dt >= self.factor * self.step * (1.0 - SLACK) else 0

    def succeeded(self, iterations: int) -> None:
        """Let a shortened Δt recover."""
        self.good += 1
        if self.factor < 1.0 and self.good >= self.patience:
            self.factor = min(1.0, 2.0 * self.factor)
            self.good = 0

    def memory(self) -> dict[str, float]:
        """What a checkpoint must hold to go on alike."""
        return {"factor": self.factor, "good": self.good, "patience": self.patience, "nominal": self.step}

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory; one of another nominal step has no say."""
        if float(memory.get("nominal", self.step)) == self.step:
            self.factor, self.good = float(memory["factor"]), int(memory["good"])
            self.patience = int(memory.get("patience", GROW_AFTER))


class ToleranceControl(StepControl):
    """Chooses Δt such that local errors add up to a tolerance by the end.

    ``step`` is the largest Δt; ``factor`` begins at ``first`` over it.
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

    def _part(self, dt: float, left: float) -> float:
        # two equal steps rather than a full one and a crumb
        return 0.5 * left if left < 2.0 * dt else dt

    def judge(self, dt: float, ratio: float, order: int, least: float = 0.0) -> bool:
        """Whether a step of length dt [s] may stand, with its error over what it may be; plans the next.

        A step that cannot be shortened, or not below ``least`` [s], stands whatever its error.
        """
        least = max(least, self.smallest)
        planned = self.factor * self.step
        allowed = math.inf if ratio == 0.0 else dt * SAFETY * ratio ** (-1.0 / order)
        stands = ratio <= 1.0 or dt <= least * (1.0 + SLACK)
        # a step shortened to end at an output time is no reason against the longer one planned
        most = max(GROW * dt, planned) if stands else 0.9 * dt
        self.factor = max(min(max(allowed, SHRINK * dt), most, self.step), least) / self.step
        return stands

    def succeeded(self, iterations: int) -> None:
        """The error alone decides."""

    def _halved(self, dt: float) -> int:
        return 0

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory; one of another largest step says how long the last was."""
        super().restore(memory)
        nominal = float(memory.get("nominal", self.step))
        if nominal != self.step:
            planned = float(memory["factor"]) * nominal
            self.factor = min(max(planned, self.smallest) / self.step, 1.0)


class LoadControl(StepControl):
    """Increments of the load factor: larger after an easy step, halved after a failure.

    ``step`` is the first increment, and the largest one after an event, ``largest`` the largest of all;
    ``factor`` may grow beyond 1.
    """

    EASY = 12
    """Newton iterations of a load step after which the next is twice as large."""

    def __init__(
        self, step: float, end: float, events: Iterable[float], smallest: float, largest: float
    ) -> None:
        super().__init__(step, end, None, events, smallest)
        self._largest = largest

    def next_end(self, time: float) -> float:
        if time in self._events:  # where motions and loads may turn: equilibria lead elsewhere
            self.factor = min(self.factor, 1.0)
        return super().next_end(time)

    def succeeded(self, iterations: int) -> None:
        larger = 2.0 * self.factor if iterations <= self.EASY else self.factor
        self.factor = min(larger, self._largest / self.step)
