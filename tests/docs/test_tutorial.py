"""The run of the tutorial is one that its report does not criticise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from blocks import ROOT, blocks_of

import lyra_petsc
from lyra_petsc.show.report.run_page import Facts, advice


def test_the_report_has_no_advice_on_the_tutorial(tmp_path: Path) -> None:
    """Its first second on one rank; wall times, which depend on the machine, are replaced."""
    for block in blocks_of(ROOT / "docs" / "tutorial.md"):
        if block.title:
            (tmp_path / block.title).write_text(block.text, encoding="utf-8")
    run = lyra_petsc.run(lyra_petsc.load(tmp_path / "pennant.yaml", {"time.end": 1.0}), tmp_path / "run")
    facts = Facts.of(run)
    assert facts.summary["notes"] == []
    columns = facts.columns | {"wall_seconds": np.ones_like(facts.columns["wall_seconds"])}
    assert advice(Facts(run, columns)) == []
