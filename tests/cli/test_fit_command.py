"""The command ``fit``: results, resumption, bad input on one rank, a signal in the first evaluation."""

from __future__ import annotations

import signal
from pathlib import Path

from launch import done, finish, lyra, read_csv, start, wait_until, write_scene

STRIP = """\
mesh: {grid: {width: 0.08, height: 0.02, nx: 4, ny: 1}}
material:
  density: 0.15
  membrane: {c11: 500, c22: 500, c12: 100, c33: 100}
  bending: 4.2e-5
  bending_model: midedge
gravity: [0, 0, -9.81]
handles: [{box: [[-1, -1, -1], [0.021, 1, 1]]}]
probes: {tip: {nodes: [4, 9]}}
time: {analysis: static}
fit:
  parameters: {material.bending: {start: 2.0e-5, bounds: [1.0e-6, 1.0e-3]}}
  measurements: [{probe: tip, axes: [z], value: -0.05, uncertainty: 1.0e-3}]
"""
LONG = STRIP.replace("{analysis: static}", "{end: 1000.0, step: 0.001}")


def test_a_fit_writes_its_results_and_resumes(tmp_path: Path) -> None:
    asked = ["fit", write_scene(tmp_path, STRIP), "--out", "out"]
    left = done(asked, tmp_path)
    assert "material.bending" in left.out
    assert any(row["parameter"] == "material.bending" for row in read_csv(tmp_path / "out" / "fit.csv"))
    assert lyra(asked, tmp_path).code == 2
    again = done([*asked, "--resume"], tmp_path)
    assert "from before" in again.err


def test_a_signal_in_the_first_evaluation_leaves_no_results(tmp_path: Path) -> None:
    process = start(["fit", write_scene(tmp_path, LONG), "--out", "out"], tmp_path)
    wait_until((tmp_path / "out" / "fit.lock").exists, process)
    process.send_signal(signal.SIGTERM)
    left = finish(process)
    assert left.code == 143, left.err
    assert left.ours == ["lyra-petsc: stopped by SIGTERM in the first evaluation, nothing is kept"]
    assert not (tmp_path / "out").exists()
