"""Reading, overriding and writing scenes."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.scene.load import dump_scene, load_scene
from lyra_petsc.scene.schema import Scene

FULL = """
title: "Flag: in a side wind, été"
mesh:
  - file: meshes/a.obj
    transform: {scale: [1, 2, 3], rotate: {axis: [0, 1, 0], degrees: 45}, translate: [0, 0, 1e-3]}
    name: front
  - {grid: {width: 1.0, height: 2, nx: 3, ny: 4, pattern: criss-cross}}
material:
  - {cloth: gray-interlock, damping: 0.03, warp_degrees: 30, rest_curvature: [1, 0, 0]}
  - group: front
    density: 0.187
    membrane: {c11: 120, c22: 120, c12: 40, c33: 30}
    bending: [1e-5, 2e-5, 3e-5]
  - {group: 7, young: 2.0e+9, poisson: 0.3, thickness: 1e-4, density: 0.1, thicken: 2}
gravity: [0, 0, -9.81]
wind: {velocity: [0, 3, 0], density: 1.2}
handles:
  - {group: pole}
  - {nodes: [2, 3], from: 1, until: 7, fade: 0.5, motion: swing, interpolation: linear}
  - {box: [[-1, -1, -1], [0, 1, 1]], axes: [z, x], stiffness: 1000}
motions:
  swing: [{time: 1}, {time: 2, rotate: {axis: [0, 0, 1], degrees: -45}, velocity: [1, 0, 0]}]
loads: [{group: tip, force: [0, 0, -1]}, {pressure: 10, until: 1}, {traction: [1, 0, 0], group: front}]
initial: {velocity: [0, 0, 1], noise: 1e-4, seed: 3}
time: {end: 4.0, step: 0.005, integrator: semi-implicit}
output: {every: null, fields: [velocity, stress], checkpoint: {seconds: 5}, reactions: true}
probes: {tip: {group: tip}}
solver: {force_tolerance: 1e-6, hessian: exact}
petsc: {ksp_type: cg, ksp_rtol: 1e-9, ksp_monitor: , mat_view: "::ascii_info", flag: true, n: 3}
"""

SMALL = """
mesh: {grid: {width: 1, height: 1, nx: 2, ny: 2}}
material: {cloth: paper}
time: {end: 1, step: 1e-2}
handles: [{group: left}, {group: right, from: 0.5}]
"""


@pytest.fixture
def full(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.obj").write_text("v 0 0 0\n")
    path = tmp_path / "full.yaml"
    path.write_text(FULL, encoding="utf-8")
    return path


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


def test_values_and_defaults(full: Path, small: Path) -> None:
    scene = load_scene(full)
    assert scene.source == full
    assert scene.mesh[0].file == full.parent / "meshes" / "a.obj"
    assert scene.mesh[0].transform.scale == (1.0, 2.0, 3.0)
    assert scene.mesh[1].transform.scale == 1.0
    assert scene.material[2].group == "7"
    assert scene.handles[0].start == 0.0
    assert scene.handles[0].until == math.inf
    assert scene.handles[0].axis_numbers == (0, 1, 2)
    assert scene.handles[1].start == 1.0
    assert scene.handles[2].axes == ("x", "z")
    assert scene.handles[2].axis_numbers == (0, 2)
    assert scene.output.every is None
    assert scene.petsc == {
        "ksp_type": "cg", "ksp_rtol": 1e-9, "ksp_monitor": None, "mat_view": "::ascii_info", "flag": True,
        "n": 3,
    }  # fmt: skip
    plain = load_scene(small)
    assert plain.gravity is None
    assert plain.wind is None
    assert plain.initial is None
    assert plain.output.every == 0.04
    assert plain.output.fields == []
    assert plain.output.checkpoint.seconds == 60.0
    assert plain.time.step == 0.01
    assert plain.time.integrator == "beuler"
    assert plain.solver.max_iterations == 50


def test_a_written_scene_loads_as_the_same_scene(full: Path, small: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "deep" / "er"
    elsewhere.mkdir(parents=True)
    for path in (full, small):
        scene = load_scene(path)
        text = dump_scene(scene)
        copy = elsewhere / "scene.yaml"
        copy.write_text(text, encoding="utf-8")
        again = load_scene(copy)
        assert again == scene
        assert dump_scene(again) == text
        assert pickle.loads(pickle.dumps(scene)) == scene
    assert load_scene(full) != load_scene(small)


def test_a_written_scene_has_defaults_and_no_internals(small: Path) -> None:
    text = dump_scene(load_scene(small))
    for line in (
        "integrator: beuler",
        "every: 0.04",
        "damping: 0.0",
        "force_tolerance: 1.0e-06",
        "from: 0.5",
    ):
        assert line in text
    for word in ("inf", "start", "source", "!!", "null"):
        assert word not in text


@pytest.mark.parametrize(
    "text", ["a: b", "- x", "2024-01-01", "yes", "1e5", "~", "'\"", "ß\n#", "\u2028x", " "]
)
def test_a_written_scene_quotes_text_that_yaml_would_misread(small: Path, tmp_path: Path, text: str) -> None:
    scene = Scene.model_validate(
        {**load_scene(small).model_dump(by_alias=True, exclude_none=True), "title": text}
    )
    path = tmp_path / "dumped.yaml"
    path.write_text(dump_scene(scene), encoding="utf-8")
    assert load_scene(path).title == text


OVERRIDES = [
    ("time.end=2", lambda s: s.time.end == 2.0),
    ("time.step=1e-3", lambda s: s.time.step == 1e-3),
    ("handles.0.until=2", lambda s: s.handles[0].until == 2.0),
    ("handles[0].until=2", lambda s: s.handles[0].until == 2.0),
    ("handles[2].group=top", lambda s: [h.group for h in s.handles] == ["left", "right", "top"]),
    ("handles[2]={nodes: [1], axes: [z]}", lambda s: s.handles[2].axis_numbers == (2,)),
    ("handles=", lambda s: s.handles == []),
    ("material.damping=0.5", lambda s: s.material[0].damping == 0.5),
    ("material[0].damping=0.5", lambda s: s.material[0].damping == 0.5),
    ("material.0.damping=0.5", lambda s: s.material[0].damping == 0.5),
    ("material[1]={group: x, cloth: isotropic}", lambda s: s.material[1].cloth == "isotropic"),
    ("mesh.grid.nx=9", lambda s: s.mesh[0].grid.nx == 9),
    ("gravity=[0, 0, -1]", lambda s: s.gravity == (0.0, 0.0, -1.0)),
    ("wind={velocity: [1, 0, 0], density: 1}", lambda s: s.wind.velocity == (1.0, 0.0, 0.0)),
    ("output.checkpoint.seconds=5", lambda s: s.output.checkpoint.seconds == 5.0),
    ("output.every=null", lambda s: s.output.every is None),
    ("output.fields=[stress]", lambda s: s.output.fields == ["stress"]),
    ("petsc.ksp_type=cg", lambda s: s.petsc == {"ksp_type": "cg"}),
    ("petsc.ksp_monitor=", lambda s: s.petsc == {"ksp_monitor": None}),
    ("probes.tip.box=[[0, 0, 0], [1, 1, 1]]", lambda s: s.probes["tip"].box[1] == (1.0, 1.0, 1.0)),
    ("title=a=b", lambda s: s.title == "a=b"),
    (" time.end = 3 ", lambda s: s.time.end == 3.0),
]


@pytest.mark.parametrize(("text", "holds"), OVERRIDES, ids=[case[0] for case in OVERRIDES])
def test_overrides(small: Path, text: str, holds: Callable[[Scene], bool]) -> None:
    assert not found(holds, load_scene(small))
    assert found(holds, load_scene(small, [text]))


def found(holds: Callable[[Scene], bool], scene: Scene) -> bool:
    try:
        return holds(scene)
    except (AttributeError, LookupError):
        return False


def test_the_last_override_wins_and_anchors_are_independent(small: Path) -> None:
    assert load_scene(small, ["time.end=2", "time.end=3"]).time.end == 3.0
    small.write_text(SMALL.replace("[{group: left}, {group: right, from: 0.5}]", "[&h {group: left}, *h]"))
    scene = load_scene(small, ["handles[0].until=2"])
    assert [handle.until for handle in scene.handles] == [2.0, math.inf]


BAD_OVERRIDES = [
    ("time.end", "--set time.end", "key.path=value"),
    ("=3", "--set =3", "key.path=value"),
    ("time..end=3", "--set time..end=3", "handles[0].until=2"),
    ("time.end=[", "--set time.end=[", "line 1"),
    ("time.end.x=3", "--set time.end.x=3", "time.end holds a single value"),
    ("handles.until=3", "--set handles.until=3", "give an index, [0] to [2]"),
    ("handles[7].until=3", "--set handles[7].until=3", "give an index, [0] to [2]"),
    (f"handles.{'9' * 5000}=3", f"--set handles.{'9' * 49}...", "give an index, [0] to [2]"),
    ("tiem.end=3", "tiem", "did you mean 'time'"),
    ("time.end=-3", "time.end", "must be > 0, not -3 (from --set)"),
    ("material.cloth=papre", "material.cloth", "did you mean 'paper'? (from --set)"),
    ("material[1].cloth=paper", "material[1].group", "second material"),
]


@pytest.mark.parametrize(("text", "key", "message"), BAD_OVERRIDES, ids=[case[0] for case in BAD_OVERRIDES])
def test_bad_overrides_are_refused(small: Path, text: str, key: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scene(small, [text])
    assert caught.value.key == key
    assert message in caught.value.message


def test_mesh_given_on_the_command_line(
    small: Path, full: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (here / "mine.obj").write_text("v 0 0 0\n")
    monkeypatch.chdir(here)
    both = ["mesh.grid=", "mesh.file=mine.obj"]
    assert load_scene(small, both).mesh[0].file == here / "mine.obj"
    assert load_scene(small, ["mesh={file: mine.obj}"]).mesh[0].file == here / "mine.obj"
    # in the scene's folder, if it is not in the working directory
    assert load_scene(small, ["mesh={file: meshes/a.obj}"]).mesh[0].file == tmp_path / "meshes" / "a.obj"
    with pytest.raises(InputError, match="no such file"):
        load_scene(small, ["mesh={file: nowhere.obj}"])


def test_json_scenes_and_byte_order_marks(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text(
        '\ufeff{"mesh": {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}}, // one\n'
        '"material": {"cloth": "paper",}, "time": {"end": 1, "step": 0.1}}',
        encoding="utf-8",
    )
    assert load_scene(path).mesh[0].grid is not None
