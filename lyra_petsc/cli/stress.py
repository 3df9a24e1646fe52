"""``stress``: stiff and extreme cases, a table, and a verdict on each from physics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import click
from mpi4py import MPI

from lyra_petsc.api.mpirun import find_launcher
from lyra_petsc.cli.experiments import FAILED, Terminal, command, petsc_words, plain_table, watched
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.launch import Launcher
from lyra_petsc.experiments.results import Results
from lyra_petsc.experiments.stress.base import setting_of
from lyra_petsc.experiments.stress.case import Case, Level, Setting
from lyra_petsc.experiments.stress.launch import launched, save
from lyra_petsc.experiments.stress.registry import FAMILIES, selected
from lyra_petsc.experiments.stress.runner import BaseClock, Outcome, run_case
from lyra_petsc.experiments.stress.view import HEADINGS, Stress, cells, release_shapes
from lyra_petsc.output.run_folder import free_name
from lyra_petsc.parallel import on_root

FOLDER = Path("stress")
"""Where results go unless ``--out`` says otherwise."""

WIDTH = 150


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
    trust_mesh: bool = False

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

    @property
    def what(self) -> list[str]:
        """Scene and options that say what each case is."""
        words = [str(self.scene)] if self.scene is not None else []
        for text in self.settings:
            words += ["--set", text]
        words += ["--trust-mesh"] if self.trust_mesh else []
        return words + ([f"--{self.level.name.lower()}"] if self.level != Level.USUAL else [])

    @property
    def words(self) -> list[str]:
        """All that repeats it."""
        words = self.what + (["--only", ",".join(self.names)] if self.names else [])
        return words + (["--ranks", str(self.ranks)] if self.ranks is not None else [])


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
    setting = on_root(comm, lambda: _setting(asked))
    assert setting is not None
    launcher = None
    if asked.ranks is not None:
        found = on_root(comm, lambda: find_launcher(asked.ranks or 0))
        launcher = Launcher(found or [], "stress", petsc_words())
    first = FOLDER / (asked.scene.stem if asked.scene is not None else "sheet")
    folder = asked.out or on_root(comm, lambda: first if asked.force else free_name(first))
    assert folder is not None
    outcomes: list[Outcome] = []

    def kept() -> str:
        return f"; the cases that had ended are in {folder}" if outcomes else "; no case had ended"

    watch = watched(comm, kept)
    if launcher is None:
        # a base scene that does not run is refused before anything is written
        clock = BaseClock(comm, setting, watch)
        setting = replace(setting, size=clock.size)

    def run(case: Case) -> Outcome:
        if launcher is not None:
            return launched(launcher, case, asked.what, watch)
        return run_case(comm, case, setting, clock, watch)

    if asked.job is not None:
        outcome, job = run(cases[0]), asked.job
        on_root(comm, lambda: save(outcome, job))
        return 0 if outcome.passed else FAILED
    view = Stress(setting, len(cases))
    again = command(comm, "stress", asked.words)
    results = Results(comm, folder, view, ranks=asked.ranks or comm.size, command=again, force=asked.force)
    outcomes = results.outcomes
    show = Show(comm, len(cases), outcomes)
    note = results.run(cases, run, show)
    show.families(folder, note)
    return 0 if all(outcome.passed for outcome in outcomes) else FAILED


def _setting(asked: Asked) -> Setting:
    return setting_of(asked.scene, asked.settings, asked.level, trust_mesh=asked.trust_mesh)


def list_cases(comm: MPI.Comm, asked: Asked) -> None:
    """Print name and title of every case of the level on rank 0."""
    found = selected(asked.names, asked.level)
    if comm.rank == 0:
        width = max(len(case.name) for case in found)
        told = ""
        for case in found:
            if case.family != told:
                told = case.family
                click.echo(f"{told}: {FAMILIES.load(told).title}")
            click.echo(f"  {case.name:<{width}}  {case.title}")
        whole = len(selected((), Level.FULL))
        click.echo(f"{len(found)} of {whole} cases; --full has all", err=True)


class Show(Terminal):
    """The table, line by line; ``outcomes`` are those so far."""

    def __init__(self, comm: MPI.Comm, count: int, outcomes: list[Outcome]) -> None:
        super().__init__(comm, count, WIDTH)
        self._outcomes = outcomes
        self.announce(len(selected((), Level.FULL)))
        self._line(list(HEADINGS), "bold")

    def end(self, outcome: Outcome) -> None:  # type: ignore[override]
        super().end(outcome)
        if outcome.left_out:
            self.print(f"{outcome.case.name}: left out: {outcome.left_out}", "dim")
            return
        self._line(cells(outcome), "" if outcome.passed else "bold red")
        for name, verdict in outcome.failures.items():
            self.print(f"    {name}: {verdict.words}", "red")
        release_shapes(self._outcomes)

    def families(self, folder: Path, note: str) -> None:
        """The end: what passed of each family."""
        run = [outcome for outcome in self._outcomes if not outcome.left_out]
        table = plain_table(["family"], ["passed", "run time [s]"])
        for family in dict.fromkeys(outcome.case.family for outcome in run):
            mine = [outcome for outcome in run if outcome.case.family == family]
            passed = sum(outcome.passed for outcome in mine)
            table.add_row(family, f"{passed} of {len(mine)}", f"{sum(o.seconds for o in mine):.1f}")
        self.print()
        self.summary(run, table, folder, note)

    def _line(self, texts: list[str], style: str) -> None:
        widths = [max(len(name), least) for name, least in HEADINGS.items()]
        first, *others = zip(texts, widths, strict=True)
        self.print("  ".join([first[0].ljust(first[1]), *(t.rjust(w) for t, w in others)]).rstrip(), style)
