"""Runs the cases of a verb one after another and writes VERB.csv, VERB.json and report.* in its folder."""

from __future__ import annotations

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from mpi4py import MPI

from lyra_petsc.errors import InputError, Interrupted
from lyra_petsc.experiments.case import Case, Outcome, Verdict, count_passed
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.summary import library_versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.show.report.document import Report, missing_report_packages, write_report

O = TypeVar("O", bound=Outcome[Any])  # noqa: E741
C = TypeVar("C", bound=Case)


Line = tuple[str, str]
"""A line of the terminal and its style for rich; empty: no style."""


def align_columns(rows: Sequence[Sequence[str]], text_columns: int = 1) -> list[str]:
    """The lines of a table; the first ``text_columns`` are aligned left, the others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        padded = (f"{text:{'<>'[i >= text_columns]}{width}}" for i, (text, width) in enumerate(cells))
        lines.append("  ".join(padded).rstrip())
    return lines


def write_csv(path: Path, lines: Iterable[Iterable[Any]]) -> None:
    """Write a table, replacing the file in one operation. Call on one rank."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    replace_text(path, text.getvalue())


def verdict_line(verdict: Verdict, name: str = "") -> Line:
    """The line of a verdict below its case; failures are emphasised."""
    return f"  {name}{verdict.line}", "" if verdict.passed else "bold red"


class View(ABC, Generic[O]):
    """How a verb reports its cases: on the terminal, as CSV and JSON, and on a page.

    Attributes
    ----------
    verb : str
    title : str
        Title of the page.
    columns : sequence of str
        Columns of the CSV file.
    entry : str
        Heading of the case names in the table at the end.
    ready : bool
        Whether there are results to write.
    """

    verb: ClassVar[str]
    title: str
    columns: Sequence[str]
    entry: ClassVar[str] = "case"
    ready: bool = True

    def heading(self) -> str:
        """Line of the terminal before the first case; empty for none."""
        return ""

    def terminal_lines(self, outcome: O) -> Iterable[Line]:
        """Lines of the terminal when a case has ended."""
        return ()

    def summary_table(self, outcomes: Sequence[O]) -> list[Sequence[str]]:
        """Table of the terminal at the end, headings first."""
        table = [(o.case.name, "left out" if o.left_out else o.status, f"{o.seconds:.1f}") for o in outcomes]
        return [(self.entry, "verdict", "run time [s]"), *table]

    def case_ended(self, outcomes: Sequence[O]) -> None:
        """Called when another case has ended; may free data of the outcomes that are no longer needed."""

    @abstractmethod
    def csv_rows(self, outcome: O) -> Iterable[Mapping[str, Any]]:
        """Rows of the CSV file for a case, by column."""

    def csv_cell(self, value: Any) -> Any:
        """A value as written to the CSV file; NaN becomes empty."""
        return "" if value != value else value

    def case_content(self, outcome: O) -> dict[str, Any]:
        """Entries of a case in the JSON file beside its name, title and verdicts."""
        return {}

    def summary_content(self, outcomes: Sequence[O]) -> dict[str, Any]:
        """Entries of the JSON file beside the cases, the overall verdict, ranks and versions."""
        return {}

    def content(self, outcomes: Sequence[O], ranks: int, command: Sequence[str]) -> dict[str, Any]:
        """The content of the JSON file."""
        run = _without_left_out(outcomes)
        return self.summary_content(outcomes) | {
            "passed": _all_passed(run),
            "ranks": ranks,
            "versions": library_versions(),
            "cases": [
                {"name": outcome.case.name, "title": outcome.case.title, **self.case_content(outcome)}
                | {
                    "verdicts": {
                        k: {"passed": v.passed, "words": v.message} for k, v in outcome.verdicts.items()
                    }
                }
                for outcome in run
            ],
        }

    @abstractmethod
    def fill(self, report: Report, outcomes: Sequence[O], summary: str, *, plots: bool) -> None:
        """Fill the page; ``summary`` says how many cases passed, ``plots`` whether plots can be drawn."""

    def close_page(self, report: Report, folder: Path, command: Sequence[str]) -> str:
        """Add command and versions and write the page, on one rank; returns a note on missing packages."""
        return write_report(report, folder, library_versions(), command, pictures="pictures")


def _all_passed(outcomes: Sequence[O]) -> bool | None:
    """Whether no case failed; None if none was compared with anything."""
    if any(outcome.failed for outcome in outcomes):
        return False
    return True if not outcomes or any(outcome.passed for outcome in outcomes) else None


def _without_left_out(outcomes: Sequence[O]) -> list[O]:
    return [outcome for outcome in outcomes if not outcome.left_out]


class CaseObserver(Generic[C, O]):
    """Is notified of the cases as they run; to be overridden."""

    def begin(self, case: C) -> None:
        """A case begins."""

    def end(self, outcome: O) -> None:
        """A case has ended."""


class Results(Generic[O]):
    """The folder of a verb and the outcomes so far; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    folder : Path or None
        None: nothing is written.
    view : View
    ranks : int
        Number of ranks of each case.
    command : sequence of str
        The command line that repeats the verb, for the page.
    force : bool
        Accept an existing folder.

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
            on_root(comm, lambda: _create_folder(folder, force=force))

    def run(
        self, cases: Iterable[C], run: Callable[[C], O], observer: CaseObserver[C, O] | None = None
    ) -> str:
        """Run the cases; returns a note on packages that the page lacks, empty if none.

        Raises
        ------
        Interrupted
            From ``run``; the outcomes so far are in the folder.
        OutputError
            On every rank, if a file could not be written.
        """
        observer = observer or CaseObserver()
        try:
            for case in cases:
                observer.begin(case)
                self.outcomes.append(run(case))
                observer.end(self.outcomes[-1])
                self.view.case_ended(self.outcomes)
                self.write()
            self.write()
        except Interrupted:
            self.write_page()
            raise
        return self.write_page()

    def write(self) -> None:
        """Write the CSV and JSON files of the outcomes so far."""
        view = self.view
        if self.folder is None or not view.ready:
            return
        path, outcomes = self.folder / f"{view.verb}.csv", self.outcomes

        def write_table() -> None:
            rows = [row for outcome in _without_left_out(outcomes) for row in view.csv_rows(outcome)]
            cells = ([view.csv_cell(row.get(name)) for name in view.columns] for row in rows)
            write_csv(path, [view.columns, *cells])

        on_root(self._comm, write_table)
        content = view.content(outcomes, self._ranks, self._command)
        write_summary(path.with_suffix(".json"), content, self._comm)

    def write_page(self) -> str:
        """Write the page; returns a note on packages that it lacks, empty if none."""
        return on_root(self._comm, self._write_page)

    def _write_page(self) -> str:
        if self.folder is None or not self.view.ready:
            return ""
        report = Report(self.view.title)
        ranks = f"{self._ranks} rank{'s' if self._ranks > 1 else ''}"
        summary = f"{count_passed(self.outcomes)} on {ranks}."
        self.view.fill(report, self.outcomes, summary, plots=not missing_report_packages())
        return self.view.close_page(report, self.folder, self._command)


def _create_folder(folder: Path, *, force: bool) -> None:
    if folder.exists() and not (force and folder.is_dir()):
        raise InputError("exists; choose another folder, or give --force", key=f"--out {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", key=f"--out {folder}") from None
