"""The command line: verbs, and how each way of failing leaves."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from lyra_petsc import __version__
from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.signals import take_back_from_petsc
from lyra_petsc.errors import InputError, LyraError, SolverError
from lyra_petsc.nearest import nearest

BUG = 70
"""Exit code of what should never happen."""

PETSC_OUT_OF_MEMORY = 55
"""PETSc's error code PETSC_ERR_MEM."""

RESERVE = 4 * 2**20
"""Bytes of address space kept back: a rank without memory needs some to say so, and MPI to end the job."""

LATER = {
    "render": "pictures and films",
    "view": "a live page",
    "export": "other formats",
    "report": "one page about a run",
    "new": "a starter scene",
}
"""Verbs that are announced and not there yet."""


def run_command_line(argv: Sequence[str]) -> int:
    """Parse and run; the exit code. Starts PETSc with its part of the arguments."""
    ours, petsc = split(argv[1:])
    try:
        import petsc4py

        petsc4py.init([argv[0], *petsc])
        take_back_from_petsc()
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
    reserve = [bytes(RESERVE)]
    # a number that overflows makes a step fail, which is told once and in words
    np.seterr(over="ignore", invalid="ignore")
    try:
        code = _verbs.main(ours, prog_name="lyra-petsc", standalone_mode=False, obj=comm)
    except LyraError as error:
        _say(comm, str(error), error.details)
        return _leave_together(comm, error.exit_code, str(error))
    except click.exceptions.Exit as leave:
        return leave.exit_code
    except click.ClickException as error:
        line = _in_one_line(error)
        _say(comm, line)
        return _leave_together(comm, InputError.exit_code, line)
    except (Exception, KeyboardInterrupt) as error:
        reserve.clear()  # Open MPI without memory leaves with a code of its own
        code = _report_unexpected(comm, error)
        _let_go(error)
        if comm.size > 1:
            comm.Abort(code)
        return code
    return code if isinstance(code, int) else 0


def _let_go(error: BaseException) -> None:
    """Free what the frames of an exception, and of those it came from, still hold."""
    chain: BaseException | None = error
    while chain is not None:
        traceback.clear_frames(chain.__traceback__)
        chain = chain.__cause__ or chain.__context__


def _say(comm: Any, line: str, details: Sequence[str] = ()) -> None:
    if comm.rank == 0:
        lines = [f"lyra-petsc: {' '.join(line.split())}", *(f"  {detail}" for detail in details)]
        with suppress(OSError):
            print("\n".join(lines), file=sys.stderr, flush=True)


def _leave_together(comm: Any, code: int, line: str) -> int:
    """Exit if all ranks failed alike; end the whole job if some are still at work."""
    from lyra_petsc.parallel import all_here

    if not all_here(comm):
        if comm.rank > 0:  # rank 0, which speaks for all, has not heard of it
            with suppress(OSError):
                print(f"lyra-petsc: rank {comm.rank}: {' '.join(line.split())}", file=sys.stderr, flush=True)
        comm.Abort(code)
    return code


def _report_unexpected(comm: Any, error: BaseException) -> int:
    """Say on this rank what happened to it alone, perhaps; the exit code."""
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
        return f"{error.option_name}: no such option; see --help (PETSc options have one dash)"
    return error.format_message()


class _Verbs(click.Group):
    """Resolves verbs; help goes to rank 0 only."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name in LATER:
            raise InputError(
                f"'{name}' ({LATER[name]}) is not there yet; there are: {_listing(self)}", key=name
            )
        if self.get_command(ctx, name) is None:
            hint = (
                "give a verb first, as in: run " + name
                if Path(name).suffix
                else nearest(name, list(self.commands))
            )
            raise InputError(f"unknown verb, {hint}", key=name)
        return super().resolve_command(ctx, args)


def _listing(group: click.Group) -> str:
    return ", ".join(sorted(group.commands))


def _help(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        if ctx.obj.rank == 0:
            click.echo(ctx.get_help())
        ctx.exit()


def _version(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        if ctx.obj.rank == 0:
            click.echo(f"lyra-petsc {__version__}")
        ctx.exit()


_helped = click.option(
    "--help", is_flag=True, is_eager=True, expose_value=False, callback=_help, help="Show this and exit."
)
_SETTINGS: dict[str, Any] = {"help_option_names": [], "token_normalize_func": None}


@click.group(cls=_Verbs, context_settings=_SETTINGS, invoke_without_command=True)
@_helped
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_version,
    help="Show the version and exit.",
)
@click.pass_context
def _verbs(ctx: click.Context) -> None:
    """Thin-shell simulation (cloth, membranes, plates) in parallel on PETSc.

    mpirun -n P lyra-petsc VERB [SCENE] [--our options] [-petsc options]
    """
    if ctx.invoked_subcommand is None and ctx.obj.rank == 0:
        click.echo(ctx.get_help())


_scene = click.argument("scene", required=False, type=click.Path(path_type=Path))
_set = click.option(
    "--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="Change the scene; may be repeated."
)


@_verbs.command(context_settings=_SETTINGS)
@_helped
@_scene
@_set
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
@click.option("--force", is_flag=True, help="Replace the results in DIR.")
@click.option("--resume", is_flag=True, help="Go on from the newest checkpoint.")
@click.pass_obj
def run(
    comm: Any, scene: Path | None, settings: tuple[str, ...], out: Path | None, force: bool, resume: bool
) -> None:
    """Simulate SCENE (default: a flag in the wind)."""
    from lyra_petsc.cli.run import run as run_scene

    run_scene(comm, scene, settings, out=out, force=force, resume=resume)


@_verbs.command(context_settings=_SETTINGS)
@_helped
@_scene
@_set
@click.pass_obj
def check(comm: Any, scene: Path | None, settings: tuple[str, ...]) -> None:
    """Check SCENE and print what a run would do; runs nothing."""
    from lyra_petsc.cli.check import check as check_scene

    check_scene(comm, scene, settings)


@_verbs.command(context_settings=_SETTINGS)
@_helped
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option("--quick", is_flag=True, help="Only the coarser resolutions of each case.")
@click.option("--list", "listed", is_flag=True, help="Name the cases; runs nothing.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
@click.option("--force", is_flag=True, help="Write into DIR also if it exists.")
@click.pass_obj
def verify(
    comm: Any, names: tuple[str, ...], quick: bool, listed: bool, out: Path | None, force: bool
) -> int:
    """Run the cases with exact or published answers (default: all); exit code 1 if a verdict fails."""
    from lyra_petsc.cli.verify import list_cases
    from lyra_petsc.cli.verify import verify as verify_cases

    if listed:
        list_cases(comm)
        return 0
    return verify_cases(comm, names, quick=quick, out=out, force=force)


@_verbs.command(context_settings=_SETTINGS)
@_helped
@_scene
@_set
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=V,V,…",
    help="What varies: dt, mesh, integrator, tolerance, ksp_rtol (any PETSc option), any key of the scene; "
    "may be repeated, all combinations are run.",
)
@click.option("--reference", metavar="auto|exact:NAME|run:DIR", help="What errors are measured against.")
@click.option("--quantities", metavar="NAME,NAME,…", help="position, energy, probes, or a probe's name.")
@click.option("--repeats", type=int, metavar="N", help="How often each combination is timed (3).")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks for each case.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
@click.option("--force", is_flag=True, help="Replace the results in DIR.")
@click.option("--resume", is_flag=True, help="Go on without repeating finished combinations.")
@click.option("--job", type=click.Path(path_type=Path), hidden=True)
@click.pass_obj
def study(comm: Any, /, job: Path | None, **asked: Any) -> None:
    """Error against run time: run, time and compare combinations of settings of SCENE."""
    from lyra_petsc.report.extras import require

    require("study")
    from lyra_petsc.cli.study import Asked, run_job
    from lyra_petsc.cli.study import study as study_scene

    if job is not None:
        run_job(comm, job)
    else:
        study_scene(comm, Asked(**asked))


@_verbs.command(context_settings=_SETTINGS)
@_helped
@_scene
@_set
@click.option("--only", multiple=True, metavar="NAME,NAME,…", help="Only these cases or families.")
@click.option("--quick", is_flag=True, help="Fewer cases, on a coarser sheet: less than a minute.")
@click.option("--full", is_flag=True, help="All values, and their products.")
@click.option("--list", "listed", is_flag=True, help="Name the cases; runs nothing.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
@click.option("--force", is_flag=True, help="Write into DIR also if it exists.")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks for each case.")
@click.option("--job", type=click.Path(path_type=Path), hidden=True)
@click.pass_obj
def stress(comm: Any, /, listed: bool, **asked: Any) -> int:
    """Run stiff and extreme cases, on a hanging sheet or on SCENE; exit code 1 if a verdict fails."""
    from lyra_petsc.cli.stress import Asked, list_cases
    from lyra_petsc.cli.stress import stress as stress_cases

    if listed:
        list_cases(comm, Asked(**asked))
        return 0
    return stress_cases(comm, Asked(**asked))


@_verbs.command(context_settings=_SETTINGS)
@_helped
@click.pass_obj
def info(comm: Any) -> None:
    """Print versions and what does not fit together."""
    from lyra_petsc.cli.info import info as describe

    text = describe(comm)
    if comm.rank == 0:
        click.echo(text)
