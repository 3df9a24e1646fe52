"""A whole run with its files, called from Python."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import numpy as np
from mpi4py import MPI

from lyra_petsc.api.run_loop import ProgressCallbacks, StopAsked, simulate
from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.api.simulations import refuse_mixed_options
from lyra_petsc.errors import Interrupted
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import choose
from lyra_petsc.parallel import on_root
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

OnStep = Callable[[StepReport], object]


def run(
    scene: SceneLike,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    trust_mesh: bool = False,
    on_step: OnStep | None = None,
    comm: MPI.Comm | None = None,
) -> StoredRun:
    """`lyra_petsc.run` without showing progress; same parameters and errors; collective."""
    comm = MPI.COMM_WORLD if comm is None else comm
    loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))
    refuse_mixed_options(loaded)
    choice = choose(comm, loaded.source.stem if loaded.source else "scene", out, force=force, resume=resume)
    try:
        with _noted_interrupt(comm) as stop_asked, np.errstate(over="ignore", invalid="ignore"):
            folder = simulate(comm, loaded, choice, _Callback(on_step), stop_asked)
    except Interrupted as stopped:
        raise KeyboardInterrupt(str(stopped)) from None
    return StoredRun(folder)


class _Callback(ProgressCallbacks):
    def __init__(self, on_step: OnStep | None) -> None:
        self._on_step = on_step

    def step(self, simulation: SteppedScene, report: StepReport) -> None:
        if self._on_step is not None:
            self._on_step(report)


@contextmanager
def _noted_interrupt(comm: MPI.Comm) -> Iterator[StopAsked]:
    """Within the context a first interrupt is noted, and a second one is handled as before it."""
    seen = 0
    before = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()  # others may not handle signals

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal seen
        seen = number
        signal.signal(signal.SIGINT, before)

    if in_main_thread:
        signal.signal(signal.SIGINT, note)
    try:
        yield lambda: int(comm.allreduce(seen, MPI.MAX))
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)
