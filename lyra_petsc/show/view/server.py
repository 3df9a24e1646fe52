"""The page's server: one process that listens on one address until a signal or the end of its run."""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.read_run import StoredRun, read_history
from lyra_petsc.show.view.access import Access, keep_quiet_about_bad_requests

LOCAL = "127.0.0.1"

CLOSING_SECONDS = 1.0

RELOAD_SECONDS = 3.0
"""Seconds that the server goes on after the last page was closed, which may only be reloading."""

LONGEST_STAY = 1800.0
"""Seconds after the end of the run that open pages are served."""


def check_address(host: str, port: int) -> None:
    """Check that an address can be listened on, before anything else is done.

    Raises
    ------
    InputError
        For a port in use, a host that is not this machine, and the like.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, address = found[0][0], found[0][4]
        socket.create_server(address, family=family).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise _refusal(host, port, error) from None


def _refusal(host: str, port: int, error: BaseException) -> InputError:
    if isinstance(error, socket.gaierror):
        return InputError(f"{host!r} is no address of this machine; leave it out for {LOCAL}", key="--host")
    if isinstance(error, OSError) and error.errno is not None and "assign" in os.strerror(error.errno):
        return InputError(f"{host} is no address of this machine; leave it out for {LOCAL}", key="--host")
    return InputError(
        f"{host}:{port} cannot be used: {reason(error)}; leave it out for a free port", key="--port"
    )


async def serve(
    run: StoredRun,
    host: str,
    port: int,
    ready: Callable[[str], None],
    ended: Callable[[], str] | None = None,
    **look: Any,
) -> int:
    """Serve the page of a run until a signal, or until the run has ended and no page is open.

    Parameters
    ----------
    run : StoredRun
    host : str
        The address to listen on.
    port : int
        0 for a free one.
    ready : callable
        Called with the page's address once it can be opened.
    ended : callable, optional
        Called in a thread; returns when the run has ended, with a text for the page.
    **look
        Of `Look`: how the page shows the run at first.

    Returns
    -------
    int
        The signal that ended it, or 0.

    Raises
    ------
    InputError
        If it cannot listen there, or the run cannot be shown so.
    """
    os.environ["WSLINK_READY_MSG"] = ""  # else it writes to our stdout
    from lyra_petsc.show.view.page import Look, Page

    asked = Look(**look)
    asked.check(run)
    token = secrets.token_urlsafe(24)
    access = Access(token, host)
    keep_quiet_about_bad_requests()
    page = Page(run, access, asked)
    server = page.server
    web: list[Any] = []

    def bind(web_server: Any) -> None:
        web.append(web_server)
        web_server.app.middlewares.append(access.middleware())

    def tell(**_: Any) -> None:
        ready(f"http://{_in_address(host)}:{server.port}/?token={token}")

    server.controller.on_server_bind.add(bind)
    server.controller.on_server_ready.add(tell)
    loop = asyncio.get_running_loop()
    over: asyncio.Future[int] = loop.create_future()
    nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    for number in (signal.SIGINT, signal.SIGTERM, *([] if nohup else [signal.SIGHUP])):
        loop.add_signal_handler(number, _settle, over, int(number))
    arguments, sys.argv[1:] = sys.argv[1:], []  # trame would read them
    try:
        listening = asyncio.create_task(
            server.start(
                host=host,
                port=port,
                timeout=0,
                thread=True,
                open_browser=False,
                show_connection_info=False,
                disable_logging=True,
                exec_mode="coroutine",
            )
        )
    finally:
        sys.argv[1:] = arguments
    tasks = [asyncio.create_task(page.animate()), asyncio.create_task(page.follow())]
    if ended is not None:
        tasks.append(asyncio.create_task(_watch(ended, page, access, over)))
    await asyncio.wait({listening, over, *tasks}, return_when=asyncio.FIRST_COMPLETED)
    failed = [task for task in tasks if task.done() and task.exception()]
    for task in tasks:
        task.cancel()
    if failed:
        await failed[0]
    if listening.done():
        try:
            listening.result()
        except OSError as error:
            raise _refusal(host, port, error) from None
    else:
        with suppress(RuntimeError, ConnectionError):  # of a page that was just opening, or has gone
            await web[0].stop()
        with suppress(asyncio.CancelledError):
            await listening
    return over.result() if over.done() else 0


async def _watch(ended: Callable[[], str], page: Any, access: Access, over: asyncio.Future[int]) -> None:
    loop = asyncio.get_running_loop()
    told: asyncio.Future[str] = loop.create_future()
    # a daemon, as it may wait for ever
    wait = threading.Thread(target=lambda: loop.call_soon_threadsafe(told.set_result, ended()), daemon=True)
    wait.start()
    words = await told
    await asyncio.sleep(CLOSING_SECONDS)  # in which the run finishes its files
    page.look()
    page.say_goodbye(words)
    deadline, unseen = time.monotonic() + LONGEST_STAY, 0.0
    while unseen < RELOAD_SECONDS and time.monotonic() < deadline:
        await asyncio.sleep(CLOSING_SECONDS)
        unseen = 0.0 if access.watching else unseen + CLOSING_SECONDS
    _settle(over, 0)


def _settle(over: asyncio.Future[int], number: int) -> None:
    if not over.done():
        over.set_result(number)


def _in_address(host: str) -> str:
    """A host as written in a URL; the machine's name if the server listens on all addresses."""
    if host in ("0.0.0.0", "::", ""):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def open_browser(address: str) -> bool:
    """Open the page if there is a desktop, or BROWSER is set; returns whether that was tried."""
    import webbrowser

    known = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    return (known or sys.platform == "darwin") and webbrowser.open(address)


def find_run(folder: Path) -> StoredRun:
    """The run in a folder, of which all that the page needs can be read.

    Raises
    ------
    InputError
    """
    run = StoredRun(folder)
    for needed in ("triangles", "rest", "scene"):
        getattr(run, needed)
    run.positions[0]
    read_history(run.folder)
    return run
