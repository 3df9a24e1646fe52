"""The verb ``study``: error against run time, for combinations of settings of a scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.cli.experiments import case_launcher, command, stop_check, to_arguments
from lyra_petsc.cli.progress import StudyProgress
from lyra_petsc.cli.run import petsc_prints, warn_unused
from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.case import save_record
from lyra_petsc.experiments.results import Results
from lyra_petsc.experiments.study.jobs import STUDY
from lyra_petsc.experiments.study.plan import REQUEST_FILE, Plan, Request, make_plan, read_request
from lyra_petsc.experiments.study.study_report import StudyView
from lyra_petsc.experiments.study.study_runner import StudyRunner, choose_references
from lyra_petsc.output.run_folder import RunDirectory, choose_folder
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.load import default_scene


def study(comm: MPI.Comm, *, out: Path | None, resume: bool, force: bool, **fields: Any) -> None:
    """Run a study; collective.

    Parameters
    ----------
    comm : MPI.Comm
    out, resume, force
        The options of these names.
    **fields
        Fields of `Request` from the command line; None or empty if not given. ``trust_mesh`` is always
        given: it is not read from a folder, which may be someone else's.

    Raises
    ------
    InputError
        For bad input; nothing is written.
    SolverError
        If all combinations, or the reference, failed; the report is written.
    Interrupted
        After a signal; the folder can be resumed.
    """
    scene = fields["scene"] or default_scene()
    stem = out.name if resume and fields["scene"] is None and out is not None else scene.stem
    choice = choose_folder(comm, stem, out, force=force, resume=resume, kind=STUDY)
    base = on_root(comm, lambda: read_request(choice.path)) if resume else Request(str(scene))
    fields["scene"] = fields["scene"] and str(scene)
    request = dataclasses.replace(
        base, **{k: value for k, value in fields.items() if value not in (None, ())}
    )
    check = stop_check(comm, lambda: f"; finished combinations are kept in {folder}, --resume goes on")
    launcher = case_launcher(comm, "study", request.ranks)
    plan = on_root(comm, lambda: make_plan(request))
    chosen = on_root(comm, lambda: choose_references(plan))
    with RunDirectory(comm, choice) as directory:
        folder = directory.path
        directory.clean()
        on_root(comm, lambda: save_record(folder / REQUEST_FILE, plan.request))
        lock = directory.descriptor if launcher is not None else -1
        with StudyProgress(comm, check, len(plan.combinations), plain=petsc_prints()) as progress:
            for note in [*plan.notes, *([directory.note] if directory.note else [])]:
                progress.note(note)
            view = StudyView(StudyRunner(comm, plan, chosen, folder, progress, launcher, lock))
            again = command(comm, "study", _arguments(plan))
            results = Results(comm, folder, view, ranks=view.ranks, command=again, force=True)
            results.run(view.cases(), view.runner.run)
    _close(comm, view, folder)


def _arguments(plan: Plan) -> list[str]:
    """The arguments that repeat the study from the beginning."""
    request, varied = plan.request, []
    for axis in plan.axes:
        values = ",".join(f"{value!r}" if isinstance(value, float) else value for value in axis.values)
        varied.append(f"{axis.key}={values}")
    options = {"--set": request.settings, "--vary": varied}
    for name in ("reference", "quantities", "repeats", "ranks"):
        options[f"--{name}"] = getattr(request, name)
    return [request.scene, *to_arguments(options | {"--trust-mesh": request.trust_mesh})]


def _close(comm: MPI.Comm, view: StudyView, folder: Path) -> None:
    """Print the outcome; raises if the study failed as a whole."""
    rows = view.runner.rows
    done = sum(row.passed for row in rows)
    if comm.rank == 0:
        for advice in view.advice.values():
            for one in advice:
                print(one.text)
        print(f"{done} of {len(rows)} combinations done, {len(rows) - done} failed")
        print(f"report       {folder / 'report.html'}", flush=True)
        warn_unused([])
    if not done:
        message = f"all {len(rows)} combinations failed; the first: {rows[0].result.problem}"
        raise SolverError(message, collective=True)
    for lost in (known for known in view.runner.references.values() if known.kind == "none"):
        message = f"{lost.description} ({'; '.join(lost.notes)}); run times are in {folder / 'study.csv'}"
        raise SolverError(message, collective=True)
