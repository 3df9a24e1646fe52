"""Runs one case in this communicator: states from the first repeat, wall time from all."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

from mpi4py import MPI

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import problem_of, simulated
from lyra_petsc.experiments.study.case import Job, Result, Timing
from lyra_petsc.experiments.study.combination import scene_of
from lyra_petsc.experiments.study.folder import empty_case
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.run_folder import checkpoint_files
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene

Watch = Callable[[float], None]
"""Called with the fraction of the case that is done, after every step, on all ranks; may raise."""


def run_case(comm: MPI.Comm, job: Job, watch: Watch, *, warm: bool) -> Result:
    """Run a case and write its result; collective.

    Parameters
    ----------
    comm : MPI.Comm
    job : Job
    watch : callable
    warm : bool
        Take one untimed step first, so that no case is charged with compiling and loading kernels.

    Returns
    -------
    Result
        Also of a case that failed: its ``problem`` says why.

    Raises
    ------
    Interrupted
        From ``watch``; the case is then unfinished.
    SolverError
        If ranks failed in different ways and cannot go on together.
    OutputError
    """
    folder = Path(job.folder)
    on_root(comm, lambda: empty_case(folder))
    result = Result(job.fingerprint, ranks=comm.size)
    try:
        scene = on_root(comm, lambda: scene_of(Path(job.scene), (), job.overrides, trust_mesh=job.trust_mesh))
        assert scene is not None
        result.integrator = str(scene.time.scheme)
        if warm:
            _warm_up(comm, scene)
        for repeat in range(job.repeats):
            _repeat(comm, scene, folder, repeat, job.repeats, result, watch)
    except (InputError, SolverError) as error:
        result.fail(problem_of(comm, error))
    on_root(comm, lambda: result.write(folder))
    return result


def _warm_up(comm: MPI.Comm, scene: Scene) -> None:
    with simulated(comm, scene) as simulation:
        simulation.problem.release()
        if not simulation.finished:
            simulation.step()


def _repeat(
    comm: MPI.Comm, scene: Scene, folder: Path, repeat: int, repeats: int, result: Result, watch: Watch
) -> None:
    """One timed run; the first also records, and the recording is charged apart."""
    comm.Barrier()
    phases, began = Phases(), time.perf_counter()
    with simulated(comm, scene, phases) as simulation, ExitStack() as stack:
        comm.Barrier()
        set_up = time.perf_counter() - began
        recorder = None
        if repeat == 0:
            result.describe(simulation.problem.outline)
            recorder = stack.enter_context(closing(Recorder(simulation)))
            with phases("files"):
                recorder.begin(folder)
        simulation.problem.release()
        run, reports = 0.0, []
        while not simulation.finished:
            started = time.perf_counter()
            reports.append(simulation.step())
            run += time.perf_counter() - started
            if recorder is not None:
                with phases("files"):
                    recorder.record(reports[-1])
            watch((repeat + min(1.0, simulation.time / simulation.control.end)) / repeats)
        if recorder is not None:
            with phases("files"):
                recorder.settle()
        if not simulation.control.is_end(simulation.time):
            raise SolverError(
                f"stopped at t = {simulation.time:g} s, before the end (-ts_max_steps?)", collective=True
            )
        result.notes += [note for note in simulation.notes if note not in result.notes]
        if repeat == 0:
            stack.close()
            result.count(reports)
            result.end, result.linear_solver = simulation.time, simulation.stepper.preset
            on_root(comm, lambda: _forget_checkpoints(folder))

        def slowest(seconds: float) -> float:
            return float(comm.allreduce(seconds, MPI.MAX))

        # phases are entered together, so that all ranks have the same
        by_phase = {name: slowest(seconds) for name, seconds in phases.seconds().items()}
        result.timings.append(Timing(slowest(set_up), slowest(run), by_phase))


def _forget_checkpoints(folder: Path) -> None:
    for path in checkpoint_files(folder):
        path.unlink(missing_ok=True)
