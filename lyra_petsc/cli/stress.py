"""``stress``: stiff and extreme cases, a table, and a verdict on each from physics."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
from mpi4py import MPI
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.progress import duration
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.cli.verify import FAILED, WIDTH
from lyra_petsc.errors import InputError, Interrupted
from lyra_petsc.output.folder import free_name
from lyra_petsc.parallel import on_root
from lyra_petsc.solvers.options import unused
from lyra_petsc.stress.base import setting_of
from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.exchange import save
from lyra_petsc.stress.launch import Launcher
from lyra_petsc.stress.registry import selected
from lyra_petsc.stress.report import release_shapes
from lyra_petsc.stress.results import finish, write
from lyra_petsc.stress.runner import BaseClock, Outcome, run_case
from lyra_petsc.stress.table import cells, headings
from lyra_petsc.study.launch import find_launcher
from lyra_petsc.verification.results import prepare

FOLDER = Path("stress")
"""Where results go unless ``--out`` says otherwise."""


@dataclass(frozen=True)
class Asked:
    """The command line of ``stress``."""

    scene: Path | None = None
    settings: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    quick: bool = False
    full: bool = False
    out: Path | None = None
    force: bool = False
    ranks: int | None = None
    job: Path | None = None

    @property
    def level(self) -> Level:
        """How much is to be run.

        Raises
        ------
        InputError
            For both ends at once.
        """
        if self.quick and self.full:
            raise InputError("give one of --quick and --full", key="--quick")
        return Level.QUICK if self.quick else Level.FULL if self.full else Level.USUAL

    @property
    def names(self) -> tuple[str, ...]:
        """Cases and families asked for."""
        return tuple(name.strip() for text in self.only for name in text.split(",") if name.strip())


def stress(comm: MPI.Comm, asked: Asked) -> int:
    """Run the cases and print what came of each; the exit code; collective.

    Raises
    ------
    InputError
        A bad scene, an unknown case, or a folder that cannot be used; nothing has run then.
    Interrupted
        A signal; what had been done is in the folder.
    """
    cases = selected(asked.names, asked.level)
    setting = on_root(comm, lambda: setting_of(asked.scene, asked.settings, asked.level))
    assert setting is not None
    launcher = _launcher(comm, asked)
    first = FOLDER / (asked.scene.stem if asked.scene is not None else "sheet")
    folder = asked.out or on_root(comm, lambda: first if asked.force else free_name(first))
    assert folder is not None
    stop = StopRequest(comm)
    outcomes: list[Outcome] = []

    def watch() -> None:
        number = stop.signal_number()
        if number:
            name = signal.Signals(number).name
            kept = f"the cases that had ended are in {folder}" if outcomes else "no case had ended"
            raise Interrupted(f"stopped by {name}; {kept}", number)

    if launcher is None:
        # a base scene that does not run is refused before anything is written
        clock = BaseClock(comm, setting, watch)
        setting = replace(setting, size=clock.size)
    if asked.job is not None:
        (family, case), folder = cases[0], asked.job
        outcome = run_case(comm, case, family.name, setting, clock, watch)
        on_root(comm, lambda: save(outcome, folder))
        return 0 if outcome.passed else FAILED
    prepare(comm, folder, force=asked.force)
    show = Show(comm, len(cases))
    command, ranks = _command(comm, asked), asked.ranks or comm.size
    try:
        for family, case in cases:
            show.begin(case)
            if launcher is not None:
                outcomes.append(launcher(case, family.name, watch))
            else:
                outcomes.append(run_case(comm, case, family.name, setting, clock, watch))
            show.case(outcomes[-1])
            release_shapes(outcomes)
            write(comm, folder, outcomes, ranks, complete=len(outcomes) == len(cases))
    except Interrupted:
        finish(comm, folder, outcomes, setting, ranks, command)
        raise
    note = finish(comm, folder, outcomes, setting, ranks, command)
    show.summary(outcomes, folder, note)
    return 0 if all(outcome.passed for outcome in outcomes) else FAILED


def _command(comm: MPI.Comm, asked: Asked) -> list[str]:
    """The command line that repeats it."""
    words = ["mpirun", "-n", str(comm.size)] if comm.size > 1 else []
    words += ["python", "-m", "lyra_petsc", "stress", *_what(asked)]
    words += ["--only", ",".join(asked.names)] if asked.names else []
    words += ["--ranks", str(asked.ranks)] if asked.ranks is not None else []
    return [*words, *split(sys.argv[1:])[1]]


def _what(asked: Asked) -> list[str]:
    """Scene and options that say what each case is."""
    words = [str(asked.scene)] if asked.scene is not None else []
    for text in asked.settings:
        words += ["--set", text]
    return words + ([f"--{asked.level.name.lower()}"] if asked.level != Level.USUAL else [])


def _launcher(comm: MPI.Comm, asked: Asked) -> Launcher | None:
    """What starts the cases with ``--ranks``.

    Raises
    ------
    InputError
        Under an mpirun, or without one to start.
    """
    if asked.ranks is None:
        return None
    command = on_root(comm, lambda: find_launcher(asked.ranks or 0))
    return Launcher(command or [], _what(asked), split(sys.argv[1:])[1])


def list_cases(comm: MPI.Comm, asked: Asked) -> None:
    """Print name and title of every case of the level on rank 0."""
    found = selected(asked.names, asked.level)
    if comm.rank == 0:
        width = max(len(case.name) for _, case in found)
        told: Family | None = None
        for family, case in found:
            if family is not told:
                click.echo(f"{family.name}: {family.title}")
                told = family
            click.echo(f"  {case.name:<{width}}  {case.title}")


class Show:
    """The table on the terminal, line by line; on rank 0.

    Parameters
    ----------
    comm : MPI.Comm
    count : int
        Cases to come.
    """

    def __init__(self, comm: MPI.Comm, count: int) -> None:
        self._speaks, self._count, self._done = comm.rank == 0, count, 0
        wide = max(WIDTH + 40, Console().width)
        self._console = Console(width=wide, highlight=False, soft_wrap=True)
        self._widths = [max(len(name), least) for name, least in headings()]
        if self._speaks:
            self._console.print(Text(self._line([name for name, _ in headings()]), style="bold"))

    def begin(self, case: Case) -> None:
        """A case starts."""
        self._done += 1
        if self._speaks and sys.stderr.isatty():
            print(f"{self._done} of {self._count}: {case.name} …", file=sys.stderr, end="\r", flush=True)

    def case(self, outcome: Outcome) -> None:
        """A case has ended."""
        if not self._speaks:
            return
        if sys.stderr.isatty():
            print("\x1b[2K", file=sys.stderr, end="\r", flush=True)
        if outcome.left_out:
            self._console.print(Text(f"{outcome.case.name}: left out: {outcome.left_out}", style="dim"))
            return
        self._console.print(Text(self._line(cells(outcome)), style="" if outcome.passed else "bold red"))
        for name, verdict in outcome.failures.items():
            self._console.print(Text(f"    {name}: {verdict.words}", style="red"))

    def summary(self, outcomes: Sequence[Outcome], folder: Path, note: str) -> None:
        """The end."""
        if not self._speaks:
            return
        run = [outcome for outcome in outcomes if not outcome.left_out]
        table = Table("family", box=None, header_style="", pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column(Text("passed"), justify="right")
        table.add_column(Text("run time [s]"), justify="right")
        for family in dict.fromkeys(outcome.family for outcome in run):
            mine = [outcome for outcome in run if outcome.family == family]
            passed = sum(outcome.passed for outcome in mine)
            table.add_row(family, f"{passed} of {len(mine)}", f"{sum(o.seconds for o in mine):.1f}")
        self._console.print()
        self._console.print(table)
        passed = sum(outcome.passed for outcome in run)
        total = sum(outcome.seconds for outcome in run)
        self._console.print(f"{passed} of {len(run)} cases passed, {duration(total)} in all")
        self._console.print(Text(f"results: {folder}"))
        if note:
            self._console.print(Text(f"note: {note}"))
        left = unused([])
        if left:
            listed = ", ".join(f"-{name}" for name in left)
            print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)

    def _line(self, texts: Sequence[str]) -> str:
        pairs = list(zip(texts, self._widths, strict=True))
        return "  ".join(t.ljust(w) if i == 0 else t.rjust(w) for i, (t, w) in enumerate(pairs)).rstrip()
