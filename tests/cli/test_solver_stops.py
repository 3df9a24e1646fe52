"""Steps that do not converge: retried with a smaller one, and given up with words."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import h5py
import pytest
from launch import DIRECT, SCENE, done, lyra, write_scene

STIFF = SCENE.replace("end: 0.05, step: 0.01", "end: 0.4, step: 0.04").replace("every: 0.02", "every: 0.04")


def history(folder: Path) -> list[dict[str, str]]:
    with (folder / "history.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("ranks", [1, 2])
def test_gives_up_with_words_and_keeps_the_last_good_state(tmp_path: Path, ranks: int) -> None:
    scene = write_scene(tmp_path, STIFF)
    left = lyra(["run", scene, "--out", "out", "--set", "solver.max_iterations=1"], tmp_path, ranks)
    assert left.code == 3, left.err
    (line,) = left.ours
    assert "did not converge even with" in line
    assert "Newton did not converge within its iterations" in line
    assert "try a smaller time.step" in line
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert "did not converge" in summary["outcome"]
    rows = history(tmp_path / "out")
    assert summary["steps"] == int(rows[-1]["step"])
    with h5py.File(max((tmp_path / "out").glob("states-*.h5")), "r") as file:
        newest = file["states"][max(file["states"])]
        assert newest.attrs["step"] == summary["steps"]
    assert (tmp_path / "out/checkpoint.h5").exists()


def test_a_step_that_fails_is_retried_smaller_and_recovers(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, STIFF)
    few = ["--set", "solver.max_iterations=6", "--set", "solver.hessian=regularised"]
    done(["run", scene, "--out", "out", *few, *DIRECT], tmp_path)
    rows = history(tmp_path / "out")
    rejected = [int(row["rejected"]) for row in rows]
    steps = [float(row["dt"]) for row in rows[1:]]
    assert sum(rejected) > 0
    assert json.loads((tmp_path / "out/summary.json").read_text())["rejected"] == sum(rejected)
    assert sum(steps) == pytest.approx(0.4, rel=1e-9)
    shortened = next(i for i, dt in enumerate(steps) if dt < 0.03)
    assert min(steps) == pytest.approx(0.02, rel=1e-9)
    assert max(steps[shortened:]) == pytest.approx(0.04, rel=1e-9)
