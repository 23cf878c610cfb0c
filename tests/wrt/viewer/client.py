"""A client of the viewer without a browser: requests byte by byte, and a WebSocket with the page's messages."""

from __future__ import annotations

import base64
import contextlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

PATIENCE = 300.0  # seconds; a busy machine may have to compile kernels


def answer(port: int, target: str, headers: list[str]) -> bytes:
    """Send a GET and return the whole response (empty: the connection was closed). A WebSocket is closed as soon as it opens."""
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection:
        connection.sendall("\r\n".join([f"GET {target} HTTP/1.1", *headers, "", ""]).encode("latin-1", "surrogateescape"))
        data = b""
        with contextlib.suppress(ConnectionResetError):
            while block := connection.recv(1 << 16):
                data += block
                if data.startswith(b"HTTP/1.1 101"):
                    break
        return data


def upgrade() -> list[str]:
    """Return the headers of a WebSocket's handshake."""
    key = base64.b64encode(b"sixteen bytes...").decode()
    return ["Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13"]


class Client:
    """A WebSocket to a page's address, like that of the page in a browser. It stores all messages of the server."""

    def __init__(self, url: str, **settings: Any) -> None:
        from websockets.sync.client import connect

        # With an unlimited queue of unread messages, the socket answers the server's pings even if the test reads nothing.
        parts = urlsplit(url)
        settings = {"origin": f"http://{parts.netloc}", **settings}
        self.socket = connect(f"ws://{parts.netloc}{parts.path}", compression=None, max_size=None,
                              max_queue=None, ping_interval=None, open_timeout=PATIENCE, **settings).__enter__()
        self.messages: list[dict[str, Any]] = []

    def send(self, kind: str, /, **fields: Any) -> None:
        self.socket.send(json.dumps({"type": kind, **fields}))

    def open(self, width: int = 64, height: int = 48) -> None:
        self.send("size", width=width, height=height)

    def move(self, angle: float) -> None:
        """Orbit by an angle, as a drag over that share of the picture's height does."""
        self.send("move", kind="orbit", by=[angle, 0.0, 0.0])

    def set(self, name: str, value: Any) -> None:
        self.send("set", name=name, value=value)

    def listen(self, seconds: float) -> dict[str, Any] | None:
        """Return the server's next message; None if none arrives in `seconds`. A picture's file is its "data"."""
        try:
            frame = self.socket.recv(timeout=seconds)
        except TimeoutError:
            return None
        if isinstance(frame, str):
            message = json.loads(frame)
        else:
            end = 4 + int.from_bytes(frame[:4], "big")
            message = {**json.loads(frame[4:end]), "data": frame[end:]}
        self.messages.append(message)
        return message

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for the next message that fulfils a condition, and return it."""
        deadline = time.monotonic() + PATIENCE
        while True:
            assert time.monotonic() < deadline, "no such message arrived"
            message = self.listen(1.0)
            if message is not None and condition(message):
                return message

    def next(self, kind: str) -> dict[str, Any]:
        return self.until(lambda message: message["type"] == kind)

    def picture(self) -> bytes:
        """Wait for a new picture, and return its file."""
        seen = {message["data"] for message in self.messages if message["type"] == "picture"}
        data: bytes = self.until(lambda message: message["type"] == "picture" and message["data"] not in seen)["data"]
        return data

    def controls(self) -> dict[str, dict[str, Any]]:
        """Return the controls of the last state by their names, once it has arrived."""
        states = [message for message in self.messages if message["type"] == "state"] or [self.next("state")]
        return {control["name"]: control for control in states[-1]["controls"]}


def wait(condition: Callable[[], Any], listening: Client | None = None) -> None:
    """Wait until the condition holds. listening: client that receives the server's messages meanwhile."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "the condition never held"
        if listening is None:
            time.sleep(0.01)
        else:
            listening.listen(0.05)


@contextlib.contextmanager
def client(url: str, **settings: Any) -> Iterator[Client]:
    made = Client(url, **settings)
    try:
        yield made
    finally:
        made.socket.close()
