"""Access to the page: requests need the token, and must name this machine as the host."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

WEB_SOCKET = "/ws"

HEADERS = {
    # nothing is loaded from other hosts; Vue compiles the page's template in the browser
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        "worker-src 'self' blob:; frame-ancestors 'none'; form-action 'none'"
    ),
    "Cache-Control": "private, no-cache",
    "Referrer-Policy": "no-referrer",  # the address contains the token
    "X-Content-Type-Options": "nosniff",
}


class Access:
    """Checks every request, also those that open a web socket.

    The first request has the token in its address (``?token=…``); the answer sets a cookie, which authorises
    all further requests of the page.

    Parameters
    ----------
    token : str
    host : str
        The address the server listens on.

    Attributes
    ----------
    watching : int
        Number of open pages (web sockets).
    """

    def __init__(self, token: str, host: str) -> None:
        self._token = token.encode()
        # browsers send cookies to all ports of a host, so each server needs a name of its own
        self._cookie = f"lyra-view-{hashlib.sha256(self._token).hexdigest()[:12]}"
        self._names = {"localhost", host.lower().strip("[]")}
        if not is_loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self._local = is_loopback(host)
        self.watching = 0

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
                self._give_cookie(request, error)
                raise
            if not response.prepared:
                response.headers.update(HEADERS)
                self._give_cookie(request, response)
            return response

        return check

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.path == "/paraview/":  # trame's page asks for the web socket's address
            return web.json_response({"sessionURL": f"ws://{request.host}{WEB_SOCKET}"})
        opens = request.headers.get("Upgrade", "").lower() == "websocket"
        if request.path != WEB_SOCKET and not opens:
            return await handler(request)
        # wslink keeps what it could not open, and can then not end
        if not web.WebSocketResponse().can_prepare(request).ok:
            words = f"426: {WEB_SOCKET} is for the page's web socket\n"
            return web.Response(status=426, text=words, headers={"Upgrade": "websocket"})
        self.watching += 1
        try:
            return await handler(request)
        except (ValueError, TypeError, KeyError, ConnectionError) as error:
            raise web.HTTPBadRequest from error  # messages that are none of the page's
        finally:
            self.watching -= 1

    def _problem(self, request: web.Request) -> str:
        """Why a request is refused; empty if it is not."""
        if not self._is_ours(_name_of(f"//{request.headers.get('Host', '')}")):
            return "this server does not go by that name"
        given = request.query.get("token") or request.cookies.get(self._cookie) or ""
        if not hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self._token):
            return "the address needs the token that was printed at the start"
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.headers.get("Host"):
            return "a page from elsewhere may not ask"
        return ""

    def _is_ours(self, name: str) -> bool:
        """Whether a host name means this machine, whatever a name server answers."""
        if name in self._names:
            return True
        with suppress(ValueError):
            return ipaddress.ip_address(name).is_loopback or not self._local
        return False

    def _give_cookie(self, request: web.Request, response: web.StreamResponse) -> None:
        if "token" in request.query:
            response.set_cookie(
                self._cookie, self._token.decode(), httponly=True, samesite="Strict", path="/"
            )


def keep_quiet_about_bad_requests() -> None:
    """Let aiohttp answer what is no HTTP with 400, and not also print a traceback for each."""

    def is_ours(record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return not isinstance(error, HttpProcessingError)

    logging.getLogger("aiohttp.server").addFilter(is_ours)


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    with suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower() == "localhost"


def _name_of(address: str) -> str:
    try:
        return (urlsplit(address).hostname or "").lower()
    except ValueError:
        return ""
