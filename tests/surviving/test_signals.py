"""Signals at any moment: no traceback, the right exit code, and a checkpoint once there are steps."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from launch import DIRECT, command, done, environment, finish, read_json, start, wait_until, write_scene
from leftovers import ENDLESS, announced, ranks_in, steps, wait_for_states

from lyra_petsc.output.stored import import_h5py

SLOW_STEPS = """
import os, sys, time
from pathlib import Path
from types import SimpleNamespace
import lyra_petsc.output.recorder as recorder
import lyra_petsc.stepping.simulation as simulation
from lyra_petsc.cli.app import run_command_line

step = simulation.SteppedScene.step
taken = 0

def slow(self):
    global taken
    taken += 1
    if taken == 6:  # takes half a minute by the clock that says when a checkpoint is due
        recorder.clock = SimpleNamespace(monotonic=lambda: time.monotonic() + 30.0)
    if taken == 7:
        Path("in-step").touch()
        time.sleep({seconds})
    return step(self)

simulation.SteppedScene.step = slow
sys.exit(run_command_line(sys.argv))
"""

CODES = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGUSR1, 143), (signal.SIGHUP, 143)]


@pytest.mark.parametrize(
    ("seconds", "number", "code"),
    [(seconds, *CODES[0]) for seconds in (0.1, 0.3, 0.6, 0.9)] + [(0.3, *each) for each in CODES[1:]],
)
def test_signals_during_the_start(tmp_path: Path, seconds: float, number: signal.Signals, code: int) -> None:
    """During imports, MPI, set-up or first steps, depending on the machine."""
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path)
    time.sleep(seconds)
    # the program cannot handle signals before its first line
    wait_until(lambda: any("lyra_petsc" in line for line in maps(process.pid)), patience=20.0)
    process.send_signal(number)
    left = finish(process)
    assert left.code == code, left.err
    assert "Traceback" not in left.err
    assert "internal error" not in left.err
    if (tmp_path / "out").exists():
        assert announced(tmp_path / "out")
        done(["run", "--out", "out", "--resume", "--set", "time.end=0.02"], tmp_path)
        assert steps(tmp_path / "out") == list(range(len(steps(tmp_path / "out"))))


def test_a_signal_that_the_launcher_has_blocked_ends_the_program_at_its_first_line(tmp_path: Path) -> None:
    """As scripts/lyra.sh does, since Python would end with another code before it."""
    program = command(["run", write_scene(tmp_path, ENDLESS)])
    process = subprocess.Popen(
        ["bash", "-c", 'kill -USR1 $$; exec "$@"', "bash", *program],
        cwd=tmp_path,
        env=environment(),
        preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1]),
    )
    assert process.wait(60) == 143
    assert not (tmp_path / "runs").exists()


def maps(pid: int) -> list[str]:
    """Check that the program's handlers are installed: the process catches SIGUSR1."""
    with open(f"/proc/{pid}/status", encoding="utf-8") as file:
        caught = next(int(line.split()[1], 16) for line in file if line.startswith("SigCgt"))
    return ["lyra_petsc"] if caught >> (signal.SIGUSR1 - 1) & 1 else []


@pytest.mark.parametrize(("number", "code", "ranks"), [(*CODES[0], 3), (*CODES[2], 2)])
def test_one_rank_that_gets_a_signal_has_all_finish_the_step(
    tmp_path: Path, number: signal.Signals, code: int, ranks: int
) -> None:
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, ranks)
    wait_for_states(tmp_path / "out", 3)
    os.kill(ranks_in(tmp_path)[-1], number)
    left = finish(process)
    assert left.code == code, left.err
    (line,) = left.ours
    assert f"stopped by {number.name} after step {steps(tmp_path / 'out')[-1]} " in line
    assert announced(tmp_path / "out")
    assert not ranks_in(tmp_path)
    done(["run", "--out", "out", "--resume", "-ts_max_steps", "1"], tmp_path, 2)
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["resumed"][-1]["step"] == summary["steps"]
    assert summary["resumed"][-1]["ranks"] == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_mpirun_kills_after_a_second_and_no_listed_state_is_lost(
    tmp_path: Path, number: signal.Signals
) -> None:
    scene = write_scene(tmp_path, ENDLESS)
    process = start(["run", scene, "--out", "out"], tmp_path, 2)
    wait_for_states(tmp_path / "out", 5)
    process.send_signal(number)
    left = finish(process)
    assert "Traceback" not in left.err
    wait_until(lambda: not ranks_in(tmp_path), patience=20)
    before = announced(tmp_path / "out")
    assert len(before) >= 4
    done(["run", scene, "--out", "out", "--resume", "--set", f"time.end={before[-1] + 0.1:.3f}"], tmp_path, 2)
    after = announced(tmp_path / "out")
    assert after[: len(before)] == before
    assert after == pytest.approx([0.02 * k for k in range(len(after))])


def test_mpirun_forwards_usr1_to_the_ranks(tmp_path: Path) -> None:
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, 2)
    wait_for_states(tmp_path / "out", 3)
    process.send_signal(signal.SIGUSR1)
    left = finish(process)
    assert "stopped by SIGUSR1 after step " in left.err
    assert not ranks_in(tmp_path)


def step_of_checkpoint(out: Path) -> int:
    """Step of the newest checkpoint."""
    with import_h5py().File(out / "checkpoint.h5") as file:
        return int(json.loads(file["entries"][64:].tobytes())["scalars"]["step"])


def test_a_long_step_under_mpirun_has_its_start_in_the_checkpoint(tmp_path: Path) -> None:
    """The checkpoint has the last accepted step long before the next state or minute."""
    program = tmp_path / "slow.py"
    program.write_text(SLOW_STEPS.format(seconds=60))
    scene = write_scene(
        tmp_path, ENDLESS.replace("every: 0.02", "every: 10").replace("step: 0.005", "step: 0.02")
    )
    process = start(["run", scene, "--out", "out", *DIRECT], tmp_path, program=(str(program),))
    wait_until((tmp_path / "in-step").exists)
    process.send_signal(signal.SIGTERM)
    wait_until(lambda: step_of_checkpoint(tmp_path / "out") == 6)
    process.kill()
    finish(process)
    assert steps(tmp_path / "out") == list(range(7))
    done(["run", scene, "--out", "out", "--resume", "-ts_max_steps", "1", *DIRECT], tmp_path)
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["resumed"][-1]["step"] == 6


def test_a_long_step_is_finished_and_written(tmp_path: Path) -> None:
    program = tmp_path / "slow.py"
    program.write_text(SLOW_STEPS.format(seconds=3))
    process = start(
        ["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, program=(str(program),)
    )
    wait_until((tmp_path / "in-step").exists)
    process.send_signal(signal.SIGUSR1)
    left = finish(process)
    assert left.code == 143
    assert "stopped by SIGUSR1 after step 7 " in left.ours[0]


def test_a_closed_stdout_does_not_end_the_run(tmp_path: Path) -> None:
    words = command(["run", write_scene(tmp_path, ENDLESS), "--out", "out", "--set", "time.end=0.1"])
    process = subprocess.Popen(
        words,
        cwd=tmp_path,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(600) == 0
    assert announced(tmp_path / "out")[-1] == pytest.approx(0.1)


def test_nohup_is_respected(tmp_path: Path) -> None:
    words = command(["run", write_scene(tmp_path, ENDLESS), "--out", "out", "--set", "time.end=0.5"])
    ignore = "signal.signal(signal.SIGHUP, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", f"import os, signal, sys; {ignore}", *words], cwd=tmp_path, env=environment()
    )
    wait_for_states(tmp_path / "out", 3)
    process.send_signal(signal.SIGHUP)
    assert process.wait(600) == 0
