"""A whole run with its files, from Python."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.api.simulations import refuse_mixed_options
from lyra_petsc.errors import Interrupted
from lyra_petsc.output.folder import choose
from lyra_petsc.parallel import on_root
from lyra_petsc.results.run import Run
from lyra_petsc.simulation import Simulation, StepReport
from lyra_petsc.whole_run import Watcher, carry_out

OnStep = Callable[[StepReport], object]


def run(
    scene: SceneLike,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    on_step: OnStep | None = None,
    comm: MPI.Comm | None = None,
) -> Run:
    """Simulate a scene and write its results, as the command ``run`` does; collective.

    An interrupt (the stop button of a notebook, Ctrl-C) lets the step end, writes a checkpoint and raises
    KeyboardInterrupt; ``resume=True`` goes on from there.

    Parameters
    ----------
    scene : Scene, path or mapping
    out : path, optional
        Folder of the results; else ``runs/<scene file stem>``, or ``…-2``, ``…-3`` when that exists.
    force : bool
        Replace the results in ``out``.
    resume : bool
        Go on from the newest checkpoint.
    on_step : callable, optional
        Called after each step with its report (``step``, ``time``, ``dt``, ``newton_iterations``, …).
    comm : MPI.Comm, optional
        COMM_WORLD unless given.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run could not go on; what was written stands.
    """
    comm = MPI.COMM_WORLD if comm is None else comm
    loaded = on_root(comm, lambda: load(scene))
    assert loaded is not None
    refuse_mixed_options(loaded)
    choice = choose(comm, loaded.source.stem if loaded.source else "scene", out, force=force, resume=resume)
    try:
        with _Interrupt(comm) as interrupt, np.errstate(over="ignore", invalid="ignore"):
            folder = carry_out(comm, loaded, choice, _Calls(on_step), interrupt.asked)
    except Interrupted as stopped:
        raise KeyboardInterrupt(str(stopped)) from None
    return Run(folder)


class _Calls(Watcher):
    def __init__(self, on_step: OnStep | None) -> None:
        self._on_step = on_step

    def step(self, simulation: Simulation, report: StepReport) -> None:
        if self._on_step is not None:
            self._on_step(report)


class _Interrupt:
    """While it is entered, an interrupt is noted; a second one is Python's own again."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._seen = 0
        self._before: Any = None

    def asked(self) -> int:
        return int(self._comm.allreduce(self._seen, MPI.MAX))

    def __enter__(self) -> _Interrupt:
        if threading.current_thread() is threading.main_thread():  # no other may handle signals
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._seen = number
        signal.signal(signal.SIGINT, self._before)
