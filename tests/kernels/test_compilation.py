"""Reporting and timing of compilation, only if numba really compiles."""

import os
import sys
import textwrap
from pathlib import Path

from patience import run_program

ROOT = Path(__file__).parents[2]

PROGRAM = """
import time
from lyra_petsc.kernels.cache import cached
from lyra_petsc.kernels.compilation import COMPILATION

told = []
COMPILATION.first = lambda: told.append("first")
COMPILATION.begins, COMPILATION.ends = lambda: told.append("begins"), lambda: told.append("ends")

@cached()
def inner(x):
    return x + 1.0

@cached()
def outer(x):
    return inner(x) * 2.0

began = time.perf_counter()
assert outer(1.0) == 4.0
took = time.perf_counter() - began
print(*told, COMPILATION.all_cached, 0.0 < COMPILATION.seconds <= took)
"""


def compiled(folder: Path, place: Path) -> list[str]:
    program = folder / "program.py"
    program.write_text(textwrap.dedent(PROGRAM))
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(place), "PYTHONPATH": str(ROOT), "HOME": "/dev/null"}
    done = run_program([sys.executable, program], env=variables, seconds=100)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_compilation_is_reported_once_and_loading_is_not(tmp_path: Path) -> None:
    assert compiled(tmp_path, tmp_path / "kept") == ["begins", "first", "ends", "True", "True"]
    assert compiled(tmp_path, tmp_path / "kept") == ["True", "False"]
