"""When numba compiles kernels in this process, for how long, and whether it can keep them."""

from __future__ import annotations

import time
from collections.abc import Callable

from numba.core import event


def nothing() -> None:
    """Called where no run is to hear of it."""


class Compilation(event.Listener):
    """Times the compilation of kernels by numba; those that are loaded from the disk do not count.

    Attributes
    ----------
    begins, ends : callable
        Called when numba starts to compile, and when it has ended; not for a kernel that another one calls.
    first : callable
        Called once, when numba compiles for the first time.
    kept : bool
        Whether all kernels have a place on the disk.
    """

    def __init__(self) -> None:
        self.begins: Callable[[], None] = nothing
        self.ends: Callable[[], None] = nothing
        self.first: Callable[[], None] = nothing
        self.kept = True
        self._done = self._since = 0.0
        self._depth = 0

    @property
    def seconds(self) -> float:
        """Wall time [s] that was spent compiling."""
        return self._done + (time.perf_counter() - self._since if self._depth else 0.0)

    def on_start(self, event: event.Event) -> None:
        """As numba begins with a kernel."""
        self._depth += 1
        if self._depth == 1:
            self._since = time.perf_counter()
            self.begins()
            first, self.first = self.first, nothing
            first()

    def on_end(self, event: event.Event) -> None:
        """As numba ends with a kernel."""
        self._depth -= 1
        if self._depth == 0:
            self.ends()
            self._done += time.perf_counter() - self._since


COMPILATION = Compilation()
event.register("numba:compile", COMPILATION)  # type: ignore[no-untyped-call]
