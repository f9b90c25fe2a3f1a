"""Guards the page in the browser: who may open it, and how much one connection may send.

MuJoCo's server answers the pages of all sites and stores whatever they send. `PageGuard.serve`
starts the same server with checks before it:

- the Host must be an address of the page, so that no site takes it over with a name that it
  resolves to this machine (DNS rebinding);
- the Origin must be the page itself, so that no other site reads the model or moves the camera;
- a page that other machines reach needs the secret token of its address;
- models cannot be dropped, and requests, messages and connections are limited.

It imports `websockets`, which comes with MuJoCo's viewer, so import it where it is needed.
"""

from __future__ import annotations

import asyncio
import functools
import http
import ipaddress
import re
import secrets
import socket
import threading
import urllib.parse
from collections.abc import Callable, Iterable
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.http11 import Request, Response

from isaacgymenvs_lite.errors import ConfigError

# What a page sends: keys and mouse, its camera, short words.
_MAX_MESSAGE_BYTES = 2**16
_MAX_HEAD_BYTES = 2**15
# A page has two lasting connections and up to six short ones; nine may be open.
_MAX_CONNECTIONS = 32
_MAX_UNCHECKED = 64
# Files that are sent at a time, each in memory; further requests wait.
_MAX_ANSWERS = 8
HEAD_TIMEOUT_S = 10.0
"""Until a request has arrived, and a refusal is sent."""
# Until a file has been sent: the largest has a few MB.
_ANSWER_TIMEOUT_S = 300.0
_CLOSE_TIMEOUT_S = 10.0
_PING_INTERVAL_S, _PING_TIMEOUT_S = 20.0, 60.0

_SOCKETS = ("/ui", "/state")
_ADDRESS = re.compile(r"(\[[0-9a-f:.]{2,45}\]|[a-z0-9_.-]{1,253})(?::([0-9]{1,5}))?")
_PORTS = {"http": 80, "https": 443}
_HEADERS = {
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # an address may have the token
}

Address = tuple[str, int | None]
"""Name or IP address as in a URL, and the port; None: any port."""


class PageGuard:
    """Checks and limits the connections of one page.

    Args:
        host: what the user called the address to listen at.
        address: its IP address.
        port: the page's.
        allowed_hosts: more hosts, with or without a port, at which browsers may reach the page.

    Attributes:
        token: secret that a browser needs; '' if only this machine reaches the page.
        started: set when connections are served through the guard.

    Raises:
        ConfigError: an allowed host is not `host` or `host:port`.
    """

    def __init__(self, host: str, address: str, port: int, allowed_hosts: Iterable[str]) -> None:
        self._port = port
        self._names = {"localhost", "127.0.0.1", "[::1]", host.lower()}
        self._allowed = read_hosts(allowed_hosts)
        is_local = ipaddress.ip_address(address).is_loopback
        if not is_local:
            self._names.add(socket.gethostname().lower())
        self.token = "" if is_local else secrets.token_urlsafe(24)
        self.started = threading.Event()
        self._unchecked: set[ServerConnection] = set()
        self._connections: set[ServerConnection] = set()
        self._answers = asyncio.Semaphore(_MAX_ANSWERS)

    async def serve(
        self,
        handler: Callable[[ServerConnection], Any],
        *,
        process_request: Callable[[ServerConnection, Request], Response | None],
        process_response: Callable[[ServerConnection, Request, Response], Response | None],
        **options: Any,
    ) -> Server:
        """Return a server that listens, as `await websockets.serve` does, behind the guard.

        Args:
            handler: serves a WebSocket.
            process_request: answers a request that passes the checks.
            process_response: adds headers.
            options: of `websockets.serve`; the guard's limits replace them.
        """

        async def answer(connection: ServerConnection, request: Request) -> Response | None:
            refusal = self._check(connection, request)
            if refusal is not None:
                return refusal
            assert isinstance(connection, _Connection)
            await connection.accept(None if "Upgrade" in request.headers else self._answers)
            return process_request(connection, request)

        def add_headers(
            connection: ServerConnection, request: Request, response: Response
        ) -> Response:
            response = process_response(connection, request, response) or response
            for name in ("Access-Control-Allow-Origin", *_HEADERS):
                if name in response.headers:
                    del response.headers[name]
            response.headers.update(_HEADERS)
            return response

        limits = {
            "create_connection": functools.partial(
                _Connection, unchecked=self._unchecked, accepted=self._connections
            ),
            "max_size": _MAX_MESSAGE_BYTES,
            "ping_interval": _PING_INTERVAL_S,
            "ping_timeout": _PING_TIMEOUT_S,
        }
        server = await serve(
            handler,
            process_request=answer,
            process_response=add_headers,
            **{**options, **limits},
        )
        self.started.set()  # not before: a browser would be refused
        return server

    def _check(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the refusal of a request, or the page that stores the token; None: go on."""
        refuse = connection.respond
        host = _one_header(request, "Host") or ""
        if not self._is_page(host, connection):
            return refuse(http.HTTPStatus.FORBIDDEN, _unknown_address("Host", host))
        origin = _one_header(request, "Origin")
        if origin is not None and not self._is_own_origin(origin, host):
            return refuse(http.HTTPStatus.FORBIDDEN, _unknown_address("Origin", origin))
        if _is_embedded(request):
            return refuse(http.HTTPStatus.FORBIDDEN, "another site's page may not load this one\n")
        if request.method != "GET":
            return refuse(http.HTTPStatus.METHOD_NOT_ALLOWED, "the page answers GET only\n")
        url = urllib.parse.urlsplit(request.path)
        if self.token and not self._has_cookie(request):
            given = urllib.parse.parse_qs(url.query).get("token", [""])[-1]
            if not _are_equal(given, self.token):
                return refuse(
                    http.HTTPStatus.FORBIDDEN,
                    "open the whole address that the run printed, with its token\n",
                )
            if url.path == "/":
                return self._store_token(connection)
        if "Upgrade" in request.headers and url.path not in _SOCKETS:
            return refuse(http.HTTPStatus.FORBIDDEN, "models cannot be dropped on this page\n")
        if len(self._connections) >= _MAX_CONNECTIONS:
            return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many connections\n")
        return None

    def _is_page(self, host: str, connection: ServerConnection) -> bool:
        address = _read_address(host, _PORTS["http"])
        if address is None:
            return False
        name, port = address
        here = str(connection.local_address[0])  # of this connection: the page may have several
        names = {*self._names, f"[{here}]" if ":" in here else here}
        return (port == self._port and name in names) or self._is_allowed(address)

    def _is_own_origin(self, origin: str, host: str) -> bool:
        scheme, _, rest = origin.partition("://")
        address = _read_address(rest, _PORTS.get(scheme))
        if scheme not in _PORTS or address is None:
            return False
        return address == _read_address(host, _PORTS["http"]) or self._is_allowed(address)

    def _is_allowed(self, address: Address) -> bool:
        return address in self._allowed or (address[0], None) in self._allowed

    @property
    def _cookie(self) -> str:
        return f"isaacgymenvs_lite_{self._port}"  # browsers do not keep ports apart

    def _has_cookie(self, request: Request) -> bool:
        pairs = ";".join(request.headers.get_all("Cookie")).split(";")
        values = [
            value
            for name, _, value in (pair.strip().partition("=") for pair in pairs)
            if name == self._cookie
        ]
        return any(_are_equal(value, self.token) for value in values)

    def _store_token(self, connection: ServerConnection) -> Response:
        """Return a page that stores the token and opens `/`, so that no address has it.

        A redirect would not do: after a link of another site browsers leave out strict cookies.
        """
        response = connection.respond(
            http.HTTPStatus.OK,
            '<!doctype html><html><meta http-equiv="refresh" content="0; url=/"></html>\n',
        )
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        response.headers["Cache-Control"] = "no-store"
        response.headers["Set-Cookie"] = (
            f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        )
        return response


class _Connection(ServerConnection):
    """A connection whose request must arrive soon and be short.

    Args:
        unchecked: connections whose request has not passed the checks.
        accepted: the others.
    """

    def __init__(
        self,
        *args: Any,
        unchecked: set[ServerConnection],
        accepted: set[ServerConnection],
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._unchecked, self._accepted = unchecked, accepted
        self._deadline: asyncio.Timeout | None = None
        self._turn: asyncio.Semaphore | None = None
        self._head_bytes = 0

    async def accept(self, answers: asyncio.Semaphore | None) -> None:
        """Count the connection as accepted, and allow the time that an answer takes.

        Args:
            answers: to wait for; released when the answer has been sent.
        """
        self._unchecked.discard(self)
        self._accepted.add(self)
        if self._deadline is not None:
            self._deadline.reschedule(self.loop.time() + _ANSWER_TIMEOUT_S)
        if answers is not None:
            await answers.acquire()
            self._turn = answers

    async def handshake(self, *args: Any, **options: Any) -> None:
        """Receive the request and answer it.

        Raises:
            TimeoutError: it took too long; the server ends the connection.
        """
        try:
            async with asyncio.timeout(HEAD_TIMEOUT_S) as self._deadline:
                await super().handshake(*args, **options)
        finally:
            if self._turn is not None:
                self._turn.release()
        self.close_timeout = _CLOSE_TIMEOUT_S

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Register the connection, or end it at once if too many wait."""
        super().connection_made(transport)
        if len(self._unchecked) >= _MAX_UNCHECKED:
            self.transport.abort()
        else:
            self._unchecked.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._unchecked.discard(self)
        self._accepted.discard(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Pass on what arrived, unless the request is too long."""
        if self in self._unchecked:
            self._head_bytes += len(data)
            if self._head_bytes > _MAX_HEAD_BYTES:
                self.transport.abort()
                return
        super().data_received(data)


def address_of(host: str) -> str:
    """Return the IP address of a name of this machine.

    Raises:
        OSError: there is none.
    """
    return "127.0.0.1" if host == "localhost" else socket.gethostbyname(host)


def read_hosts(hosts: Iterable[str]) -> frozenset[Address]:
    """Return the hosts that `viewer_allowed_hosts` names.

    Raises:
        ConfigError: one is not `host` or `host:port`.
    """
    addresses = {host: _read_address(host, None) for host in hosts}
    for host, address in addresses.items():
        if address is None:
            raise ConfigError(
                f"viewer_allowed_hosts: got {host[:80]!r}, expected a host or host:port as in the"
                " browser's address, such as gpu7.example.org or localhost:9000"
            )
    return frozenset(address for address in addresses.values() if address is not None)


def _read_address(text: str, default_port: int | None) -> Address | None:
    """Return name and port of a `host[:port]`, or None if it is none."""
    match = _ADDRESS.fullmatch(text.lower())
    if match is None:
        return None
    name, port = match.groups()
    return name.rstrip("."), int(port) if port else default_port


def _one_header(request: Request, name: str) -> str | None:
    """Return the value of a header, or None; '', which no check accepts, for several values."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else "" if values else None


def _is_embedded(request: Request) -> bool:
    """Whether a page of another site requests a part of this one; a link to it is none.

    Scripts and pictures are requested without an Origin, but browsers add these headers.
    """
    sites = set(request.headers.get_all("Sec-Fetch-Site"))
    is_link = request.headers.get_all("Sec-Fetch-Dest") == ["document"]
    return bool(sites & {"cross-site", "same-site"}) and not is_link


def _unknown_address(header: str, value: str) -> str:
    address = value.partition("://")[2] or value
    if _read_address(address, None) is None:
        return f"the {header} of the request is no address of this page\n"
    return (
        f"{header} {value} is no address of this page; to allow it, start with"
        f" viewer_allowed_hosts=[{address}]\n"
    )


def _are_equal(given: str, token: str) -> bool:
    return secrets.compare_digest(given.encode(errors="surrogateescape"), token.encode())
