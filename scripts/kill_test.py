#!/usr/bin/env python3
"""Kills runs at random times, checks their files, resumes them, and compares with an uninterrupted run.

    python scripts/kill_test.py --kills 100 --ranks 2 --seed 1

A run is killed several times and continued with --resume until it reaches its end; then the next run begins,
with another integrator. The target is random as well: one rank, all ranks or the launcher (SIGKILL), or the
launcher gets a signal and gives its ranks a second to stop (SIGTERM, SIGINT). After every kill all processes
must end within 20 s, and every state in states.xdmf must be complete; at the end states, history, probes and
reactions must be those of an uninterrupted run.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from subprocess import Popen

os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")

import h5py
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = map(str, (ROOT, *(ROOT / "tests" / name for name in ("", "surviving", "cli"))))
from launch import DIRECT, finish, start  # noqa: E402
from leftovers import announced, ranks_in  # noqa: E402

from lyra_petsc.output.read_run import StoredRun, read_table  # noqa: E402

PATIENCE = 20.0
"""Seconds within which the other ranks must end."""

SAME = 1e-9
"""Largest difference [m] between positions of two runs on the same ranks with a direct solver."""

SCENE = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 6, ny: 6}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
handles:
  - {nodes: [0, 6]}
  - {nodes: [45], from: 0.205, motion: lift}
motions:
  lift: [{time: 0.3, translate: [0, 0, 0]}, {time: 0.9, translate: [0, 0, 0.2]}]
time: {end: 0.4, step: 0.005}
output: {every: 0.02, checkpoint: {seconds: 0.05}, fields: [velocity], reactions: true, vtkhdf: true}
probes: {middle: {nodes: [24]}}
"""

INTEGRATORS = {
    "beuler": [],
    "bdf2": ["--set", "time.integrator=bdf2"],
    "alpha2, adaptive": ["--set", "time={end: 0.4, step: auto, tolerance: 0.02, integrator: alpha2}"],
}

TARGETS = ("one rank", "all ranks", "launcher", "launcher, SIGTERM", "launcher, SIGINT")


class WrongResult(Exception):
    """A run has left wrong or incomplete files, or processes."""


def launch(arguments: list[str], folder: Path, ranks: int) -> Popen[str]:
    """Start the program."""
    parallel = ["-pc_factor_mat_solver_type", "mumps"] if ranks > 1 else []
    return start(["run", *arguments, *DIRECT, *parallel], folder, ranks)


def complete(process: Popen[str]) -> None:
    """Wait for the end of a run."""
    left = finish(process, 600.0)
    if left.code != 0:
        raise WrongResult(left.err[-2000:])


def rows(path: Path) -> int:
    """Lines of a file; 0 if there is none."""
    try:
        return path.read_bytes().count(b"\n")
    except OSError:
        return 0


def wait_random_time(process: Popen[str], history: Path, draw: random.Random, length: float) -> None:
    """Wait for a random time of the run and its set-up, or for a random number of rows of the history."""
    by_rows, goal = draw.random() < 0.6, rows(history) + draw.randint(1, 40)
    deadline = time.monotonic() + (10.0 * length if by_rows else draw.uniform(0.0, length))
    while process.poll() is None and time.monotonic() < deadline:
        if by_rows and rows(history) >= goal:
            time.sleep(draw.uniform(0.0, 0.03))
            return
        time.sleep(0.002)


def strike(process: Popen[str], folder: Path, target: str, draw: random.Random) -> bool:
    """Kill the target; returns whether the run was still going on."""
    victims = ranks_in(folder)
    if process.poll() is not None:
        return False
    if not target.startswith("launcher") and not victims:
        target = "launcher"  # it has not started its ranks yet
    number = {"launcher, SIGTERM": signal.SIGTERM, "launcher, SIGINT": signal.SIGINT}.get(
        target, signal.SIGKILL
    )
    if target == "one rank":
        victims = [draw.choice(victims)]
    elif target.startswith("launcher"):
        victims = [process.pid]
    for victim in victims:
        try:
            os.kill(victim, number)
        except ProcessLookupError:
            continue
    return True


def wait_until_gone(process: Popen[str], folder: Path) -> None:
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None or ranks_in(folder):
        if time.monotonic() > deadline:
            remaining = ranks_in(folder)
            os.killpg(process.pid, signal.SIGKILL)
            raise WrongResult(f"after {PATIENCE:g} s there are still ranks: {remaining}")
        time.sleep(0.02)
    process.communicate()


def check_announced(out: Path) -> int:
    """Read every state listed in ``states.xdmf`` as other programs would; returns their number."""
    if not (out / "states.xdmf").exists():
        return 0
    try:
        times = announced(out)
    except AssertionError:
        traceback.print_exc()
        raise WrongResult("states listed in states.xdmf are not complete") from None
    check_vtkhdf(out, times)
    return len(times)


def check_vtkhdf(out: Path, times: list[float]) -> None:
    """Check that VTK finds the same states; the last ones may be missing, as they are written later."""
    path = out / "states.vtkhdf"
    stored: list[float] = []
    if path.exists():
        with h5py.File(path, "r") as file:
            stored = file["VTKHDF/Steps/Values"][()].tolist()
            for name in ("Points", "PointData/velocity", "PointData/rest"):
                if not np.isfinite(file[f"VTKHDF/{name}"][()]).all():
                    raise WrongResult(f"{path.name}: {name} is not finite")
    if stored != times[: len(stored)] or len(times) - len(stored) > 1 + 0.1 * len(times):
        raise WrongResult(f"{path.name} has the times {stored}, not {times}")


def table(path: Path) -> np.ndarray:
    """The rows of a CSV file, without columns that vary between runs."""
    skipped = {"wall_seconds", "residual", "linear_iterations"}
    return np.column_stack([column for name, column in read_table(path).items() if name not in skipped])


def last_state(out: Path) -> tuple[float, np.ndarray]:
    run = StoredRun(out)
    return float(run.times[-1]), run.positions[-1]


def compare(out: Path, whole: Path) -> None:
    """Compare the resumed run with the uninterrupted one."""
    (time, x), (expected_time, expected_x) = last_state(out), last_state(whole)
    if time != expected_time or np.abs(x - expected_x).max() > SAME:
        raise WrongResult(f"ends at t = {time}, {np.abs(x - expected_x).max():.3g} m off")
    for name in ("history.csv", "probes.csv", "reactions.csv"):
        mine, other = table(out / name), table(whole / name)
        if mine.shape != other.shape or not np.array_equal(mine[:, 0], np.arange(len(mine))):
            raise WrongResult(f"{name}: steps {mine[:, 0].astype(int).tolist()}")
        if not np.allclose(mine, other, rtol=1e-6, atol=1e-9):
            raise WrongResult(
                f"{name} differs in row {np.flatnonzero(~np.isclose(mine, other, 1e-6, 1e-9).all(1))[0]}"
            )
    if check_announced(out) != check_announced(whole):
        raise WrongResult("another number of states")
    clutter = [entry.name for entry in out.iterdir() if entry.suffix in (".part", ".lock")]
    if clutter:
        raise WrongResult(f"clutter: {clutter}")


def continue_options(out: Path) -> list[str]:
    """--resume if there is a checkpoint; else the run begins again."""
    if list(out.glob("checkpoint*.h5")):
        return ["--resume"]
    return ["--force"] if out.exists() else []


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="working folder, which is kept (default a temporary one)")
    asked = parser.parse_args()
    draw = random.Random(asked.seed)
    folder = (asked.folder or Path(tempfile.mkdtemp(prefix="kill_test-"))).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    scene = folder / "scene.yaml"
    scene.write_text(SCENE, encoding="utf-8")

    whole: dict[str, tuple[Path, float]] = {}
    kills: collections.Counter[str] = collections.Counter()
    finished, states = 0, 0
    try:
        while kills.total() < asked.kills:
            integrator = list(INTEGRATORS)[finished % len(INTEGRATORS)]
            words = [str(scene), *INTEGRATORS[integrator]]
            if integrator not in whole:
                straight, began = folder / f"whole-{len(whole)}", time.monotonic()
                complete(launch([*words, "--out", straight.name], folder, asked.ranks))
                whole[integrator] = straight, time.monotonic() - began
            straight, length = whole[integrator]
            out = folder / f"killed-{finished}"
            while True:
                process = launch([*words, "--out", out.name, *continue_options(out)], folder, asked.ranks)
                target = draw.choice(TARGETS if asked.ranks > 1 else TARGETS[:1])
                if kills.total() < asked.kills:
                    wait_random_time(process, out / "history.csv", draw, length)
                if kills.total() == asked.kills or not strike(process, folder, target, draw):
                    complete(process)
                    break
                wait_until_gone(process, folder)
                kills[target] += 1
                states += check_announced(out)
                print(
                    f"{kills.total():4d}  {integrator:<18} {target:<18} rows {rows(out / 'history.csv'):4d}"
                )
            compare(out, straight)
            finished += 1
            shutil.rmtree(out)
    except WrongResult as error:
        print(f"FAILED after {kills.total()} kills in {folder}: {error}")
        return 1
    listed = ", ".join(f"{name} {count}" for name, count in sorted(kills.items()))
    print(
        f"{kills.total()} kills on {asked.ranks} ranks ({listed}), seed {asked.seed}: "
        f"{states} announced states read back, {finished} runs resumed to the same end"
    )
    if asked.folder is None:
        shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
