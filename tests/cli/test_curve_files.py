"""Curves in files: what ``check`` says of them, refused rows, and runs that go on without the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from launch import done, refused, write_scene

import lyra_petsc

SCENE = """
mesh: {grid: {width: 0.4, height: 0.4, nx: 4, ny: 4}}
material: {cloth: gray-interlock, damping: 0.02}
loads: [{pressure: gust.csv}]
handles: [{group: left}]
time: {end: 0.1, step: 0.01, integrator: bdf2}
output: {every: 0.01}
"""


def test_a_run_goes_on_without_the_file(tmp_path: Path) -> None:
    gust = tmp_path / "gust.csv"
    gust.write_text("time [s]; pressure [Pa]\n0; 0\n0.035; 2\n0.08; 0\n")
    scene = write_scene(tmp_path, SCENE)
    plan = done(["check", scene], tmp_path).out
    assert "loads[0].pressure" in plan
    assert "3 points from 0 to 0.08, up to 2 Pa; steps end at its 3 kinks" in plan
    done(["run", scene, "--out", "whole"], tmp_path)
    done(["run", scene, "--out", "part", "-ts_max_steps", "3"], tmp_path, ranks=2)
    gust.unlink()
    done(["run", "part/scene.yaml", "--out", "part", "--resume"], tmp_path)
    whole, part = (lyra_petsc.Run(tmp_path / name) for name in ("whole", "part"))
    assert whole.times[-1] == part.times[-1] == 0.1
    np.testing.assert_allclose(part.positions[-1], whole.positions[-1], atol=1e-6)


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_bad_row_is_refused_before_anything_is_written(tmp_path: Path, ranks: int) -> None:
    (tmp_path / "gust.csv").write_text("time,pressure\n0,0\n0.1,five\n")
    words = "gust.csv, line 3: must be 2 finite numbers with decimal points"
    refused(["run", write_scene(tmp_path, SCENE), "--out", "out"], tmp_path, words, ranks)
