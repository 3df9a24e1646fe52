"""The command ``export``: choice of states, folders, full disks."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from written_run import position, written, written_with_obstacles

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.show.export import FORMATS, export_run


def states(folder):
    """Numbers of the states in the files of an OBJ sequence, by their positions."""
    found = []
    for file in sorted(folder.glob("*.obj")):
        lines = file.read_text().splitlines()
        points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)
        found.append(next(i for i in range(20) if np.array_equal(points, position(i))))
    return found


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, [0, 1, 2, 3, 4]),
        ({"every": 2}, [0, 2, 4]),
        ({"every": 99}, [0]),
        ({"times": "0.39"}, [4]),
        ({"times": "0.2, 0.11,0.2"}, [1, 2]),
    ],
)
def test_choice_of_states(tmp_path, chosen, expected):
    done = export_run(written(tmp_path / "run", states=5), "obj", **chosen)
    assert states(done.folder) == expected
    assert done.states == len(expected)


def test_times_of_a_sequence_are_in_a_table(tmp_path):
    done = export_run(written(tmp_path / "run", states=4), "obj", times="0.1,0.3")
    expected = "file,state,time\n0,1,0.1\n1,3,0.30000000000000004\n"
    assert (done.folder / "times.csv").read_text() == expected


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"to": "fbx"}, r"--to: unknown format 'fbx', (known|did you)"),
        ({"times": "1.5"}, r"--times: 1\.5 s is outside the run, whose states go from 0 to 0\.2 s"),
        ({"times": "nan"}, r"--times: must be numbers with commas"),
        ({"times": "a"}, r"--times: must be numbers"),
        ({"every": 0}, r"--every: must be at least 1"),
        ({"every": 1, "times": "0"}, r"--every: choose states either by"),
    ],
)
def test_mistakes_leave_no_files(tmp_path, asked, words):
    folder = written(tmp_path / "run")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=words):
        export_run(folder, **{"to": "obj", **asked})
    assert sorted(tmp_path.rglob("*")) == before


def test_a_missing_extra_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(FORMATS, "usd", replace(FORMATS["usd"], packages=("no_such_package",)))
    with pytest.raises(InputError, match=r"no_such_package is not installed; .*lyra-petsc\[export\]'"):
        export_run(written(tmp_path / "run"), "usd")


def test_an_existing_folder_is_replaced_with_force_only(tmp_path):
    run, out = written(tmp_path / "run", states=5), tmp_path / "a" / "b"
    export_run(run, "obj", out)
    with pytest.raises(InputError, match=r"b: --out: exists; name another folder, or give --force"):
        export_run(run, "obj", out, every=2)
    export_run(run, "obj", out, every=2, force=True)
    assert states(out) == [0, 2, 4]
    (out / "mine.txt").touch()
    with pytest.raises(InputError, match=r"holds 'mine\.txt', which no export wrote"):
        export_run(run, "obj", out, force=True)
    with pytest.raises(InputError, match="which no export wrote"):  # not the run itself
        export_run(run, "obj", run, force=True)
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "x"):
        with pytest.raises(InputError, match="is a file"):
            export_run(run, "obj", place, force=True)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "file", "run"]


def test_a_failure_keeps_the_existing_folder(tmp_path, monkeypatch):
    run, out = written(tmp_path / "run"), tmp_path / "out"
    export_run(run, "obj", out)

    form = FORMATS["obj"]

    def fails(states, folder, name):
        form.write(states, folder, name)
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(FORMATS, "obj", replace(form, write=fails))
    with pytest.raises(OutputError, match=r"out: cannot be written: No space left on device"):
        export_run(run, "obj", out, force=True, every=2)
    assert states(out) == [0, 1, 2]
    with pytest.raises(OutputError):
        export_run(run, "obj", tmp_path / "new" / "folder")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["out", "run"]


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_a_full_disk(tmp_path, small_disk, to):
    subprocess.run(["mount", "-o", "remount,size=8k", str(small_disk)], check=True)
    run = written(tmp_path / "run", states=30)
    with pytest.raises(OutputError, match="cannot be written"):
        export_run(run, to, small_disk / "out")
    assert list(small_disk.iterdir()) == []


def test_obstacles_are_imported_for_scenes_with_obstacles_only(tmp_path):
    """For setting up a scene and for exporting its run."""
    code = """
import sys
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.show.export import export_run
from lyra_petsc.output.read_run import StoredRun
import lyra_petsc.show.render.draw
build_scene_mesh(StoredRun(sys.argv[1]).scene)
export_run(sys.argv[1], "obj")
print("lyra_petsc.mesh.obstacles" in sys.modules)
"""
    ball = {"ball": {"sphere": {"center": [0, 0, 0], "radius": 1}}}
    for run, expected in (
        (written(tmp_path / "without"), "False"),
        (written_with_obstacles(tmp_path / "with", obstacles=ball), "True"),
    ):
        done = subprocess.run([sys.executable, "-c", code, run], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected
