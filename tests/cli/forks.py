"""The program with half of its imports done: forks for each command line that it reads, tells how it left.

A line of the standard input asks for a run: arguments, folder, environment. The answers are its process
number and, when it has ended and nothing that it started can speak for it, its exit code and its words.
Neither MPI nor PETSc have been loaded here: each of the forked processes starts them as any other does,
and ends in no other way.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

EARLY = (
    *("cli.app", "cli.progress", "scene.load", "scene.dump", "scene.json_schema", "mesh.build"),
    *("mesh.obj_file", "mesh.msh_file", "mesh.geo_file", "kernels.scatter", "terms.registry"),
    *("terms.membrane", "terms.bending", "terms.prescribed_handles", "terms.gravity"),
    *("linear.pattern", "linear.block_rows", "linear.gauss_seidel", "linear.edge_couplings"),
    *("stepping.step_control", "output.read_run", "output.run_folder"),
    *("output.vtkhdf_file", "output.summary"),
)
"""Modules that runs load, and that know nothing of MPI."""

DRAWING = (
    "jinja2",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_svg",
    "scipy.spatial",
    "scipy.special",
)
"""What verbs that write a report take longest to load."""

REPORTING = ("report", "stress", "study", "verify")


def load(*modules: str) -> None:
    """Import modules, where they are installed, for all processes that are forked from now on."""
    if set(modules) <= set(sys.modules):
        return
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(module)
    # a third of a forked process's time went into copies of what the collector looked at as it ended
    gc.collect()
    gc.freeze()


def become(asked: dict[str, Any], out: int, err: int) -> None:
    """Make this process what the asked one is before its first import."""
    os.setsid()
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    for number, file in enumerate((os.open(os.devnull, os.O_RDONLY), out, err)):
        os.dup2(file, number)
        os.close(file)
    sys.argv = [str(ROOT / "lyra_petsc" / "__main__.py"), *asked["arguments"]]


def heard(*files: int) -> list[str]:
    """All that comes out of pipes until their other ends are closed."""
    words = {file: bytearray() for file in files}
    still = list(files)
    while still:
        for file in select.select(still, [], [])[0]:
            piece = os.read(file, 2**16)
            words[file] += piece
            if not piece:
                still.remove(file)
                os.close(file)
    return [text.decode() for text in words.values()]


def serve() -> None:
    """Fork for each line; returns in the forked processes alone."""
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["arguments"][:1] and asked["arguments"][0] in REPORTING:
            load(*DRAWING)
        (out, to_out), (err, to_err) = os.pipe(), os.pipe()
        pid = os.fork()
        if pid == 0:
            become(asked, to_out, to_err)
            os.close(out)
            os.close(err)
            return
        os.close(to_out)
        os.close(to_err)
        print(pid, flush=True)
        words = heard(out, err)
        print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), *words]), flush=True)
    os._exit(0)


load(*(f"lyra_petsc.{name}" for name in EARLY))
assert not {"mpi4py.MPI", "petsc4py.PETSc"} & set(sys.modules)
serve()

from lyra_petsc.__main__ import main  # noqa: E402

main()
