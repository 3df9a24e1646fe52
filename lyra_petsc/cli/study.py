"""``study``: error against run time, for combinations of settings of a scene."""

from __future__ import annotations

import dataclasses
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.run import _petsc_speaks
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.cli.study_progress import StudyProgress
from lyra_petsc.errors import InputError, Interrupted, SolverError
from lyra_petsc.extras import require
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.default import default_scene
from lyra_petsc.solvers.options import unused
from lyra_petsc.study.case import Job
from lyra_petsc.study.conduct import Outcome, conduct
from lyra_petsc.study.folder import Lock, StudyFolder, choose_folder
from lyra_petsc.study.launch import Launcher, find_launcher, report_progress
from lyra_petsc.study.plan import Plan, make_plan
from lyra_petsc.study.reference import Chosen, Physics, choose_references
from lyra_petsc.study.request import REQUEST_FILE, Request, read_request
from lyra_petsc.study.runner import run_case
from lyra_petsc.study.work import Runner, Work


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


@dataclasses.dataclass(frozen=True)
class _Ready:
    """All that is decided before anything is written."""

    folder: StudyFolder
    plan: Plan
    chosen: dict[Physics, Chosen]
    launcher: tuple[str, ...] = ()


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
    stop = StopRequest(comm)
    ready = on_root(comm, lambda: _prepare(comm, asked))
    assert ready is not None
    plan = ready.plan
    lock = Lock(comm, ready.folder)
    folder = lock.path
    on_root(comm, lambda: replace_text(folder / REQUEST_FILE, plan.request.text()))
    run: Runner = lambda job, watch, warm: run_case(comm, job, watch, warm=warm)  # noqa: E731
    if ready.launcher:
        run = Launcher(ready.launcher, split(sys.argv[1:])[1], lock.descriptor)

    def obey() -> None:
        number = stop.signal_number()
        if number:
            raise Interrupted(
                f"stopped by {signal.Signals(number).name}; finished combinations are kept in {folder}, "
                "--resume goes on",
                number,
            )

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
    launcher: tuple[str, ...] = ()
    if request.ranks is not None:
        if comm.size > 1:
            raise InputError(
                "starts one mpirun per case and cannot be used under mpirun; leave one of them out",
                key="--ranks",
            )
        launcher = tuple(find_launcher(request.ranks))
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
    }
    return dataclasses.replace(base, **{key: value for key, value in said.items() if value is not None})


def _command(comm: MPI.Comm, plan: Plan) -> str:
    """The command line that repeats the study from the beginning."""
    request = plan.request
    words = ["mpirun", "-n", str(comm.size)] if comm.size > 1 else []
    words += ["python", "-m", "lyra_petsc", "study", request.scene]
    for text in request.settings:
        words += ["--set", text]
    for axis in plan.axes:
        values = ",".join(f"{value!r}" if isinstance(value, float) else value for value in axis.values)
        words += ["--vary", f"{axis.key}={values}"]
    words += ["--reference", request.reference]
    words += ["--quantities", request.quantities] if request.quantities else []
    words += ["--repeats", str(request.repeats)]
    words += ["--ranks", str(request.ranks)] if request.ranks is not None else []
    return shlex.join([*words, *split(sys.argv[1:])[1]])


def _close(comm: MPI.Comm, outcome: Outcome, folder: Path) -> None:
    """Words at the end, and the ways in which a study fails as a whole."""
    left = unused([]) if comm.rank == 0 else []
    if comm.rank == 0:
        for advice in outcome.advice.values():
            for one in advice:
                print(one.words)
        done = len(outcome.rows) - len(outcome.failed)
        print(f"{done} of {len(outcome.rows)} combinations done, {len(outcome.failed)} failed")
        print(f"report       {folder / 'report.html'}", flush=True)
        if left:
            listed = ", ".join(f"-{name}" for name in left)
            print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)
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
    stop = StopRequest(comm)

    def read() -> Job:
        try:
            return Job.read(path)
        except (OSError, ValueError, TypeError, KeyError):
            raise InputError("is no job of a study", file=path, key="--job") from None

    job = on_root(comm, read)
    assert job is not None
    tell: Callable[[float], None] = report_progress(Path(job.folder))

    def watch(fraction: float) -> None:
        number = stop.signal_number()
        if number:
            raise Interrupted(f"stopped by {signal.Signals(number).name}", number)
        if comm.rank == 0:
            tell(fraction)

    run_case(comm, job, watch, warm=True)
