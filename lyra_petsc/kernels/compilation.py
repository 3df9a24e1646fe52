"""When numba compiles kernels in this process, for how long, and whether it can keep them."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

from numba.core import event


def no_action() -> None:
    """Default callback."""


class Compilation(event.Listener):
    """Measures the time in which numba compiles kernels; kernels loaded from disk do not count.

    Attributes
    ----------
    begins, ends : callable
        Called when numba starts and ends a compilation; not for a kernel that another one calls.
    first : callable
        Called once, at the first compilation.
    ahead : callable
        Called when numba starts to compile, unless the result cannot be stored; may compile other kernels.
    all_cached : bool
        Whether all kernels could be stored on disk.
    """

    def __init__(self) -> None:
        self.begins: Callable[[], None] = no_action
        self.ends: Callable[[], None] = no_action
        self.first: Callable[[], None] = no_action
        self.ahead: Callable[[], None] = no_action
        self.all_cached = True
        self._done = self._since = 0.0
        self._depth = 0
        self._collects = False

    @property
    def seconds(self) -> float:
        """Wall time [s] spent compiling."""
        return self._done + (time.perf_counter() - self._since if self._depth else 0.0)

    def on_start(self, event: event.Event) -> None:
        """Numba starts to compile a kernel."""
        self._depth += 1
        if self._depth == 1:
            self._since = time.perf_counter()
            # numba makes many objects that live: to search them for garbage takes up to a tenth of the time
            self._collects = gc.isenabled()
            gc.disable()
            self.begins()
            first, self.first = self.first, no_action
            first()
            if self.all_cached:
                self.ahead()

    def on_end(self, event: event.Event) -> None:
        """Numba has compiled a kernel."""
        self._depth -= 1
        if self._depth == 0:
            if self._collects:
                gc.enable()
            self.ends()
            self._done += time.perf_counter() - self._since


COMPILATION = Compilation()
event.register("numba:compile", COMPILATION)  # type: ignore[no-untyped-call]
