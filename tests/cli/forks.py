"""The program with half of its imports done, forked for each command line of ``rank.py`` or of a test.

A command line that begins with a ``.py`` file runs this file instead, with the words after it.

The process listens on the socket that is its standard input. A message has arguments, folder and environment,
and descriptors for stdout and stderr; the answer is the exit code, negative for a signal. If a client closes
its connection before, the forked process is killed. MPI and PETSc are not loaded here: each forked process
starts and ends them as any other process does, also under mpirun.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from compile_once import compile_once

ROOT = Path(__file__).parents[2]

EARLY = (
    *("h5py", "ruamel.yaml", "lyra_petsc.cli.app", "lyra_petsc.cli.progress", "lyra_petsc.scene.load"),
    *("lyra_petsc.scene.dump", "lyra_petsc.scene.json_schema", "lyra_petsc.mesh.build"),
    *("lyra_petsc.mesh.obj_file", "lyra_petsc.mesh.msh_file", "lyra_petsc.mesh.library_file"),
    *("lyra_petsc.kernels.scatter", "lyra_petsc.terms.membrane"),
    *("lyra_petsc.terms.bending.hinge_forces", "lyra_petsc.terms.bending.hinge_rows"),
    *("lyra_petsc.terms.handles.prescribed_handles", "lyra_petsc.linear.block_product"),
    *("lyra_petsc.linear.block_rows", "lyra_petsc.linear.gauss_seidel", "lyra_petsc.linear.edge_couplings"),
    *("lyra_petsc.stepping.integrators.beuler", "lyra_petsc.stepping.integrators.static"),
    *("lyra_petsc.stepping.step_control", "lyra_petsc.output.history", "lyra_petsc.output.run_folder"),
    *("lyra_petsc.output.stored", "lyra_petsc.output.summary", "lyra_petsc.output.vtkhdf_file"),
    *("lyra_petsc.output.xdmf",),
)
"""Modules that runs load, and that do not use MPI."""

DRAWING = (
    "jinja2",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_svg",
    "pyvista",
    "scipy.spatial",
    "scipy.special",
)
"""Slowest imports of commands that write reports."""

REPORTING = ("render", "report", "stress", "study", "verify")


def load(*modules: str, optional: bool = False) -> None:
    """Import modules, optional ones if they are installed, for all processes that are forked later."""
    if set(modules) <= set(sys.modules):
        return
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError) if optional else contextlib.nullcontext():
            importlib.import_module(module)
    # else a forked process copies the memory that the collector visits at its end: a third of its time
    gc.collect()
    gc.freeze()


def become(asked: dict[str, Any], out: int, err: int) -> None:
    """Take over environment, folder and streams of the requesting process.

    Packages that ``TESTS_WITHOUT`` names cannot be imported, as if they were not installed.
    """
    os.setsid()
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    for number, file in enumerate((os.open(os.devnull, os.O_RDONLY), out, err)):
        os.dup2(file, number)
        os.close(file)
    hidden = os.environ.pop("TESTS_WITHOUT", "").split()
    sys.modules.update(dict.fromkeys([*hidden, *(n for n in sys.modules if n.partition(".")[0] in hidden)]))
    sys.argv = [str(ROOT / "lyra_petsc" / "__main__.py"), *asked["arguments"]]


def attend(connection: socket.socket, asked: dict[str, Any], out: int, err: int) -> None:
    """Fork, wait and answer; returns in the forked process only."""
    pid = os.fork()
    if pid == 0:
        connection.close()
        become(asked, out, err)
        return
    os.close(out)
    os.close(err)
    ended = os.pidfd_open(pid)
    if ended not in select.select([connection, ended], [], [])[0]:  # the client has closed the connection
        os.kill(pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    with contextlib.suppress(OSError):
        connection.send(json.dumps(code).encode())
    os._exit(0)


def serve() -> None:
    """Fork for each connection; returns in the forked processes only."""
    listener = socket.socket(fileno=os.dup(0))
    while True:
        connection, _ = listener.accept()
        with contextlib.suppress(ChildProcessError):  # collect processes that have ended
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        message, files, *_ = socket.recv_fds(connection, 2**18, 2)
        asked = json.loads(message)
        if asked["arguments"][:1] and asked["arguments"][0] in REPORTING:
            load(*DRAWING, optional=True)
        if os.fork() == 0:
            listener.close()
            attend(connection, asked, *files)
            return
        connection.close()
        for file in files:
            os.close(file)


load(*EARLY)
compile_once()
assert not {"mpi4py.MPI", "petsc4py.PETSc"} & set(sys.modules)
serve()

if sys.argv[1:] and sys.argv[1].endswith(".py"):
    del sys.argv[0]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
    runpy.run_path(sys.argv[0], run_name="__main__")
    gc.freeze()  # as in `main`
else:
    from lyra_petsc.__main__ import main

    main()
