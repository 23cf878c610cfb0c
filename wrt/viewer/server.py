"""viser's server behind a door: it answers nobody without the token, and hears only what the viewer can follow.

viser serves its page and its WebSocket by one call of `websockets.asyncio.server.serve`, and offers no way to check who comes. So
that call is given our checks, and a socket that we bound: no other port is opened. This holds for the versions of viser in
VERSIONS; with any other one, or where viser does not make the call, nothing is served.
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
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any
from weakref import WeakSet

from wrt.core.errors import InputError
from wrt.viewer.access import Access, Place, Refused, shown
from wrt.viewer.messages import check_message

VERSIONS = (1, 1, 1), (1, 2)  # from the first on, to before the second
LARGEST_MESSAGE = 1 << 16  # bytes; a browser sends some hundreds
MOST_CONNECTIONS = 64  # open at a time, with those that have not shown a token yet
LONGEST_PATH = 200
LONGEST_LINE = 300  # characters of what is reported
CONNECTING = 0  # websockets.protocol.State of a connection without a WebSocket yet
CLOSING = 1.0  # seconds that a browser has to say goodbye
QUIET = logging.getLogger("wrt.viewer.refine.connections")  # what goes wrong in one connection is no matter of the others
QUIET.propagate = False
QUIET.addHandler(logging.NullHandler())
_ALONE = threading.RLock()  # for what is replaced in the whole process: stdout, and websockets' `serve`


def import_viser() -> Any:
    """The module; raises InputError that says how to install it."""
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
    """A socket that listens there. Raises InputError where that cannot be."""
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
    """One line."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """viser greets on stdout, which is for data."""
    with _ALONE, contextlib.redirect_stdout(io.StringIO()):
        yield


class Door:
    """Checks every request and every message to a viser server, which `open` starts. warn: hears of what is refused, once of each
    kind."""

    def __init__(self, access: Access, warn: Callable[[str], None] = to_stderr) -> None:
        self.access, self.warn = access, warn
        self.viser: Any = None  # the ViserServer, when there is one
        self.connections: WeakSet[Any] = WeakSet()
        self._thread = 0  # in which viser serves
        self._loop: Any = None  # of that thread
        self._told: set[str] = set()
        self._lock = threading.Lock()

    def open(self, listening: socket.socket, label: str) -> Any:
        """A viser.ViserServer behind this door. Raises InputError if viser does not pass through it."""
        viser = import_viser()
        websockets: Any = importlib.import_module("websockets.asyncio.server")
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)  # of a browser that just left
        host, port = listening.getsockname()[:2]

        def guarded(handler: Any, *address: Any, **settings: Any) -> Any:
            self._thread = self._thread or threading.get_ident()
            if self._thread != threading.get_ident():
                return serve(handler, *address, **settings)  # of somebody else who begins at the same time
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
        """Stop viser's server. It would wait for connections that have not sent their request yet."""
        with contextlib.suppress(RuntimeError):  # it has stopped
            self._loop.call_soon_threadsafe(self._abort_half_open)
        with quiet():
            self.viser.stop()

    def _abort_half_open(self) -> None:
        for connection in self.connections:
            if connection.protocol.state == CONNECTING:
                connection.transport.abort()

    def report(self, about: str, text: str) -> None:
        """In one line, once of each kind."""
        with self._lock:
            if about in self._told:
                return
            self._told.add(about)
        self.warn(f"viewer: {' '.join(text.split())[:LONGEST_LINE]} (told once)")

    # --- requests -----------------------------------------------------------------------------------------------------

    def _settings(self, page: Callable[[Any, Any], Any] | None) -> dict[str, Any]:
        """Of websockets' `serve`, in place of viser's. page: viser's answer to requests for its files."""
        from websockets.asyncio.server import ServerConnection

        class Connection(_Checked, ServerConnection):
            door = self

        return {"process_request": lambda connection, request: self._answer(connection, request, page), "server_header": None,
                "max_size": LARGEST_MESSAGE, "close_timeout": CLOSING, "logger": QUIET, "create_connection": Connection}

    def _answer(self, connection: Any, request: Any, page: Callable[[Any, Any], Any] | None) -> Any:
        """None where a WebSocket may be opened."""
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

    def _greeting(self, handler: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """viser's handler for the browsers that speak its language; it would report others on stdout."""
        import viser

        async def greet(connection: Any) -> None:
            if connection.subprotocol == f"viser-v{viser.__version__}":
                await handler(connection)
            else:
                self.report("version", f"closed a WebSocket of the protocol {shown(connection.subprotocol)}; load the page again")
                await connection.close(1002, f"Version mismatch: the server is viser {viser.__version__}")

        return greet

    # --- messages -----------------------------------------------------------------------------------------------------

    def lets_in(self, data: str | bytes) -> bool:
        """Whether viser is to get a message; one that it is not to get is reported."""
        try:
            check_message(_decoded(data), self._control)
        except Refused as refused:
            self.report(refused.about, f"dropped {refused}")
            return False
        return True

    def _control(self, uuid: str) -> Any:
        if self.viser is None:
            return None
        panels = [self.viser.gui, *(client.gui for client in self.viser.get_clients().values())]
        handles = (panel._gui_input_handle_from_uuid.get(uuid) for panel in panels)
        return next((handle for handle in handles if handle is not None), None)

    def _failed(self, loop: Any, context: dict[str, Any]) -> None:
        """In place of asyncio's traceback."""
        error = context.get("exception")
        what = context.get("message") if error is None else f"{type(error).__name__}: {error}"
        self.report(f"failure {type(error).__name__}", f"error: {what}")


class _Checked:
    """A connection whose messages are checked. For a subclass of ServerConnection."""

    door: Door

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)  # type: ignore[misc]
        self.door.connections.add(self)
        if len(self.server.handlers) > MOST_CONNECTIONS:  # type: ignore[attr-defined]
            self.door.report("connections", f"closed a connection; there are {MOST_CONNECTIONS} already")
            transport.abort()

    async def recv(self, *arguments: Any, **settings: Any) -> Any:
        while True:
            data = await super().recv(*arguments, **settings)  # type: ignore[misc]
            if self.door.lets_in(data):
                return data


COMMON = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Connection": "close"}


def _response(status: HTTPStatus, **headers: str) -> Any:
    """An answer without content."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    return Response(status.value, status.phrase, Headers({"Content-Length": "0", **COMMON, **headers}))


def _decoded(data: str | bytes) -> Any:
    import msgspec

    try:
        if isinstance(data, bytes):
            return msgspec.msgpack.decode(data)
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError, OverflowError):
        pass
    raise Refused("frame", "a message that is no MessagePack")
