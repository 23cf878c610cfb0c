"""viser's server behind a guard, which refuses requests without the token and messages that wrt.viewer.messages does not allow.

viser serves its page and its WebSocket with one call of `websockets.asyncio.server.serve`, without a hook for checks. While viser
starts, wrt replaces `serve`, to add its checks and a socket that wrt has bound. viser opens no other port. VERSIONS has the supported
versions of viser. With another version, or if viser does not call `serve`, the viewer does not start.
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

VERSIONS = (1, 1, 1), (1, 2)  # Supported versions of viser: from the first, below the second.
LARGEST_MESSAGE = 1 << 16  # Bytes; a browser's messages have a few hundred.
MOST_CONNECTIONS = 64  # Open at a time, with or without a token.
LONGEST_PATH = 200  # Characters.
LONGEST_LINE = 300  # Characters of a report.
CONNECTING = 0  # The websockets.protocol.State of a connection before the handshake.
CLOSING = 1.0  # Seconds that a browser has to close its WebSocket.
QUIET = logging.getLogger("wrt.viewer.refine.connections")  # Drops the errors of single connections.
QUIET.propagate = False
QUIET.addHandler(logging.NullHandler())
_PATCHING = threading.RLock()  # held while stdout or websockets' `serve` is replaced in the whole process


def import_viser() -> ModuleType:
    """Return the module viser. Raises InputError if it is missing or has an unsupported version."""
    try:
        import viser
    except ImportError as error:
        raise InputError(f"the viewer needs viser ({error})", hint='pip install "wrt[viewer]"') from error
    numbers = tuple(map(int, re.findall(r"[0-9]+", viser.__version__)[:3]))
    if not VERSIONS[0] <= numbers < VERSIONS[1]:
        raise InputError(f"the viewer cannot guard viser {viser.__version__}",
                         hint='pip install "wrt[viewer]" installs a version that it can guard')
    return viser


def listen(place: Place) -> socket.socket:
    """Return a socket that listens at `place`. Raises InputError if that fails."""
    host, port = place.host, place.port
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address, family=family)
    except (OSError, OverflowError, UnicodeError) as error:
        number = getattr(error, "errno", None) or 0
        reason = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot listen on port {port} of {host} ({reason})",
                         argument="port", hint="choose another with --port or --host") from error


def to_stderr(text: str) -> None:
    """Write a line to stderr."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def without_stdout() -> Iterator[None]:
    """Drop viser's output to stdout in the `with` block, because wrt's stdout is for data."""
    with _PATCHING, contextlib.redirect_stdout(io.StringIO()):
        yield


class Guard:
    """Guard of a viser server, which checks every request and every message. `open` starts the server.

    warn: called with one line, once for each kind of refusal."""

    def __init__(self, access: Access, warn: Callable[[str], None] = to_stderr) -> None:
        self.access, self.warn = access, warn
        self.viser: Any = None  # the ViserServer, after `open`
        self.connections: WeakSet[ServerConnection] = WeakSet()
        self._thread = 0  # viser's thread
        self._loop: Any = None  # its event loop
        self._reported: set[str] = set()
        self._lock = threading.Lock()

    def open(self, listening: socket.socket, label: str) -> viser.ViserServer:
        """Start a viser server on the socket `listening`, behind this guard. Raises InputError if viser calls `serve` in another way."""
        viser = import_viser()
        websockets: Any = importlib.import_module("websockets.asyncio.server")
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)  # from viser, after a browser disconnects
        host, port = listening.getsockname()[:2]

        def guarded(handler: Handler, *address: object, **settings: Any) -> object:
            self._thread = self._thread or threading.get_ident()
            if self._thread != threading.get_ident():
                return serve(handler, *address, **settings)  # the call of another server, which starts at the same time
            settings = {key: value for key, value in settings.items() if key not in ("host", "port", "sock")}
            self._loop = asyncio.get_running_loop()
            self._loop.set_exception_handler(self._report_failure)
            return serve(self._checking_version(handler), sock=listening, **settings | self._settings(settings.get("process_request")))

        with without_stdout():
            serve, websockets.serve = websockets.serve, guarded
            try:
                server = viser.ViserServer(host, port, label=label, verbose=False)
            finally:
                websockets.serve = serve
        if not self._thread or server.get_port() != port:
            with without_stdout():
                server.stop()
            listening.close()
            raise InputError(f"viser {viser.__version__} cannot be guarded", hint="the viewer is tested with viser 1.1.1")
        self.viser = server
        return server

    def close(self) -> None:
        """Abort connections that have sent no request, for which viser would wait; then stop viser's server."""
        with contextlib.suppress(RuntimeError):  # the server has stopped already
            self._loop.call_soon_threadsafe(self._abort_half_open)
        with without_stdout():
            self.viser.stop()

    def _abort_half_open(self) -> None:
        for connection in self.connections:
            if connection.protocol.state == CONNECTING:
                connection.transport.abort()

    def report(self, kind: str, text: str) -> None:
        """Pass a text to `warn` as one line, once for each kind."""
        with self._lock:
            if kind in self._reported:
                return
            self._reported.add(kind)
        self.warn(f"viewer: {' '.join(text.split())[:LONGEST_LINE]} (reported once)")

    # --- requests -----------------------------------------------------------------------------------------------------

    def _settings(self, page: Files | None) -> dict[str, Any]:
        """Return the arguments of websockets' `serve` that replace viser's. page: viser's function that answers requests for files."""
        return {"process_request": lambda connection, request: self._answer(connection, request, page), "server_header": None,
                "max_size": LARGEST_MESSAGE, "close_timeout": CLOSING, "logger": QUIET, "create_connection": _checked_connection(self)}

    def _answer(self, connection: ServerConnection, request: Request, page: Files | None) -> Response | None:
        """Return the response to a request; None: the request opens a WebSocket."""
        from websockets.http11 import Request

        headers = request.headers
        try:
            self.access.check(headers.get_all("Host"), headers.get_all("Origin"), connection.local_address[0].partition("%")[0])
            path, location = self.access.strip_token(request.path)
        except Refused as refused:
            self.report(refused.kind, f"refused {refused}")
            return _response(HTTPStatus.FORBIDDEN)
        if [value.lower() for value in headers.get_all("Upgrade")] == ["websocket"]:
            return None
        if location:
            return _response(HTTPStatus.SEE_OTHER, Location=location)
        if page is None or len(path) > LONGEST_PATH or "\0" in path or "%00" in path:
            return _response(HTTPStatus.NOT_FOUND)
        encodings = {"Accept-Encoding": "gzip"} if any("gzip" in value for value in headers.get_all("Accept-Encoding")) else {}
        answer = page(connection, Request(path, type(headers)(encodings)))
        if answer is None or answer.status_code != HTTPStatus.OK:
            return _response(HTTPStatus.NOT_FOUND)
        answer.headers.update(COMMON)
        return answer

    def _checking_version(self, handler: Handler) -> Handler:
        """Return a handler that calls viser's `handler`, but closes connections of other versions, which viser reports on stdout."""
        import viser

        async def check(connection: ServerConnection) -> None:
            if connection.subprotocol == f"viser-v{viser.__version__}":
                await handler(connection)
            else:
                self.report("version", f"closed a WebSocket of the protocol {shown(connection.subprotocol)}; load the page again")
                await connection.close(1002, f"Version mismatch: the server is viser {viser.__version__}")

        return check

    # --- messages -----------------------------------------------------------------------------------------------------

    def allows(self, data: str | bytes) -> bool:
        """Return True if viser may receive a message; report a refused message."""
        try:
            check_message(_decoded(data), self._control)
        except Refused as refused:
            self.report(refused.kind, f"dropped {refused}")
            return False
        return True

    def _control(self, uuid: str) -> viser.GuiInputHandle[Any] | None:
        if self.viser is None:
            return None
        panels = [self.viser.gui, *(client.gui for client in self.viser.get_clients().values())]
        handles = (panel._gui_input_handle_from_uuid.get(uuid) for panel in panels)
        return next((handle for handle in handles if handle is not None), None)

    def _report_failure(self, loop: object, context: dict[str, Any]) -> None:
        """Report an error in one line, in place of asyncio's traceback."""
        error = context.get("exception")
        text = context.get("message") if error is None else f"{type(error).__name__}: {error}"
        self.report(f"failure {type(error).__name__}", f"error: {text}")


def _checked_connection(guard: Guard) -> type[ServerConnection]:
    """Return a class of connections whose messages the guard checks."""
    from websockets.asyncio.server import ServerConnection

    class Checked(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            guard.connections.add(self)
            if len(self.server.handlers) > MOST_CONNECTIONS:
                guard.report("connections", f"closed a connection, because {MOST_CONNECTIONS} are open already")
                self.transport.abort()

        async def recv(self, decode: bool | None = None) -> str | bytes:  # type: ignore[override]
            while True:
                data: str | bytes = await super().recv(decode)
                if guard.allows(data):
                    return data

    return Checked


COMMON = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Connection": "close"}


def _response(status: HTTPStatus, **headers: str) -> Response:
    """Return a response without content."""
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
    raise Refused("frame", "a message that is not MessagePack")
