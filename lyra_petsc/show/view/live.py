"""The page of ``run --live`` and of notebooks: a separate process, which reads the run's folder.

``python -m lyra_petsc.show.view.live FOLDER HOST PORT`` writes one line to its standard output: the address
of the page, or the reason why there is none. The end of its standard input means that the run has ended; the
process then ends when no page is open any more.
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

PACKAGES = ("pyvista", "trame", "trame_pyvista", "trame_vtk", "trame_vuetify", "vtkmodules", "matplotlib")
"""Packages of the extra ``view`` that the page needs."""

FAILED = "failed "
"""Beginning of the line on standard output if there is no page."""

NICENESS = 5
"""With a busy rank on the same processor, Linux gives the process 335 / (1024 + 335) = 25 % of its time."""


class LivePage:
    """The page's process; the run never waits for it. For one rank.

    Parameters
    ----------
    folder : Path
        The run's folder, with one state at least.
    host : str
    port : int
    ready : callable
        Called in a thread with the page's address.
    failed : callable
        Called in a thread with the reason, if the page cannot be served.
    """

    def __init__(
        self,
        folder: Path,
        host: str,
        port: int,
        ready: Callable[[str], object],
        failed: Callable[[str], object],
    ) -> None:
        self._process = subprocess.Popen(
            [*module_command("lyra_petsc.show.view.live"), str(folder.absolute()), host, str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),  # the process is not a rank of the run
            start_new_session=True,  # Ctrl-C must reach the run only
            text=True,
        )
        self._announced = self._ended = False

        def listen() -> None:
            assert self._process.stdout is not None
            line = self._process.stdout.readline().strip()
            if line and not line.startswith(FAILED):
                self._announced = True
                ready(line)
            elif not self._ended:
                failed(line.removeprefix(FAILED) or "its process ended")

        threading.Thread(target=listen, daemon=True).start()

    def end(self) -> None:
        """Notify the process that the run has ended; if nobody has got its address yet, it ends at once."""
        self._ended = True
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        if not self._announced:
            self._process.terminate()


def main(folder: str, host: str, port: str) -> None:
    """Serve the page of a run until the standard input has ended and nobody has the page open."""
    os.setpriority(os.PRIO_PROCESS, 0, max(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))
    with suppress(OSError):  # Linux may share the time out among sessions first, and this is one of its own
        Path("/proc/self/autogroup").write_text(str(NICENESS), encoding="ascii")
    with suppress(AttributeError, OSError):  # the process inherits the binding of rank 0 to a processor
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    from lyra_petsc.show.view.server import MAX_STAY_SECONDS, serve

    def report(line: str) -> None:
        with suppress(OSError):  # the run's process has ended
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

    async def ended() -> str:
        loop, closed = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(sys.stdin, closed.set)
        await closed.wait()
        loop.remove_reader(sys.stdin)
        stay = f"at most {MAX_STAY_SECONDS // 60} minutes"
        return f"The run has ended. This page stays while it is open, {stay}; later: lyra-petsc view {folder}"

    try:
        asyncio.run(serve(Path(folder), host, int(port), report, ended))
    except LyraError as error:
        report(FAILED + str(error))


if __name__ == "__main__":
    main(*sys.argv[1:])
