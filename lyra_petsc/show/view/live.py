"""The page of ``run --live`` and of notebooks: a separate process, which reads the run's folder.

``python -m lyra_petsc.show.view.live HOST PORT`` reads the folder from its standard input and writes one line
to its standard output: the address of the page, or the reason for its failure. The end of the standard input
means that the run has ended; the process then ends when no page is open any more.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from lyra_petsc.api.mpirun import environment
from lyra_petsc.errors import LyraError
from lyra_petsc.startup import module_command

PACKAGES = ("trame", "trame_vtk", "trame_vuetify", "trame_plotly", "vtkmodules", "matplotlib")
"""Packages of the extra ``view`` that the page needs."""

READY, FAILED = "ready ", "failed "
"""Prefixes of the line on standard output."""

NICENESS = 10
"""With a busy rank on the same processor, Linux gives the process 110 / (1024 + 110) = 10 % of its time.

The process needs it only while a page is loaded; with less, loading the page's megabytes takes minutes.
"""


class LivePage:
    """The page's process; a run starts it before its set-up and never waits for it. For one rank.

    Parameters
    ----------
    host : str
    port : int
    ready : callable
        Called in a thread with the page's address.
    failed : callable
        Called in a thread with the reason, if the page cannot be served.
    """

    def __init__(
        self, host: str, port: int, ready: Callable[[str], None], failed: Callable[[str], None]
    ) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._ready, self._failed, self._announced = ready, failed, False
        try:
            self._process = subprocess.Popen(
                [*module_command("lyra_petsc.show.view.live"), host, str(port)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment(),  # the process is not a rank of the run
                start_new_session=True,  # Ctrl-C must reach the run only
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
            self._announced = True
            self._ready(line.removeprefix(READY))
        elif process.stdin is not None and not process.stdin.closed:  # closed: the run has ended already
            self._failed(line.removeprefix(FAILED) or "its process ended")

    def show(self, folder: Path) -> None:
        """Serve the page of a run whose first state has been written."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # `failed` reports it
                self._process.stdin.write(f"{folder.absolute()}\n")
                self._process.stdin.flush()

    def end(self) -> None:
        """Notify the process that the run has ended; it shows the last state until no page is open.

        If nobody has got the address of the page yet, the process ends at once.
        """
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
            if not self._announced:
                self._process.terminate()


def main(host: str, port: int) -> None:
    """Serve the page of the run whose folder is the first line of the standard input."""
    _lower_priority(NICENESS)
    # the imports take a second, during the run's set-up
    from lyra_petsc.show.view.server import MAX_STAY, find_run, serve

    line = sys.stdin.readline()
    if not line:
        return
    folder = Path(line.removesuffix("\n"))

    def report(line: str) -> None:
        with suppress(OSError):  # the run's process has ended
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

    def ended() -> str:
        sys.stdin.read()
        return (
            "The run has ended, or the notebook that shows it. This page stays for as long as it is open, at "
            f"most {MAX_STAY / 60:.0f} minutes; later: lyra-petsc view {folder}"
        )

    def ready(url: str) -> None:
        report(READY + url)

    try:
        asyncio.run(serve(find_run(folder), host, port, ready, ended))
    except LyraError as error:
        report(FAILED + str(error))


def _lower_priority(niceness: int) -> None:
    """Lower this process's priority, and remove the binding to processors inherited from rank 0."""
    os.setpriority(os.PRIO_PROCESS, 0, max(niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    if os.getsid(0) == os.getpid():
        # Linux may divide processor time among sessions first, and this process has a session of its own
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(niceness), encoding="ascii")
    if hasattr(os, "sched_setaffinity"):
        with suppress(OSError):
            os.sched_setaffinity(0, range(os.cpu_count() or 1))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
