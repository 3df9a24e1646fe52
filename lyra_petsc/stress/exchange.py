"""Outcomes as files: from the process that ran a case to the one that had it started."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.output.atomic import replace_text
from lyra_petsc.simulation import StepReport
from lyra_petsc.stress.balance import Balance
from lyra_petsc.stress.case import Case
from lyra_petsc.stress.record import Record
from lyra_petsc.stress.runner import Outcome
from lyra_petsc.verification.claims import Verdict

OUTCOME_FILE, SHAPES_FILE = "outcome.json", "shapes.npz"
ARRAYS = ("last", "triangles")
"""Of a record, that go into the second file."""

NOT_KEPT = (*ARRAYS, "observed", "reports", "balances")


def save(outcome: Outcome, folder: Path) -> None:
    """Write an outcome, without what its case observed. On one rank.

    Raises
    ------
    OutputError
    """
    record = outcome.record
    arrays = {name: getattr(record, name) for name in ARRAYS if getattr(record, name) is not None}
    np.savez(folder / SHAPES_FILE, **arrays)
    content = {
        "record": {f.name: getattr(record, f.name) for f in fields(record) if f.name not in NOT_KEPT},
        "reports": [asdict(report) for report in record.reports],
        "balances": [asdict(balance) for balance in record.balances],
        "verdicts": {name: asdict(verdict) for name, verdict in outcome.verdicts.items()},
        "seconds": outcome.seconds,
        "ratio": outcome.ratio,
        "busy_ratio": outcome.busy_ratio,
        "left_out": outcome.left_out,
    }
    # numbers of another process: with NaN and infinity, which Python's own reader takes back
    replace_text(folder / OUTCOME_FILE, json.dumps(content, default=_number))


def restore(folder: Path, case: Case, family: str) -> Outcome | None:
    """The outcome in a folder; None if there is none."""
    try:
        content: dict[str, Any] = json.loads((folder / OUTCOME_FILE).read_text(encoding="utf-8"))
        with np.load(folder / SHAPES_FILE) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError):
        return None
    record = Record(
        **content["record"],
        reports=[StepReport(**report) for report in content["reports"]],
        balances=[Balance(**balance) for balance in content["balances"]],
        **arrays,
    )
    return Outcome(
        case,
        family,
        record,
        {name: Verdict(**verdict) for name, verdict in content["verdicts"].items()},
        content["seconds"],
        content["ratio"],
        content["busy_ratio"],
        content["left_out"],
    )


def _number(value: Any) -> Any:
    """What JSON does not know: numpy's numbers."""
    return value.item()
