"""Bad input from the command line: one line, exit 2, nothing written, on one rank and on two."""

from __future__ import annotations

from pathlib import Path

import pytest
from launch import SCENE, lyra, write_scene

GRID = "{grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}"
EMPTY = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"

# name: (change of the scene (old, new) or None, arguments after `run scene.yaml`, words in the line)
CASES: dict[str, tuple[tuple[str, str] | None, list[str], str]] = {
    "unknown key": (("gravity:", "gravitty:"), [], "gravitty: unknown key, did you mean 'gravity'"),
    "wrong type": (("step: 0.01", "step: [1]"), [], "time.step: must be a number"),
    "out of range": (("density: 0.15", "density: -1"), [], "material.density: must be > 0"),
    "not a number": (("[0, 0, -9.81]", "[0, 0, .nan]"), [], "gravity: must be a finite number"),
    "missing mesh": ((GRID, "{file: none.msh}"), [], "none.msh"),
    "empty mesh": ((GRID, "{file: empty.obj}"), [], "empty.obj"),
    "binary mesh": ((GRID, "{file: noise.msh}"), [], "noise.msh"),
    "unknown group": (("nodes: [0, 4]", "group: pole"), [], "handles[0].group"),
    "vertex out of range": (("nodes: [0, 4]", "nodes: [0, 25]"), [], "handles[0].nodes"),
    "curvature without bending": (
        ("output: {every: 0.02}", "output: {every: 0.02, fields: [curvature]}"),
        ["--set", "material.bending=0"],
        "output.fields",
    ),
    "set without equals": (None, ["--set", "rubbish"], "--set"),
    "set of an unknown key": (None, ["--set", "time.stepp=1"], "time.stepp"),
    "set of an unknown word": (None, ["--set", "time.step=abc"], "time.step"),
    "unknown preconditioner": (None, ["-pc_type", "foo"], "foo"),
    "unknown Krylov method": (None, ["-ksp_type", "foo"], "foo"),
    "another time scheme": (None, ["-ts_type", "cn"], "-ts_type"),
    "theta endpoint": (None, ["-ts_theta_endpoint"], "-ts_theta_endpoint"),
    "no number for PETSc": (None, ["-ts_dt", "abc"], "abc has no numeric value"),
    "negative step for PETSc": (None, ["-ts_dt", "-1"], "-ts_dt"),
    "unknown option": (None, ["--ouut", "x"], "--ouut: no such option"),
    "option without value": (None, ["--out"], "--out"),
    "force with resume": (None, ["--force", "--resume"], "--force"),
    "nothing to resume": (None, ["--resume"], "--resume"),
    "folder in use": (None, ["--out", "used"], "used"),
    "folder is a file": (None, ["--out", "empty.obj"], "empty.obj"),
    "second scene": (None, ["other.yaml"], "other.yaml"),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "empty.obj").write_text(EMPTY)
    (tmp_path / "noise.msh").write_bytes(bytes(range(256)) * 8)
    (tmp_path / "used").mkdir()
    return tmp_path


def refused(arguments: list[str], folder: Path, ranks: int, words: str) -> None:
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    left = lyra(arguments, folder, ranks, patience=30)
    assert left.code == 2, left.err
    assert len(left.ours) == 1, left.err
    assert words in left.ours[0]
    assert "Traceback" not in left.err
    assert left.out == ""
    if ranks == 1:
        assert left.err.splitlines() == left.ours
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("name", CASES)
def test_a_mistake_is_one_line(folder: Path, name: str, ranks: int) -> None:
    change, arguments, words = CASES[name]
    if change is not None:
        assert change[0] in SCENE
    write_scene(folder, SCENE.replace(*change) if change else SCENE)
    refused(["run", "scene.yaml", *arguments], folder, ranks, words)


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["runn", "scene.yaml"], "runn: unknown verb, did you mean 'run'"),
        (["scene.yaml"], "give a verb first, as in: run scene.yaml"),
        (["export", "nowhere", "--to", "obj"], "nowhere: no such folder"),
        (["run", "none.yaml"], "none.yaml"),
        (["run", "used"], "used"),
        (["check", "noise.msh"], "noise.msh"),
        (["check", "scene.yaml", "--out", "x"], "--out: no such option"),
        (["run", "--resume", "--out", "used"], "used"),
    ],
    ids=" ".join,
)
def test_a_wrong_word_is_one_line(folder: Path, arguments: list[str], words: str, ranks: int) -> None:
    write_scene(folder)
    refused(arguments, folder, ranks, words)
