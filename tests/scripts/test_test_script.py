"""``scripts/test.sh``: selected tests, numbers of processes, exit code, last line."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from environments import NEEDED, ROOT, activated, call, make, put, site_packages

pytestmark = pytest.mark.skipif(os.name != "posix", reason="shell scripts")

PYTEST = """\
import os, signal, sys
workers = os.environ["PYTEST_XDIST_AUTO_NUM_WORKERS"]
heeded = signal.getsignal(signal.SIGINT) != signal.SIG_IGN
print(f"{workers} workers, interrupts heeded: {heeded}, words:", sys.argv[1:])
line, code = os.environ.get("SAID", "=== 7 passed in 3.75s ===;0").split(";")
print(line, flush=True)
if int(code) < 0:
    os.kill(os.getpid(), -int(code))
sys.exit(int(code))
"""

CORES = '#!/bin/sh\necho "${CORES:-2}"\n'

Tests = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment in which pytest prints its arguments and ends with a given code."""
    folder = tmp_path_factory.mktemp("tests") / "environment"
    make(folder)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for extra in ("view", "export", "test"):
        names = re.search(rf"^{extra} = \[(.*?)\]", text, re.MULTILINE | re.DOTALL)
        assert names is not None
        for name, version in re.findall(r'"([a-z-]+)>=([0-9.]+)"', names[1]):
            if name not in NEEDED and not (site_packages(folder) / name).exists():
                put(folder, name, version)
    (site_packages(folder) / "pytest" / "__main__.py").write_text(PYTEST)
    (folder / "bin" / "nproc").write_text(CORES)
    (folder / "bin" / "nproc").chmod(0o755)
    return folder


@pytest.fixture
def tests(made: Path, tmp_path: Path) -> Tests:
    return lambda *words, **variables: call(
        "test.sh", *words, cwd=tmp_path, **{**activated(made), **variables}
    )


def first_part(done: subprocess.CompletedProcess[str]) -> str:
    """Arguments of pytest on one rank."""
    line = re.search(r"^\d+ workers, .*", done.stdout, re.MULTILINE)
    assert line is not None, done.stderr
    return line[0]


def parallel_part(done: subprocess.CompletedProcess[str], ranks: int) -> str:
    """Arguments of pytest under mpirun; empty if it was not called."""
    call = re.search(rf"^launched in .* -n {ranks} (.*\n)*?exit \$code sh (.*)", done.stdout, re.MULTILINE)
    return call[2] if call else ""


def test_all_tests_on_one_rank_and_the_parallel_ones_on_two_and_three(tests: Tests) -> None:
    done = tests("-x", "-k", "some or other")
    assert done.returncode == 0, done.stderr
    assert first_part(done).startswith("4 workers, interrupts heeded: True")
    assert "'-n', 'auto'" in first_part(done)
    assert "'tests', '-x', '-k', 'some or other', '-m', ''" in first_part(done)
    for ranks in (2, 3):
        words = parallel_part(done, ranks)
        assert "-x -k some or other -m parallel" in words
        assert "tests/stepping/test_ranks.py" in words
        assert "tests/docs/" not in words
    assert done.stdout.splitlines()[-1] == "=== 7 passed in 3.75s ==="


def test_quick_collects_only_files_with_quick_tests(tests: Tests) -> None:
    done = tests("--quick", "-m", "not slow")
    assert "'-m', 'quick and not parallel and (not slow)'" in first_part(done)
    assert "quick and parallel and (not slow)" in parallel_part(done, 2)
    mark = "pytest.mark." + "quick"  # not in one word, or this file would have it
    for words in (first_part(done), parallel_part(done, 2)):
        files = re.findall(r"tests/[\w/]+\.py", words)
        assert files
        assert all(mark in (ROOT / file).read_text(encoding="utf-8") for file in files)


@pytest.mark.parametrize(
    ("said", "code", "line"),
    [
        ("=== 1 failed, 2 passed in 61.00s (0:01:01) ===;1", 1, None),
        ("=== 9 deselected in 0.50s ===;5", 5, None),
        ("tests/cli ...;-11", 139, "tests/cli ..."),
    ],
)
def test_a_failure_is_the_last_line_and_the_exit_code(
    tests: Tests, said: str, code: int, line: str | None
) -> None:
    done = tests(SAID=said)
    assert done.returncode == code, done.stderr
    assert done.stdout.splitlines()[-1] == line or said.split(";")[0]
