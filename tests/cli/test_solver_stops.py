"""Steps that do not converge: repeated with a smaller Δt, or ended with a message."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from launch import DIRECT, SCENE, done, lyra, read_csv, read_json, write_scene

from lyra_petsc.output.read_run import stored_states

STIFF = SCENE.replace("end: 0.05, step: 0.01", "end: 0.4, step: 0.04").replace("every: 0.02", "every: 0.04")


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_failed_run_ends_with_a_message_and_keeps_the_last_state(tmp_path: Path, ranks: int) -> None:
    scene = write_scene(tmp_path, STIFF)
    left = lyra(["run", scene, "--out", "out", "--set", "solver.max_iterations=1"], tmp_path, ranks)
    assert left.code == 3, left.err
    (line,) = left.ours
    assert re.search(r"step \d+ \(t = \S+ s\) did not converge even with Δt = 9\.77e-06 s: ", line)
    assert "Newton did not converge within its iterations (nonlinear trouble)" in line
    assert "try solver.max_iterations above 1" in line
    lines = left.err.splitlines()
    details = lines[lines.index(line) + 1 :]
    assert details[0].startswith("  residual [N] by iteration (linear iterations): ")
    assert sum(words.startswith("  vertex") for words in details) == 1
    assert "  look at out/failure.xdmf (ParaView) and out/failure.txt" in details
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["outcome"] == line.removeprefix("lyra-petsc: ")
    failure = summary["failure"]
    assert failure["kind"] == "nonlinear trouble"
    assert failure["attempts"][-1]["dt"] == pytest.approx(0.04 / 2**12)
    assert failure["step"] == summary["steps"] + 1
    assert f"worst at vertex {failure['vertex']['number']} around" in line
    text = (tmp_path / "out/failure.txt").read_text()
    assert text.startswith(summary["outcome"] + "\n")
    assert text.count("Newton and") == len(failure["attempts"])
    with h5py.File(tmp_path / "out/failure.h5", "r") as file:
        before, failing = file["states/000000"], file["states/000001"]
        assert failing.attrs["time"] - before.attrs["time"] == pytest.approx(0.04 / 2**12)
        residual = failing["residual"][:]
        assert residual[failure["vertex"]["number"]] == pytest.approx(failure["vertex"]["residual"])
        assert np.abs(failing["position"][:] - before["position"][:]).max() > 0.0
    rows = read_csv(tmp_path / "out" / "history.csv")
    assert summary["steps"] == int(rows[-1]["step"])
    assert stored_states(tmp_path / "out")[-1].step == summary["steps"]
    assert (tmp_path / "out/checkpoint.h5").exists()


def test_a_successful_resumed_run_removes_files_of_the_failure(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, STIFF)
    fails = "--set", "solver.max_iterations=1", "-ts_adapt_dt_min", "1"
    left = lyra(["run", scene, "--out", "out", *fails], tmp_path)
    assert left.code == 3, left.err
    assert (tmp_path / "out/failure.xdmf").exists()
    done(["run", scene, "--out", "out", "--resume", *DIRECT], tmp_path)
    assert not list((tmp_path / "out").glob("failure*"))
    assert "failure" not in read_json(tmp_path / "out/summary.json")
    lyra(["run", scene, "--out", "out", "--force", *fails], tmp_path)
    assert (tmp_path / "out/failure.xdmf").exists()
    done(["run", scene, "--out", "out", "--force", *DIRECT], tmp_path)
    assert not list((tmp_path / "out").glob("failure*"))


def test_a_petsc_error_in_a_step_keeps_the_last_state(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    left = lyra(["run", scene, "--out", "out", "-ksp_converged_reason", "nonsense"], tmp_path, 2)
    assert left.code == 3, left.err
    (line,) = left.ours
    assert "PETSc stopped in the step from t = 0 s" in line
    assert line.endswith("check -ksp_converged_reason")
    assert read_json(tmp_path / "out/summary.json")["outcome"] in line


def test_a_petsc_error_is_not_blamed_on_options_of_the_program(tmp_path: Path) -> None:
    left = lyra(["run", write_scene(tmp_path), "--out", "out", "-pc_type", "bddc"], tmp_path)
    assert left.code == 3, left.err
    assert left.ours[0].endswith("; check -pc_type bddc")


def test_a_failed_step_is_repeated_with_a_smaller_dt(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, STIFF)
    few = ["--set", "solver.max_iterations=6", "--set", "solver.hessian=regularised"]
    done(["run", scene, "--out", "out", *few, *DIRECT], tmp_path)
    rows = read_csv(tmp_path / "out" / "history.csv")
    rejected = [int(row["rejected"]) for row in rows]
    steps = [float(row["dt"]) for row in rows[1:]]
    assert sum(rejected) > 0
    assert read_json(tmp_path / "out/summary.json")["rejected"] == sum(rejected)
    assert sum(steps) == pytest.approx(0.4, rel=1e-9)
    shortened = next(i for i, dt in enumerate(steps) if dt < 0.03)
    assert min(steps) == pytest.approx(0.02, rel=1e-9)
    assert max(steps[shortened:]) == pytest.approx(0.04, rel=1e-9)
