"""The viewer's server: HTTP and WebSockets on one port. It checks every request and every message before the page sees them.

The library websockets parses both protocols. `Server` runs it in a thread of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import sys
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from types import ModuleType
from typing import TYPE_CHECKING, Protocol

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.types import JsonObject
from wrt.viewer.access import Access, Place, Refused
from wrt.viewer.panel import decoded

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LARGEST_MESSAGE = 1 << 16  # Bytes; a browser's messages have about a hundred.
LONGEST_LINE = 300  # Characters of a report.
CLOSING = 1.0  # Seconds that a browser has to close its WebSocket.
QUIET = logging.getLogger("wrt.viewer.server.connections")  # Drops the library's reports of malformed requests.
QUIET.propagate = False
QUIET.addHandler(logging.NullHandler())
COMMON = {
    "Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Connection": "close",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self';"
                               " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}


class Answers(Protocol):
    """What a Server serves. The server's thread calls all methods, so they must return soon."""

    def file(self, path: str) -> tuple[str, bytes] | None:
        """Return the content type and the bytes of a file, or None for an unknown path."""

    def joined(self, browser: Browser) -> None: ...

    def left(self, browser: Browser) -> None: ...

    def received(self, message: JsonObject) -> None:
        """Act on a message, a JSON object. Raises Refused or InputError for a message that is not allowed."""


class Browser:
    """A connected browser. Of each kind of message, it keeps only the newest that is not sent yet, so that memory stays bounded."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._unsent, self._filled = loop, dict[str, str | bytes](), asyncio.Event()

    def put(self, kind: str, message: JsonObject, data: bytes | None = None) -> None:
        """Send a message. With `data`, it is binary: the JSON's length in 4 bytes (big endian), the JSON, and the data."""
        text = json.dumps({"type": kind, **message}, allow_nan=False)
        head = text.encode()
        frame = text if data is None else len(head).to_bytes(4, "big") + head + data
        with contextlib.suppress(RuntimeError):  # the server has ended
            self._loop.call_soon_threadsafe(self._keep, kind, frame)

    def _keep(self, kind: str, frame: str | bytes) -> None:
        self._unsent[kind] = frame
        self._filled.set()

    async def send_all(self, connection: ServerConnection) -> None:
        """Send messages until the connection ends."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while await self._filled.wait():
                while self._unsent:
                    await connection.send(self._unsent.pop(next(iter(self._unsent))))
                self._filled.clear()


def import_websockets() -> ModuleType:
    """Return the module websockets.asyncio.server. Raises InputError if it is missing."""
    with needed_by("the viewer"):
        import websockets.asyncio.server as module
    return module


def listen(place: Place) -> socket.socket:
    """Return a socket that listens at `place`. Raises InputError if that fails."""
    host, port = place.host, place.port
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address, family=family)
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"cannot listen on port {port} of {host} ({getattr(error, 'strerror', None) or error})",
                         argument="port", hint="choose another with --port or --host") from error


def to_stderr(text: str) -> None:
    """Write a line to stderr."""
    print(text, file=sys.stderr, flush=True)


class Server:
    """A server on the socket `listening`, which runs until `close`. warn: called with one line, once for each kind of refusal."""

    def __init__(self, access: Access, answers: Answers, listening: socket.socket, warn: Callable[[str], None] = to_stderr) -> None:
        import_websockets()
        self.access, self.answers, self.warn = access, answers, warn
        self.browsers: tuple[Browser, ...] = ()
        self._reported: set[str] = set()
        self._ready = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self._serve(listening)), name="wrt viewer's server", daemon=True)
        self.thread.start()
        self._ready.wait()

    def close(self) -> None:
        with contextlib.suppress(RuntimeError):  # the server has ended already
            self._loop.call_soon_threadsafe(self._ended.set)
        self.thread.join(2.0 * CLOSING)  # longer only with a connection that sends no request

    def report(self, kind: str, text: str) -> None:
        """Pass a text to `warn` as one line, once for each kind."""
        if kind not in self._reported:
            self._reported.add(kind)
            self.warn(f"viewer: {' '.join(text.split())[:LONGEST_LINE]} (reported once)")

    async def _serve(self, listening: socket.socket) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        async with import_websockets().serve(self._follow, sock=listening, process_request=self._answer, server_header=None,
                                             compression=None, max_size=LARGEST_MESSAGE, close_timeout=CLOSING, logger=QUIET):
            self._ready.set()
            await self._ended.wait()

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None: the request opens a WebSocket."""
        headers = request.headers
        try:
            self.access.check(headers.get_all("Host"), headers.get_all("Origin"), connection.local_address[0].partition("%")[0])
            path = self.access.strip_token(request.path)
        except Refused as refused:
            self.report(refused.kind, f"refused {refused}")
            return _response(HTTPStatus.FORBIDDEN)
        if getattr(request, "method", "GET") != "GET":  # up to 16, the library closes such connections
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": "GET"})
        if [value.lower() for value in headers.get_all("Upgrade")] == ["websocket"]:
            return None
        found = self.answers.file(path)
        if found is None:
            return _response(HTTPStatus.NOT_FOUND)
        return _response(HTTPStatus.OK, {"Content-Type": found[0]}, found[1])

    async def _follow(self, connection: ServerConnection) -> None:
        """Pass the messages of one WebSocket to the page until it closes."""
        from websockets.exceptions import ConnectionClosed

        browser = Browser(self._loop)
        self.browsers += (browser,)
        sender = asyncio.create_task(browser.send_all(connection))
        try:
            self.answers.joined(browser)
            async for data in connection:
                try:
                    self.answers.received(decoded(data))
                except Refused as refused:
                    self.report(refused.kind, f"dropped {refused}")
                except InputError as error:
                    self.report("action", f"error: {error}")
                except Exception as error:  # a defect of the viewer; the library would drop it with the connection
                    self.report("failure", f"error: {type(error).__name__}: {error}")
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self.browsers = tuple(each for each in self.browsers if each is not browser)
            self.answers.left(browser)


def _response(status: HTTPStatus, headers: Mapping[str, str] = COMMON, body: bytes = b"") -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    return Response(status.value, status.phrase, Headers({"Content-Length": str(len(body)), **COMMON, **headers}), body)
