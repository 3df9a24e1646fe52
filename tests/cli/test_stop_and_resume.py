"""Runs that are stopped or killed are resumed, also on another number of ranks."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from launch import DIRECT, REDUNDANT, Left, done, finish, read_csv, read_json, start, wait_until, write_scene
from numpy.typing import NDArray

from lyra_petsc.output.read_run import StoredRun, stored_states

LONG = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 6, ny: 6}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
handles:
  - {nodes: [0, 6]}
  - {nodes: [45], from: 0.205, motion: lift}
motions:
  lift: [{time: 0.3, translate: [0, 0, 0]}, {time: 0.9, translate: [0, 0, 0.2]}]
time: {end: 0.8, step: 0.005}
output: {every: 0.05, checkpoint: {seconds: 0.02}, fields: [velocity], reactions: true}
probes: {middle: {nodes: [24]}}
"""


HALF = ("--set", "time.end=0.25")


def final_state(folder: Path) -> tuple[float, NDArray[np.float64]]:
    run = StoredRun(folder)
    return float(run.times[-1]), run.positions[-1]


def state_times(folder: Path) -> list[float]:
    """Times [s] of all states, rounded; checks that none is repeated."""
    times = [round(state.time, 9) for state in stored_states(folder)]
    assert times == sorted(set(times))
    return times


def wait_for_rows(folder: Path, rows: int) -> None:
    path = folder / "history.csv"
    wait_until(lambda: path.exists() and path.read_text(encoding="utf-8").count("\n") > rows)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    done(["run", write_scene(folder, LONG), "--out", "whole", *DIRECT], folder)
    return folder / "whole"


@pytest.fixture(scope="module")
def first_half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("half")
    done(["run", write_scene(folder, LONG), "--out", "half", *HALF, *DIRECT], folder)
    return folder / "half"


def equal_runs(left: Path, whole: Path, end: float = 0.8) -> None:
    """Check equal last states, and that each step, probe and reaction is there once."""
    (time_a, a), (time_b, b) = final_state(left), final_state(whole)
    assert time_a == time_b == pytest.approx(end, abs=1e-12)
    np.testing.assert_allclose(a, b, atol=1e-9)
    for name in ("history.csv", "probes.csv", "reactions.csv"):
        steps = [int(row["step"]) for row in read_csv(left / name)]
        assert steps == list(range(len(read_csv(whole / name))))
    for mine, other in zip(read_csv(left / "history.csv"), read_csv(whole / "history.csv"), strict=True):
        assert float(mine["time"]) == pytest.approx(float(other["time"]), abs=1e-12)
        assert float(mine["dissipation"]) == pytest.approx(float(other["dissipation"]), rel=1e-6, abs=1e-12)
    assert set(state_times(whole)) <= set(state_times(left))


def stopped_by(number: signal.Signals, folder: Path) -> Left:
    process = start(["run", write_scene(folder, LONG), "--out", "out", *DIRECT], folder)
    wait_for_rows(folder / "out", 60)
    process.send_signal(number)
    return finish(process)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_run_stopped_by_a_signal_is_resumed(
    tmp_path: Path, uninterrupted: Path, number: signal.Signals, code: int
) -> None:
    left = stopped_by(number, tmp_path)
    assert left.code == code, left.err
    (line,) = left.ours
    assert number.name in line
    assert "--resume" in line
    steps = len(read_csv(tmp_path / "out" / "history.csv")) - 1
    assert steps < len(read_csv(uninterrupted / "history.csv")) - 1
    summary = read_json(tmp_path / "out/summary.json")
    assert number.name in summary["outcome"]
    assert summary["steps"] == steps
    done(["run", "--out", "out", "--resume", *DIRECT], tmp_path)
    summary = read_json(tmp_path / "out/summary.json")
    assert (summary["outcome"], summary["steps_of_this_run"]) == ("done", summary["steps"] - steps)
    equal_runs(tmp_path / "out", uninterrupted)


def test_a_killed_run_is_resumed_from_its_newest_checkpoint(tmp_path: Path, uninterrupted: Path) -> None:
    assert stopped_by(signal.SIGKILL, tmp_path).code == -signal.SIGKILL
    done(["run", tmp_path / "scene.yaml", "--out", "out", "--resume", *DIRECT], tmp_path)
    equal_runs(tmp_path / "out", uninterrupted)


@pytest.mark.parametrize(("before", "after"), [pytest.param(1, 2, marks=pytest.mark.quick), (3, 1)])
def test_a_run_is_resumed_on_another_number_of_ranks(
    tmp_path: Path, first_half: Path, before: int, after: int
) -> None:
    scene = write_scene(tmp_path, LONG)
    done(["run", scene, "--out", "out", "-ts_max_steps", "43", *HALF, *REDUNDANT], tmp_path, before)
    assert len(read_csv(tmp_path / "out" / "history.csv")) == 44
    done(["run", scene, "--out", "out", "--resume", *HALF, *REDUNDANT], tmp_path, after)
    equal_runs(tmp_path / "out", first_half, 0.25)
    assert read_json(tmp_path / "out/summary.json")["ranks"] == after


def test_resume_without_a_folder_uses_the_newest_run_of_the_scene(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    done(["run", scene], tmp_path)
    again = done(["run", scene, "-ts_max_steps", "2"], tmp_path)
    assert "note: runs/scene exists: the results go to runs/scene-2" in again.err
    done(["run", scene, "--resume"], tmp_path)
    assert len(read_csv(tmp_path / "runs/scene-2" / "history.csv")) == 6
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["scene", "scene-2"]
