"""Mutation tests, single changes of the program that tests must notice: python scripts/mutate.py [--list]
[WORD...]

Each change is made in a temporary copy of the tree, where each of its tests must fail; without the change
they must pass. WORDs select the changes whose file, text or tests contain one of them. A test that begins
with ``2@`` runs on two ranks, by the launcher in $MPIRUN (``mpirun``). Not part of CI, as all changes take a
quarter of an hour. Exit code 1 if a change goes unnoticed, 2 if its old text does not occur exactly once.
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

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parent.parent

NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv*", "runs", "*.gif", ".pytest_cache", ".mypy_cache", ".ruff_cache"
)

TIMEOUT = 600.0
"""Seconds after which a test counts as failed, as the change may make it hang."""

FAILED, PASSED = 1, 0
"""Exit codes of pytest."""


class Change(NamedTuple):
    """One change of ``mutations.yaml``, and the tests that must fail with it."""

    file: str
    old: str
    new: str
    tests: list[str]


CHANGES = [
    Change(*(entry[name] for name in Change._fields))
    for entry in YAML(typ="safe").load(Path(__file__).with_name("mutations.yaml"))
]


def main() -> int:
    """Run the chosen changes; returns the exit code."""
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
        shutil.copytree(ROOT, tree, ignore=NOT_COPIED, symlinks=True)
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
    """Whether all tests of a change fail with it in a copy of the tree, which is then restored."""
    file = tree / change.file
    text, times = file.read_text("utf-8"), file.stat()
    file.write_text(text.replace(change.old, change.new), "utf-8")
    try:
        passed = [test for test in change.tests if _run(tree, test) != FAILED]
    finally:
        file.write_text(text, "utf-8")
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))  # cached kernels depend on the time
    print(
        f"{'UNNOTICED' if passed else 'noticed'}  {change.file}: {_line(change)}  {passed or ''}", flush=True
    )
    return not passed


def _run(tree: Path, *tests: str) -> int:
    """Run tests, all on the same number of ranks; returns pytest's exit code."""
    ranks = tests[0].rpartition("@")[0]
    names = [test.rpartition("@")[2] for test in tests]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *names]
    if ranks:
        launcher = shlex.split(os.environ.get("MPIRUN", "mpirun"))
        command = [*launcher, "-n", ranks, *command, "-m", "parallel"]
    path = [str(tree), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path)}
    try:
        done = subprocess.run(command, cwd=tree, capture_output=True, timeout=TIMEOUT, env=environment)
    except subprocess.TimeoutExpired:
        return FAILED if len(tests) == 1 else -1
    # Python without pytest ends with exit code 1 as well
    return done.returncode if done.returncode != FAILED or b" failed" in done.stdout else -1


if __name__ == "__main__":
    sys.exit(main())
