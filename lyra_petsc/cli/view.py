"""``view``: a local page that plays a run."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lyra_petsc.cli.options import SETTINGS, helped, results
from lyra_petsc.errors import Interrupted, LyraError
from lyra_petsc.extras import require

if TYPE_CHECKING:
    from mpi4py import MPI

PACKAGES = ("trame", "trame_vtk", "trame_vuetify", "trame_plotly", "vtkmodules", "matplotlib")
"""What the page needs of the extra ``view``."""

Function = TypeVar("Function", bound=Callable[..., Any])


def address(function: Function) -> Function:
    """The options that say where the page is served."""
    for option in (
        click.option("--no-browser", is_flag=True, help="Do not open the page in a browser."),
        click.option("--port", type=click.IntRange(0, 65535), metavar="N", help="Its port (a free one)."),
        click.option("--host", metavar="ADDRESS", help="Where it listens (127.0.0.1: this machine alone)."),
    ):
        function = option(function)
    return function


@click.command(context_settings=SETTINGS)
@helped
@results
@address
@click.pass_obj
def view(comm: Any, run: Path, host: str | None, port: int | None, no_browser: bool) -> None:
    """Play RUN, a folder of results, in the browser; follow it if it goes on."""
    problem: LyraError | None = None
    number = 0
    if comm.rank == 0:
        try:
            number = _serve(run, host, port or 0, browse=not no_browser)
        except LyraError as error:
            problem = error
    _wait_for_rank_0(comm)
    problem, number = comm.bcast((problem, number), root=0)
    if problem is not None:
        raise problem
    if number not in (0, signal.SIGINT):  # Ctrl-C is how a page ends
        raise Interrupted(f"ended by {signal.Signals(number).name}", number)


def _wait_for_rank_0(comm: MPI.Comm) -> None:
    """Meet the other ranks without keeping their processors busy."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(0.2)


def _serve(folder: Path, host: str | None, port: int, *, browse: bool) -> int:
    """Serve until a signal; the signal."""
    require("view", PACKAGES, "view")
    from lyra_petsc.view.server import LOCAL, check_address, find_run, open_browser, serve

    host = LOCAL if host is None else host
    run = find_run(folder)
    check_address(host, port)

    def ready(url: str) -> None:
        click.echo(announcement(url, host))
        click.echo("Ctrl-C ends")
        if browse:
            open_browser(url)

    return serve(run, host=host, port=port, ready=ready)


def announcement(url: str, host: str) -> str:
    """Where the page is, and who can reach it."""
    from lyra_petsc.view.access import is_loopback

    if is_loopback(host):
        return f"view: {url}"
    return f"view: {url}\nreached also from other machines, by whoever has this address; it is not encrypted"
