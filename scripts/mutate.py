"""Single-point changes of the program that tests must notice: python scripts/mutate.py [--list] [WORD...]

Each change is made in a temporary copy of the tree, and its tests must fail there, each of them; unchanged
they must pass. WORDs choose the changes whose file or text contains one of them. A test that begins with
``2@`` runs on two ranks, by the launcher in $MPIRUN (``mpirun``). Not part of CI: all of it takes a quarter
of an hour. Exit code 1 if a change goes unnoticed, 2 if its old text is not found once.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent

LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv*", "runs", "*.gif", ".pytest_cache", ".mypy_cache", ".ruff_cache"
)

LONGEST = 600.0
"""Seconds after which a test that a change lets hang has noticed it."""

FAILED, PASSED = 1, 0
"""Exit codes of pytest."""


class Change(NamedTuple):
    """One change, and the tests each of which must fail by it."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


STEPPING, OUTPUT, TERMS = "lyra_petsc/stepping/", "lyra_petsc/output/", "lyra_petsc/terms/"
BOOKS = "tests/stepping/test_bookkeeping.py::"
RESUME = "tests/output/test_resume.py::test_the_way_is_the_same"
STABLE = "tests/stepping/test_stability.py::"
ORDER = "tests/stepping/test_orders.py::test_observed_order"

CHANGES: list[Change] = [
    # -- what a run tells of itself
    Change(
        STEPPING + "energy_balance.py",
        "        system.points.comm.Allreduce(local, total)\n        return list(total)",
        "        total[:] = system.points.comm.bcast(local)\n        return list(total)",
        ("2@" + BOOKS + "test_handles_bear_the_weight",),
    ),
    Change(
        TERMS + "spring.py",
        "-(frozen.stiffness * self._pull(x, frozen))[:n]",
        "(frozen.stiffness * self._pull(x, frozen))[:n]",
        (BOOKS + "test_handles_bear_the_weight[40.0]",),
    ),
    Change(
        STEPPING + "stage_equations.py",
        "energy(self.x)\n        self.active.turn_targets(UpcomingStep(self.t0, self.t1, self.t1",
        "energy(self.x)\n        self.active.turn_targets(UpcomingStep(self.t0, self.t1, self.t0",
        (BOOKS + "test_a_turning_clamp_stores_energy_where_it_stands[midpoint]",),
    ),
    Change(
        TERMS + "gravity.py",
        "return -float(self._mass @ x",
        "return float(self._mass @ x",
        ("tests/stepping/test_budgets.py",),
    ),
    Change(
        STEPPING + "energy_balance.py",
        "heat = system.dt * float(np.vdot(system.stage_velocity, part))",
        "heat = 0.5 * system.dt * float(np.vdot(system.stage_velocity, part))",
        ("tests/stepping/test_budgets.py",),
    ),
    Change(
        STEPPING + "energy_balance.py",
        "self._moving += energy if term.moving and not term.pushes else 0.0",
        "self._moving += 0.0",
        ("tests/stepping/test_budgets.py",),
    ),
    Change(
        STEPPING + "compression_watch.py",
        "not self.smallest < SOFTENS_BELOW",
        "not self.smallest > SOFTENS_BELOW",
        ("tests/stepping/test_compression_watch.py",),
    ),
    Change(
        STEPPING + "simulation.py",
        "self.totals[name] += int(number)",
        "self.totals[name] = int(number)",
        ("tests/stepping/test_recovery.py::test_one_note_says_how_often_and_why",),
    ),
    Change(
        STEPPING + "simulation.py",
        "self._repeated[why] = self._repeated.get(why, 0) + 1",
        "self._repeated[why] = 1",
        ("tests/stepping/test_recovery.py::test_one_note_says_how_often_and_why",),
    ),
    Change(
        STEPPING + "simulation.py",
        'self._least = math.inf if memory.get("least") is None else float(memory["least"])',
        "self._least = math.inf",
        ("tests/stepping/test_recovery.py::test_one_note_says_how_often_and_why",),
    ),
    Change(
        OUTPUT + "summary.py",
        "if isinstance(value, float) and not math.isfinite(value):",
        "if isinstance(value, float) and math.isnan(value):",
        ("tests/output/test_summary.py",),
    ),
    # -- resuming
    Change(
        STEPPING + "energy_balance.py",
        'self._pull, self._targets = arrays.get("pull", self._pull)',
        "self._pull, self._targets = 0.0 * self._pull",
        (RESUME + "[static-2]",),
    ),
    Change(
        STEPPING + "energy_balance.py",
        "setattr(self.budget, name, float(value))",
        "setattr(self.budget, name, 0.0)",
        (RESUME + "[beuler-9]",),
    ),
    Change(
        STEPPING + "simulation.py",
        'self.estimated_error = float(memory["estimated_error"])',
        "self.estimated_error = 0.0",
        (RESUME + "[beuler, adaptive-9]",),
    ),
    Change(
        STEPPING + "simulation.py",
        'self.totals |= {name: int(number) for name, number in memory.get("totals", {}).items()}',
        "pass",
        (RESUME + "[midpoint-9]",),
    ),
    Change(
        STEPPING + "simulation.py",
        'system.integrator.restore(arrays, memory["integrator"])',
        "pass",
        (RESUME + "[bdf2-2]", RESUME + "[alpha2-9]"),
    ),
    Change(
        STEPPING + "simulation.py",
        'self.local_error.restore(arrays, memory["integrator"])',
        "pass",
        (RESUME + "[bdf2, adaptive-1]",),
    ),
    Change(
        STEPPING + "extrapolation.py",
        'self._degree = int(numbers["degree"])',
        "self._degree = 0",
        ("tests/stepping/test_extrapolation.py::test_a_resumed_run_expects_the_same",),
    ),
    Change(
        STEPPING + "step_control.py",
        'self.factor, self.good = float(memory["factor"]), int(memory["good"])',
        "pass",
        (RESUME + "[alpha2, adaptive-9]",),
    ),
    Change(
        OUTPUT + "history.py",
        'return int(line.split(",", 1)[0]) <= last_step',
        'return int(line.split(",", 1)[0]) < last_step',
        (RESUME + "[beuler-9]",),
    ),
    Change(
        OUTPUT + "checkpoint.py",
        "if int(check_sums([slab], order.comm)[0]) != expected:",
        "if False:",
        ("tests/output/test_checkpoint.py",),
    ),
    # -- equilibria
    Change(
        STEPPING + "equilibrium.py",
        "if force <= self._tolerances.force_tolerance * self._scale:",
        "if force <= 100.0 * self._tolerances.force_tolerance * self._scale:",
        (BOOKS + "test_statics_end_at_their_tolerance",),
    ),
    Change(
        STEPPING + "equilibrium.py",
        "system.applied.unbalanced = -force",
        "system.applied.unbalanced = force",
        (BOOKS + "test_a_static_analysis_begins_in_balance",),
    ),
    Change(
        STEPPING + "equilibrium.py",
        "MOST_DESCENTS = 5",
        "MOST_DESCENTS = 0",
        (STABLE + "test_a_strip_above_it_falls_over[1.2]",),
    ),
    Change(
        STEPPING + "stability.py",
        "pivots.negative == 0",
        "pivots.negative <= 1",
        (STABLE + "test_a_strip_above_it_falls_over[1.5]",),
    ),
    Change(
        STEPPING + "stability.py",
        "BENDS = 0.5",
        "BENDS = -0.5",
        (STABLE + "test_wrinkles_of_a_sheet_without_bending_are_told_not_followed",),
    ),
    Change(
        "lyra_petsc/linear/inertia.py",
        "NEUTRAL = 1e-10",
        "NEUTRAL = 1e-2",
        (STABLE + "test_a_strip_below_its_critical_weight_stands",),
    ),
    Change(
        STEPPING + "exact_hessian.py",
        "force_of, system.applied.factor",
        "force_of, 1.0",
        (STABLE + "test_the_hessian_is_the_slope_of_all_forces[pressure]",),
    ),
    Change(
        TERMS + "load_stiffness.py",
        "0.5 * (out + out.transpose(0, 2, 1, 4, 3))",
        "out",
        (STABLE + "test_the_hessian_is_the_slope_of_all_forces[wind]",),
    ),
    # -- steps
    Change(
        STEPPING + "stage_equations.py",
        "if changed or any(abs(t0 - event) <= 1e-6 * self.dt for event in self._events):",
        "if changed:",
        (BOOKS + "test_a_load_that_switches_begins_the_scheme_anew",),
    ),
    Change(
        STEPPING + "local_error.py",
        "error = 0.5 * dt * dt * slope",
        "error = 0.25 * dt * dt * slope",
        (BOOKS + "test_the_first_order_estimate_is_the_error_of_free_fall",),
    ),
    Change(
        STEPPING + "sensitivity.py",
        "values + way * tangent.memory.get(name, 0.0) for",
        "values for",
        ("tests/stepping/test_sensitivity.py::test_each_number[bdf2]",),
    ),
    Change(
        STEPPING + "integrators/alpha2.py",
        "self._gamma = 0.5 - self._am + self._af",
        "self._gamma = 0.6 - self._am + self._af",
        (ORDER + "[alpha2]",),
    ),
    Change(
        STEPPING + "integrators/bdf2.py",
        "return lead / dt, [-c / lead for c in rest]",
        "return lead / dt, [-1.001 * c / lead for c in rest]",
        (ORDER + "[bdf2]",),
    ),
    Change(
        STEPPING + "integrators/midpoint.py",
        "return x + dt * stage_velocity, 2.0 * stage_velocity - v",
        "return x + dt * stage_velocity, stage_velocity",
        (ORDER + "[midpoint]",),
    ),
    Change(
        STEPPING + "stage_equations.py",
        "x = self.x + (at - self.t0) * self.v",
        "x = self.x.copy()",
        (ORDER + "[midpoint]",),
    ),
    Change(
        STEPPING + "prescribed.py",
        "self.velocity = (self.goal - x_h.take(self.at)) / reach",
        "self.velocity = 0.5 * (self.goal - x_h.take(self.at)) / reach",
        ("tests/stepping/test_budgets.py",),
    ),
    Change(
        STEPPING + "damping.py",
        "factor = 1.0 + weight / self._gamma",
        "factor = weight / self._gamma",
        ("tests/stepping/test_damping.py",),
    ),
    Change(
        STEPPING + "convergence.py",
        "return float(self._tolerances.force_tolerance *",
        "return float(100.0 * self._tolerances.force_tolerance *",
        ("tests/stepping/test_tolerances.py",),
    ),
    Change(
        STEPPING + "step_control.py",
        "stands = ratio <= 1.0 or",
        "stands = ratio <= 10.0 or",
        ("tests/stepping/test_adaptive.py",),
    ),
    Change(
        STEPPING + "step_control.py",
        "return target if target - time <= dt * (1.0 + SLACK) else",
        "return target if target - time <= dt else",
        (BOOKS + "test_round_off_makes_no_tiny_step",),
    ),
    # -- materials, meshes, loads
    Change(
        "lyra_petsc/scene/materials/library.py",
        "bend = stretch * thickness * thickness / 12",
        "bend = stretch * thickness * thickness / 10",
        ("tests/scene/test_material_library.py",),
    ),
    Change(
        "lyra_petsc/mesh/build.py",
        "cell[:, [[0, 1, 3], [1, 2, 3]]]",
        "cell[:, [[0, 1, 3], [1, 3, 2]]]",
        ("tests/mesh/test_grids.py",),
    ),
    Change(
        "lyra_petsc/mesh/obstacles.py",
        "rotation = turn @ start.T",
        "rotation = turn",
        ("tests/mesh/test_obstacles.py",),
    ),
    Change(
        "lyra_petsc/show/obstacle_surfaces.py",
        "((middle - place) @ normal) * normal",
        "(middle - place)",
        ("tests/show/test_obstacle_surfaces.py",),
    ),
    Change(
        "lyra_petsc/mesh/measures.py",
        "mirror = np.where(determinant < 0.0, -1.0, 1.0)",
        "mirror = np.ones_like(determinant)",
        ("tests/mesh/test_measure.py",),
    ),
    Change(
        "lyra_petsc/mesh/crossings.py",
        "_RELATIVE = (7.0 + 56.0 * _HALF_ULP) * _HALF_ULP",
        "_RELATIVE = 0.0",
        ("tests/mesh/test_crossings.py::test_sides_of_points_within_rounding_of_a_plane[0.0]",),
    ),
    Change(
        "lyra_petsc/mesh/crossings.py",
        "if part != 0.0 and not _LEAST < part < _MOST:",
        "if False:",
        ("tests/mesh/test_crossings.py::test_sides_that_only_expansions_or_rational_numbers_tell",),
    ),
    Change(
        "lyra_petsc/mesh/crossings.py",
        "int(mine < 0 and others < 0)",
        "int(mine <= 0 and others <= 0)",
        ("tests/mesh/test_crossings.py",),
    ),
    Change(
        "lyra_petsc/mesh/start_crossings.py",
        "reach = radius - _rounding(",
        "reach = radius + _rounding(",
        ("tests/mesh/test_overlaps.py",),
    ),
    Change(
        TERMS + "force.py",
        " * strength[self._load, None])",
        ")",
        ("tests/terms/test_loads.py",),
    ),
]


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", metavar="WORD")
    parser.add_argument("--list", action="store_true", help="name the changes, and make none")
    asked = parser.parse_args()
    chosen = [change for change in CHANGES if not asked.words or _names(change, asked.words)]
    lost = [change for change in chosen if (ROOT / change.file).read_text("utf-8").count(change.old) != 1]
    for change in lost:
        print(f"{change.file}: not found once: {change.old}")
    if lost or asked.list:
        print("\n".join(f"{change.file}: {_line(change)}" for change in chosen if change not in lost))
        return 2 if lost else 0
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=LEFT_OUT, symlinks=True)
        tests = {test for change in chosen for test in change.tests}
        alone = sorted(test for test in tests if "@" not in test)
        if not all(
            _run(tree, *some) == PASSED for some in [alone, *([t] for t in tests if "@" in t)] if some
        ):
            print("the tests fail without any change")
            return 1
        unnoticed = [change for change in chosen if not _noticed(tree, change)]
    print(f"{len(chosen) - len(unnoticed)} of {len(chosen)} changes noticed")
    return 1 if unnoticed else 0


def _names(change: Change, words: list[str]) -> bool:
    return any(word in text for word in words for text in (change.file, change.old, *change.tests))


def _line(change: Change) -> str:
    return change.new.strip().splitlines()[0]


def _noticed(tree: Path, change: Change) -> bool:
    """Whether all tests of a change fail by it in a copy of the tree, which is then as before."""
    file = tree / change.file
    text, times = file.read_text("utf-8"), file.stat()
    file.write_text(text.replace(change.old, change.new), "utf-8")
    try:
        passed = [test for test in change.tests if _run(tree, test) != FAILED]
    finally:
        file.write_text(text, "utf-8")
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))  # compiled kernels are of this time
    print(
        f"{'UNNOTICED' if passed else 'noticed'}  {change.file}: {_line(change)}  {passed or ''}", flush=True
    )
    return not passed


def _run(tree: Path, *tests: str) -> int:
    """Exit code of pytest; all tests are for one number of ranks."""
    ranks = tests[0].rpartition("@")[0]
    names = [test.rpartition("@")[2] for test in tests]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *names]
    if ranks:
        launcher = shlex.split(os.environ.get("MPIRUN", "mpirun"))
        command = [*launcher, "-n", ranks, *command, "-m", "parallel"]
    path = [str(tree), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path)}
    try:
        done = subprocess.run(command, cwd=tree, capture_output=True, timeout=LONGEST, env=environment)
    except subprocess.TimeoutExpired:
        return FAILED if len(tests) == 1 else -1
    # also a Python without pytest ends with 1
    return done.returncode if done.returncode != FAILED or b" failed" in done.stdout else -1


if __name__ == "__main__":
    sys.exit(main())
