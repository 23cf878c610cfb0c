"""viser's server behind a guard: it answers no request without the token, and gets only the messages of wrt.viewer.messages.

viser serves its page and its WebSocket by one call of `websockets.asyncio.server.serve`, without a hook for checks. That call gets
wrt's checks and a socket that wrt has bound, so that no other port is opened. It works with the versions of viser in VERSIONS; with
another one, or if viser does not make the call, nothing is served.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import io
import logging
import os
import re
import socket
import sys
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import WeakSet

from wrt.core.errors import InputError
from wrt.viewer.access import Access, Place, Refused, shown
from wrt.viewer.messages import check_message

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Handler: TypeAlias = Callable[[ServerConnection], Awaitable[None]]  # of a WebSocket
    Files: TypeAlias = Callable[[ServerConnection, Request], Response | None]  # viser's answer to requests for its files

VERSIONS = (1, 1, 1), (1, 2)  # the first that works, the first that may not
LARGEST_MESSAGE = 1 << 16  # bytes; a browser sends a few hundred
MOST_CONNECTIONS = 64  # open at a time, also without a token so far
LONGEST_PATH = 200
LONGEST_LINE = 300  # characters of a report
CONNECTING = 0  # websockets.protocol.State of a connection before its WebSocket
CLOSING = 1.0  # seconds for a browser to close its WebSocket
QUIET = logging.getLogger("wrt.viewer.refine.connections")  # errors of single connections are not shown
QUIET.propagate = False
QUIET.addHandler(logging.NullHandler())
_ALONE = threading.RLock()  # held while stdout and websockets' `serve` are replaced in the whole process


def import_viser() -> ModuleType:
    """Return the module viser. Raises InputError that says how to install it."""
    try:
        import viser
    except ImportError as error:
        raise InputError(f"the viewer needs viser ({error})", hint='pip install "wrt[viewer]"') from error
    numbers = tuple(map(int, re.findall(r"[0-9]+", viser.__version__)[:3]))
    if not VERSIONS[0] <= numbers < VERSIONS[1]:
        raise InputError(f"the viewer cannot guard viser {viser.__version__}",
                         hint='pip install "wrt[viewer]" installs one that it can')
    return viser


def listen(place: Place) -> socket.socket:
    """Return a socket that listens at the place. Raises InputError if it cannot."""
    host, port = place.host, place.port
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address, family=family)
    except (OSError, OverflowError, UnicodeError) as error:
        number = getattr(error, "errno", None) or 0
        reason = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot listen on port {port} of {host} ({reason})",
                         argument="port", hint="--port and --host choose another") from error


def to_stderr(text: str) -> None:
    """Write a line to stderr."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Drop what viser writes to stdout, which is for data."""
    with _ALONE, contextlib.redirect_stdout(io.StringIO()):
        yield


class Door:
    """Guard of a viser server, which `open` starts: it checks every request and every message.

    warn: called once for each kind of refusal."""

    def __init__(self, access: Access, warn: Callable[[str], None] = to_stderr) -> None:
        self.access, self.warn = access, warn
        self.viser: Any = None  # the ViserServer, after `open`
        self.connections: WeakSet[ServerConnection] = WeakSet()
        self._thread = 0  # viser's thread
        self._loop: Any = None  # its event loop
        self._told: set[str] = set()
        self._lock = threading.Lock()

    def open(self, listening: socket.socket, label: str) -> viser.ViserServer:
        """Start a viser server behind this guard. Raises InputError if viser does not use it."""
        viser = import_viser()
        websockets: Any = importlib.import_module("websockets.asyncio.server")
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)  # after a browser has left
        host, port = listening.getsockname()[:2]

        def guarded(handler: Handler, *address: object, **settings: Any) -> object:
            self._thread = self._thread or threading.get_ident()
            if self._thread != threading.get_ident():
                return serve(handler, *address, **settings)  # another server of this process that starts at the same time
            settings = {key: value for key, value in settings.items() if key not in ("host", "port", "sock")}
            self._loop = asyncio.get_running_loop()
            self._loop.set_exception_handler(self._failed)
            return serve(self._greeting(handler), sock=listening, **settings | self._settings(settings.get("process_request")))

        with quiet():
            serve, websockets.serve = websockets.serve, guarded
            try:
                server = viser.ViserServer(host, port, label=label, verbose=False)
            finally:
                websockets.serve = serve
        if not self._thread or server.get_port() != port:
            with quiet():
                server.stop()
            listening.close()
            raise InputError(f"viser {viser.__version__} does not let itself be guarded; the viewer knows 1.1.1")
        self.viser = server
        return server

    def close(self) -> None:
        """Stop viser's server, which would wait for connections that have not sent a request yet."""
        with contextlib.suppress(RuntimeError):  # it has stopped
            self._loop.call_soon_threadsafe(self._abort_half_open)
        with quiet():
            self.viser.stop()

    def _abort_half_open(self) -> None:
        for connection in self.connections:
            if connection.protocol.state == CONNECTING:
                connection.transport.abort()

    def report(self, about: str, text: str) -> None:
        """Report a text in one line, once for each kind `about`."""
        with self._lock:
            if about in self._told:
                return
            self._told.add(about)
        self.warn(f"viewer: {' '.join(text.split())[:LONGEST_LINE]} (told once)")

    # --- requests -----------------------------------------------------------------------------------------------------

    def _settings(self, page: Files | None) -> dict[str, Any]:
        """Return settings of websockets' `serve` that replace viser's."""
        return {"process_request": lambda connection, request: self._answer(connection, request, page), "server_header": None,
                "max_size": LARGEST_MESSAGE, "close_timeout": CLOSING, "logger": QUIET, "create_connection": _checked_connection(self)}

    def _answer(self, connection: ServerConnection, request: Request, page: Files | None) -> Response | None:
        """Return the answer to a request; None opens a WebSocket."""
        from websockets.http11 import Request

        headers = request.headers
        try:
            self.access.check(headers.get_all("Host"), headers.get_all("Origin"), connection.local_address[0].partition("%")[0])
            path, moved = self.access.inside(request.path)
        except Refused as refused:
            self.report(refused.about, f"refused {refused}")
            return _response(HTTPStatus.FORBIDDEN)
        if [value.lower() for value in headers.get_all("Upgrade")] == ["websocket"]:
            return None
        if moved:
            return _response(HTTPStatus.SEE_OTHER, Location=moved)
        if page is None or len(path) > LONGEST_PATH or "\0" in path or "%00" in path:
            return _response(HTTPStatus.NOT_FOUND)
        encodings = {"Accept-Encoding": "gzip"} if any("gzip" in value for value in headers.get_all("Accept-Encoding")) else {}
        answer = page(connection, Request(path, type(headers)(encodings)))
        if answer is None or answer.status_code != HTTPStatus.OK:
            return _response(HTTPStatus.NOT_FOUND)
        answer.headers.update(COMMON)
        return answer

    def _greeting(self, handler: Handler) -> Handler:
        """Return viser's handler for browsers with its protocol. It would report others on stdout."""
        import viser

        async def greet(connection: ServerConnection) -> None:
            if connection.subprotocol == f"viser-v{viser.__version__}":
                await handler(connection)
            else:
                self.report("version", f"closed a WebSocket of the protocol {shown(connection.subprotocol)}; load the page again")
                await connection.close(1002, f"Version mismatch: the server is viser {viser.__version__}")

        return greet

    # --- messages -----------------------------------------------------------------------------------------------------

    def lets_in(self, data: str | bytes) -> bool:
        """Return whether viser may get a message; report a refused one."""
        try:
            check_message(_decoded(data), self._control)
        except Refused as refused:
            self.report(refused.about, f"dropped {refused}")
            return False
        return True

    def _control(self, uuid: str) -> viser.GuiInputHandle[Any] | None:
        if self.viser is None:
            return None
        panels = [self.viser.gui, *(client.gui for client in self.viser.get_clients().values())]
        handles = (panel._gui_input_handle_from_uuid.get(uuid) for panel in panels)
        return next((handle for handle in handles if handle is not None), None)

    def _failed(self, loop: object, context: dict[str, Any]) -> None:
        """Report an error in one line in place of asyncio's traceback."""
        error = context.get("exception")
        what = context.get("message") if error is None else f"{type(error).__name__}: {error}"
        self.report(f"failure {type(error).__name__}", f"error: {what}")


def _checked_connection(door: Door) -> type[ServerConnection]:
    """Return a class of connections whose messages the guard checks."""
    from websockets.asyncio.server import ServerConnection

    class Checked(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            door.connections.add(self)
            if len(self.server.handlers) > MOST_CONNECTIONS:
                door.report("connections", f"closed a connection; there are {MOST_CONNECTIONS} already")
                self.transport.abort()

        async def recv(self, decode: bool | None = None) -> str | bytes:  # type: ignore[override]
            while True:
                data: str | bytes = await super().recv(decode)
                if door.lets_in(data):
                    return data

    return Checked


COMMON = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Connection": "close"}


def _response(status: HTTPStatus, **headers: str) -> Response:
    """Return an answer without content."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    return Response(status.value, status.phrase, Headers({"Content-Length": "0", **COMMON, **headers}))


def _decoded(data: str | bytes) -> object:
    import msgspec

    try:
        if isinstance(data, bytes):
            return msgspec.msgpack.decode(data)
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError, OverflowError):
        pass
    raise Refused("frame", "a message that is no MessagePack")
