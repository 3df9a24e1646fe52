"""The verb ``fit``: estimates numbers of a scene from measurements."""

from __future__ import annotations

import subprocess
from pathlib import Path

import click
from mpi4py import MPI

from lyra_petsc.api.mpirun import environment, find_launcher
from lyra_petsc.cli.experiments import command, petsc_arguments, stop_check, to_arguments
from lyra_petsc.cli.progress import ProgressBar, duration
from lyra_petsc.cli.run import petsc_prints, warn_unused
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.case import Case
from lyra_petsc.experiments.fit.estimate import Misfit
from lyra_petsc.experiments.fit.fit_report import FitOutcome, FitView, outcome_of
from lyra_petsc.experiments.fit.fit_runner import FIT, FitObserver, fit_scene, unknowns_of
from lyra_petsc.experiments.results import Results
from lyra_petsc.output.run_folder import RunDirectory, choose_folder
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.startup import module_command


class FitProgress(ProgressBar, FitObserver):
    """Shows the progress of a fit: the current evaluation, and the sum of squares of the last one."""

    def __init__(self, comm: MPI.Comm, *, plain: bool) -> None:
        super().__init__(comm, plain=plain)
        self._cost = ""

    def progress(self, number: int, part: float) -> None:
        self.show(min(part, 0.999), f"evaluation {number}{self._cost}")

    def evaluated(self, number: int, evaluation: Misfit, *, resumed: bool) -> None:
        self._cost = f"  sum of squares {2.0 * evaluation.cost:.5g}"
        source = " (from before)" if resumed else ""
        self.say(f"evaluation {number}{self._cost}{source}")


def fit(
    comm: MPI.Comm,
    scene: Path | None,
    settings: tuple[str, ...],
    *,
    trust_mesh: bool,
    out: Path | None,
    force: bool,
    resume: bool,
    ranks: int | None,
) -> int:
    """Fit a scene; returns the exit code; collective.

    Raises
    ------
    InputError
        For bad input; nothing is written.
    SolverError
        If a simulation fails; earlier evaluations are kept.
    Interrupted
        After a signal; ``--resume`` continues.
    """
    if scene is None:
        raise InputError("needs a scene with a block fit, as in: fit strip.yaml", key="SCENE")
    arguments = [str(scene), *to_arguments({"--set": settings, "--trust-mesh": trust_mesh})]
    if ranks is not None:
        arguments += to_arguments({"--out": out, "--force": force, "--resume": resume})
        return _launched(comm, ranks, arguments)

    def read() -> Scene:
        loaded = load_scene(scene, settings)
        unknowns_of(loaded)
        return loaded.trusting_meshes() if trust_mesh else loaded

    loaded = on_root(comm, read)
    choice = choose_folder(comm, scene.stem, out, force=force, resume=resume, kind=FIT)

    def kept() -> str:
        if not FIT.resumable(choice.path):
            return " in the first evaluation, nothing is kept"
        return f"; evaluations are kept in {choice.path}, fit --resume goes on"

    watch = stop_check(comm, kept)
    view = FitView(f"Fit of {loaded.title or scene.stem}")
    with RunDirectory(comm, choice) as directory:
        folder = directory.path
        directory.clean()

        def work(case: Case) -> FitOutcome:
            with FitProgress(comm, plain=petsc_prints()) as progress:
                if directory.note:
                    progress.say(f"note: {directory.note}")
                return outcome_of(fit_scene(comm, loaded, folder=folder, watch=watch, observer=progress))

        results: Results[FitOutcome] = Results(
            comm, folder, view, ranks=comm.size, command=command(comm, "fit", arguments), force=True
        )
        note = results.run([Case("fit", "numbers from measurements")], work)
    if comm.rank == 0:
        outcome = results.outcomes[0]
        for line in view.terminal(outcome):
            click.echo(line)
        evaluations = f"{len(outcome.fitted.evaluations)} evaluations in {duration(outcome.fitted.seconds)}"
        click.echo(f"{evaluations}; results: {folder}")
        if note:
            click.echo(f"note: {note}")
        warn_unused([])
    return 0


def _launched(comm: MPI.Comm, ranks: int, arguments: list[str]) -> int:
    """Run the same command on ``ranks`` ranks, with this process's streams; returns the exit code."""
    program = [*on_root(comm, lambda: find_launcher(ranks)), *module_command("lyra_petsc"), "fit"]
    return subprocess.call([*program, *arguments, *petsc_arguments()], env=environment())
