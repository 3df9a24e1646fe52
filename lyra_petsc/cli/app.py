"""Entry point of the command line: starts PETSc, runs a verb, and turns errors into messages and exit
codes."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.arguments import move_help, split, start_error, start_petsc
from lyra_petsc.cli.verbs import verbs
from lyra_petsc.errors import InputError, LyraError, SolverError, shorten_words
from lyra_petsc.parallel import restore_signal_handlers

PROGRAM = "lyra-petsc"

COMPLETION = "_LYRA_PETSC_COMPLETE"
"""Environment variable by which a shell requests completions; click derives it from the program's name."""

BUG = 70
"""Exit code of unexpected errors."""

PETSC_OUT_OF_MEMORY = 55
"""PETSc's error code PETSC_ERR_MEM."""

RESERVE = 4 * 2**20
"""Bytes kept in reserve: a rank that runs out of memory needs some to print a message and end the job."""


def run_command_line(argv: Sequence[str]) -> int:
    """Start PETSc with its part of the arguments and run the verb; returns the exit code."""
    if COMPLETION in os.environ:  # completion does not need PETSc
        verbs.main([], prog_name=PROGRAM)
    ours, petsc = move_help(*split(argv[1:]))
    # without a launcher Open MPI would start a daemon, which is only needed to spawn processes
    os.environ.setdefault("OMPI_MCA_ess_singleton_isolated", "1")
    try:
        failure = start_error(petsc)
        if not failure:
            failure = start_petsc([argv[0], *petsc])
            restore_signal_handlers()
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
    if failure:
        _print_error(comm, failure)
        MPI.Finalize()  # PETSc does not, as it has not started
        return InputError.exit_code
    from petsc4py import PETSc

    from lyra_petsc.linear.petsc_options import quoted, refused

    reserve = [bytes(RESERVE)]
    # if colorama is installed, numba would print colour codes to the standard output
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    # overflow makes a step fail, with a message of its own
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
        reserve.clear()  # without memory Open MPI would end with another exit code
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
    """Free the objects referenced by the frames of an exception and of its causes."""
    chain: BaseException | None = error
    while chain is not None:
        traceback.clear_frames(chain.__traceback__)
        chain = chain.__cause__ or chain.__context__


def _print_error(comm: Any, line: str, details: Sequence[str] = ()) -> None:
    """Print an error message with details on rank 0."""
    if comm.rank == 0:
        lines = [f"lyra-petsc: {' '.join(line.split())}", *(f"  {detail}" for detail in details)]
        with suppress(OSError):
            print("\n".join(lines), file=sys.stderr, flush=True)


def _leave_together(comm: Any, code: int, line: str, details: Sequence[str] = ()) -> int:
    """Print the message; returns the exit code if all ranks failed together, else ends the MPI job."""
    from lyra_petsc.parallel import all_ranks_arrive

    _print_error(comm, line, details)
    if not all_ranks_arrive(comm):
        if comm.rank > 0:  # rank 0 may not have failed, and printed nothing
            with suppress(OSError):
                print(f"lyra-petsc: rank {comm.rank}: {' '.join(line.split())}", file=sys.stderr, flush=True)
        comm.Abort(code)
    return code


def _report_unexpected(comm: Any, error: BaseException) -> int:
    """Print an unexpected error, which may concern this rank only; returns the exit code."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    location = f"{Path(frame.filename).name}:{frame.lineno}"
    message = f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'} ({location})"
    if isinstance(error, MemoryError) or getattr(error, "ierr", 0) == PETSC_OUT_OF_MEMORY:
        code, kind = SolverError.exit_code, "out of memory"
        remedy = "take more memory, more machines or a coarser mesh"
    else:
        code, kind = BUG, "internal error"
        remedy = "this is a bug, please report it with the scene; LYRA_TRACEBACK=1 shows where it happened"
    with suppress(OSError):
        print(f"lyra-petsc: {kind} on rank {comm.rank}: {message}; {remedy}", file=sys.stderr, flush=True)
    if os.environ.get("LYRA_TRACEBACK"):
        traceback.print_exception(error)
    return code


def _in_one_line(error: click.ClickException) -> str:
    if isinstance(error, click.NoSuchOption):
        name = shorten_words(error.option_name)
        return f"{name}: no such option; see --help (PETSc options have one dash)"
    return shorten_words(error.format_message())
