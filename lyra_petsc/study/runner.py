"""Runs one case in this communicator: states from the first repeat, wall time from all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.errors import InputError, Interrupted, LyraError, OutputError, SolverError
from lyra_petsc.meshing.build import build_mesh
from lyra_petsc.output.checkpoint import checkpoint_files
from lyra_petsc.output.phases import Phases
from lyra_petsc.parallel import all_here, on_root
from lyra_petsc.recorder import Recorder
from lyra_petsc.scene.schema import Scene
from lyra_petsc.simulation import Simulation, StepReport
from lyra_petsc.study.case import Job, Result, Timing
from lyra_petsc.study.combination import scene_of
from lyra_petsc.study.folder import empty_case

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
        Take one untimed step first, so that compiling and loading of kernels are charged to nobody.

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
        scene = on_root(comm, lambda: scene_of(Path(job.scene), (), job.overrides))
        assert scene is not None
        result.integrator = _scheme(scene)
        if warm:
            _warm_up(comm, scene)
        for repeat in range(job.repeats):
            _repeat(comm, scene, folder, repeat, job.repeats, result, watch)
    except (Interrupted, OutputError):
        raise
    except (InputError, SolverError) as error:
        if isinstance(error, SolverError) and not error.collective and not all_here(comm):
            raise
        result.problem = " ".join(str(error).split())
        result.timings = []
    on_root(comm, lambda: result.write(folder))
    return result


def _scheme(scene: Scene) -> str:
    return str(getattr(scene.time, "scheme", scene.time.integrator))


class _Run:
    """A simulation that leaves PETSc's options as it found them; a context manager, collective."""

    def __init__(self, comm: MPI.Comm, scene: Scene, phases: Phases) -> None:
        self._alone = comm.size == 1
        self._before = set(PETSc.Options().getAll())
        try:
            self.simulation = Simulation(comm, scene, phases)
        except LyraError:
            self._give_back()
            raise

    def __enter__(self) -> Simulation:
        return self.simulation

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        # what met this rank alone must not be followed by calls that wait for the others
        together = error is None or (isinstance(error, LyraError) and getattr(error, "collective", True))
        if together or self._alone:
            self.simulation.destroy()
        self._give_back()

    def _give_back(self) -> None:
        database = PETSc.Options()
        for name in set(database.getAll()) - self._before:
            database.delValue(name)


def _warm_up(comm: MPI.Comm, scene: Scene) -> None:
    with _Run(comm, scene, Phases()) as simulation:
        simulation.model.release()
        if not simulation.finished:
            simulation.step()


def _repeat(
    comm: MPI.Comm, scene: Scene, folder: Path, repeat: int, repeats: int, result: Result, watch: Watch
) -> None:
    """One timed run; the first also records, and the recording is charged apart."""
    comm.Barrier()
    phases, began = Phases(), time.perf_counter()
    with _Run(comm, scene, phases) as simulation:
        comm.Barrier()
        set_up = time.perf_counter() - began
        recorder = None
        if repeat == 0:
            _describe(comm, scene, simulation, result)
            recorder = Recorder(simulation)
            with phases("files"):
                recorder.begin(folder)
        simulation.model.release()
        run, reports = 0.0, []
        try:
            while not simulation.finished:
                started = time.perf_counter()
                report = simulation.step()
                run += time.perf_counter() - started
                reports.append(report)
                if recorder is not None:
                    with phases("files"):
                        recorder.record(report)
                watch((repeat + min(1.0, simulation.time / simulation.control.end)) / repeats)
            if recorder is not None:
                with phases("files"):
                    recorder.settle()
        finally:
            if recorder is not None:
                recorder.close()
        if not simulation.control.is_end(simulation.time):
            raise SolverError(
                f"stopped at t = {simulation.time:g} s, before the end (-ts_max_steps?)", collective=True
            )
        result.notes += [note for note in simulation.notes if note not in result.notes]
        if repeat == 0:
            _count(simulation, reports, result)
            on_root(comm, lambda: _forget_checkpoints(folder))
        result.timings.append(_slowest(comm, set_up, run, phases.seconds()))


def _describe(comm: MPI.Comm, scene: Scene, simulation: Simulation, result: Result) -> None:
    outline = simulation.model.outline
    result.vertices, result.triangles = outline.n_vertices, outline.n_triangles
    result.spacing = outline.spacing
    sheets = [outline.n_vertices]
    if len(scene.mesh) > 1:
        found = on_root(
            comm, lambda: [build_mesh([source], file=scene.source).n_vertices for source in scene.mesh]
        )
        sheets = found or sheets
    result.sheets = sheets


def _count(simulation: Simulation, reports: Sequence[StepReport], result: Result) -> None:
    result.steps = len(reports)
    result.rejected = sum(report.rejected for report in reports)
    result.newton_iterations = sum(report.newton_iterations for report in reports)
    result.linear_iterations = sum(report.linear_iterations for report in reports)
    result.shortest = min((report.dt for report in reports), default=0.0)
    result.longest = max((report.dt for report in reports), default=0.0)
    result.end = simulation.time
    result.linear_solver = simulation.stepper.preset


def _forget_checkpoints(folder: Path) -> None:
    for path in checkpoint_files(folder):
        path.unlink(missing_ok=True)


def _slowest(comm: MPI.Comm, set_up: float, run: float, phases: dict[str, float]) -> Timing:
    names = list(phases)  # the same on all ranks: phases are entered together
    mine = np.array([set_up, run, *phases.values()])
    most = np.empty_like(mine)
    comm.Allreduce(mine, most, MPI.MAX)
    return Timing(float(most[0]), float(most[1]), dict(zip(names, most[2:].tolist(), strict=True)))
