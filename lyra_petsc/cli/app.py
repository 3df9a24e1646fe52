"""Entry point of the command line: runs a verb, and turns errors into messages and exit codes."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import numpy as np

from lyra_petsc.cli.arguments import move_help, split
from lyra_petsc.cli.options import Session
from lyra_petsc.cli.verbs import verbs
from lyra_petsc.errors import InputError, LyraError, SolverError, shorten_words
from lyra_petsc.parallel import ALONE

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
    """Run the verb; returns the exit code."""
    if COMPLETION in os.environ:
        verbs.main([], prog_name=PROGRAM)
    ours, petsc = move_help(*split(argv[1:]))
    try:
        session = Session(petsc)
    except InputError as error:  # no MPI
        _print_error(ALONE, str(error))
        return error.exit_code
    reserve = [bytes(RESERVE)]
    # if colorama is installed, numba would print colour codes to the standard output
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    # overflow makes a step fail, with a message of its own
    np.seterr(over="ignore", invalid="ignore")
    try:
        code = verbs.main(ours, prog_name=PROGRAM, standalone_mode=False, obj=session)
    except LyraError as error:
        return _leave_together(session.comm, error.exit_code, str(error), error.details)
    except click.exceptions.Exit as leave:
        return leave.exit_code
    except click.ClickException as error:
        return _leave_together(session.comm, InputError.exit_code, _in_one_line(error))
    except (Exception, KeyboardInterrupt) as error:
        reserve.clear()  # without memory Open MPI would end with another exit code
        if line := _refused_option(error):
            _clear_frames(error)
            return _leave_together(session.comm, InputError.exit_code, line)
        code = _report_unexpected(session.comm, error)
        _clear_frames(error)
        if session.comm.size > 1:
            session.comm.Abort(code)
        return code
    return code if isinstance(code, int) else 0


def _refused_option(error: BaseException) -> str:
    """Message on an option that PETSc refuses; empty for any other error."""
    if "petsc4py.PETSc" not in sys.modules:
        return ""
    from petsc4py import PETSc

    from lyra_petsc.linear.petsc_options import quoted, refused

    return str(refused(error)) if isinstance(error, PETSc.Error) and quoted(error) else ""


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
