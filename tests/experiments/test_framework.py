"""The common framework of experiments: outcomes, the registry, records, and folders."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError, Interrupted
from lyra_petsc.experiments.case import (
    Case,
    Outcome,
    Registry,
    Verdict,
    count_passed,
    load_record,
    save_record,
)
from lyra_petsc.experiments.results import Line, Results, View, align_columns
from lyra_petsc.experiments.stress.cases import FAMILIES
from lyra_petsc.experiments.verification.cases import CASES
from lyra_petsc.show.report.document import Report

GOOD, BAD = Verdict(True, "as it should be"), Verdict(False, "off by a half")


def outcome(name: str, *verdicts: Verdict, left_out: str = "") -> Outcome[Case]:
    named = {str(number): verdict for number, verdict in enumerate(verdicts)}
    return Outcome(Case(name, f"title of {name}"), named, 1.0, left_out)


def test_passed_and_failed_outcomes() -> None:
    assert outcome("a", GOOD, GOOD).passed
    assert not outcome("a", GOOD, BAD).passed
    assert outcome("a", GOOD, BAD).failures == {"1": BAD}
    assert not outcome("a").passed  # nothing was judged
    assert outcome("a", left_out="needs a handle").passed
    assert count_passed([outcome("a", GOOD), outcome("b", BAD), outcome("c", left_out="no")]) == (
        "1 of 2 cases passed"
    )


@pytest.mark.parametrize("registry", [CASES, FAMILIES])
def test_every_name_of_a_registry_is_an_entry_of_that_name(registry: Registry[Any]) -> None:
    assert [entry.name for entry in registry.all()] == list(registry.entries)


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    with pytest.raises(InputError, match="free-fal: unknown case, did you mean 'free-fall'"):
        CASES.load("free-fal")


@dataclass
class Part:
    seconds: float


@dataclass
class Whole:
    name: str
    parts: list[Part]
    words: tuple[str, ...] = ()
    count: int | None = None


def test_a_record_is_read_from_its_file(tmp_path: Path) -> None:
    whole = Whole("Δt", [Part(0.5), Part(math.inf)], ("a", "b"), 3)
    save_record(tmp_path / "whole.json", whole)
    assert load_record(tmp_path / "whole.json", Whole) == whole
    (tmp_path / "whole.json").write_text('{"name": "older", "parts": [], "gone": 1}', encoding="utf-8")
    assert load_record(tmp_path / "whole.json", Whole) == Whole("older", [])
    (tmp_path / "whole.json").write_text('{"name": "half"', encoding="utf-8")
    with pytest.raises(ValueError, match="JSON"):
        load_record(tmp_path / "whole.json", Whole)


class Told(View[Outcome[Case]]):
    verb, title, pictures, columns = "try", "A try", "pictures", ("case", "value")

    def csv_rows(self, outcome: Outcome[Case]) -> Iterable[Mapping[str, Any]]:
        yield {"case": outcome.case.name, "value": math.nan, "more": 1}

    def terminal_lines(self, outcome: Outcome[Case]) -> Iterable[Line]:
        return [(outcome.case.name, "bold")]

    def summary_table(self, outcomes: Sequence[Outcome[Case]]) -> list[Sequence[str]]:
        return [(outcome.case.name,) for outcome in outcomes]

    def case_content(self, outcome: Outcome[Case]) -> dict[str, Any]:
        return {"seconds": outcome.seconds}

    def fill(self, report: Report, outcomes: Sequence[Outcome[Case]], summary: str, *, plots: bool) -> None:
        report.paragraph(summary)


def test_a_table_for_the_terminal() -> None:
    assert align_columns([("case", "n"), ("a", "10")]) == ["case   n", "a     10"]
    assert align_columns([("case", "n"), ("a", "10")], text_columns=2) == ["case  n", "a     10"]


class Silent:
    def begin(self, case: Case) -> None: ...

    def end(self, outcome: Outcome[Case]) -> None: ...


def test_an_interrupted_experiment_leaves_its_finished_cases(tmp_path: Path) -> None:
    def run(case: Case) -> Outcome[Case]:
        if case.name == "b":
            raise Interrupted("", 2)
        return outcome(case.name, GOOD)

    results = Results(MPI.COMM_SELF, tmp_path / "out", Told(), ranks=2, command=["try", "a b"])
    with pytest.raises(Interrupted):
        results.run([Case("a", "one"), Case("b", "two"), Case("c", "three")], run, Silent())
    with open(tmp_path / "out" / "try.csv", encoding="utf-8", newline="") as file:
        assert list(csv.DictReader(file)) == [{"case": "a", "value": ""}]
    content = json.loads((tmp_path / "out" / "try.json").read_text(encoding="utf-8"))
    assert (content["passed"], content["ranks"]) == (True, 2)
    assert content["cases"][0]["verdicts"] == {"0": {"passed": True, "words": "as it should be"}}
    page = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert "1 of 1 cases passed on 2 ranks." in page
    assert "try 'a b'" in page


def test_an_existing_folder_is_refused_unless_forced(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exists; choose another folder, or give --force"):
        Results(MPI.COMM_SELF, tmp_path, Told(), ranks=1, command=[])
    assert Results(MPI.COMM_SELF, tmp_path, Told(), ranks=1, command=[], force=True).outcomes == []
