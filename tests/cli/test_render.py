"""The command ``render``: messages, files, exit codes."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from launch import SCENE, done, lyra, start, write_scene
from patience import communicate
from written_run import Writer, written

from lyra_petsc.errors import InputError
from lyra_petsc.show.render.paraview_script import write_script
from lyra_petsc.show.render.render_plan import RenderOptions, make_plan

MISTAKES = [
    ({"at": "5"}, "--at: 5 s is outside the run, whose states go from 0 to 0.2 s"),
    ({"at": "a,b"}, "--at: must be numbers with commas between them"),
    ({"at": "nan"}, "--at: must be numbers"),
    ({"at": ","}, "--at: must be numbers"),
    ({"film": Path("film.avi")}, "--film: a film's name ends in .mp4, .webm, .gif, not 'film.avi'"),
    ({"film": Path("nowhere/film.mp4")}, "--film: there is no folder nowhere"),
    ({"film": Path("film.mp4"), "size": "161x120"}, "--size: 161x120: films need even numbers"),
    ({"size": "31x31"}, "--size: must be WIDTHxHEIGHT"),
    ({"size": "1280"}, "--size: must be WIDTHxHEIGHT"),
    ({"size": "99999x99999"}, "--size: must be WIDTHxHEIGHT"),
    ({"fps": float("nan")}, "--fps: must be from 0.1 to 240"),
    ({"speed": 0.0}, "--speed: must be > 0"),
    ({"speed": float("inf")}, "--speed: must be > 0"),
    ({"film": Path("film.mp4"), "speed": 1e-9}, "--film: .* more than 20000; give a larger --speed"),
    ({"field": "strian"}, "--field: no field 'strian', did you mean 'strain'"),
    ({"field": "speed", "texture": Path("a.png")}, "--field: covers what --texture shows"),
    ({"texture": Path("a.png")}, "a.png: --texture: cannot be read: No such file"),
    ({"texture": Path("text.png")}, "text.png: --texture: is not a picture"),
    ({"range": "0,1"}, "--range: is the range of what --field shows"),
    ({"field": "speed", "range": "1,0"}, "--range: must be two"),
    ({"field": "speed", "range": "1"}, "--range: must be two"),
    ({"colors": "red"}, "--colors: must be two colours"),
    ({"colors": "red,nocolour"}, "--colors: must be two colours"),
    ({"handles": True}, "--handles: this run's scene has no handles"),
    ({"wind": True}, "--wind: this run's scene has no wind"),
    ({"out": Path("text.png")}, "--out: cannot be made"),
    ({"settings": ("time.end=3",)}, "--set: 'time.end=3': the run is done, only render"),
    ({"settings": ("render.camera.angel=3",)}, "render.camera.angel: unknown key, did you mean 'angle'"),
    ({"settings": ("render.camera.angle=0",)}, "render.camera.angle: must be from 1 to 120 degrees, not 0"),
    ({"run": Path("nowhere")}, "nowhere: no such folder"),
    ({"run": Path("text.png")}, "text.png: is a file"),
]


@pytest.mark.parametrize(("options", "words"), MISTAKES, ids=[words[:40] for _, words in MISTAKES])
def test_bad_input_is_one_line_without_files(options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "run")
    (tmp_path / "text.png").write_text("no picture")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=words) as caught:
        make_plan(RenderOptions(**{"run": Path("run"), **options}))
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_scene_with_a_camera_runs_and_is_drawn(tmp_path):
    """The scene's camera is used; without it the picture differs."""
    camera = "render: {camera: {position: [0.5, -3, 0], target: [0.5, 0.5, 0], angle: 30}}\n"
    write_scene(tmp_path, SCENE + camera)
    left = done(["run", "scene.yaml", "--out", "run"], tmp_path)
    left = done(["render", "run", "--at", "0.05", "--size", "160x120"], tmp_path)
    assert left.out == "picture  run/picture-0.05.png\n"
    done(
        ["render", "run", "--at", "0.05", "--size", "160x120", "--out", "other", "--set", "render="], tmp_path
    )
    pictures = [(tmp_path / folder / "picture-0.05.png").read_bytes() for folder in ("run", "other")]
    assert pictures[0] != pictures[1]


@pytest.mark.slow
def test_two_ranks_make_a_film_and_refuse_with_one_line(tmp_path):
    written(tmp_path / "run", states=4)
    left = done(
        ["render", "run", "--film", "film.mp4", "--size", "160x120", "--fps", "10"], tmp_path, ranks=2
    )
    assert left.out == "film     film.mp4  (0.4 s, 4 frames, 10 a second)\n"
    left = lyra(["render", "run", "--at", "9"], tmp_path, ranks=2)
    assert left.code == 2
    assert left.ours == ["lyra-petsc: --at: 9 s is outside the run, whose states go from 0 to 0.3 s"]


def test_a_signal_ends_a_film_without_files(tmp_path):
    written(tmp_path / "run", states=200)
    process = start(["render", "run", "--film", "film.mp4"], tmp_path)
    part = tmp_path / ".film.part.mp4"
    while process.poll() is None and not part.exists():
        pass
    process.terminate()
    _, err = communicate(process)
    assert process.returncode == 143, err
    assert "stopped by SIGTERM after" in err
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_unfinished_run_is_drawn_up_to_its_newest_state(tmp_path):
    writer = Writer(tmp_path / "run")
    for _ in range(3):
        writer.write()
    plan = make_plan(RenderOptions(tmp_path / "run"))
    assert plan.states == [0, 1, 2]
    writer.write()
    assert make_plan(RenderOptions(tmp_path / "run")).states == [0, 1, 2, 3]


@pytest.mark.parametrize("fields", [True, False])
def test_the_script_for_paraview_is_valid_and_names_existing_files(tmp_path, fields, monkeypatch):
    path = write_script(written(tmp_path / "run with 'quotes'", fields=fields))
    text = path.read_text(encoding="utf-8")
    tree = compile(text, str(path), "exec")
    simple = MagicMock()  # replaces ParaView's functions
    simple.GenerateSurfaceNormals().PointData = simple.SurfaceNormals().PointData = {"velocity": None}
    monkeypatch.setitem(sys.modules, "paraview", SimpleNamespace(simple=simple))
    exec(tree, {"__file__": str(path)})
    assert simple.Xdmf3ReaderS.call_args.kwargs["FileName"] == [str(path.parent / "states.xdmf")]
    colour = simple.ColorBy.call_args.args[1]
    assert colour == (("POINTS", "velocity", "Magnitude") if fields else None)
    assert simple.Calculator.call_args.kwargs["registrationName"] == "displacement"
