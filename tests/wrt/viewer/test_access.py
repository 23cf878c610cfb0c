"""Access to the viewer's server: requests and messages that it accepts or refuses. tests/wrt/viewer/test_page.py uses a browser."""

from __future__ import annotations

import contextlib
import json
import math
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from tests.refused import refused
from tests.wrt.viewer.client import answer, client, upgrade, wait
from wrt.viewer.access import HERE, Access, Place, Refused, access_for, as_origin
from wrt.viewer.panel import decoded
from wrt.viewer.server import LARGEST_MESSAGE, Browser, Server, listen

NONSENSE = (None, True, {}, "", math.nan, 1e308, -1, "1", [1.0, 2.0, math.nan], [1.0, 2.0], [True, 0, 0], 1.5)
MOVE = {"type": "move", "kind": "orbit", "by": [0.1, 0, 0.0]}
ALLOWED = (MOVE, {"type": "size", "width": 64, "height": 48}, {"type": "set", "name": "bounces", "value": 1}, {"type": "reset"},
           {"type": "click", "x": 0, "y": 1.0, "sample": 0}, {"type": "clear"}, {"type": "walk", "step": 3})


# --- the address ------------------------------------------------------------------------------------------------------


def test_the_printed_address_holds_a_new_token_each_time() -> None:
    access, url = access_for(HERE, "127.0.0.1", 8080)
    assert url == f"http://127.0.0.1:8080/{access.token}/" and len(access.token) >= 43
    assert access.token not in repr(access) and access_for(HERE, "127.0.0.1", 8080)[0].token != access.token


@pytest.mark.parametrize(("host", "address", "printed", "names"), [
    ("127.0.0.1", "127.0.0.1", "127.0.0.1", ("127.0.0.1", "localhost", "[::1]")),
    ("LocalHost", "::1", "[::1]", ("127.0.0.1", "localhost", "[::1]")),
    ("0.0.0.0", "0.0.0.0", "127.0.0.1", ("127.0.0.1", "localhost", "[::1]")),
    ("::", "::", "[::1]", ("127.0.0.1", "localhost", "[::1]")),
    ("Box.lan", "192.168.1.5", "192.168.1.5", ("192.168.1.5", "box.lan")),
])
def test_the_names_of_an_address(host: str, address: str, printed: str, names: tuple[str, ...]) -> None:
    access, url = access_for(Place(host, 8080, ["https://Example.org", "http://proxy:9000/"]), address, 8080)
    assert url == f"http://{printed}:8080/{access.token}/"
    assert access.origins == {f"http://{name}:8080" for name in names} | {"https://example.org", "http://proxy:9000"}
    access.check(["192.168.1.7:8080"], ["http://192.168.1.7:8080"], "192.168.1.7")  # the connection's own IP address
    access.check(["example.org"], ["https://example.org"], address)
    for name in ("evil.example:8080", "192.168.1.8:8080", "0.0.0.0:8080"):
        with pytest.raises(Refused):
            access.check([name], [], "192.168.1.7")


@pytest.mark.parametrize("text", ["*", "example.org", "ftp://example.org", "https://example.org/path", "http://user@example.org", "http://a:65536"])
def test_text_that_is_no_origin_is_refused(text: str) -> None:
    with refused(what="origin"):
        as_origin(text)


def test_where_the_token_may_stand() -> None:
    access = Access(frozenset(), 80, "secret")
    assert access.strip_token("/secret/?a=b") == "/" and access.strip_token("/secret/x/y?z") == "/x/y"
    for target in ("/", "", "*", "/secret", "/Secret/", "/secretx/", "//secret/", "secret/", "/x/secret/", "http://h/secret/",
                   "/?token=secret", "/\udcff/", "/%73ecret/"):
        with pytest.raises(Refused):
            access.strip_token(target)


# --- requests ---------------------------------------------------------------------------------------------------------


class Served:
    """A server with one file in place of a page, its warnings, and the messages that it has received."""

    def __init__(self, **place: Any) -> None:
        pytest.importorskip("websockets")
        self.warnings: list[str] = []
        self.messages: list[dict[str, Any]] = []
        listening = listen(Place(port=0, **place))
        self.port = listening.getsockname()[1]
        access, self.url = access_for(Place(**place), "127.0.0.1", self.port)
        self.token = access.token
        self.server = Server(access, self, listening, self.warnings.append)

    def file(self, path: str) -> tuple[str, bytes] | None:
        return ("text/html", b"<!doctype html>") if path == "/" else None

    def joined(self, browser: Browser) -> None:
        browser.put("state", {"controls": []})

    def left(self, browser: Browser) -> None:
        pass

    def received(self, message: dict[str, Any]) -> None:
        if message["type"] == "reset":
            raise ValueError("a defect")
        self.messages.append(message)


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    yield served
    served.server.close()


FORGED = [  # target and headers; ME: the viewer's host and port, TOKEN: its token
    ("/TOKEN/", []), ("/TOKEN/", ["Host: ME", "Host: ME"]), ("/TOKEN/", ["Host: evil.example"]), ("/TOKEN/", ["Host: 127.0.0.1"]),
    ("/TOKEN/", ["Host: ME.evil.example"]), ("/TOKEN/", ["Host: user@ME"]),
    ("/TOKEN/", ["Host: ME", "Origin: null"]), ("/TOKEN/", ["Host: ME", "Origin: http://evil.example:PORT"]),
    ("/TOKEN/", ["Host: ME", "Origin: https://ME"]), ("/TOKEN/", ["Host: ME", "Origin: http://ME", "Origin: http://evil.example"]),
    ("/", ["Host: ME"]), ("/TOKENx/", ["Host: ME"]), ("//TOKEN/", ["Host: ME"]), ("/?a=\udcff", ["Host: ME"]),
    ("/", ["Host: ME", "Cookie: token=TOKEN"]),
]


def test_requests_without_access_get_nothing(served: Served, capfd: pytest.CaptureFixture[str]) -> None:
    def filled(text: str) -> str:
        return text.replace("ME", f"127.0.0.1:{served.port}").replace("TOKEN", served.token).replace("PORT", str(served.port))

    for target, headers in FORGED:
        for more in ([], upgrade()):
            came = answer(served.port, filled(target), [filled(each) for each in headers] + more)
            assert came.startswith(b"HTTP/1.1 403 ") and came.endswith(b"\r\n\r\n"), (target, headers, came[:80])
            assert served.token.encode() not in came and b"websockets" not in came and b"Python" not in came
    assert served.server.browsers == () and len(served.warnings) == 3
    assert all(line.startswith("viewer: refused ") and "\n" not in line for line in served.warnings)
    assert capfd.readouterr() == ("", "")


def test_the_printed_address_leads_in(served: Served) -> None:
    port, token = served.port, served.token
    names = (f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}")
    for host in names:
        page = answer(port, f"/{token}/?a=1", [f"Host: {host}"])
        assert page.startswith(b"HTTP/1.1 200 ") and b"<!doctype html>" in page
        assert b"\r\nReferrer-Policy: no-referrer\r\n" in page and b"\r\nCache-Control: no-store\r\n" in page
        assert b"Set-Cookie" not in page and b"\r\nContent-Security-Policy: default-src 'none';" in page
        for origin in ([], *([f"Origin: http://{name}"] for name in names)):
            assert answer(port, f"/{token}/", [f"Host: {host}", *origin, *upgrade()]).startswith(b"HTTP/1.1 101 ")
    assert answer(port, f"/{token}/../x", [f"Host: {names[0]}"]).startswith(b"HTTP/1.1 404 ") and served.warnings == []


def test_other_origins_can_be_allowed() -> None:
    served = Served(allow_origins=["https://Example.org"])
    for host, origin, status in (("example.org", "https://example.org", 101), (f"127.0.0.1:{served.port}", "https://example.org", 101),
                                 ("example.org", "http://example.org", 403), ("example.org:80", "https://example.org", 403),
                                 ("www.example.org", "https://example.org", 403), ("example.org", "https://www.example.org", 403)):
        came = answer(served.port, f"/{served.token}/", [f"Host: {host}", f"Origin: {origin}", *upgrade()])
        assert came.startswith(f"HTTP/1.1 {status} ".encode())
    served.server.close()


def test_malformed_requests_and_frames_print_nothing(served: Served, capfd: pytest.CaptureFixture[str]) -> None:
    """They get an error of HTTP or, by older versions of the library, nothing; the server goes on."""
    handshake = "\r\n".join([f"GET /{served.token}/ HTTP/1.1", f"Host: 127.0.0.1:{served.port}", *upgrade(), "", ""]).encode()
    for request in (b"", b"\x16\x03\x01\x02\x00\x01\x00\x01", b"GET / HTTP/1.1\r\nbad header\r\n\r\n", b"POST" + handshake[3:],
                    handshake + b"\xff" * 20):
        with socket.create_connection(("127.0.0.1", served.port), timeout=30.0) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                came = connection.recv(1 << 16)
                assert came == b"" or came.startswith(b"HTTP/1.1 101 " if request.startswith(handshake) else b"HTTP/1.1 4"), came
    with client(served.url) as fine:
        assert fine.controls() == {}
    assert capfd.readouterr() == ("", "")


# --- messages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("message", ALLOWED, ids=lambda message: str(message["type"]))
def test_a_browsers_messages_are_allowed_and_no_others(message: dict[str, Any]) -> None:
    assert decoded(json.dumps(message)) == message
    wrong: list[Any] = [{key: value for key, value in message.items() if key != field} for field in message]
    for field in message.keys() - {"type", "name", "value"}:
        wrong += [{**message, field: value} for value in NONSENSE]
    wrong += [{**message, "more": 1}, {**message, "type": "Message"}, {**message, "type": [message["type"]]}]
    for each in wrong:
        with pytest.raises(Refused):
            decoded(json.dumps(each))
    with pytest.raises(Refused):
        decoded(json.dumps(message).encode())


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 60000, '{"type": null}', '{"type": "set", "name": "a", "value": null}'])
def test_text_that_is_no_message_is_refused(text: str) -> None:
    with pytest.raises(Refused):
        decoded(text)


def test_messages_that_fail_are_reported_once_and_the_others_go_on(served: Served) -> None:
    with client(served.url) as somebody:
        for _ in range(3):
            for text in ("no JSON", json.dumps({"type": "reset"}), json.dumps({**MOVE, "kind": "fly"})):
                somebody.socket.send(text)
        somebody.socket.send(json.dumps(MOVE))
        wait(lambda: served.messages == [MOVE])
    assert len(served.warnings) == 3 and "ValueError: a defect" in served.warnings[1]


def test_a_slow_browser_keeps_the_newest_message_of_each_kind(served: Served) -> None:
    with client(served.url) as somebody:
        somebody.controls()
        browser, = served.server.browsers
        for i in range(1000):
            browser.put("activity", {"text": str(i)})
        texts = []
        while not texts or texts[-1] != "999":
            texts.append(somebody.next("activity")["text"])
        assert len(texts) < 1000 and texts == sorted(texts, key=int)


def test_a_large_message_ends_its_connection_alone(served: Served) -> None:
    from websockets.exceptions import ConnectionClosedError

    with client(served.url) as large, client(served.url) as other:
        large.socket.send("x" * (LARGEST_MESSAGE + 1))
        with pytest.raises(ConnectionClosedError) as closed:
            large.until(lambda message: False)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009
        other.socket.send(json.dumps(MOVE))
        wait(lambda: served.messages == [MOVE])
