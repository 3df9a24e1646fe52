"""``study``: error against run time, for combinations of settings of a scene."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.cli.experiments import case_launcher, command, watched
from lyra_petsc.cli.progress import StudyProgress
from lyra_petsc.cli.run import petsc_speaks, tell_unused
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.case import load_record, save_record
from lyra_petsc.experiments.study.jobs import STUDY, Job, Result, launched, report_progress, run_case
from lyra_petsc.experiments.study.plan import REQUEST_FILE, Plan, Request, make_plan, read_request
from lyra_petsc.experiments.study.study_report import StudyOutcome, conduct
from lyra_petsc.experiments.study.work import Work, choose_references
from lyra_petsc.output.run_folder import RunDirectory, choose
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.default import default_scene


def study(comm: MPI.Comm, *, out: Path | None, resume: bool, force: bool, **said: Any) -> None:
    """Run a study; collective.

    Parameters
    ----------
    comm : MPI.Comm
    out, resume, force
        The options of these names.
    **said
        Fields of `Request` as the command line gives them; None or empty where nothing was said.
        ``trust_mesh`` is always said: it is not taken from a folder, which may be another's.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError
        No combination ran to its end, or no reference; what there is to tell is written.
    Interrupted
        A signal; the folder can be resumed.
    """
    scene = said["scene"] or default_scene()
    stem = out.name if resume and said["scene"] is None and out is not None else scene.stem
    choice = choose(comm, stem, out, force=force, resume=resume, kind=STUDY)
    base = Request(str(scene))
    if resume:
        base = on_root(comm, lambda: read_request(choice.path))
    said["scene"] = said["scene"] and str(scene)
    request = dataclasses.replace(base, **{k: given for k, given in said.items() if given not in (None, ())})
    obey = watched(comm, lambda: f"; finished combinations are kept in {folder}, --resume goes on")
    launcher = case_launcher(comm, "study", request.ranks)
    plan = on_root(comm, lambda: make_plan(request))
    chosen = on_root(comm, lambda: choose_references(plan))
    with RunDirectory(comm, choice) as directory:
        folder = directory.path
        directory.clean()
        on_root(comm, lambda: save_record(folder / REQUEST_FILE, plan.request))

        def run(job: Job, watch: Callable[[float], None], warm: bool) -> Result:
            if launcher is not None:
                # every process warms up by itself
                return launched(launcher, job, watch, directory.descriptor)
            return run_case(comm, job, watch, warm=warm)

        with StudyProgress(comm, obey, len(plan.combinations), plain=petsc_speaks()) as progress:
            for note in [*plan.notes, *([directory.note] if directory.note else [])]:
                progress.note(note)
            outcome = conduct(comm, Work(comm, plan, chosen, folder, run, progress), _command(comm, plan))
    _close(comm, outcome, folder)


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


def _close(comm: MPI.Comm, outcome: StudyOutcome, folder: Path) -> None:
    """Words at the end, and the ways in which a study fails as a whole."""
    if comm.rank == 0:
        for advice in outcome.advice.values():
            for one in advice:
                print(one.words)
        done = len(outcome.rows) - len(outcome.failed)
        print(f"{done} of {len(outcome.rows)} combinations done, {len(outcome.failed)} failed")
        print(f"report       {folder / 'report.html'}", flush=True)
        tell_unused([])
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
            return load_record(path, Job)
        except (OSError, ValueError):
            raise InputError("is no job of a study", file=path, key="--job") from None

    job = on_root(comm, read)
    tell: Callable[[float], None] = report_progress(Path(job.folder))

    def watch(fraction: float) -> None:
        obey()
        if comm.rank == 0:
            tell(fraction)

    run_case(comm, job, watch, warm=True)
