"""A whole run with its files, called from Python."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
from mpi4py import MPI

from lyra_petsc.api.run_loop import ProgressCallbacks, SignalCheck, simulate
from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.api.simulations import refuse_mixed_options
from lyra_petsc.errors import Interrupted, LyraError
from lyra_petsc.output.run_folder import choose_folder
from lyra_petsc.parallel import on_root
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

OnStep = Callable[[StepReport], object]


REDRAW_SECONDS = 0.3


def run(
    scene: SceneLike,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    trust_mesh: bool = False,
    on_step: OnStep | None = None,
    comm: MPI.Comm | None = None,
    progress: bool | None = None,
) -> Path:
    """Implements `lyra_petsc.run`, see there; returns the folder of the results; collective."""
    comm = MPI.COMM_WORLD if comm is None else comm
    callbacks = NotebookProgress(on_step, shown=in_notebook() if progress is None else progress)
    try:
        loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))
        refuse_mixed_options(loaded)
        stem = loaded.source.stem if loaded.source else "scene"
        choice = choose_folder(comm, stem, out, force=force, resume=resume)
        with _defer_interrupt(comm) as stop, np.errstate(over="ignore", invalid="ignore"):
            folder = simulate(comm, loaded, choice, callbacks, stop)
    except (LyraError, KeyboardInterrupt) as error:
        callbacks.end("stopped")
        if isinstance(error, Interrupted):
            raise KeyboardInterrupt(str(error)) from None
        raise
    callbacks.end(f"done: {folder}")
    return folder


def in_notebook() -> bool:
    """Whether this is a notebook's kernel (and rank 0 of it)."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return type(shell).__name__ == "ZMQInteractiveShell"


class NotebookProgress(ProgressCallbacks):
    """Calls a function after each step, and shows rich's bar below the cell."""

    def __init__(self, on_step: OnStep | None, *, shown: bool) -> None:
        self._on_step, self._drawn, self._handle = on_step, -REDRAW_SECONDS, None
        if shown:
            from IPython.display import display
            from rich.progress import BarColumn, Progress, TextColumn
            from rich.table import Column

            whole = Column(overflow="fold")  # folders may have long names
            self._bar = Progress(
                BarColumn(), TextColumn("{task.description}", markup=False, table_column=whole)
            )
            self._task = self._bar.add_task("set-up and first step", total=1.0)
            self._handle = display(self._bar, display_id=True)

    def step(self, simulation: SteppedScene, report: StepReport) -> None:
        end = simulation.control.end
        self._draw(f"step {report.step}, t = {report.time:.4g} of {end:.4g}", min(report.time / end, 1.0))
        if self._on_step is not None:
            self._on_step(report)

    def _draw(self, text: str, fraction: float | None = None) -> None:
        if self._handle is None:
            return
        self._bar.update(self._task, description=text, completed=fraction)
        if fraction is None or time.monotonic() - self._drawn >= REDRAW_SECONDS:
            self._drawn = time.monotonic()
            self._handle.update(self._bar)

    def end(self, outcome: str) -> None:
        """Show how the run ended."""
        if self._handle is not None:
            self._draw(f"{self._bar.tasks[0].description}, {outcome}")


@contextmanager
def _defer_interrupt(comm: MPI.Comm) -> Iterator[SignalCheck]:
    """Within the context a first interrupt is only recorded; a second one is handled as before."""
    received = 0
    before = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()  # only it may set handlers

    def record(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = number
        signal.signal(signal.SIGINT, before)

    if in_main_thread:
        signal.signal(signal.SIGINT, record)
    try:
        yield lambda: int(comm.allreduce(received, MPI.MAX))
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)
