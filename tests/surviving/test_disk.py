"""Full disks, limits, removed folders: one clear line, exit code 3, and listed states stay readable."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from launch import DIRECT, Left, done, finish, lyra, start, write_scene
from leftovers import ENDLESS, SHEET, announced, ranks_in, steps, wait_for_states

LIMITED = """
import resource, sys
import lyra_petsc.output.recorder as recorder
from lyra_petsc.cli.app import run_command_line
from lyra_petsc.output.history import History

def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

def limit_states(recorder, folder):
    begin(recorder, folder)
    limit(20_000)

def limit_rows(history, values):
    size = history.path.stat().st_size
    if size > 68_000 and history.path.name == "history.csv":
        limit(size + 50)
    append(history, values)

begin, append = recorder.Recorder.begin, History.append
if {in_a_row}:
    History.append = limit_rows
else:
    recorder.Recorder.begin = limit_states
sys.exit(run_command_line(sys.argv))
"""


def refused(left: Left, words: str) -> None:
    """Check exit code 3, one line of the program with these words, and no traceback."""
    assert left.code == 3, left.err
    (line,) = left.ours
    assert words in line
    assert "Traceback" not in left.err


def goes_on(scene: Path, out: Path, folder: Path, ranks: int = 1) -> None:
    """Check that the run resumes after its last complete state, without gap or duplicate."""
    before = announced(out)
    end = before[-1] + 0.1
    done(["run", scene, "--out", out, "--resume", "--set", f"time.end={end:.3f}"], folder, ranks)
    after = announced(out)
    assert after[: len(before)] == before
    assert after == pytest.approx([0.02 * k for k in range(len(after))])
    assert steps(out) == list(range(4 * (len(after) - 1) + 1))
    assert not [entry.name for entry in out.iterdir() if entry.suffix in (".part", ".lock")]


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_full_disk(tmp_path: Path, small_disk: Path, ranks: int) -> None:
    scene = write_scene(tmp_path, ENDLESS)
    left = lyra(["run", scene, "--out", "disk/out"], tmp_path, ranks)
    refused(left, "cannot be written: No space left on device")
    assert "--resume goes on" in left.err
    assert not ranks_in(tmp_path)
    assert len(announced(small_disk / "out")) > 1
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    goes_on(scene, small_disk / "out", tmp_path, ranks)


def test_a_disk_full_from_the_start(tmp_path: Path, small_disk: Path) -> None:
    (small_disk / "filler").write_bytes(bytes(250_000))
    left = lyra(["run", write_scene(tmp_path, ENDLESS), "--out", "disk/out"], tmp_path)
    refused(left, "No space left on device")
    (small_disk / "filler").unlink()
    done(["run", write_scene(tmp_path, SHEET % 0.02), "--out", "disk/out", "--force"], tmp_path)
    assert announced(small_disk / "out") == [0.0, 0.02]


@pytest.mark.parametrize("in_a_row", [False, True])
def test_a_limit_on_the_size_of_files(tmp_path: Path, in_a_row: bool) -> None:
    """It is reached in a state, or within a row of the history."""
    program = tmp_path / "limited.py"
    program.write_text(LIMITED.format(in_a_row=in_a_row))
    scene = write_scene(tmp_path, ENDLESS)
    every = ["--set", "output.every=0.5"] if in_a_row else []
    left = lyra(["run", scene, "--out", "out", *every, *DIRECT], tmp_path, program=(str(program),))
    refused(left, "cannot be written: File too large")
    if in_a_row:
        assert "history.csv" in left.ours[0]
        assert not (tmp_path / "out/history.csv").read_text().endswith("\n")
        last = announced(tmp_path / "out")[-1]
        more = ["--set", "output.every=0.5", "--set", f"time.end={last + 0.5}"]
        done(["run", scene, "--out", "out", "--resume", *more, *DIRECT], tmp_path)
        assert steps(tmp_path / "out") == list(range(round((last + 0.5) / 0.005) + 1))
    else:
        goes_on(scene, tmp_path / "out", tmp_path)


@pytest.mark.parametrize("ranks", [1, 2])
def test_the_folder_is_removed(tmp_path: Path, ranks: int) -> None:
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, ranks)
    wait_for_states(tmp_path / "out", 4)
    (tmp_path / "out").rename(tmp_path / "elsewhere")
    left = finish(process)
    refused(left, "cannot be written: No such file or directory")
    assert "is gone" in left.err
    assert not ranks_in(tmp_path)
    assert len(announced(tmp_path / "elsewhere")) >= 3
    done(["run", "--out", "elsewhere", "--resume", "-ts_max_steps", "1"], tmp_path)


def test_a_folder_that_becomes_read_only(tmp_path: Path, small_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,size=50m", str(small_disk)], check=True)
    scene = write_scene(tmp_path, ENDLESS)
    done(["run", scene, "--out", "disk/out", "-ts_max_steps", "8"], tmp_path)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for words in (["--out", "disk/out", "--resume"], ["--out", "disk/out", "--force"], ["--out", "disk/new"]):
        left = lyra(["run", scene, *words], tmp_path)
        assert left.code == 2, left.err
        (line,) = left.ours
        assert "Read-only file system" in line or "no permission to write" in line
    assert len(announced(small_disk / "out")) == 3
    subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)
    goes_on(scene, small_disk / "out", tmp_path)
