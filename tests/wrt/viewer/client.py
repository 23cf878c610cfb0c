"""A client of the viewer without a browser: requests byte by byte, and a WebSocket with viser's messages."""

from __future__ import annotations

import base64
import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

PATIENCE = 300.0  # seconds; a busy machine may have to compile kernels


def answer(port: int, target: str, headers: list[str], host: str = "127.0.0.1") -> bytes:
    """Send a GET and return the whole response (empty: the connection was closed). A WebSocket is closed as soon as it opens."""
    request = "\r\n".join([f"GET {target} HTTP/1.1", *headers, "", ""])
    return raw_answer(port, request.encode("latin-1", "surrogateescape"), host)


def raw_answer(port: int, request: bytes, host: str = "127.0.0.1") -> bytes:
    with socket.create_connection((host, port), timeout=PATIENCE) as connection:
        connection.sendall(request)
        data = b""
        with contextlib.suppress(ConnectionResetError):
            while block := connection.recv(1 << 16):
                data += block
                if data.startswith(b"HTTP/1.1 101"):
                    break
        return data


def upgrade(subprotocol: str = "viser-v1.1.1") -> list[str]:
    """Return the headers of a WebSocket's handshake."""
    key = base64.b64encode(b"sixteen bytes...").decode()
    return ["Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {subprotocol}"]


class Client:
    """A WebSocket to a page's address, like that of the page in a browser. It stores all messages of the server."""

    def __init__(self, url: str, **settings: Any) -> None:
        import viser
        from websockets.sync.client import connect

        # With an unlimited queue of unread messages, the socket answers the server's pings even if the test reads nothing.
        parts = urlsplit(url)
        settings = {"subprotocols": [f"viser-v{viser.__version__}"], "origin": f"http://{parts.netloc}", **settings}
        self.socket = connect(f"ws://{parts.netloc}{parts.path}?{parts.query}", compression=None, max_size=None,
                              max_queue=None, ping_interval=None, open_timeout=PATIENCE, **settings)
        self.messages: list[dict[str, Any]] = []

    def send(self, **message: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode(message))

    def look(self, angle: float = 0.0, **changes: Any) -> None:
        """Move the camera."""
        camera = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [angle, 0.0, -1.0], "fov": 0.8, "near": 0.01, "far": 1000.0,
                  "image_height": 48, "image_width": 64, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 1.0, 0.0]}
        self.send(type="ViewerCameraMessage", **camera | changes)

    def set(self, uuid: str, value: Any) -> None:
        self.send(type="GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def listen(self, seconds: float) -> list[dict[str, Any]]:
        """Return the server's next messages; empty if none arrive in `seconds`."""
        import msgspec
        import zstandard

        try:
            data = self.socket.recv(timeout=seconds)
        except TimeoutError:
            return []
        size = int.from_bytes(data[8:16], "little")
        messages = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))["messages"]
        self.messages += messages
        return messages

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for the next message that fulfils a condition, and return it."""
        deadline = time.monotonic() + PATIENCE
        while True:
            assert time.monotonic() < deadline, "no such message arrived"
            for message in self.listen(1.0):
                if condition(message):
                    return message

    def picture(self) -> bytes:
        """Wait for a new picture, and return its file."""
        seen = set(self.pictures)
        self.until(lambda message: is_picture(message) and message["rgb_data"] not in seen)
        return self.pictures[-1]

    @property
    def pictures(self) -> list[bytes]:
        return [message["rgb_data"] for message in self.messages if is_picture(message)]

    def controls(self) -> dict[str, str]:
        """Return the uuid of each control by its label, once the panel has arrived."""
        while not any(message.get("props", {}).get("label") == "camera as TOML" for message in self.messages):
            assert self.listen(PATIENCE), "the panel never came"
        return {message["props"]["label"]: message["uuid"] for message in self.messages
                if message["type"].startswith("Gui") and "container_uuid" in message and "label" in message.get("props", {})}


def is_picture(message: dict[str, Any]) -> bool:
    return message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None  # None: viser starts without a picture


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
