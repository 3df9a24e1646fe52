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
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import reason

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

LOCAL = "127.0.0.1"
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

LEAVE_SECONDS, MAX_STAY_SECONDS = 30, 1800
"""After its run has ended a page is served until nobody has had it open for the first time [s], at most for
the second one: a browser starts slowly, and a forgotten page must not keep a process for ever."""


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
    """

    def __init__(self, token: str, host: str) -> None:
        self._token = token.encode()
        # browsers send cookies to all ports of a host, so each server needs a cookie name of its own
        self._cookie = f"lyra-view-{hashlib.sha256(self._token).hexdigest()[:12]}"
        self._names, self._local = {"localhost", host.lower().strip("[]")}, is_loopback(host)
        if not self._local:
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self.n_open = 0

    def middleware(self) -> Any:
        """The check as aiohttp's middleware."""

        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            if problem := self._problem(request):
                return web.Response(status=403, text=f"403: {problem}\n", headers=HEADERS)
            if request.path == "/paraview/":  # trame's page asks for the web socket's address
                return web.json_response({"sessionURL": f"ws://{request.host}{WEB_SOCKET}"})
            opens = request.path == WEB_SOCKET
            # wslink would keep a web socket that it cannot open, and then could not stop
            if opens and not web.WebSocketResponse().can_prepare(request).ok:
                return web.Response(status=426, headers={"Upgrade": "websocket"})
            self.n_open += opens
            try:
                response = await handler(request)
            except web.HTTPException as answer:
                self._complete(request, answer)
                raise
            finally:
                self.n_open -= opens
            if not response.prepared:
                self._complete(request, response)
            return response

        return check

    def _problem(self, request: web.Request) -> str:
        """The reason for refusing a request; empty if it is accepted."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if not self._is_this_machine(host):
            return "this server does not go by that name"
        token = request.query.get("token") or request.cookies.get(self._cookie) or ""
        if not hmac.compare_digest(token.encode("utf-8", "surrogateescape"), self._token):
            return "the address needs the token that was printed at the start"
        if origin is not None and origin.partition("://")[2] != host:
            return "a page from elsewhere may not ask"
        return ""

    def _is_this_machine(self, host: str) -> bool:
        """Whether the host of a request means this machine, without asking a name server."""
        with suppress(ValueError):
            name = (urlsplit(f"//{host}").hostname or "").lower()
            return name in self._names or ipaddress.ip_address(name).is_loopback or not self._local
        return False

    def _complete(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(HEADERS)
        if "token" in request.query:
            token = self._token.decode()
            response.set_cookie(self._cookie, token, httponly=True, samesite="Strict", path="/")


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine."""
    with suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower() == "localhost"


def check_address(host: str, port: int) -> None:
    """Check that the server can listen on an address, before any other work.

    Raises
    ------
    InputError
        For a port in use, a host that is not this machine, and similar errors.
    """
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, address = addresses[0][0], addresses[0][4]
        socket.create_server(address, family=family).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise _refusal(host, port, error) from None


def _refusal(host: str, port: int, error: BaseException) -> InputError:
    number = getattr(error, "errno", None)
    if isinstance(error, socket.gaierror) or (number and "assign" in os.strerror(number)):
        return InputError(f"{host!r} is no address of this machine; leave it out for {LOCAL}", key="--host")
    return InputError(
        f"{host}:{port} cannot be used: {reason(error)}; leave it out for a free port", key="--port"
    )


async def serve(
    folder: Path,
    host: str,
    port: int,
    ready: Callable[[str], None],
    ended: Callable[[], Awaitable[str]] | None = None,
    **look: Any,
) -> int:
    """Serve the page of a run until a signal, or until the run has ended and no page is open.

    Parameters
    ----------
    folder : Path
        The run's folder.
    host : str
        The address to listen on.
    port : int
        0 for a free one.
    ready : callable
        Called with the page's address once it can be opened.
    ended : callable, optional
        Waits for the end of the run, and returns a text for the page.
    **look
        Arguments of `RunPage`: the page's initial settings.

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
    logging.getLogger("aiohttp").setLevel(logging.CRITICAL)  # it logs each invalid request with a traceback
    from lyra_petsc.show.view.page import RunPage

    page = RunPage(folder, **look)
    token = secrets.token_urlsafe(24)
    access, server = Access(token, host), page.server
    sites: list[Any] = []

    def bind(site: Any) -> None:
        sites.append(site)
        site.app.middlewares.append(access.middleware())

    def announce(**_: Any) -> None:
        ready(f"http://{_in_address(host)}:{server.port}/?token={token}")

    server.controller.on_server_bind.add(bind)
    server.controller.on_server_ready.add(announce)
    loop = asyncio.get_running_loop()
    over: asyncio.Future[int] = loop.create_future()
    nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN

    def end(number: int) -> None:
        if not over.done():
            over.set_result(number)

    for number in (signal.SIGINT, signal.SIGTERM, *([] if nohup else [signal.SIGHUP])):
        loop.add_signal_handler(number, end, int(number))
    sys.argv[1:] = []  # trame would parse them
    options = {"open_browser": False, "show_connection_info": False, "disable_logging": True, "thread": True}
    started = server.start(host=host, port=port, timeout=0, exec_mode="coroutine", **options)
    listening = asyncio.create_task(started)
    tasks = [asyncio.create_task(work) for work in (page.play(), page.follow())]
    if ended is not None:
        tasks.append(asyncio.create_task(_await_end(ended(), page, access)))
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
            await sites[0].stop()
        with suppress(asyncio.CancelledError):
            await listening
    return over.result() if over.done() else 0


async def _await_end(ended: Awaitable[str], page: Any, access: Access) -> None:
    """Show the end of the run once it has come, and return when nobody has the page open any more."""
    page.show_end(await ended)
    unused = 0
    for _ in range(MAX_STAY_SECONDS):
        await asyncio.sleep(1.0)
        unused = 0 if access.n_open else unused + 1
        if unused == LEAVE_SECONDS:
            return


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
