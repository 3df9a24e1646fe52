"""The start of the command line, and the message and exit code of each way of failing."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.arguments import help_asked, petsc_cannot_start, split, start_petsc
from lyra_petsc.cli.verbs import verbs
from lyra_petsc.errors import InputError, LyraError, SolverError, with_short_words
from lyra_petsc.parallel import take_back_signals

PROGRAM = "lyra-petsc"

COMPLETION = "_LYRA_PETSC_COMPLETE"
"""Variable by which the shell asks click for completions; click derives it from the program's name."""

BUG = 70
"""Exit code of unexpected errors."""

PETSC_OUT_OF_MEMORY = 55
"""PETSc's error code PETSC_ERR_MEM."""

RESERVE = 4 * 2**20
"""Bytes kept in reserve: a rank that is out of memory needs some to say so, and MPI to end the job."""


def run_command_line(argv: Sequence[str]) -> int:
    """Start PETSc with its part of the arguments and run the verb; returns the exit code."""
    if COMPLETION in os.environ:  # the shell asks at a press of the tab key: PETSc is not needed
        verbs.main([], prog_name=PROGRAM)
    ours, petsc = help_asked(*split(argv[1:]))
    # without a launcher Open MPI starts a daemon, which only a process that spawns others would need
    os.environ.setdefault("OMPI_MCA_ess_singleton_isolated", "1")
    try:
        why = petsc_cannot_start(petsc)
        if not why:
            why = start_petsc([argv[0], *petsc])
            take_back_signals()
        import numpy as np
        from mpi4py import MPI
    except ImportError as error:
        print(
            f"lyra-petsc: {error}: this Python ({sys.executable}) has no working petsc4py and mpi4py; "
            "use 'bash scripts/run.sh', or see the README for conda, clusters and PyPI",
            file=sys.stderr,
        )
        return InputError.exit_code

    comm = MPI.COMM_WORLD
    if why:
        _say(comm, why)
        MPI.Finalize()  # which a PETSc that has not started leaves to others
        return InputError.exit_code
    from petsc4py import PETSc

    from lyra_petsc.linear.petsc_options import quoted, refused

    reserve = [bytes(RESERVE)]
    # numba would put colour codes on the standard output where it finds colorama
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    # numbers that overflow make a step fail, and the message says so
    np.seterr(over="ignore", invalid="ignore")
    try:
        code = verbs.main(ours, prog_name=PROGRAM, standalone_mode=False, obj=comm)
    except LyraError as error:
        return _leave_together(comm, error.exit_code, str(error), error.details)
    except click.exceptions.Exit as leave:
        return leave.exit_code
    except click.ClickException as error:
        return _leave_together(comm, InputError.exit_code, _in_one_line(error))
    except (Exception, KeyboardInterrupt) as error:
        reserve.clear()  # Open MPI without memory leaves with a code of its own
        if isinstance(error, PETSc.Error) and quoted(error):
            line = str(refused(error))
            _clear_frames(error)
            return _leave_together(comm, InputError.exit_code, line)
        code = _report_unexpected(comm, error)
        _clear_frames(error)
        if comm.size > 1:
            comm.Abort(code)
        return code
    return code if isinstance(code, int) else 0


def _clear_frames(error: BaseException) -> None:
    """Free the objects that the frames of an exception and of its causes still hold."""
    chain: BaseException | None = error
    while chain is not None:
        traceback.clear_frames(chain.__traceback__)
        chain = chain.__cause__ or chain.__context__


def _say(comm: Any, line: str, details: Sequence[str] = ()) -> None:
    if comm.rank == 0:
        lines = [f"lyra-petsc: {' '.join(line.split())}", *(f"  {detail}" for detail in details)]
        with suppress(OSError):
            print("\n".join(lines), file=sys.stderr, flush=True)


def _leave_together(comm: Any, code: int, line: str, details: Sequence[str] = ()) -> int:
    """Print the message; returns the exit code if all ranks failed together, else ends the MPI job."""
    from lyra_petsc.parallel import all_here

    _say(comm, line, details)
    if not all_here(comm):
        if comm.rank > 0:  # rank 0, which prints the messages, does not know
            with suppress(OSError):
                print(f"lyra-petsc: rank {comm.rank}: {' '.join(line.split())}", file=sys.stderr, flush=True)
        comm.Abort(code)
    return code


def _report_unexpected(comm: Any, error: BaseException) -> int:
    """Print an unexpected error, which this rank alone may have met; returns the exit code."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(frame.filename).name}:{frame.lineno}"
    what = f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'} ({where})"
    if isinstance(error, MemoryError) or getattr(error, "ierr", 0) == PETSC_OUT_OF_MEMORY:
        code, kind = SolverError.exit_code, "out of memory"
        remedy = "take more memory, more machines or a coarser mesh"
    else:
        code, kind = BUG, "internal error"
        remedy = "this is a bug, please report it with the scene; LYRA_TRACEBACK=1 shows where it happened"
    with suppress(OSError):
        print(f"lyra-petsc: {kind} on rank {comm.rank}: {what}; {remedy}", file=sys.stderr, flush=True)
    if os.environ.get("LYRA_TRACEBACK"):
        traceback.print_exception(error)
    return code


def _in_one_line(error: click.ClickException) -> str:
    if isinstance(error, click.NoSuchOption):
        name = with_short_words(error.option_name)
        return f"{name}: no such option; see --help (PETSc options have one dash)"
    return with_short_words(error.format_message())
