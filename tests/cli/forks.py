"""The program with half of its imports done: forks for each command line that it reads, tells how it left.

A line of the standard input asks for a run: arguments, folder, environment, and where its words go. The
answers are its process number and, when it has ended, its exit code. Neither MPI nor PETSc have been
loaded here: each of the forked processes starts them as any other does, and ends in no other way.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

EARLY = ("cli.app", "kernel_cache", "scene.load", "scene.dump")
"""Modules that take long to load, and know nothing of MPI."""


def become(asked: dict[str, Any]) -> None:
    """Make this process what the asked one is before its first import."""
    os.setsid()
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    for number, (name, how) in enumerate(
        [(os.devnull, os.O_RDONLY), (asked["out"], os.O_WRONLY), (asked["err"], os.O_WRONLY)]
    ):
        file = os.open(name, how)
        os.dup2(file, number)
        os.close(file)
    sys.argv = [str(ROOT / "lyra_petsc" / "__main__.py"), *asked["arguments"]]


def serve() -> None:
    """Fork for each line; returns in the forked processes alone."""
    for line in sys.stdin:
        asked = json.loads(line)
        pid = os.fork()
        if pid == 0:
            become(asked)
            return
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
    os._exit(0)


for room in EARLY:
    importlib.import_module(f"lyra_petsc.{room}")
assert not {"mpi4py.MPI", "petsc4py.PETSc"} & set(sys.modules)
serve()

from lyra_petsc.__main__ import main  # noqa: E402

main()
