"""Time of a scene's first run, from an empty cache of kernels: ``cold_start.py SCENE [KEY=VALUE …]``.

``--record`` writes the list of kernels that are compiled ahead, with those of the scenes in `RECORDED`.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "lyra_petsc" / "kernels" / "signatures.txt"

SMALL = ("ball", "time.end=0.1", "mesh.grid.nx=12", "mesh.grid.ny=12")
RECORDED = (
    ("flag", "time.end=0.01"),
    SMALL,
    (*SMALL, "material.bending_model=midedge", "petsc.pc_type=mg"),
)
"""Scenes of ``configs``, with changes, whose kernels are listed: hinges and wind, contact and friction,
unknowns on edges and multigrid."""

LOG_CALLS = """
import sys
from numba.core import types
from numba.core.dispatcher import Dispatcher
from lyra_petsc.kernels.cache import kernel_name

def text(kind):
    if isinstance(kind, types.BaseTuple):
        return f"Tuple(({', '.join(map(text, kind))},))"
    if isinstance(kind, types.Array):
        return f"Array({text(kind.dtype)}, {kind.ndim}, '{kind.layout}', {not kind.mutable})"
    return "boolean" if kind == types.boolean else str(kind)

def logged(kernel, *args, **keywords):
    kinds = [kernel.typeof_pyval(arg) for arg in args]
    print("kernel:", kernel_name(kernel), f"({', '.join(map(text, kinds))},)", file=sys.stderr)
    return compiled(kernel, *args, **keywords)

compiled, Dispatcher._compile_for_args = Dispatcher._compile_for_args, logged
from lyra_petsc.__main__ import main
sys.exit(main())
"""
"""Runs the program, and prints each kernel when Python first calls it."""


def arguments(scene: str, changes: tuple[str, ...], folder: str) -> list[str]:
    """Command line of a run."""
    sets = [part for change in changes for part in ("--set", change)]
    return ["run", str(ROOT / "configs" / f"{scene}.yaml"), "--out", f"{folder}/out", *sets]


def kernels(scene: str, *changes: str) -> list[str]:
    """Lines of the list for the kernels that a run calls, in the order of the first calls."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", LOG_CALLS, *arguments(scene, changes, folder)]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=True)
    return [line.removeprefix("kernel: ") for line in done.stderr.splitlines() if line.startswith("kernel: ")]


def record() -> None:
    """Write the list: each scene's kernels are inserted behind those that it calls before them."""
    lines: list[str] = []
    for case in RECORDED:
        at = 0
        for line in kernels(*case):
            if line in lines:
                at = max(at, lines.index(line) + 1)
            else:
                lines.insert(at, line)
                at += 1
    LIST.write_text("".join(f"{line}\n" for line in lines))


def measure(scene: str, *changes: str) -> None:
    """Run a scene with an empty cache, and print its wall and CPU time."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "lyra_petsc", *arguments(scene, changes, folder)]
        begin = time.perf_counter()
        subprocess.run(command, env=os.environ | {"NUMBA_CACHE_DIR": f"{folder}/kernels"}, check=True)
        wall = time.perf_counter() - begin
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{wall:.1f} s of wall time, {used.ru_utime + used.ru_stime:.1f} s of CPU time")


if __name__ == "__main__":
    record() if sys.argv[1:] == ["--record"] else measure(*sys.argv[1:])
