"""``-log_view`` shows phases as stages and the assembly as events, with correct counts."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from launch import SCENE, done, read_csv, write_scene

STAGE = re.compile(r"^ *\d+: +(mesh|partition|assembly|solve|balance|output): +\S+ +[\d.]+%", re.M)


def counts(log: str, name: str) -> list[int]:
    """Calls of an event in each stage in which it occurred (maximum over ranks)."""
    calls = re.findall(rf"^{name} +(\d+) 1\.0", log, re.M)
    return [int(number) for number in calls if int(number)]


def column(folder: Path, name: str) -> list[int]:
    return [int(row[name]) for row in read_csv(folder / "history.csv")]


@pytest.mark.parametrize(
    ("integrator", "ranks"), [("beuler", 1), ("semi-implicit", 1), ("midpoint", 1), ("beuler", 2)]
)
def test_stages_and_events(tmp_path: Path, integrator: str, ranks: int) -> None:
    scene = write_scene(tmp_path, SCENE.replace("step: 0.01}", f"step: 0.01, integrator: {integrator}}}"))
    left = done(["run", scene, "--out", "out", "-log_view"], tmp_path, ranks)
    assert STAGE.findall(left.out) == ["mesh", "partition", "assembly", "solve", "balance", "output"]
    newton, rejected = column(tmp_path / "out", "newton_iterations"), column(tmp_path / "out", "rejected")
    steps = len(newton) - 1
    assert steps == 5
    assert sum(rejected) == 0
    assert sum(newton) == steps if integrator == "semi-implicit" else sum(newton) > steps
    assert counts(left.out, "AssembleJacobian") == [sum(newton)]
    assert counts(left.out, "AssembleFrozen") == [steps]
    (residuals,) = counts(left.out, "AssembleResidual")
    assert residuals >= sum(newton)
    assert counts(left.out, "AssembleAgain") == []
    assert "Event Stage" in left.out
    assert not re.search(r"Event Stage \d+: Unknown", left.out)
