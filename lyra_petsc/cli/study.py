"""``study``: error against run time, for combinations of settings of a scene."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.api.mpirun import find_launcher
from lyra_petsc.cli.experiments import command, petsc_words, tell_unused, watched
from lyra_petsc.cli.run import _petsc_speaks
from lyra_petsc.cli.study_progress import StudyProgress
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments import records
from lyra_petsc.experiments.launch import Launcher
from lyra_petsc.experiments.study.case import Job, Result
from lyra_petsc.experiments.study.conduct import Outcome, conduct
from lyra_petsc.experiments.study.folder import Lock, StudyFolder, choose_folder
from lyra_petsc.experiments.study.launch import launched, report_progress
from lyra_petsc.experiments.study.plan import Plan, make_plan
from lyra_petsc.experiments.study.reference import Chosen, Physics, choose_references
from lyra_petsc.experiments.study.request import REQUEST_FILE, Request, read_request
from lyra_petsc.experiments.study.runner import run_case
from lyra_petsc.experiments.study.work import Work
from lyra_petsc.extras import require
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.default import default_scene


@dataclasses.dataclass(frozen=True)
class Asked:
    """The command line of ``study``; None or empty where nothing was said."""

    scene: Path | None
    settings: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    reference: str | None = None
    quantities: str | None = None
    repeats: int | None = None
    ranks: int | None = None
    out: Path | None = None
    resume: bool = False
    force: bool = False
    trust_mesh: bool = False


@dataclasses.dataclass(frozen=True)
class _Ready:
    """All that is decided before anything is written."""

    folder: StudyFolder
    plan: Plan
    chosen: dict[Physics, Chosen]
    launcher: Launcher | None = None


def study(comm: MPI.Comm, asked: Asked) -> None:
    """Run a study; collective.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError
        No combination ran to its end, or no reference; what there is to tell is written.
    Interrupted
        A signal; the folder can be resumed.
    """
    obey = watched(comm, lambda: f"; finished combinations are kept in {folder}, --resume goes on")
    ready = on_root(comm, lambda: _prepare(comm, asked))
    assert ready is not None
    plan = ready.plan
    lock = Lock(comm, ready.folder)
    folder = lock.path
    on_root(comm, lambda: records.save(folder / REQUEST_FILE, plan.request))

    def run(job: Job, watch: Callable[[float], None], warm: bool) -> Result:
        if ready.launcher is not None:
            # every process warms up by itself
            return launched(ready.launcher, job, watch, lock.descriptor)
        return run_case(comm, job, watch, warm=warm)

    with StudyProgress(comm, obey, len(plan.combinations), plain=_petsc_speaks()) as progress:
        for note in plan.notes:
            progress.note(note)
        outcome = conduct(comm, Work(comm, plan, ready.chosen, folder, run, progress), _command(comm, plan))
    lock.release()
    _close(comm, outcome, folder)


def _prepare(comm: MPI.Comm, asked: Asked) -> _Ready:
    """Everything that can be refused, before anything is written (rank 0)."""
    require("study")
    if asked.resume and asked.scene is None and asked.out is not None:
        stem = asked.out.name
    else:
        stem = (asked.scene or default_scene()).stem
    folder = choose_folder(stem, asked.out, force=asked.force, resume=asked.resume)
    request = _request(asked, read_request(folder.path) if asked.resume else None)
    launcher = None
    if request.ranks is not None:
        if comm.size > 1:
            raise InputError(
                "starts one mpirun per case and cannot be used under mpirun; leave one of them out",
                key="--ranks",
            )
        launcher = Launcher(find_launcher(request.ranks), "study", petsc_words())
    plan = make_plan(request)
    return _Ready(folder, plan, choose_references(plan), launcher)


def _request(asked: Asked, stored: Request | None) -> Request:
    """What was asked for, and where nothing was said what the study was begun with."""
    base = stored or Request(str(asked.scene or default_scene()))
    said: dict[str, Any] = {
        "scene": str(asked.scene) if asked.scene is not None else None,
        "settings": asked.settings or None,
        "vary": asked.vary or None,
        "reference": asked.reference,
        "quantities": asked.quantities,
        "repeats": asked.repeats,
        "ranks": asked.ranks,
        "trust_mesh": asked.trust_mesh,  # is not taken from a folder, which may be another's
    }
    return dataclasses.replace(base, **{key: value for key, value in said.items() if value is not None})


def _command(comm: MPI.Comm, plan: Plan) -> str:
    """The command line that repeats the study from the beginning."""
    request = plan.request
    words = [request.scene]
    for text in request.settings:
        words += ["--set", text]
    for axis in plan.axes:
        values = ",".join(f"{value!r}" if isinstance(value, float) else value for value in axis.values)
        words += ["--vary", f"{axis.key}={values}"]
    words += ["--reference", request.reference]
    words += ["--quantities", request.quantities] if request.quantities else []
    words += ["--repeats", str(request.repeats)]
    words += ["--ranks", str(request.ranks)] if request.ranks is not None else []
    words += ["--trust-mesh"] if request.trust_mesh else []
    return shlex.join(command(comm, "study", words))


def _close(comm: MPI.Comm, outcome: Outcome, folder: Path) -> None:
    """Words at the end, and the ways in which a study fails as a whole."""
    if comm.rank == 0:
        for advice in outcome.advice.values():
            for one in advice:
                print(one.words)
        done = len(outcome.rows) - len(outcome.failed)
        print(f"{done} of {len(outcome.rows)} combinations done, {len(outcome.failed)} failed")
        print(f"report       {folder / 'report.html'}", flush=True)
        tell_unused()
    if not any(row.result.done for row in outcome.rows):
        raise SolverError(
            f"all {len(outcome.rows)} combinations failed; the first: {outcome.rows[0].result.problem}",
            collective=True,
        )
    lost = [known for known in outcome.known.values() if known.kind == "none"]
    if lost:
        raise SolverError(
            f"{lost[0].words} ({'; '.join(lost[0].notes)}); run times are in {folder / 'study.csv'}",
            collective=True,
        )


def run_job(comm: MPI.Comm, path: Path) -> None:
    """``study --job FILE``: one case of a study that was started with ``--ranks``; collective.

    Raises
    ------
    InputError
        If the file is no job.
    Interrupted
        A signal.
    """
    obey = watched(comm)

    def read() -> Job:
        try:
            return records.load(path, Job)
        except (OSError, ValueError):
            raise InputError("is no job of a study", file=path, key="--job") from None

    job = on_root(comm, read)
    assert job is not None
    tell: Callable[[float], None] = report_progress(Path(job.folder))

    def watch(fraction: float) -> None:
        obey()
        if comm.rank == 0:
            tell(fraction)

    run_case(comm, job, watch, warm=True)
