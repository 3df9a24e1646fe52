"""Runs of a study: their input and result files, by which a study can be resumed, and how they are timed.

A case runs on the present communicator, or with ``--ranks P`` in an mpirun of its own. Its states are written
by the first repeat; wall times come from all repeats.
"""

from __future__ import annotations

import re
import shutil
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import failure_message, open_simulation
from lyra_petsc.experiments.case import Launcher, read_record, save_record
from lyra_petsc.experiments.study.plan import REQUEST_FILE, scene_of
from lyra_petsc.output.file_operations import make_folder, writing
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.run_folder import RUN, FolderKind
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene

RESULT_FILE = "result.json"

PHASES = ("mesh", "partition", "assembly", "solve", "balance", "output", "other")
"""Timed phases of a run; ``balance`` is the energy balance; writing files is not timed."""

COUNTS = ("rejected", "newton_iterations", "linear_iterations")
"""Counts of a run's steps that are summed up."""


@dataclass(frozen=True)
class Job:
    """The input of one run.

    Attributes
    ----------
    scene : str
        Path of the scene file.
    overrides : tuple of str
        All ``--set`` arguments.
    folder : str
        Folder of its states and its result.
    repeats : int
        How often it is timed; the first repeat writes the states.
    fingerprint : str
        Digest of everything that the result depends on.
    trust_mesh : bool
        ``--trust-mesh``.
    """

    scene: str
    overrides: tuple[str, ...]
    folder: str
    repeats: int
    fingerprint: str
    trust_mesh: bool = False


@dataclass
class Timing:
    """Wall times [s] of one repeat, maxima over the ranks.

    Attributes
    ----------
    set_up : float
        Mesh, partition, assembly set-up and solver objects.
    run : float
        All steps, without output.
    phases : dict of str to float
        Time per phase; ``files`` is the writing of states.
    """

    set_up: float
    run: float
    phases: dict[str, float] = field(default_factory=dict)


@dataclass
class Result:
    """The result of a case.

    Attributes
    ----------
    fingerprint : str
    problem : str
        Why it failed; empty if it did not.
    ranks : int
    integrator : str
    vertices, triangles : int
    spacing : float
        Mean edge length [m].
    sheets : list of int
        Vertices of each mesh source.
    steps, rejected, newton_iterations, linear_iterations : int
    shortest, longest : float
        Δt [s] of accepted steps.
    end : float
        Time reached [s].
    linear_solver : str
    timings : list of Timing
    notes : list of str
    """

    fingerprint: str
    problem: str = ""
    ranks: int = 1
    integrator: str = ""
    vertices: int = 0
    triangles: int = 0
    spacing: float = 0.0
    sheets: list[int] = field(default_factory=list)
    steps: int = 0
    rejected: int = 0
    newton_iterations: int = 0
    linear_iterations: int = 0
    shortest: float = 0.0
    longest: float = 0.0
    end: float = 0.0
    linear_solver: str = ""
    timings: list[Timing] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def mean_step(self) -> float:
        """Mean Δt [s]; 0 without steps."""
        return self.end / self.steps if self.steps else 0.0

    def fail(self, problem: str) -> None:
        """Mark the run as failed and discard its times."""
        self.problem, self.timings = problem, []

    @property
    def run_seconds(self) -> list[float]:
        """Time of the steps, for each repeat."""
        return [timing.run for timing in self.timings]

    @property
    def total_seconds(self) -> list[float]:
        """Time of set-up and steps, for each repeat."""
        return [timing.set_up + timing.run for timing in self.timings]

    @property
    def phase_seconds(self) -> dict[str, float]:
        """Median over the repeats for each phase; empty without repeats."""
        by_phase = {name: [timing.phases.get(name, 0.0) for timing in self.timings] for name in PHASES}
        return {name: statistics.median(times) for name, times in by_phase.items() if times}


def read_result(folder: Path, fingerprint: str) -> Result | None:
    """Read the result of a finished case; None if there is none with this fingerprint."""
    result = read_record(folder / RESULT_FILE, Result)
    return result if result is not None and result.fingerprint == fingerprint else None


CASES = "cases"

RESULT = re.compile(
    r"(study\.(csv|json)|request\.json|report\.(html|md)"
    r"|(work-precision|convergence)[\w.+-]*\.(png|svg))(\.part)?"
)
"""Files of a study beside its cases."""


STUDY = FolderKind(
    "study",
    Path("studies"),
    RESULT,
    (REQUEST_FILE,),
    "no study to resume",
    folders=(CASES,),
)


def prepare_folder(folder: Path) -> None:
    """Create an empty folder for a case and the one above; files of an interrupted case are removed.

    Raises
    ------
    OutputError
    """
    with writing(folder):
        make_folder(folder.parent)
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()


Watch = Callable[[float], None]
"""Called with the completed fraction of the case, after every step, on all ranks; may raise."""


def run_case(comm: MPI.Comm, job: Job, watch: Watch, *, warm_up: bool) -> Result:
    """Run a case and write its result; collective.

    Parameters
    ----------
    comm : MPI.Comm
    job : Job
    watch : callable
    warm_up : bool
        Take one untimed step first, so that the times do not include compiling and loading kernels.

    Returns
    -------
    Result
        Also for a case that failed: its ``problem`` says why.

    Raises
    ------
    Interrupted
        From ``watch``; the case is then unfinished.
    SolverError
        If ranks failed in different ways and cannot continue together.
    OutputError
    """
    folder = Path(job.folder)
    on_root(comm, lambda: prepare_folder(folder))
    result = Result(job.fingerprint, ranks=comm.size)
    try:
        scene = on_root(comm, lambda: scene_of(job.scene, job.overrides, trust_mesh=job.trust_mesh))
        result.integrator = str(scene.time.scheme)
        if warm_up:
            _warm_up(comm, scene)
        for repeat in range(job.repeats):
            _run_repeat(comm, scene, job, repeat, result, watch)
    except (InputError, SolverError) as error:
        result.fail(failure_message(comm, error))
    on_root(comm, lambda: save_record(folder / RESULT_FILE, result))
    return result


def _warm_up(comm: MPI.Comm, scene: Scene) -> None:
    with open_simulation(comm, scene) as simulation:
        simulation.problem.release()
        if not simulation.finished:
            simulation.step()


def _run_repeat(comm: MPI.Comm, scene: Scene, job: Job, repeat: int, result: Result, watch: Watch) -> None:
    """One timed run; the first one also writes its states, which is timed separately."""
    folder = Path(job.folder)
    comm.Barrier()
    phases, began = Phases(), time.perf_counter()
    with open_simulation(comm, scene, phases) as simulation, ExitStack() as stack:
        comm.Barrier()
        set_up = time.perf_counter() - began
        recorder, whole = None, simulation.problem.whole
        if repeat == 0:
            result.vertices, result.triangles = whole.n_vertices, whole.n_triangles
            result.spacing, result.sheets = whole.spacing, [source.n_vertices for source in whole.sources]
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
            watch((repeat + min(1.0, simulation.time / simulation.control.end)) / job.repeats)
        if recorder is not None:
            with phases("files"):
                recorder.flush()
        if not simulation.control.is_end(simulation.time):
            raise SolverError(
                f"stopped at t = {simulation.time:g} s, before the end (-ts_max_steps?)", collective=True
            )
        result.notes += [note for note in simulation.notes if note not in result.notes]
        if repeat == 0:
            stack.close()
            result.steps, lengths = len(reports), [report.dt for report in reports]
            for count in COUNTS:
                setattr(result, count, sum(getattr(report, count) for report in reports))
            result.shortest, result.longest = min(lengths, default=0.0), max(lengths, default=0.0)
            result.end, result.linear_solver = simulation.time, simulation.stepper.preset
            for path in RUN.resumable(folder) if comm.rank == 0 else ():
                path.unlink(missing_ok=True)

        def slowest(seconds: float) -> float:
            return float(comm.allreduce(seconds, MPI.MAX))

        # ranks enter phases together, so that all have the same names
        by_phase = {name: slowest(seconds) for name, seconds in phases.seconds().items()}
        result.timings.append(Timing(slowest(set_up), slowest(run), by_phase))


def launch(launcher: Launcher, job: Job, watch: Callable[[], None], lock: int) -> Result:
    """Run a job in processes of its own.

    Parameters
    ----------
    launcher : Launcher
    job : Job
    watch : callable
        Called repeatedly; if it raises, the processes are terminated.
    lock : int
        File descriptor that the processes keep open, so that the folder stays locked while they run.
    """
    folder = Path(job.folder)
    job_file = folder.with_name(f"{folder.name}.job.json")
    with writing(folder.parent):
        make_folder(folder.parent)
    save_record(job_file, job)
    try:
        _, message = launcher(["--job", str(job_file)], watch, (lock,))
    finally:
        job_file.unlink(missing_ok=True)
    result = read_result(folder, job.fingerprint)
    if result is None:
        result = Result(job.fingerprint, problem=message)
        with writing(folder):
            make_folder(folder)
        save_record(folder / RESULT_FILE, result)
    return result


def run_job(comm: MPI.Comm, path: Path, check_stop: Callable[[], None]) -> None:
    """Run the job in a file; collective. ``check_stop`` is called after every step and may raise.

    Raises
    ------
    InputError
        If the file does not hold a job.
    """
    job = on_root(comm, lambda: read_record(path, Job))
    if job is None:
        raise InputError("is no job of a study", file=path, key="--job")
    run_case(comm, job, lambda fraction: check_stop(), warm_up=True)
