"""Options that several verbs share.

`cli.verbs` registers the commands. A module that declares a verb imports the modules for its work only when
it is called, as the declarations of all verbs are imported every time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import update_wrapper
from pathlib import Path
from typing import Any

import click

from lyra_petsc.errors import InputError
from lyra_petsc.parallel import ALONE
from lyra_petsc.startup import is_launched, start_mpi, start_petsc

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class Session:
    """The ranks of this job, of which MPI and PETSc are started when a verb needs them.

    Parameters
    ----------
    petsc : sequence of str
        PETSc options of the command line.

    Attributes
    ----------
    comm : MPI.Comm
        `ALONE` until MPI has started; in a job of a launcher it starts at once.
    """

    def __init__(self, petsc: Sequence[str]) -> None:
        self._petsc = petsc
        self.comm: Any = start_mpi() if is_launched(os.environ) else ALONE

    def start_petsc(self) -> Any:
        """Start PETSc and return MPI's communicator.

        Raises
        ------
        InputError
            If PETSc does not start with its options.
        """
        self.comm = start_mpi()
        start_petsc(self._petsc)
        return self.comm

    def without_petsc(self) -> Any:
        """The communicator for work without PETSc.

        Raises
        ------
        InputError
            If there are PETSc options.
        """
        if self._petsc:
            raise InputError("is an option of PETSc, which has no part in this", key=self._petsc[0])
        return self.comm


def prints(name: str, text: Callable[[click.Context], str], description: str) -> Decorator:
    """An option that prints a text on rank 0 and exits."""

    def show(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value and not ctx.resilient_parsing:
            if ctx.obj.comm.rank == 0:
                click.echo(text(ctx))
            ctx.exit()

    return click.option(
        name, is_flag=True, is_eager=True, expose_value=False, callback=show, help=description
    )


add_help = prints("--help", click.Context.get_help, "Show this and exit.")


SETTINGS: dict[str, Any] = {"help_option_names": [], "token_normalize_func": None}


def example(*lines: str) -> str:
    """The end of a verb's help: commands to copy."""
    heading = "Examples:" if len(lines) > 1 else "Example:"
    return "\n".join(["\b", heading, *(f"  {line}" for line in lines)])


def verb(
    *examples: str, start: Callable[[Session], Any] = Session.start_petsc
) -> Callable[[Callable[..., Any]], click.Command]:
    """Declares a verb; its first argument is what ``start`` returns, and its help ends with the examples."""

    def declare(function: Callable[..., Any]) -> click.Command:
        def call(session: Session, /, *arguments: Any, **options: Any) -> Any:
            return function(start(session), *arguments, **options)

        command = click.command(context_settings=SETTINGS, epilog=example(*examples))
        started = click.pass_obj(update_wrapper(call, function))
        return command(add_help(started if start is Session.without_petsc else petscrc(started)))

    return declare


petscrc = click.option(
    "--petscrc", metavar="FILE", expose_value=False, help="A file of PETSc options, one a line."
)


scene = click.argument("scene", required=False, type=click.Path(path_type=Path))
settings = click.option(
    "--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="Change the scene; may be repeated."
)
trust_mesh = click.option(
    "--trust-mesh",
    is_flag=True,
    help="Let mesh scripts (.geo) read any file, and run without seccomp, if you trust them.",
)
results = click.argument("run", type=click.Path(path_type=Path))
out = click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
