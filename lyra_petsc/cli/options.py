"""Options that several verbs share.

`cli.verbs` registers the commands. A module that declares a verb imports the modules for its work only when
it is called, as the declarations of all verbs are imported every time.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def prints(name: str, text: Callable[[click.Context], str], description: str) -> Decorator:
    """An option that prints a text on rank 0 and exits."""

    def show(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value and not ctx.resilient_parsing:
            if ctx.obj.rank == 0:
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


def verb(*examples: str) -> Callable[[Callable[..., Any]], click.Command]:
    """Declares a verb, whose first argument is the communicator and whose help ends with the examples."""

    def declare(function: Callable[..., Any]) -> click.Command:
        command = click.command(context_settings=SETTINGS, epilog=example(*examples))
        return command(add_help(click.pass_obj(function)))

    return declare


scene = click.argument("scene", required=False, type=click.Path(path_type=Path))
settings = click.option(
    "--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="Change the scene; may be repeated."
)
trust_mesh = click.option(
    "--trust-mesh",
    is_flag=True,
    help="Pass mesh scripts (.geo) to gmsh unchecked, if you trust them.",
)
results = click.argument("run", type=click.Path(path_type=Path))
out = click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the results.")
