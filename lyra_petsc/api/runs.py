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
from lyra_petsc.output.read_run import Run
from lyra_petsc.output.run_folder import choose
from lyra_petsc.parallel import on_root
from lyra_petsc.stepping.simulation import Simulation, StepReport

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
    trust_mesh : bool
        Give gmsh this scene's scripts (.geo) whatever they say.
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
    loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))
    assert loaded is not None
    refuse_mixed_options(loaded)
    choice = choose(comm, loaded.source.stem if loaded.source else "scene", out, force=force, resume=resume)
    try:
        with _noted_interrupt(comm) as stop_asked, np.errstate(over="ignore", invalid="ignore"):
            folder = simulate(comm, loaded, choice, _Callback(on_step), stop_asked)
    except Interrupted as stopped:
        raise KeyboardInterrupt(str(stopped)) from None
    return Run(folder)


class _Callback(ProgressCallbacks):
    def __init__(self, on_step: OnStep | None) -> None:
        self._on_step = on_step

    def step(self, simulation: Simulation, report: StepReport) -> None:
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
