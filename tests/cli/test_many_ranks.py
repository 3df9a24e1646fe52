"""More ranks than vertices: the run is the same."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from launch import REDUNDANT, done, write_scene

SCENE = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 1, ny: 1}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
wind: {velocity: [0, 3, 0], density: 1.2}
handles: [{nodes: [0], clamp: true}, {nodes: [3], stiffness: 50}]
probes: {corner: {nodes: [1]}}
time: {end: 0.03, step: 0.01}
output: {every: 0.02, reactions: true, fields: [velocity, rank, green_strain], checkpoint: {steps: 1}}
"""


def numbers(file: Path) -> list[list[float]]:
    with file.open(encoding="utf-8") as text:
        return [[float(value) for value in row[:4]] for row in list(csv.reader(text))[1:]]


@pytest.mark.slow
def test_four_vertices_on_five_ranks_with_all_files(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, SCENE)
    done(["run", scene, "--out", "many", "-ts_max_steps", 2, *REDUNDANT], tmp_path, 5)
    done(["run", scene, "--out", "many", "--resume", *REDUNDANT], tmp_path, 5)
    done(["run", scene, "--out", "one", *REDUNDANT], tmp_path)
    for name in ("probes.csv", "reactions.csv"):
        many, one = (numbers(tmp_path / folder / name) for folder in ("many", "one"))
        assert len(many) == len(one) > 3
        for row, other in zip(many, one, strict=True):
            assert row == pytest.approx(other, rel=1e-6, abs=1e-9)
