"""A failing rank ends the job within 20 s, and no process remains."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from launch import Left, done, finish, start, wait_until, write_scene
from leftovers import ENDLESS, announced, ranks_in, wait_for_states

WITHIN = 20.0

FAILING = """
import resource, sys, time
from pathlib import Path
import numpy as np
from mpi4py import MPI
import lyra_petsc.{module} as module
import lyra_petsc.parallel as parallel
from lyra_petsc.cli.app import run_command_line

parallel.GRACE = 1.0  # the other ranks do not fail, however long they are waited for
right = module.{name}
calls = 0

def out_of_memory():
    now = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now, now))
    crumbs = []
    try:
        while True:
            crumbs.append(bytearray(2**12))
    except MemoryError:
        hoard = [np.ones(2**18) for _ in range(10**6)]

def wrong(*arguments, **keywords):
    global calls
    calls += 1
    if MPI.COMM_WORLD.rank == {rank} and calls > {after}:
        Path("failed").touch()
        {what}
    return right(*arguments, **keywords)

module.{name} = wrong
sys.exit(run_command_line(sys.argv))
"""

PLACES = {
    "meshing": ("stepping.problem", "build_scene_mesh", 0),
    "distributing": ("stepping.problem", "distribute", 0),
    "assembly": ("linear.discretisation", "BlockPattern", 0),
    "residual": ("stepping.forces", "StageForces.residual", 25),
    "jacobian": ("stepping.forces", "StageForces.jacobian", 9),
    "writing a state": ("output.states", "write_rows", 3),
    "a row of the history": ("output.recorder", "Recorder._write_row", 4),
}


def job(folder: Path, place: str, what: str, rank: int, ranks: int) -> Left:
    """A run with a fault, which must end in time."""
    module, name, after = PLACES[place]
    program = folder / "failing.py"
    program.write_text(FAILING.format(module=module, name=name, after=after, what=what, rank=rank))
    process = start(
        ["run", write_scene(folder, ENDLESS), "--out", "out"], folder, ranks, program=(str(program),)
    )
    wait_until((folder / "failed").exists)
    left = finish(process, patience=WITHIN)
    wait_until(lambda: not ranks_in(folder), patience=WITHIN)
    return left


@pytest.mark.parametrize(
    ("place", "rank", "ranks"),
    [
        ("meshing", 0, 2),
        ("assembly", 2, 3),
        ("jacobian", 1, 2),
        ("writing a state", 1, 2),
        ("a row of the history", 1, 2),
    ],
)
def test_an_exception_on_one_rank(tmp_path: Path, place: str, rank: int, ranks: int) -> None:
    left = job(tmp_path, place, "raise ZeroDivisionError('here')", rank, ranks)
    assert left.code not in (0, 2, 3)
    assert f"internal error on rank {rank}: ZeroDivisionError: here" in left.err


@pytest.mark.parametrize(("place", "rank"), [("distributing", 1), ("residual", 0)])
def test_no_memory_left_on_one_rank(tmp_path: Path, place: str, rank: int) -> None:
    left = job(tmp_path, place, "out_of_memory()", rank, 2)
    assert left.code == 3, left.err
    (line,) = left.ours
    assert line.startswith(f"lyra-petsc: out of memory on rank {rank}: MemoryError")
    assert line.endswith("take more memory, more machines or a coarser mesh")


def test_a_petsc_error_on_one_rank_only(tmp_path: Path) -> None:
    """No state can be written, and the message does not promise one."""
    left = job(tmp_path, "residual", "from petsc4py import PETSc; raise PETSc.Error(56)", 1, 2)
    assert left.code == 3, left.err
    (line,) = left.ours
    assert "the last checkpoint (the other ranks work on) is kept" in line
    before = announced(tmp_path / "out")
    end = before[-1] + 0.04
    done(["run", "--out", "out", "--resume", "--set", f"time.end={end:.3f}"], tmp_path)
    assert announced(tmp_path / "out")[: len(before)] == before


def test_a_rank_is_killed_during_the_set_up(tmp_path: Path) -> None:
    left = job(tmp_path, "assembly", "import os; os.kill(os.getpid(), 9)", 1, 2)
    assert left.code != 0
    # only the lock's file may stand, and it is no obstacle
    assert [entry.name for entry in (tmp_path / "out").iterdir()] == ["run.lock"]
    done(["run", "scene.yaml", "--out", "out", "-ts_max_steps", "2"], tmp_path)


@pytest.mark.parametrize(("rank", "ranks"), [(0, 3), (1, 2)])
def test_a_rank_is_killed_during_the_steps(tmp_path: Path, rank: int, ranks: int) -> None:
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, ranks)
    wait_for_states(tmp_path / "out", 3)
    os.kill(sorted(ranks_in(tmp_path))[rank], signal.SIGKILL)
    left = finish(process, patience=WITHIN)
    assert left.code != 0
    wait_until(lambda: not ranks_in(tmp_path), patience=WITHIN)
    before = announced(tmp_path / "out")
    done(["run", "--out", "out", "--resume", "--set", f"time.end={before[-1] + 0.04:.3f}"], tmp_path)
    assert announced(tmp_path / "out")[: len(before)] == before


def test_the_launcher_is_killed(tmp_path: Path) -> None:
    process = start(["run", write_scene(tmp_path, ENDLESS), "--out", "out"], tmp_path, 2)
    wait_for_states(tmp_path / "out", 3)
    process.kill()
    process.communicate()
    wait_until(lambda: not ranks_in(tmp_path), patience=WITHIN)
    assert announced(tmp_path / "out")
