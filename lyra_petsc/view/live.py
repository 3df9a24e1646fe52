"""The page of a run that goes on: a process of its own, which reads the run's folder.

``python -m lyra_petsc.view.live HOST PORT`` reads the folder from its standard input, and tells in one line
on its standard output where the page is, or why there is none. When its standard input ends, the run has
ended, however it did; the process ends when nobody has the page open any more.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from lyra_petsc.errors import LyraError
from lyra_petsc.study.launch import environment

READY, FAILED = "ready ", "failed "
"""How the line begins."""

NICENESS = 15
"""Linux: beside a rank on the same processor 36 / (1024 + 36) = 3.4 % of the time, of an idle one all."""

NICENESS_AT_START = 10
"""As long as there is no page: 10 % of the time, for a second's work that falls mostly into the set-up."""


class LivePage:
    """Starts the page's process, before the set-up, and lets go of it; for one rank. The run never waits.

    Parameters
    ----------
    host : str
    port : int
    ready : callable
        Called in a thread with the page's address.
    failed : callable
        Called in a thread with the reason, if there will be no page.
    """

    def __init__(
        self, host: str, port: int, ready: Callable[[str], None], failed: Callable[[str], None]
    ) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._ready, self._failed = ready, failed
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "lyra_petsc.view.live", host, str(port)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment(),  # it is no rank of the run
                start_new_session=True,  # Ctrl-C is for the run
                text=True,
            )
        except OSError as error:
            failed(str(error))
        else:
            threading.Thread(target=self._listen, args=[self._process], daemon=True).start()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        if line.startswith(READY):
            self._ready(line.removeprefix(READY))
        elif process.stdin is not None and not process.stdin.closed:  # else the run was over before
            self._failed(line.removeprefix(FAILED) or "its process ended")

    def show(self, folder: Path) -> None:
        """The first state is in the run's folder: serve the page."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # `failed` is told
                self._process.stdin.write(f"{folder.absolute()}\n")
                self._process.stdin.flush()

    def end(self) -> None:
        """The run has ended: let the page show the last state, and go when nobody looks."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()


def main(host: str, port: int) -> None:
    """Serve the page of the run whose folder comes first until the standard input ends."""
    _step_back(NICENESS_AT_START)
    # what takes a second is done while the run sets itself up
    from lyra_petsc.view import page  # noqa: F401
    from lyra_petsc.view.server import LONGEST_STAY, find_run, serve

    line = sys.stdin.readline()
    if not line:
        return
    folder = Path(line.removesuffix("\n"))

    def tell(line: str) -> None:
        with suppress(OSError):  # the run is gone already
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

    def ended() -> str:
        sys.stdin.read()
        return (
            f"The run has ended. This page stays for as long as it is open, at most {LONGEST_STAY / 60:.0f} "
            f"minutes; later: lyra-petsc view {folder}"
        )

    def ready(url: str) -> None:
        _step_back(NICENESS)
        tell(READY + url)

    try:
        serve(find_run(folder), host=host, port=port, ready=ready, ended=ended)
    except LyraError as error:
        tell(FAILED + str(error))


def _step_back(niceness: int) -> None:
    """Leave the processors to the run, and be bound to none: rank 0 is, perhaps."""
    os.setpriority(os.PRIO_PROCESS, 0, max(niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    if os.getsid(0) == os.getpid():
        # Linux may share the time out among sessions first, and this is one of its own
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(niceness), encoding="ascii")
    if hasattr(os, "sched_setaffinity"):
        with suppress(OSError):
            os.sched_setaffinity(0, range(os.cpu_count() or 1))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
