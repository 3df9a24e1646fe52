"""Kernels that another process compiles before they are called."""

import os
import sys
import textwrap
from pathlib import Path

import pytest
from module_of import module_of
from patience import run_program

from lyra_petsc.kernels.ahead import listed

ROOT = Path(__file__).parents[2]

PROGRAM = """
import os
from lyra_petsc.kernels import ahead
from lyra_petsc.kernels.cache import KERNELS, cached
from lyra_petsc.kernels.compilation import COMPILATION

@cached()
def first(x):
    return x + 1.0

@cached()
def second(x):
    return x + 2.0

@cached()
def third(x):
    return x + 3.0

names = "first", "second", "third", "of_another_scene"
ahead.listed = lambda: [(f"__main__:{name}", "(float64,)") for name in names]
os.sched_getaffinity = lambda process: {0, 1}
COMPILATION.ahead = ahead.CompilationAhead()
assert first(1.0) == 2.0
assert os.waitpid(COMPILATION.ahead._child, 0)[1] == 0
compiled_here = [name for name in names[:3] if KERNELS[f"__main__:{name}"].stats.cache_misses]
assert (second(1.0), third(1.0)) == (3.0, 4.0)
loaded = [name for name in names[:3] if KERNELS[f"__main__:{name}"].stats.cache_hits]
print(*compiled_here, "|", *loaded)
"""


def test_another_process_compiles_what_is_called_later(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(textwrap.dedent(PROGRAM))
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(ROOT)}
    done = run_program([sys.executable, program], env=variables, seconds=100)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "first | second third"


@pytest.mark.slow
def test_the_list_has_the_kernels_of_its_scenes() -> None:
    """If not, write it anew by ``scripts/cold_start.py --record``."""
    script = module_of(ROOT / "scripts" / "cold_start.py", "cold_start")
    called = {line for case in script.RECORDED for line in script.kernels(*case)}
    assert called == {f"{name} {types}" for name, types in listed()}
