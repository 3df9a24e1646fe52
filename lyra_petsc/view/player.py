"""Which state is shown when: playing, scrubbing, and following a run that goes on."""

from __future__ import annotations

import asyncio
import math
import time as clock

from lyra_petsc.results.run import Run

SHORTEST, LONGEST = 0.5, 60.0
"""Lengths of a motion [s] that are played in real time; others take `USUAL` at first."""

USUAL = 10.0
"""[s]"""

PACES = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Speeds to choose from, over the first one."""


class Player:
    """The clock of the page.

    Parameters
    ----------
    run : Run

    Attributes
    ----------
    shown : int
        Number of the state that is wanted on the page.
    speed : float
        Seconds of the run in a second.
    playing : bool
    changed : asyncio.Event
        Set when another state is wanted.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.shown = 0 if run.finished else len(run) - 1
        self.speed = first_speed(run)
        self.playing = False
        self.changed = asyncio.Event()
        self._begun, self._from = 0.0, 0.0

    @property
    def last(self) -> int:
        """Number of the newest state."""
        return len(self._run) - 1

    def play(self) -> None:
        """Go on from the state shown, or from the first one when the last is shown."""
        if self.shown >= self.last:
            self.shown = 0
        self.playing = True
        self._restart()

    def pause(self) -> None:
        """Stay at the state shown."""
        self.playing = False

    def go(self, state: int) -> None:
        """Show a state, and play on from there if it plays."""
        self.shown = min(max(state, 0), self.last)
        self._restart()

    def set_speed(self, speed: float) -> None:
        """Change the speed from here on."""
        self.speed = speed
        self._restart()

    def _restart(self) -> None:
        self._begun, self._from = clock.monotonic(), float(self._run.times[self.shown])
        self.changed.set()

    def due(self) -> int:
        """Number of the state to show now; stops playing at the last one."""
        if self.playing:
            now = self._from + self.speed * (clock.monotonic() - self._begun)
            self.shown = max(int(self._run.times.searchsorted(now, side="right")) - 1, self.shown, 0)
            if self.shown >= self.last:
                self.playing = False
        return self.shown

    def next_due(self) -> float:
        """Seconds until another state is due; infinite while it does not play."""
        if not self.playing or self.shown >= self.last:
            return math.inf
        now = self._from + self.speed * (clock.monotonic() - self._begun)
        return max(0.0, (float(self._run.times[self.shown + 1]) - now) / self.speed)

    def follow(self) -> bool:
        """See what the run has written meanwhile; whether there is anything new.

        Who looks at the newest state goes on looking at the newest one.

        Raises
        ------
        InputError
            If the results are gone.
        """
        newest = self.shown >= self.last and not self.playing
        if not self._run.refresh():
            return False
        self.shown = self.last if newest else min(self.shown, self.last)
        self.changed.set()
        return True


def first_speed(run: Run) -> float:
    """Real time where that suits the eye, else what lets the motion last about ten seconds."""
    span = float(run.times[-1] - run.times[0])
    if span <= 0 or SHORTEST <= span <= LONGEST:
        return 1.0
    return float(10.0 ** round(math.log10(span / USUAL)))
