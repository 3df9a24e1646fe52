"""The page's server: a process that listens on one address until a signal or the end of its run.

Requests must contain the token and name this machine as the host.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import logging
import os
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import reason
from lyra_petsc.output.read_run import StoredRun, read_history

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

WEB_SOCKET = "/ws"

HEADERS = {
    # nothing may be loaded from other hosts; unsafe-eval: Vue compiles the page's template in the browser
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        "worker-src 'self' blob:; form-action 'none'; "
        # notebooks of this machine show the page in a frame
        "frame-ancestors http://localhost:* http://127.0.0.1:*"
    ),
    "Cache-Control": "private, no-cache",
    "Referrer-Policy": "no-referrer",  # the address contains the token
    "X-Content-Type-Options": "nosniff",
}


class Access:
    """Checks every request, including those that open a web socket.

    The first request has the token in its address (``?token=…``); the answer sets a cookie, which authorises
    all further requests of the page.

    Parameters
    ----------
    token : str
    host : str
        The address the server listens on.

    Attributes
    ----------
    n_open : int
        Number of open pages (web sockets).
    was_opened : bool
        Whether a page has ever been opened.
    """

    def __init__(self, token: str, host: str) -> None:
        self._token = token.encode()
        # browsers send cookies to all ports of a host, so each server needs a cookie name of its own
        self._cookie = f"lyra-view-{hashlib.sha256(self._token).hexdigest()[:12]}"
        self._names = {"localhost", host.lower().strip("[]")}
        if not is_loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self._local = is_loopback(host)
        self.n_open, self.was_opened = 0, False

    def middleware(self) -> Any:
        """The check as aiohttp's middleware."""

        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            problem = self._problem(request)
            if problem:
                return web.Response(status=403, text=f"403: {problem}\n", headers=HEADERS)
            try:
                response = await self._answer(request, handler)
            except web.HTTPException as error:
                error.headers.update(HEADERS)
                self._set_cookie(request, error)
                raise
            if not response.prepared:
                response.headers.update(HEADERS)
                self._set_cookie(request, response)
            return response

        return check

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.path == "/paraview/":  # trame's page asks for the web socket's address
            return web.json_response({"sessionURL": f"ws://{request.host}{WEB_SOCKET}"})
        opens = request.headers.get("Upgrade", "").lower() == "websocket"
        if request.path != WEB_SOCKET and not opens:
            return await handler(request)
        # wslink would keep a web socket that it cannot open, and then could not stop
        if not web.WebSocketResponse().can_prepare(request).ok:
            text = f"426: {WEB_SOCKET} is for the page's web socket\n"
            return web.Response(status=426, text=text, headers={"Upgrade": "websocket"})
        self.n_open, self.was_opened = self.n_open + 1, True
        try:
            return await handler(request)
        except (ValueError, TypeError, KeyError, ConnectionError) as error:
            raise web.HTTPBadRequest from error  # a message that the page does not send
        finally:
            self.n_open -= 1

    def _problem(self, request: web.Request) -> str:
        """The reason for refusing a request; empty if it is accepted."""
        if not self._is_this_machine(_host_name(f"//{request.headers.get('Host', '')}")):
            return "this server does not go by that name"
        given = request.query.get("token") or request.cookies.get(self._cookie) or ""
        if not hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self._token):
            return "the address needs the token that was printed at the start"
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.headers.get("Host"):
            return "a page from elsewhere may not ask"
        return ""

    def _is_this_machine(self, name: str) -> bool:
        """Whether a host name means this machine, without asking a name server."""
        if name in self._names:
            return True
        with suppress(ValueError):
            return ipaddress.ip_address(name).is_loopback or not self._local
        return False

    def _set_cookie(self, request: web.Request, response: web.StreamResponse) -> None:
        if "token" in request.query:
            response.set_cookie(
                self._cookie, self._token.decode(), httponly=True, samesite="Strict", path="/"
            )


def silence_bad_requests() -> None:
    """Keep aiohttp from logging a traceback for each invalid HTTP request, which it answers with 400."""

    def is_logged(record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return not isinstance(error, HttpProcessingError)

    logging.getLogger("aiohttp.server").addFilter(is_logged)


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine."""
    with suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower() == "localhost"


def _host_name(address: str) -> str:
    try:
        return (urlsplit(address).hostname or "").lower()
    except ValueError:
        return ""


LOCAL = "127.0.0.1"

CLOSING_SECONDS = 1.0

RELOAD_SECONDS = 3.0
"""Time [s] for which the server runs after the last page is closed, as a page may only be reloading."""

FIRST_PAGE_SECONDS = 30.0
"""Time [s] for which the server waits after the end of a run for a first page: a browser starts slowly."""

MAX_STAY = 1800.0
"""Time [s] after the end of the run for which open pages are served."""


def check_address(host: str, port: int) -> None:
    """Check that the server can listen on an address, before any other work.

    Raises
    ------
    InputError
        For a port in use, a host that is not this machine, and similar errors.
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
        Called in a thread; returns a text for the page when the run has ended.
    **look
        Arguments of `Look`: the page's initial settings.

    Returns
    -------
    int
        The signal that ended the server, or 0.

    Raises
    ------
    InputError
        If the server cannot listen on the address, or the run cannot be shown with these settings.
    """
    os.environ["WSLINK_READY_MSG"] = ""  # else wslink writes to standard output
    from lyra_petsc.show.view.page import Look, Page

    settings = Look(**look)
    settings.check(run)
    token = secrets.token_urlsafe(24)
    access = Access(token, host)
    silence_bad_requests()
    page = Page(run, access, settings)
    server = page.server
    web: list[Any] = []

    def bind(web_server: Any) -> None:
        web.append(web_server)
        web_server.app.middlewares.append(access.middleware())

    def announce(**_: Any) -> None:
        ready(f"http://{_in_address(host)}:{server.port}/?token={token}")

    server.controller.on_server_bind.add(bind)
    server.controller.on_server_ready.add(announce)
    loop = asyncio.get_running_loop()
    over: asyncio.Future[int] = loop.create_future()
    nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    for number in (signal.SIGINT, signal.SIGTERM, *([] if nohup else [signal.SIGHUP])):
        loop.add_signal_handler(number, _finish, over, int(number))
    arguments, sys.argv[1:] = sys.argv[1:], []  # trame would parse them
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
        tasks.append(asyncio.create_task(_await_end(ended, page, access, over)))
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
        with suppress(RuntimeError, ConnectionError):  # a page that is just opening, or has been closed
            await web[0].stop()
        with suppress(asyncio.CancelledError):
            await listening
    return over.result() if over.done() else 0


async def _await_end(ended: Callable[[], str], page: Any, access: Access, over: asyncio.Future[int]) -> None:
    """After the run has ended, show its end, and set ``over`` when all pages are closed."""
    loop = asyncio.get_running_loop()
    text: asyncio.Future[str] = loop.create_future()
    # a daemon thread, as it may wait forever
    wait = threading.Thread(target=lambda: loop.call_soon_threadsafe(text.set_result, ended()), daemon=True)
    wait.start()
    farewell = await text
    await asyncio.sleep(CLOSING_SECONDS)  # the run is still completing its files
    page.refresh()
    page.show_end(farewell)
    deadline, closed = time.monotonic() + MAX_STAY, 0.0
    while closed < (RELOAD_SECONDS if access.was_opened else FIRST_PAGE_SECONDS):
        if time.monotonic() > deadline:
            break
        await asyncio.sleep(CLOSING_SECONDS)
        closed = 0.0 if access.n_open else closed + CLOSING_SECONDS
    _finish(over, 0)


def _finish(over: asyncio.Future[int], number: int) -> None:
    if not over.done():
        over.set_result(number)


def _in_address(host: str) -> str:
    """A host as written in a URL; the machine's name if the server listens on all addresses."""
    if host in ("0.0.0.0", "::", ""):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def open_browser(address: str) -> bool:
    """Try to open the page if there is a desktop or BROWSER is set; returns whether a browser was opened."""
    import webbrowser

    known = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    return (known or sys.platform == "darwin") and webbrowser.open(address)


def find_run(folder: Path) -> StoredRun:
    """The run in a folder, after checking that all data of the page can be read.

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
