"""Two runs in one folder: the second is always refused."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from launch import UNHURRIED, done, finish, lyra, start, wait_until, write_scene
from leftovers import ENDLESS, SHEET, announced, wait_for_states
from patience import Patience

from lyra_petsc.output.read_run import stored_states

SLOW_SET_UP = """
import sys, time
from pathlib import Path
import lyra_petsc.stepping.problem as problem
from lyra_petsc.cli.app import run_command_line

build = problem.build_scene_mesh

def slow(*arguments, **keywords):
    Path("in-set-up").touch()
    while not Path("go-on").exists():
        time.sleep(0.01)
    return build(*arguments, **keywords)

problem.build_scene_mesh = slow
sys.exit(run_command_line(sys.argv))
"""


def test_a_second_run_is_refused_while_the_first_steps(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, ENDLESS)
    first = start(["run", scene, "--out", "out"], tmp_path, 2, program=("-c", UNHURRIED))
    wait_for_states(tmp_path / "out", 3)
    for words, ranks in ((["--force"], 1), (["--resume"], 2), ([], 1)):
        left = lyra(["run", scene, "--out", "out", *words], tmp_path, ranks)
        assert left.code == 2, left.err
        (line,) = left.ours
        assert "another run is at work in this folder (process " in line or not words
    before = len(stored_states(tmp_path / "out"))
    wait_for_states(tmp_path / "out", before + 2)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    patience = Patience(20.0)
    while True:  # until the ranks are gone, and with them the lock
        left = lyra(["run", scene, "--out", "out", "--resume", "--set", "time.end=0.01"], tmp_path)
        if left.code == 0:
            break
        assert "another run is at work" in left.err
        assert not patience.over
    assert not (tmp_path / "out/run.lock").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_second_run_is_refused_while_the_first_sets_up(tmp_path: Path, number: int) -> None:
    program = tmp_path / "slow.py"
    program.write_text(SLOW_SET_UP)
    scene = write_scene(tmp_path, SHEET % 0.02)
    first = start(["run", scene, "--out", "deep/out"], tmp_path, program=(str(program),))
    wait_until((tmp_path / "in-set-up").exists)
    for words in ([], ["--force"]):
        left = lyra(["run", scene, "--out", "deep/out", *words], tmp_path)
        assert left.code == 2
        (line,) = left.ours
        assert f"another run is at work in this folder (process {first.pid} on " in line
    first.send_signal(number)
    (tmp_path / "go-on").touch()
    left = finish(first)
    if number == signal.SIGTERM:
        assert left.code == 143
        assert "during the set-up; nothing was written" in left.ours[0]
        assert not (tmp_path / "deep").exists()
    done(["run", scene, "--out", "deep/out"], tmp_path)
    assert announced(tmp_path / "deep/out") == [0.0, 0.02]
    assert not (tmp_path / "deep/out/run.lock").exists()


def test_bad_input_found_in_the_set_up_leaves_no_folder(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, ENDLESS.replace("nodes: [0, 4]", "nodes: [0, 400]"))
    left = lyra(["run", scene], tmp_path)
    assert left.code == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.yaml"]
