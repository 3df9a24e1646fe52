"""The verb ``view``: serves a local web page that plays a run."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lyra_petsc.cli.options import Session, results, verb
from lyra_petsc.errors import InputError, Interrupted, LyraError
from lyra_petsc.extras import require_packages
from lyra_petsc.output.file_operations import raise_on_all_ranks

if TYPE_CHECKING:
    from lyra_petsc.show.view.live import LivePage

Function = TypeVar("Function", bound=Callable[..., Any])


def server_options(function: Function) -> Function:
    """Add the options of the page's server."""
    for option in (
        click.option("--no-browser", is_flag=True, help="Do not open the page in a browser."),
        click.option("--port", type=click.IntRange(0, 65535), metavar="N", help="Its port (a free one)."),
        click.option("--host", metavar="ADDRESS", help="Where it listens (127.0.0.1: this machine alone)."),
    ):
        function = option(function)
    return function


@dataclass(frozen=True)
class Served:
    """Address and port of the page, and whether to open it in a browser."""

    host: str
    port: int
    browse: bool

    @classmethod
    def of(cls, host: str | None, port: int | None, no_browser: bool) -> Served:
        """The address that the options name."""
        return cls("127.0.0.1" if host is None else host, port or 0, not no_browser)

    @classmethod
    def of_live(cls, live: bool, host: str | None, port: int | None, no_browser: bool) -> Served | None:
        """The address that the options of ``run`` name; None without ``--live``.

        Raises
        ------
        InputError
            For server options without ``--live``.
        """
        if live:
            return cls.of(host, port, no_browser)
        options = {"--host": host is not None, "--port": port is not None, "--no-browser": no_browser}
        for name, is_given in options.items():
            if is_given:
                raise InputError("says where the page of --live is, which is not given", key=name)
        return None

    def check(self, option: str) -> None:
        """Check that the page can be served; to be called on one rank before anything else.

        Raises
        ------
        InputError
            For missing packages, or an address that cannot be used.
        """
        from lyra_petsc.show.view.live import PACKAGES

        require_packages(option, PACKAGES, "view")
        from lyra_petsc.show.view.server import check_address

        check_address(self.host, self.port)

    def live_page(self, folder: Path, say: Callable[[str], Any]) -> LivePage:
        """Start the page of a run whose first state has been written; to be called on one rank."""
        from lyra_petsc.show.view.live import LivePage

        def failed(why: str) -> None:
            say(f"note: no page: {why}")

        return LivePage(folder, self.host, self.port, lambda url: self.announce(url, say), failed)

    def announce(self, url: str, say: Callable[[str], Any]) -> None:
        """Print the address of the page, warn if others can reach it, and open it."""
        from lyra_petsc.show.view.server import is_loopback, open_browser

        say(f"view: {url}")
        if not is_loopback(self.host):
            say("reached from other machines, too, by whoever has this address; it is not encrypted")
        if self.browse:
            open_browser(url)


@verb("lyra-petsc view runs/flag", start=Session.without_petsc)
@results
@click.option("--field", metavar="NAME", help="Colour by speed, strain, displacement or a written field.")
@click.option("--range", metavar="LOW,HIGH", help="Range of the colours: values, or percentiles as 2%,98%.")
@click.option(
    "--set", "settings", multiple=True, metavar="render.KEY=VALUE", help="Change the camera; may be repeated."
)
@server_options
def view(comm: Any, /, run: Path, host: str | None, port: int | None, no_browser: bool, **look: Any) -> None:
    """Play RUN, a folder of results, in the browser, also while it is running."""
    problem: LyraError | None = None
    if comm.rank == 0:
        try:
            _serve(run, Served.of(host, port, no_browser), look)
        except LyraError as error:
            problem = error
    if comm.size > 1:
        request = comm.Ibarrier()
        while not request.Test():  # unlike MPI's barrier this keeps no processor busy
            time.sleep(0.2)
    raise_on_all_ranks(comm, problem)


def _serve(folder: Path, served: Served, look: dict[str, Any]) -> None:
    """Serve the page until a signal."""
    served.check("view")
    from lyra_petsc.show.view.server import serve

    def ready(url: str) -> None:
        served.announce(url, click.echo)
        click.echo("Ctrl-C ends")

    number = asyncio.run(serve(folder, served.host, served.port, ready, **look))
    if number not in (0, signal.SIGINT):  # Ctrl-C is the normal end
        raise Interrupted("", number, "ended by")
