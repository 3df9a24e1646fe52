"""``scripts/test.sh``: two halves that leave nothing out, one closing line, whatever becomes of a half."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from environments import NEEDED, ROOT, activated, call, make, put, site_packages, surroundings

pytestmark = pytest.mark.skipif(os.name != "posix", reason="shell scripts")

PYTEST = """\
import os, signal, sys, time
from pathlib import Path
words = sys.argv[1:]
ignored = [word for word in words if word.startswith("--ignore=")]
half = "SECOND" if ignored else "FIRST" if "tests/cli" in words else "WHOLE"
print(half, words, "asks to be interrupted:", signal.getsignal(signal.SIGINT) != signal.SIG_IGN)
line, code = os.environ[half].split(";")
print(line)
sys.stdout.flush()
if line == "works":
    Path(os.environ["LYRA_VENV"]).with_name(half).write_text(str(os.getpid()))
    time.sleep(60)
if int(code) < 0:
    os.kill(os.getpid(), -int(code))
sys.exit(int(code))
"""

CORES = '#!/bin/sh\necho "${CORES:-2}"\n'

SAID = {
    "FIRST": "=== 3 passed, 1 warning in 2.50s ===;0",
    "SECOND": "=== 4 passed in 1.25s ===;0",
    "WHOLE": "=== 7 passed in 3.75s ===;0",
}

Tests = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment in which pytest only says how it was called, and ends as it is told."""
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
        "test.sh", *words, cwd=tmp_path, **{**activated(made), **SAID, **variables}
    )


def test_the_second_half_is_all_but_the_first(tests: Tests) -> None:
    done = tests("-x", "-k", "some or other")
    assert done.returncode == 0, done.stderr
    first = re.search(r"^FIRST \[(.*)\]", done.stdout, re.MULTILINE)
    second = re.search(r"^SECOND \[(.*)\]", done.stdout, re.MULTILINE)
    assert first is not None
    assert second is not None
    folders = re.findall(r"'(tests/\w+)'", first[1])
    assert folders
    assert all((ROOT / folder).is_dir() for folder in folders)
    assert re.findall(r"'--ignore=([^']*)'", second[1]) == folders
    assert not re.search(r"'tests/", second[1])
    for half in (first, second):
        assert "'-x', '-k', 'some or other'" in half[1]
    assert done.stdout.count("asks to be interrupted: True") == 2
    assert done.stdout.splitlines()[-3:] == [
        "=== 3 passed, 1 warning in 2.50s ===",
        "=== 4 passed in 1.25s ===",
        "=== 7 passed, 1 warning in 2.50s (0:00:02) ===",
    ]
    assert " -n 2 " in done.stdout
    assert " -n 3 " in done.stdout


@pytest.mark.parametrize(
    ("first", "second", "code", "line"),
    [
        ("1 failed, 2 passed in 61.00s (0:01:01);1", None, 1, "1 failed, 6 passed in 61.00s (0:01:01)"),
        (None, "1 failed, 3 passed, 2 skipped, 2 warnings in 9.00s;1", 1,
         "1 failed, 6 passed, 2 skipped, 3 warnings in 9.00s (0:00:09)"),
        ("=== 9 deselected in 0.50s ===;5", None, 0, "4 passed, 9 deselected in 1.25s (0:00:01)"),
        (None, "=== no tests ran in 0.01s ===;5", 0, "3 passed, 1 warning in 2.50s (0:00:02)"),
        ("=== no tests ran in 0.50s ===;5", "=== no tests ran in 0.25s ===;5", 5,
         "no tests ran in 0.50s (0:00:00)"),
        ("tests/cli ...;-11", None, 139, "4 passed, 1 of 2 processes ended early in 1.25s (0:00:01)"),
        (None, "tests/docs ...;-9", 137,
         "3 passed, 1 warning, 1 of 2 processes ended early in 2.50s (0:00:02)"),
        ("=== 1 error in 0.50s ===;2", "=== 1 error in 0.50s ===;1", 2, "2 errors in 0.50s (0:00:00)"),
    ],
)  # fmt: skip
def test_a_half_that_fails_is_a_failure(
    tests: Tests, first: str | None, second: str | None, code: int, line: str
) -> None:
    said = {name: text for name, text in (("FIRST", first), ("SECOND", second)) if text is not None}
    done = tests(**said)
    assert done.returncode == code, done.stderr
    assert done.stdout.splitlines()[-1] == f"=== {line} ==="


def at_work(pid: int) -> bool:
    """Whether a process has not ended."""
    words = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout
    return words.strip()[:1] not in ("", "Z")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_both_halves(made: Path, tmp_path: Path, number: int) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    process = subprocess.Popen(
        ["bash", str(ROOT / "scripts/test.sh")],
        env=surroundings(tmp_path)
        | activated(made)
        | {"FIRST": "works;0", "SECOND": "works;0", "TMPDIR": str(logs)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    halves = [tmp_path / "FIRST", tmp_path / "SECOND"]
    deadline = time.monotonic() + 30.0
    while not all(half.exists() and half.read_text() for half in halves):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, number)  # as a terminal does, of whose group the second half is not
    assert process.wait(timeout=20.0) != 0
    while any(at_work(int(half.read_text())) for half in halves):
        assert time.monotonic() < deadline + 20.0
        time.sleep(0.02)
    assert list(logs.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "variables"),
    [
        ((), {"CORES": "1"}),
        (("--co", "-q"), {}),
        (("--junitxml=all.xml",), {}),
        ((str(ROOT / "tests/test_house.py"),), {}),
        (("-q", "tests/cli::nothing"), {}),
    ],
)
def test_what_asks_for_one_process_gets_one(
    tests: Tests, words: tuple[str, ...], variables: dict[str, str]
) -> None:
    done = tests(*words, **variables)
    assert done.returncode == 0, done.stderr
    assert "WHOLE" in done.stdout
    assert "FIRST" not in done.stdout
    assert "SECOND" not in done.stdout
    assert done.stdout.splitlines()[-1] == "=== 7 passed in 3.75s ==="
