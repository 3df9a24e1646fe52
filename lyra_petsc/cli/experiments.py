"""The verbs ``verify``, ``stress`` and ``fabric``, and functions shared with ``study`` and ``fit``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from mpi4py import MPI
from rich.console import Console
from rich.text import Text

from lyra_petsc.api.mpirun import find_launcher
from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.progress import duration
from lyra_petsc.cli.run import warn_unused
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.errors import InputError, Interrupted
from lyra_petsc.experiments.case import OUTCOME_FILE, Case, Launcher, Outcome, count_passed, save_record
from lyra_petsc.experiments.results import CaseObserver, Results, View, align_columns
from lyra_petsc.output.run_folder import free_name
from lyra_petsc.parallel import on_root

FAILED = 1
"""Exit code if a verdict failed."""

FOLDER = Path("stress")
"""Folder of the results of ``stress`` without ``--out``."""

MIN_WIDTH = 150
"""Smallest number of columns of the output, so that numbers are never cut."""


def stop_check(comm: MPI.Comm, kept: Callable[[], str] = str) -> Callable[[], None]:
    """A function to call before every step; it raises `Interrupted` on all ranks after a signal.

    ``kept`` returns the end of the message: which results are kept, and how to resume.
    """
    stop = StopRequest(comm)

    def watch() -> None:
        if number := stop.signal_number():
            raise Interrupted(kept(), number)

    return watch


def petsc_arguments() -> list[str]:
    """PETSc options of the command line."""
    return split(sys.argv[1:])[1]


def command(comm: MPI.Comm, verb: str, arguments: Sequence[str]) -> list[str]:
    """The command line that repeats a verb."""
    launcher = ["mpirun", "-n", str(comm.size)] if comm.size > 1 else []
    return [*launcher, "python", "-m", "lyra_petsc", verb, *arguments, *petsc_arguments()]


def to_arguments(options: Mapping[str, Any]) -> list[str]:
    """Options as arguments: repeated for each of several values, omitted without a value."""
    arguments = []
    for name, values in options.items():
        for value in values if isinstance(values, tuple | list) else [values]:
            if value not in (None, "", False):
                arguments += [name] if value is True else [name, str(value)]
    return arguments


def case_launcher(comm: MPI.Comm, verb: str, ranks: int | None) -> Launcher | None:
    """Launcher that starts an mpirun for each case; None without ``--ranks``; collective.

    Raises
    ------
    InputError
        If no launcher can be used.
    """
    if ranks is None:
        return None
    return Launcher(on_root(comm, lambda: find_launcher(ranks)), verb, petsc_arguments())


class Terminal(CaseObserver[Any, Any]):
    """Shows the progress of cases on the terminal; on rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
    view : View
    count, known : int
        Numbers of cases to run, and of all existing cases.
    """

    def __init__(self, comm: MPI.Comm, view: View[Any], count: int, known: int) -> None:
        self._shown, self._view, self._count, self._done = comm.rank == 0, view, count, 0
        self._console = Console(width=max(MIN_WIDTH, Console().width), highlight=False, soft_wrap=True)
        self.print(f"{count}{f' of {known}' if known != count else ''} cases")
        if heading := view.heading():
            self.print(heading, "bold")

    def print(self, text: str = "", style: str = "") -> None:
        """Print a line."""
        if self._shown:
            self._console.print(Text(text, style=style))

    def begin(self, case: Case) -> None:
        """Show the name of a case that begins, on a terminal."""
        self._done += 1
        if self._shown and sys.stderr.isatty():
            print(f"{self._done} of {self._count}: {case.name} …", file=sys.stderr, end="\r", flush=True)

    def end(self, outcome: Outcome[Any]) -> None:
        """Print the result of a case that has ended."""
        if self._shown and sys.stderr.isatty():
            print("\x1b[2K", file=sys.stderr, end="\r", flush=True)
        for line in self._view.terminal_lines(outcome):
            self.print(*line)

    def close(self, results: Results[Any], note: str) -> None:
        """Print the summary table, the verdict, the folder of the results, a note and unused options."""
        outcomes, table = results.outcomes, self._view.summary_table(results.outcomes)
        if self._view.heading():  # an empty line between the table of the cases and the summary
            self.print()
        for line in align_columns(table, len(table[0]) - 1):
            self.print(line)
        total = duration(sum(outcome.seconds for outcome in outcomes))
        self.print(f"{count_passed(outcomes)}, {total} in all")
        if results.folder is not None:
            self.print(f"results: {results.folder}")
        if note:
            self.print(f"note: {note}")
        if self._shown:
            warn_unused([])


def verify(
    comm: MPI.Comm, names: Sequence[str], *, quick: bool, listed: bool, out: Path | None, force: bool
) -> int:
    """Run cases of ``verify`` (all of them without names) or list them; returns the exit code; collective.

    Raises
    ------
    InputError
        For an unknown case, or a folder that cannot be used; nothing has run then.
    Interrupted
        After a signal; results of finished cases are in the folder.
    """
    from lyra_petsc.experiments.verification import verification_case
    from lyra_petsc.experiments.verification.cases import CASES
    from lyra_petsc.experiments.verification.verification_case import VerificationView

    if listed:
        return _list(comm, CASES.all(), f"{len(CASES.entries)} cases")
    cases = [CASES.load(name) for name in dict.fromkeys(names or CASES.entries)]
    again = command(comm, "verify", [*names, *to_arguments({"--quick": quick})])
    results = Results(comm, out, VerificationView(), ranks=comm.size, command=again, force=force)
    run = partial(verification_case.run_case, comm, quick=quick, watch=stop_check(comm))
    return _run(comm, results, cases, run, len(CASES.entries))


def stress(
    comm: MPI.Comm,
    scene: Path | None,
    settings: Sequence[str],
    *,
    only: Sequence[str],
    quick: bool,
    full: bool,
    listed: bool,
    out: Path | None,
    force: bool,
    ranks: int | None,
    job: Path | None,
    trust_mesh: bool,
) -> int:
    """Run the cases of ``stress`` or list them; returns the exit code; collective.

    Raises
    ------
    InputError
        For a bad scene, an unknown case, or a folder that cannot be used; nothing has run then.
    Interrupted
        After a signal; results of finished cases are in the folder.
    """
    from lyra_petsc.experiments.stress import stress_runner
    from lyra_petsc.experiments.stress.cases import FAMILIES, selected
    from lyra_petsc.experiments.stress.stress_runner import StressView
    from lyra_petsc.experiments.stress.stress_scenes import Scope, StressCase, setting_of

    if quick and full:
        raise InputError("give one of --quick and --full", key="--quick")
    level = Scope.QUICK if quick else Scope.FULL if full else Scope.USUAL
    names = [name.strip() for text in only for name in text.split(",") if name.strip()]
    cases, known = selected(names, level), len(selected((), Scope.FULL))
    if listed:
        count = f"{len(cases)} of {known} cases; --full has all"
        return _list(comm, cases, count, lambda c: f"{c.family}: {FAMILIES.load(c.family).title}")
    setting = on_root(comm, lambda: setting_of(scene, settings, level, trust_mesh=trust_mesh))
    launcher = case_launcher(comm, "stress", ranks)
    first = FOLDER / (scene.stem if scene is not None else "sheet")
    folder = out or on_root(comm, lambda: first if force else free_name(first))
    results: Results[stress_runner.StressOutcome] | None = None

    def kept() -> str:
        ended = results is not None and results.outcomes
        return f"; the cases that had ended are in {folder}" if ended else "; no case had ended"

    watch = stop_check(comm, kept)
    if launcher is None:
        # a base scene that fails is refused before anything is written
        clock = stress_runner.BaseClock(comm, setting, watch)
        setting = replace(setting, size=clock.size)
    asked = [*([] if scene is None else [str(scene)]), *to_arguments({"--set": settings})]
    asked += to_arguments({"--trust-mesh": trust_mesh, "--quick": quick, "--full": full})

    def run(case: StressCase) -> stress_runner.StressOutcome:
        if launcher is not None:
            return stress_runner.launched(launcher, case, asked, watch)
        return stress_runner.run_case(comm, case, setting, clock, watch)

    if job is not None:
        outcome = run(cases[0])
        on_root(comm, lambda: save_record(job / OUTCOME_FILE, outcome.saved()))
        return 0 if outcome.passed else FAILED
    arguments = [*asked, *to_arguments({"--only": ",".join(names), "--ranks": ranks})]
    again, view = command(comm, "stress", arguments), StressView(setting, len(cases))
    results = Results(comm, folder, view, ranks=ranks or comm.size, command=again, force=force)
    return _run(comm, results, cases, run, known)


def fabric(
    comm: MPI.Comm,
    test: str,
    material: str | None,
    cloth: str | None,
    settings: Sequence[str],
    *,
    out: Path | None,
    force: bool,
    ranks: int | None,
    only: str | None,
    job: Path | None,
) -> int:
    """Run textile tests; returns the exit code; collective.

    Raises
    ------
    InputError
        For an unknown test or cloth, a bad scene, or a folder that cannot be used; nothing has run then.
    Interrupted
        After a signal; results of finished tests are in the folder.
    """
    from lyra_petsc.experiments.fabric import fabric_report, textile_tests
    from lyra_petsc.experiments.fabric.specimens import fabric_of

    if (material is None) == (cloth is None):
        raise InputError("give a material: a cloth's name or a scene file, once", key="fabric")
    named = material or cloth or ""
    cases = textile_tests.cases_of(test)
    tested = on_root(comm, lambda: fabric_of(named, settings))
    if test != textile_tests.ALL and textile_tests.TESTS[test].bends:
        tested.needs_bending(test)
    launcher = case_launcher(comm, "fabric", ranks)
    asked = [named, *to_arguments({"--set": settings})]
    watch = stop_check(comm)

    def run(case: fabric_report.FabricCase) -> fabric_report.FabricOutcome:
        if textile_tests.TESTS[case.test].bends and not tested.bends:
            return fabric_report.FabricOutcome(case, left_out="the material does not resist bending")
        if launcher is not None:
            return textile_tests.launched(launcher, case, [*asked, "--out", str(folder), "--force"], watch)
        return textile_tests.run_case(comm, case, tested, watch, folder)

    if job is not None:
        folder = out
        outcome = run(next(case for case in cases if case.name == only))
        on_root(comm, lambda: save_record(job / OUTCOME_FILE, outcome.record))
        return FAILED if outcome.failed else 0
    first = Path("fabric") / f"{Path(named).stem}-{test}"
    folder = out or on_root(comm, lambda: first if force else free_name(first))
    again = command(comm, "fabric", [test, *asked, *to_arguments({"--ranks": ranks})])
    view = fabric_report.FabricView(named)
    results = Results(comm, folder, view, ranks=ranks or comm.size, command=again, force=force)
    return _run(comm, results, cases, run, len(cases))


def _run(
    comm: MPI.Comm, results: Results[Any], cases: Sequence[Any], run: Callable[[Any], Any], known: int
) -> int:
    """Run cases and print their outcomes; returns the exit code. ``known`` is the number of all cases."""
    terminal = Terminal(comm, results.view, len(cases), known)
    note = results.run(cases, run, terminal)
    terminal.close(results, note)
    return FAILED if any(outcome.failed for outcome in results.outcomes) else 0


def _list(
    comm: MPI.Comm, cases: Sequence[Any], count: str, heading: Callable[[Any], str] | None = None
) -> int:
    """Print names and titles of cases below headings, on rank 0; returns the exit code."""
    if comm.rank > 0:
        return 0
    width, last = max(len(case.name) for case in cases), ""
    for case in cases:
        if heading is not None and heading(case) != last:
            click.echo(last := heading(case))
        click.echo(f"{'  ' * (heading is not None)}{case.name:<{width}}  {case.title}")
    click.echo(count, err=True)
    return 0
