"""The cache of compiled functions; stale, damaged or differently typed entries are not used."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba import config
from numba.core.caching import CacheImpl
from patience import communicate

from lyra_petsc.kernels import cache as kernel_cache
from lyra_petsc.kernels.cache import KernelCache, cached

REPOSITORY = Path(__file__).resolve().parents[2]


def twice(x):  # type: ignore[no-untyped-def]
    return 2 * x


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    config.reload_config()  # else the first compilation does, where a variable of numba's has changed
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def compiled(x: Any) -> tuple[Any, int]:
    """Result of a new dispatcher, as in a new process, and the number of types that it found in the cache."""
    dispatcher = cached()(twice)
    result = dispatcher(x)
    return result, sum(dispatcher.stats.cache_hits.values())


def files(place: Path, ending: str) -> list[Path]:
    return sorted(place.rglob(f"*.{ending}"))


def test_compiled_functions_are_found_again(place: Path) -> None:
    assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 1)
    assert len(files(place, "nbi")) == len(files(place, "nbc")) == 1


def test_a_change_of_any_module_replaces_the_cache(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled(2.5)
    (before,) = files(place, "nbc")
    other = before.with_name(before.name.replace("twice", "twice_as_much"))
    moved = before.with_name(re.sub(r"-\d+\.", "-9999.", before.name))
    for file in (other, moved):
        file.write_bytes(before.read_bytes())
    monkeypatch.setattr(kernel_cache, "digest", lambda room: "changed")
    assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 1)
    assert not before.exists()
    assert not moved.exists()
    assert len(files(place, "nbc")) == 2
    assert other.exists()


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0, 40])
def test_truncated_files_are_compiled_again_and_replaced(place: Path, ending: str, left: int) -> None:
    compiled(2.5)
    (file,) = files(place, ending)
    file.write_bytes(file.read_bytes()[:left])
    assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 1)


def test_two_ranks_that_use_one_file_name_for_two_types(place: Path) -> None:
    """Both read an empty index: the file has one rank's function, the index the other's."""
    compiled(2)
    (integer,) = files(place, "nbc")
    of_integers = integer.read_bytes()
    for file in files(place, "nb?"):
        file.unlink()
    compiled(2.5)
    assert files(place, "nbc") == [integer]
    integer.write_bytes(of_integers)
    assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 1)


def test_a_full_disk(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 0)
    assert compiled(2.5) == (5.0, 1)


def test_no_writable_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    with pytest.raises(RuntimeError):
        KernelCache(twice)
    assert compiled(2.5) == (5.0, 0)


@pytest.mark.slow
def test_processes_that_start_together_with_an_empty_cache(place: Path) -> None:
    code = (
        "import numpy as np; from lyra_petsc.terms.loads import wind; out = np.ones((1, 3)); x = np.eye(3)\n"
        "wind.normals(x, np.array([[0, 1, 2]], dtype=np.int{}), out); assert np.allclose(out, 3 ** -0.5), out"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(place), "PYTHONPATH": str(REPOSITORY)}
    for each in ((32, 64, 32, 64), (32, 64)):
        begun = [
            subprocess.Popen([sys.executable, "-c", code.format(bits)], env=environment) for bits in each
        ]
        for process in begun:
            communicate(process)
        assert not any(process.returncode for process in begun)
    assert not files(place, "tmp.*")
