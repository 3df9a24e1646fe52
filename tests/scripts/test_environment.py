"""The set-up scripts in simulated environments: what is used, refused and left unchanged."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from environments import NEEDED, ROOT, YIELD, activated, call, make, site_packages

HELPER = ROOT / "scripts" / "environment.py"

pytestmark = pytest.mark.skipif(os.name != "posix", reason="shell scripts")

BLOCKS = subprocess.run(["env", "--block-signal=USR1", "true"], capture_output=True).returncode == 0
BLOCKING = "env --block-signal=USR1 " if BLOCKS else ""
"""What scripts put before Python so that no signal ends it before its first line, if there is such an env."""


@pytest.fixture
def environment(tmp_path):
    folder = tmp_path / "own environment"
    make(folder)
    return folder


def listing(folder: Path) -> list[tuple[str, float]]:
    return sorted((str(path), path.lstat().st_mtime) for path in folder.rglob("*"))


def test_a_complete_environment_is_used_unchanged(environment, tmp_path):
    before = listing(environment)
    done = call("run.sh", "my scene.yaml", "-ts_monitor", cwd=tmp_path, **activated(environment))
    python = environment / "bin" / "python3"
    expected = (
        f"launched in {tmp_path}: -n 2 {BLOCKING}{python} {ROOT}/lyra_petsc run my scene.yaml -ts_monitor"
    )
    assert done.stdout.strip() == expected, done.stderr
    assert done.stderr == ""
    assert listing(environment) == before
    assert not (tmp_path / "laid over").exists()


def test_waiting_ranks_yield_only_if_they_exceed_the_cores(environment, tmp_path):
    """Otherwise a run would get little time next to busy programs."""
    (environment / "bin" / "mpirun").write_text(f'#!/bin/sh\necho "${YIELD}"\n')
    cores = len(os.sched_getaffinity(0))
    for script, words in (("run.sh", []), ("lyra.sh", ["run"])):
        for ranks, expected in ((cores, "0"), (cores + 1, "1")):
            if ranks > 1:
                done = call(script, *words, cwd=tmp_path, RANKS=str(ranks), **activated(environment))
                assert done.stdout.strip() == expected, (script, ranks, done.stderr)
    kept = call("run.sh", cwd=tmp_path, RANKS="2", **{YIELD: "1"}, **activated(environment))
    assert kept.stdout.strip() == "1"


def test_a_python_without_petsc_is_refused(tmp_path):
    venv.create(tmp_path / "empty", symlinks=True)
    done = call("run.sh", cwd=tmp_path, PYTHON=str(tmp_path / "empty" / "bin" / "python"))
    assert done.returncode == 1
    assert "does not see petsc4py and mpi4py" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_other_folders_are_not_changed(environment, tmp_path):
    shutil.rmtree(site_packages(environment) / "rich")
    mine = tmp_path / "laid over" / "pyvenv.cfg"
    mine.parent.mkdir()
    mine.write_text("made by hand")
    done = call("run.sh", cwd=tmp_path, **activated(environment))
    assert done.returncode == 1
    assert "was not made by these scripts and is left alone" in done.stderr
    assert mine.read_text() == "made by hand"


def test_nothing_is_imported_from_the_working_directory(environment, tmp_path):
    shutil.rmtree(site_packages(environment) / "rich")
    stranger, mark = tmp_path / "stranger", tmp_path / "mark"
    stranger.mkdir()
    for name in {*sys.stdlib_module_names, *NEEDED, "pip", "sitecustomize"}:
        (stranger / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').write(__name__)\n")
    done = call("run.sh", cwd=stranger, PYTHONPATH=":", **activated(environment))
    assert "installing from PyPI" in done.stderr
    assert not mark.exists(), mark.read_text()


def test_old_missing_and_incomplete_packages_are_listed(environment):
    site = site_packages(environment)
    (site / "click-8.1.7.dist-info" / "METADATA").write_text("Name: click\nVersion: 7.9\n")
    shutil.rmtree(site / "rich-13.9.dist-info")  # the module is there, its metadata never came
    shutil.rmtree(site / "h5py-3.11.dist-info")  # as Debian's: no metadata under this name
    shutil.rmtree(site / "numba")
    command = [environment / "bin" / "python", "-B", HELPER, "missing", ROOT / "pyproject.toml", "stack"]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=clean)
    assert {line.split(">=")[0] for line in done.stdout.splitlines()} == {"click", "rich", "numba"}


def test_a_layered_environment_uses_and_pins_the_packages_below(environment, tmp_path):
    over = tmp_path / "über"
    venv.create(over, symlinks=True)
    python = str(over / "bin" / "python")
    command = [sys.executable, "-B", str(HELPER), "layer", python, str(site_packages(environment))]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    pinned = set(done.stdout.split())
    assert pinned == {"numpy==1.26.0", "mpi4py==4.0.0", "petsc4py==3.20.1", "h5py==3.11", "gmsh==4.12"}
    words = [python, "-Ic", "import petsc4py; print(petsc4py.__file__)"]
    shown = subprocess.run(words, capture_output=True, text=True, check=True)
    assert shown.stdout.startswith(str(environment))


def test_one_script_runs_every_verb(environment: Path, tmp_path: Path) -> None:
    variables = {**activated(environment), "RANKS": "3"}
    done = call("lyra.sh", "check", "a scene.yaml", "-ksp_view", cwd=tmp_path, **variables)
    assert done.returncode == 0, done.stderr
    assert f"launched in {tmp_path}: -n 3 " in done.stdout
    assert done.stdout.strip().endswith("/lyra_petsc check a scene.yaml -ksp_view")
    done = call("lyra.sh", "run", cwd=tmp_path, **activated(environment))
    assert ": -n 2 " in done.stdout
    done = call("lyra.sh", "report", "x", cwd=tmp_path, **{**variables, "RANKS": "many"})
    assert done.returncode == 1
    assert "RANKS=many is not a number of ranks" in done.stderr
