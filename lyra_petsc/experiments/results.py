"""Runs the cases of a verb one after another and writes its folder: VERB.csv, VERB.json, report.*."""

from __future__ import annotations

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from mpi4py import MPI

from lyra_petsc.errors import InputError, Interrupted
from lyra_petsc.experiments.case import Case, Outcome, Verdict, passed_of
from lyra_petsc.output.agreement import replace_text
from lyra_petsc.output.summary import versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.show.report.document import Report, close, lacking

O = TypeVar("O", bound=Outcome[Any])  # noqa: E741
C = TypeVar("C", bound=Case)


Line = tuple[str, str]
"""A line of the terminal and its style, as of rich; empty: none."""


def aligned(rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    """The lines of a table: so many columns of words, set to the left, then columns of numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(f"{text:{'<>'[i >= words]}{width}}" for i, (text, width) in enumerate(cells)))
    return [line.rstrip() for line in lines]


def write_csv(path: Path, lines: Iterable[Iterable[Any]]) -> None:
    """Write a table; the file is the old or the new one, never half. Call on one rank."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    replace_text(path, text.getvalue())


def verdict_line(verdict: Verdict, name: str = "") -> Line:
    """A verdict below its case; those that are not good stand out."""
    return f"  {name}{verdict.line}", "" if verdict.passed else "bold red"


class View(ABC, Generic[O]):
    """How a verb tells of its cases: in a table, in a file for programs, and on a page.

    Attributes
    ----------
    verb : str
    title : str
        Of the page.
    pictures : str
        What the page lacks without the packages that draw.
    columns : sequence of str
        Of the CSV.
    entry : str
        What a case is called in the table at the end.
    ready : bool
        Whether there is something to write.
    """

    verb: ClassVar[str]
    title: str
    pictures: str = ""
    columns: Sequence[str]
    entry: ClassVar[str] = "case"
    ready: bool = True

    def heading(self) -> str:
        """What the terminal shows before the first case; empty: nothing."""
        return ""

    def lines(self, outcome: O) -> Iterable[Line]:
        """What the terminal shows when a case has ended."""
        return ()

    def summary(self, outcomes: Sequence[O]) -> list[Sequence[str]]:
        """The table that the terminal shows at the end, its headings first."""
        table = [(o.case.name, "passed" if o.passed else "FAILED", f"{o.seconds:.1f}") for o in outcomes]
        return [(self.entry, "verdict", "run time [s]"), *table]

    def ended(self, outcomes: Sequence[O]) -> None:
        """Another case has ended: what no later use has of the outcomes so far may be freed."""

    @abstractmethod
    def rows(self, outcome: O) -> Iterable[Mapping[str, Any]]:
        """Its lines of the CSV, by the columns."""

    def cell(self, value: Any) -> Any:
        """A value of the CSV as a text or a number: empty for what is not a number."""
        return "" if value != value else value

    def told(self, outcome: O) -> dict[str, Any]:
        """What the JSON file holds of a case beside its name, title and verdicts."""
        return {}

    def facts(self, outcomes: Sequence[O]) -> dict[str, Any]:
        """What the JSON file holds beside the cases, the verdict on all, ranks and versions."""
        return {}

    def content(self, outcomes: Sequence[O], ranks: int, command: Sequence[str]) -> dict[str, Any]:
        """The JSON file."""
        run = _run(outcomes)
        return self.facts(outcomes) | {
            "passed": all(outcome.passed for outcome in run),
            "ranks": ranks,
            "versions": versions(),
            "cases": [
                {"name": outcome.case.name, "title": outcome.case.title, **self.told(outcome)}
                | {"verdicts": {name: asdict(verdict) for name, verdict in outcome.verdicts.items()}}
                for outcome in run
            ],
        }

    @abstractmethod
    def page(self, report: Report, outcomes: Sequence[O], summary: str, *, drawn: bool) -> None:
        """Fill the page; ``summary`` says how many cases passed, ``drawn`` whether there can be pictures."""

    def close(self, report: Report, folder: Path, command: Sequence[str]) -> str:
        """Add what made the page, and write it; what is missing for its pictures, in words. On one rank."""
        return close(report, folder, versions(), command, pictures=self.pictures)


def _run(outcomes: Sequence[O]) -> list[O]:
    return [outcome for outcome in outcomes if not outcome.left_out]


class CaseObserver(Generic[C, O]):
    """Receives the cases as they run."""

    def begin(self, case: C) -> None:
        """A case begins."""

    def end(self, outcome: O) -> None:
        """A case has ended."""


class Results(Generic[O]):
    """The folder of a verb and what came of the cases so far; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    folder : Path or None
        None: nothing is written.
    view : View
    ranks : int
        On which each case is run.
    command : sequence of str
        That repeats it.
    force : bool
        The folder may exist.

    Attributes
    ----------
    outcomes : list of Outcome
    folder, view

    Raises
    ------
    InputError
        If the folder exists and ``force`` is not given, or it cannot be created.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        folder: Path | None,
        view: View[O],
        *,
        ranks: int,
        command: Sequence[str],
        force: bool = False,
    ) -> None:
        self._comm, self.folder, self.view = comm, folder, view
        self._ranks, self._command = ranks, command
        self.outcomes: list[O] = []
        if folder is not None:
            on_root(comm, lambda: _create(folder, force=force))

    def run(self, cases: Iterable[C], run: Callable[[C], O], show: CaseObserver[C, O] | None = None) -> str:
        """Run the cases; what the page lacks and how to get it, empty if nothing.

        Raises
        ------
        Interrupted
            From ``run``; what had been done is in the folder.
        OutputError
            On every rank, if something could not be written.
        """
        show = show or CaseObserver()
        try:
            for case in cases:
                show.begin(case)
                self.outcomes.append(run(case))
                show.end(self.outcomes[-1])
                self.view.ended(self.outcomes)
                self.write()
            self.write()
        except Interrupted:
            self.finish()
            raise
        return self.finish()

    def write(self) -> None:
        """Write the tables of what came of the cases so far."""
        view = self.view
        if self.folder is None or not view.ready:
            return
        path, outcomes = self.folder / f"{view.verb}.csv", self.outcomes

        def table() -> None:
            rows = [row for outcome in _run(outcomes) for row in view.rows(outcome)]
            cells = ([view.cell(row.get(name)) for name in view.columns] for row in rows)
            write_csv(path, [view.columns, *cells])

        on_root(self._comm, table)
        content = view.content(outcomes, self._ranks, self._command)
        write_summary(path.with_suffix(".json"), content, self._comm)

    def finish(self) -> str:
        """Write the page; what is missing for its pictures, in words."""
        return on_root(self._comm, self._page)

    def _page(self) -> str:
        if self.folder is None or not self.view.ready:
            return ""
        report = Report(self.view.title)
        on = f"{self._ranks} rank{'s' if self._ranks > 1 else ''}"
        summary = f"{passed_of(self.outcomes)} on {on}."
        self.view.page(report, self.outcomes, summary, drawn=not lacking())
        return self.view.close(report, self.folder, self._command)


def _create(folder: Path, *, force: bool) -> None:
    if folder.exists() and not (force and folder.is_dir()):
        raise InputError("exists; choose another folder, or give --force", key=f"--out {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", key=f"--out {folder}") from None
