"""Frames of bodies and handles: what ``check`` says, tables, exports, and runs that go on."""

from __future__ import annotations

import csv
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from launch import DIRECT, done, lyra, refusal, refused, write_scene

import lyra_petsc
from lyra_petsc.mesh.frame_files import UsdFrames
from lyra_petsc.mesh.obstacles import BOX_TRIANGLES
from lyra_petsc.show.obstacle_surfaces import run_obstacles

SCENE = """
mesh:
  grid: {width: 0.4, height: 0.4, nx: 6, ny: 6}
  transform: {translate: [-0.21, -0.19, 0.004]}
material: {cloth: gray-interlock, damping: 0.02}
gravity: [0, 0, -9.81]
contact: {gap: 0.005, friction: 0.4}
obstacles:
  tray: {mesh: {file: tray.obj, frames: walk.npz, repeat: true}, interpolation: linear}
handles:
  - {group: left, frames: pins.npz, from: 0.02}
output: {every: 0.01}
solver: {force_tolerance: 1.0e-9}
"""
TIMES = np.array([0.0, 0.025, 0.05, 0.075])
CORNERS = np.array([[x, y, z] for z in (-0.1, 0.0) for y in (-0.15, 0.15) for x in (-0.15, 0.15)])


def write_frames(folder: Path, *, lifted: float = 0.01, after: int = 3) -> None:
    """A tray that is bent in its frames, and an edge that is pulled; from frame ``after`` on it is lifted."""
    rows = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a} {b} {c}" for a, b, c in BOX_TRIANGLES + 1]
    (folder / "tray.obj").write_text("\n".join(rows) + "\n")
    walk = np.repeat(CORNERS[None], 4, axis=0)
    walk[1:, 4:, 2] += 0.1 * CORNERS[4:, 0]
    walk[2:, :, 0] += 0.01
    walk[after:, :, 2] += lifted
    np.savez(folder / "walk.npz", time=TIMES, position=walk)
    np.savez(folder / "pins.npz", time=TIMES, position=np.array([7 * [[0.0, 0, t]] for t in TIMES]))


def columns(file: Path) -> tuple[list[str], np.ndarray]:
    with open(file, encoding="utf-8", newline="") as text:
        header, *rows = csv.reader(text)
    return header, np.array([[float(entry) for entry in row[:2] + row[3:]] for row in rows])


@pytest.mark.parametrize(
    ("time", "ranks"),
    [("{end: 0.1, step: 0.01}", (1, 2)), ("{end: 0.1, step: auto, tolerance: 0.05}", (3, 1))],
)
def test_a_run_goes_on_with_its_frames(tmp_path: Path, time: str, ranks: tuple[int, int]) -> None:
    write_frames(tmp_path)
    scene = write_scene(tmp_path, SCENE + f"time: {time}\n")
    done(["run", scene, "--out", "whole", *DIRECT], tmp_path)
    done(["run", scene, "--out", "part", "-ts_max_steps", "4"], tmp_path, ranks=ranks[0])
    result = done(["run", scene, "--out", "part", "--resume"], tmp_path, ranks=ranks[1])
    assert "changed since" not in result.err
    whole, part = (lyra_petsc.Run(tmp_path / name) for name in ("whole", "part"))
    assert whole.times[-1] == part.times[-1] == 0.1
    np.testing.assert_allclose(part.positions[-1], whole.positions[-1], atol=1e-5)
    (header, mine), (_, others) = (columns(tmp_path / name / "obstacles.csv") for name in ("part", "whole"))
    assert header[2] == "obstacle"
    assert others[:, 4].min() < -0.1  # the sheet presses the tray down
    np.testing.assert_allclose(mine, others, rtol=0, atol=2e-3 * np.abs(others[:, 2:]).max())


def test_the_plan_names_frames(tmp_path: Path) -> None:
    write_frames(tmp_path)
    plan = done(["check", write_scene(tmp_path, SCENE + "time: {end: 0.1, step: 0.03}\n")], tmp_path).out
    text = " ".join(plan.split())
    frames = "4 frames from 0 to 0.075 s, {}, steps of 0.03 s pass over 1.2 frames each"
    assert f"handle 0 left {frames.format('monotone')} contact" in text
    assert f"obstacle tray mesh, {frames.format('linear, repeated')}, friction 0.4" in text


def test_other_frames_are_named_when_a_run_goes_on(tmp_path: Path) -> None:
    write_frames(tmp_path)
    scene = write_scene(tmp_path, SCENE + "time: {end: 0.03, step: 0.01}\n")
    done(["run", scene, "--out", "run", "-ts_max_steps", "1"], tmp_path)
    write_frames(tmp_path, lifted=0.02)
    result = done(["run", scene, "--out", "run", "--resume", "-ts_max_steps", "2"], tmp_path, ranks=2)
    text = "changed since the run was begun: obstacles.tray.mesh.frames: other frames from number 3 (t = "
    assert text + "0.075 s) on" in " ".join(result.err.split())
    assert "handles[0].frames" not in result.err
    kept = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    write_frames(tmp_path, lifted=0.02, after=1)  # into the sheet
    refusal(lyra(["run", scene, "--out", "run", "--resume"], tmp_path), "obstacles.tray")
    (tmp_path / "pins.npz").unlink()
    refused(["run", scene, "--out", "run", "--resume"], tmp_path, "pins.npz")
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == kept


def test_the_body_is_exported_and_drawn_where_its_frames_are(tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    write_frames(tmp_path)
    scene = write_scene(tmp_path, SCENE + "time: {end: 0.05, step: 0.01}\n")
    done(["run", scene, "--out", "run"], tmp_path)
    done(["export", "run", "--to", "npz", "--out", "out"], tmp_path)
    with np.load(next((tmp_path / "out").glob("*.npz"))) as exported, np.load(tmp_path / "walk.npz") as walk:
        np.testing.assert_allclose(exported["obstacle_tray"][-1], walk["position"][2], atol=1e-12)
        np.testing.assert_array_equal(exported["triangles_of_tray"], BOX_TRIANGLES)
    done(["render", "run", "--at", "0,0.05", "--size", "160x120"], tmp_path)
    assert (tmp_path / "run" / "picture-0.05.png").exists()
    (tmp_path / "walk.npz").unlink()
    refused(["render", "run", "--at", "0", "--size", "160x120"], tmp_path, "walk.npz")


def test_the_cloth_of_a_run_is_the_body_of_another(tmp_path: Path) -> None:
    """By export --to npz and obj, as frames of a body and, from the whole mesh, of a handle."""
    one = SCENE[: SCENE.index("contact")] + "time: {end: 0.03, step: 0.01}\noutput: {every: 0.01}\n"
    done(["run", write_scene(tmp_path, one), "--out", "one"], tmp_path)
    done(["export", "one", "--to", "npz"], tmp_path)
    done(["export", "one", "--to", "obj"], tmp_path)
    body = "{mesh: {file: one/obj/one_0000.obj, frames: one/npz/one.npz}, interpolation: linear}"
    sheet = SCENE[: SCENE.index("contact")].replace("0.004]", "0.02]")
    other = sheet + "contact: {gap: 0.005}\n" + f"obstacles:\n  below: {body}\n"
    other += "handles: [{group: left, frames: one/npz/one.npz, interpolation: linear}]\n"
    (tmp_path / "two.yaml").write_text(other + "time: {end: 0.03, step: 0.01}\noutput: {every: 0.01}\n")
    done(["run", "two.yaml", "--out", "two"], tmp_path, ranks=2)
    first, second = (lyra_petsc.Run(tmp_path / name) for name in ("one", "two"))
    moved = [run.positions[-1][::7] - run.positions[0][::7] for run in (first, second)]
    assert np.abs(moved[0]).max() > 2e-3
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-9)


def test_a_body_that_gets_frames_is_shown_where_it_was(tmp_path: Path) -> None:
    write_frames(tmp_path)
    down = CORNERS - 0.1 * TIMES[:, None, None]
    np.savez(tmp_path / "walk.npz", time=TIMES, position=down)
    aside = "motion: [{time: 0}, {time: 0.1, translate: [0.01, 0, 0]}]"
    keyed = SCENE.replace("tray.obj, frames: walk.npz, repeat: true}", f"tray.obj}}, {aside}")
    end = "time: {end: 0.05, step: 0.01}\n"
    done(["run", write_scene(tmp_path, keyed + end), "--out", "run", "-ts_max_steps", "2"], tmp_path)
    done(["run", write_scene(tmp_path, SCENE + end), "--out", "run", "--resume"], tmp_path)
    run = lyra_petsc.Run(tmp_path / "run")
    (tray,) = run_obstacles(run)
    np.testing.assert_allclose(tray.positions(0.01), CORNERS + [1e-3, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(tray.positions(0.05), down[2], atol=1e-12)


def test_usd_is_imported_while_no_other_thread_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """USD's libraries give up Python's lock while they are loaded: two threads that import wait for ever."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "pins.usda"))
    points = UsdGeom.Mesh.Define(stage, "/pins").CreatePointsAttr()
    for code in (0.0, 2.4):
        points.Set(Vt.Vec3fArray.FromNumpy(np.full((3, 3), 0.01 * code, dtype=np.float32)), code)
    stage.GetRootLayer().Save()
    started: list[str] = []
    at_import: list[list[str]] = []
    start, open_usd = threading.Thread.start, UsdFrames.__init__

    def noted(thread: threading.Thread) -> None:
        started.append(thread.name)
        start(thread)

    def opened(frames: UsdFrames, file: Path) -> None:
        at_import.append(list(started))
        open_usd(frames, file)

    monkeypatch.setattr(threading.Thread, "start", noted)
    monkeypatch.setattr(UsdFrames, "__init__", opened)
    scene: dict[str, Any] = {
        "mesh": {"grid": {"width": 0.2, "height": 0.2, "nx": 2, "ny": 2}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"group": "left", "frames": str(tmp_path / "pins.usda"), "interpolation": "linear"}],
        "time": {"end": 0.05, "step": 0.01},
        "output": {"every": 0.05},
    }
    run = lyra_petsc.run(scene, tmp_path / "run")
    assert at_import
    assert not any(at_import)
    moved = np.asarray(run.positions[-1] - run.positions[0])[[0, 3, 6]]
    assert np.allclose(moved, 0.012, atol=1e-8)
