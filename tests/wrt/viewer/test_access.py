"""Access to the viewer: requests and messages that it accepts or refuses. tests/wrt/viewer/test_page.py uses a browser."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.refused import refused
from tests.wrt.viewer.client import PATIENCE, Client, answer, client, raw_answer, upgrade, wait
from tests.wrt.viewer.test_refine import SCENE
from wrt.lab.costs import CostCounter
from wrt.renderer.options import Options
from wrt.viewer.access import HERE, Access, Place, Refused, access_for, as_origin
from wrt.viewer.messages import decoded

NONSENSE = (None, True, [], {}, [1.0], {"value": 1}, "", "x" * 9000, "\x1b[31m\n", math.nan, math.inf, -math.inf,
            1e308, -1e308, -1, 10**18, 1 << 63, 0.5e-300, "nan", "1")
SENSE = {"exposure": (-1, 0.5e-300), "aperture": (0.5e-300,), "auto exposure": (True,)}
MOVE = {"type": "move", "kind": "orbit", "by": [0.1, 0, 0.0], "begin": True}
ALLOWED = (MOVE, {"type": "size", "width": 64, "height": 48}, {"type": "set", "name": "bounces", "value": 1}, {"type": "reset"},
           {"type": "click", "x": 0, "y": 1.0, "sample": 0}, {"type": "undo"}, {"type": "clear"}, {"type": "walk", "step": 3})


# --- the address ------------------------------------------------------------------------------------------------------


def test_the_printed_address_holds_a_new_token_each_time() -> None:
    access, url = access_for(HERE, "127.0.0.1", 8080)
    assert url == f"http://127.0.0.1:8080/?token={access.token}" and len(access.token) >= 43
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
    assert url.startswith(f"http://{printed}:8080/?token=")
    assert access.origins == {f"http://{name}:8080" for name in names} | {"https://example.org", "http://proxy:9000"}
    access.check(["192.168.1.7:8080"], ["http://192.168.1.7:8080"], "192.168.1.7")  # the connection's own IP address
    access.check(["example.org"], ["https://example.org"], address)
    for name in ("evil.example:8080", "192.168.1.8:8080", "0.0.0.0:8080"):
        with pytest.raises(Refused):
            access.check([name], [], "192.168.1.7")
    assert access_for(HERE, "127.0.0.1", 80)[1].startswith("http://127.0.0.1/?token=")


@pytest.mark.parametrize("text", ["*", "null", "example.org", "https://", "ftp://example.org", "https://example.org/path", "",
                                  "http://user@example.org", "http://a:0", "http://a:65536", "https://example.org?x", "http://a b"])
def test_text_that_is_no_origin_is_refused(text: str) -> None:
    with refused(what="origin"):
        as_origin(text)


def test_where_the_token_may_stand() -> None:
    access = Access(frozenset(), 80, "secret")
    assert access.strip_token("/secret/") == ("/", "") and access.strip_token("/secret?a=b") == ("/", "secret/?a=b")
    assert access.strip_token("/?a=b&token=secret&c=%20") == ("/", "secret/?a=b&c=+")
    assert access.strip_token("/x?token=secret") == ("/x", "") and access.strip_token("/secret/x/y?z") == ("/x/y", "")
    for target in ("/", "/?token=", "/?token=Secret", "/?token=secret&token=secret", "/secretx/", "//secret/", "secret/", "*", "",
                   "/x/secret/", "http://h/secret/", "/?Token=secret", "/\udcff/", "/?token=%ff", "/%73ecret/"):
        with pytest.raises(Refused):
            access.strip_token(target)


# --- requests ---------------------------------------------------------------------------------------------------------


class Served:
    """A page, its warnings, and its port."""

    def __init__(self, **place: Any) -> None:
        from wrt.viewer.page import Page, Tools

        self.warnings: list[str] = []
        self.page = Page(SCENE, Options(threads=1), Place(port=0, **place), spp=1, tools=Tools(CostCounter.beside),
                         warn=self.warnings.append)
        self.port, self.token = self.page.port, self.page.server.access.token


@pytest.fixture
def rendering() -> Iterator[Served]:
    pytest.importorskip("websockets")
    served = Served()
    yield served
    served.page.close()
    served.page.thread.join()


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """Start a page that renders no pictures, so that no kernel is compiled."""
    pytest.importorskip("websockets")
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: False)
    served = Served()
    yield served
    served.page.close()
    served.page.thread.join()


def test_a_connection_without_a_request_does_not_hold_up_the_end(served: Served) -> None:
    with socket.create_connection(("127.0.0.1", served.port), timeout=PATIENCE) as silent:
        assert answer(served.port, "/", [])  # by then the silent connection is accepted
        served.page.close()
        assert not served.page.server.thread.is_alive()
        with contextlib.suppress(ConnectionResetError):
            assert silent.recv(1) == b""


def attempts(port: int, token: str) -> list[tuple[str, list[str]]]:
    """Return requests without access: target and headers."""
    me, way = f"127.0.0.1:{port}", f"/?token={token}"
    hosts = [[], [f"Host: {me}", f"Host: {me}"], ["Host:"], *([f"Host: {value}"] for value in (
        f"evil.example:{port}", "evil.example", f"EVIL.EXAMPLE:{port}", f"LOCALHOST:{port}", f"localhost.:{port}", "127.0.0.1",
        "localhost", f"127.0.0.1:{port + 1}", f"127.0.0.1.:{port}", f"127.0.0.1:{port}.", f"0.0.0.0:{port}", f"127.1:{port}",
        f"2130706433:{port}", f"user@{me}", f"{me}@evil.example", f"{me}, evil.example", f"{me}/", "127.0.0.1.evil.example"))]
    origins = [[f"Origin: {value}"] for value in (
        "null", "http://evil.example", f"http://evil.example:{port}", f"HTTP://EVIL.EXAMPLE:{port}", f"https://{me}", me, "",
        f"http://127.0.0.1:{port + 1}", f"HTTP://{me}", f"http://{me}/", f"http://localhost.:{port}", f"http://LOCALHOST:{port}",
        "http://localhost:3000", "file://", f"http://{me}.evil.example", f"http://{me}@evil.example", "chrome-extension://abc",
        "http://127.0.0.1")] + [[f"Origin: http://{me}", "Origin: http://evil.example"]]
    targets = ["/", "/index.html", "/?token=", "/?token=wrong", f"/?token={token[:-1]}", f"/?token={token}x", f"/#{token}",
               "/wrong/", f"/?token={token}&token={token}", f"/?Token={token}", f"//{token}/", f"http://{me}/{token}/",
               f"/x/{token}/", f"/?token={token.swapcase()}", "/?token=%00", f"/?x=token={token}", "/?\udcff", "/" + "a" * 5000]
    carried = [[f"Cookie: token={token}"], [f"Authorization: token {token}"], [f"X-Token: {token}"], [f"Referer: http://{me}{way}"]]
    return ([(way, headers) for headers in hosts] + [(way, [f"Host: {me}", *headers]) for headers in origins]
            + [(target, [f"Host: {me}"]) for target in targets] + [("/", [f"Host: {me}", *headers]) for headers in carried])


def test_requests_without_access_get_nothing(served: Served, capfd: pytest.CaptureFixture[str]) -> None:
    tries = attempts(served.port, served.token)
    assert len(tries) >= 50
    for target, headers in tries:
        for more in ([], upgrade()):
            came = answer(served.port, target, headers + more)
            if target.isascii() or came:  # from 17, the library closes a connection whose target is not ASCII
                assert came.startswith(b"HTTP/1.1 403 ") and came.endswith(b"\r\n\r\n"), (target, headers, came[:80])
            assert served.token.encode() not in came and b"websockets" not in came and b"Python" not in came
    assert served.page.server.browsers == ()
    assert len(served.warnings) == 3 and all("\n" not in line for line in served.warnings)
    assert all(line.startswith("viewer: refused ") for line in served.warnings)
    assert capfd.readouterr() == ("", "")


def test_the_printed_address_leads_in(served: Served) -> None:
    port, token = served.port, served.token
    names = (f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}")
    for host in names:
        moved = answer(port, f"/?token={token}&a=1", [f"Host: {host}"])
        assert moved.startswith(b"HTTP/1.1 303 ") and f"\r\nLocation: {token}/?a=1\r\n".encode() in moved
        page = answer(port, f"/{token}/?a=1", [f"Host: {host}"])
        assert page.startswith(b"HTTP/1.1 200 ") and b"<!doctype html>" in page
        assert b"\r\nReferrer-Policy: no-referrer\r\n" in page and b"\r\nCache-Control: no-store\r\n" in page
        assert b"Set-Cookie" not in moved + page and b"\r\nContent-Security-Policy: default-src 'none';" in page
        for target in (f"/{token}", f"/{token}/", f"/?token={token}"):
            for origin in ([], *([f"Origin: http://{name}"] for name in names)):
                assert answer(port, target, [f"Host: {host}", *origin, *upgrade()]).startswith(b"HTTP/1.1 101 ")
    assert served.warnings == []


def test_other_origins_can_be_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: False)
    served = Served(allow_origins=["https://Example.org"])
    try:
        target = f"/{served.token}/"
        for host in ("example.org", f"127.0.0.1:{served.port}"):
            headers = [f"Host: {host}", "Origin: https://example.org", *upgrade()]
            assert answer(served.port, target, headers).startswith(b"HTTP/1.1 101 ")
        for host, origin in (("example.org", "http://example.org"), ("example.org:80", "https://example.org"),
                             ("www.example.org", "https://example.org"), ("example.org", "https://www.example.org")):
            headers = [f"Host: {host}", f"Origin: {origin}", *upgrade()]
            assert answer(served.port, target, headers).startswith(b"HTTP/1.1 403 ")
    finally:
        served.page.close()
    with refused(what="origin"):
        Served(allow_origins=["*"])


def test_malformed_requests_print_nothing(served: Served, capfd: pytest.CaptureFixture[str]) -> None:
    """Malformed requests get an error of HTTP or, by older versions of the library, nothing. They print nothing."""
    port, token = served.port, served.token
    host = [f"Host: 127.0.0.1:{port}"]
    for request in (b"", b"\r\n\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01", b"GET / HTTP/2\r\n\r\n",
                    b"GET / HTTP/1.0\r\n\r\n", f"POST /{token}/ HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc".encode(),
                    b"GET / HTTP/1.1\r\nbad header\r\n\r\n",
                    b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n"):
        with socket.create_connection(("127.0.0.1", port), timeout=30.0) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                came = connection.recv(1 << 16)
                assert came == b"" or came.startswith(b"HTTP/1.1 4"), (request, came)
                assert token.encode() not in came and b"websockets" not in came and b"Python" not in came
    for method in ("POST", "PUT", "HEAD"):
        came = raw_answer(port, "\r\n".join([f"{method} /{token}/ HTTP/1.1", *host, "", ""]).encode())
        assert came == b"" or came.startswith(b"HTTP/1.1 405 "), (method, came[:60])
    for target in ("a" * 5000, "a" * 150, "..", "../__init__.py", "%2e%2e/%2e%2e/__init__.py", "%00", "\udcff", "con", ".", "a//b"):
        came = answer(port, f"/{token}/{target}", host)
        assert came.startswith(b"HTTP/1.1 404 ") or (came == b"" and not target.isascii()), (target, came[:60])
    for more in (["Upgrade: websocket"], [*upgrade()[:3], "Sec-WebSocket-Version: 7"], [*upgrade(), "Upgrade: websocket"],
                 [*upgrade(), "Accept-Encoding: gzip", "Accept-Encoding: br"]):
        assert answer(port, f"/{token}/", host + more)[9:12] in (b"400", b"426", b"101", b"200")
    handshake = "\r\n".join([f"GET /{token}/ HTTP/1.1", *host, *upgrade(), "", ""]).encode()
    for frame in (b"\xff" * 20, b"\x82\x05hello", b"\x81\xfe\x00\x80abcd" + b"\xff" * 128, b"\x82\xff" + b"\x7f" + b"\xff" * 20,
                  b"\x83\x80abcd", b"\x88\x81abcdx", b"\x89\xfe\x00\xffabcd" + b"x" * 255, b"\x82"):
        with socket.create_connection(("127.0.0.1", port), timeout=30.0) as connection:
            connection.sendall(handshake)
            assert connection.recv(1 << 16).startswith(b"HTTP/1.1 101 ")
            connection.sendall(frame)
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                while connection.recv(1 << 16):
                    pass
    with client(served.page.url) as fine:
        assert "exposure" in fine.controls()
    out, err = capfd.readouterr()
    assert out == "" and "Traceback" not in err and err == "", err


# --- messages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("message", ALLOWED, ids=lambda message: str(message["type"]))
def test_a_browsers_messages_are_allowed_and_no_others(message: dict[str, Any]) -> None:
    assert decoded(json.dumps(message)) == message
    for field in message:
        with pytest.raises(Refused):
            decoded(json.dumps({key: value for key, value in message.items() if key != field}))
    for wrong in ({**message, "more": 1}, {**message, "type": "Message"}, {**message, "type": [message["type"]]}):
        with pytest.raises(Refused):
            decoded(json.dumps(wrong))
    with pytest.raises(Refused):
        decoded(json.dumps(message).encode())


@pytest.mark.parametrize("text", ["", "null", "[]", "1", "no JSON", "{", "[" * 60000, '{"type": "undo"', '{"type": null}', '"undo"'])
def test_text_that_is_no_message_is_refused(text: str) -> None:
    with pytest.raises(Refused):
        decoded(text)


@pytest.mark.parametrize(("kind", "field"), [(each["type"], field) for each in ALLOWED for field in each if field != "type"])
def test_invalid_fields_are_refused(kind: str, field: str) -> None:
    message = next(each for each in ALLOWED if each["type"] == kind)
    fine: tuple[type, ...] = {"begin": (bool,), "value": (bool, int, float, str), "name": (str,)}.get(field, ())
    for value in (*NONSENSE, [1.0, 2.0, math.nan], [1.0, 2.0], [1.0, 2.0, 101.0], [True, 0, 0], 16385, 1.5):
        if type(value) in fine or (field in ("x", "y") and value == 0.5e-300) or (field in ("sample", "step") and value == 16385):
            continue
        with pytest.raises(Refused):
            decoded(json.dumps({**message, field: value}))


def moves(who: Client) -> int:
    """Move the camera 20 times, and return the number of different pictures that arrive."""
    new = set()
    for _ in range(20):
        who.move(0.01)
        new.add(who.picture())
    return len(new)


def test_invalid_values_do_not_stop_pictures(rendering: Served, capfd: pytest.CaptureFixture[str]) -> None:
    served, page = rendering, rendering.page
    with client(page.url) as bad, client(page.url) as good:
        for who in (bad, good):
            who.open()
            who.picture()
        controls = bad.controls()
        assert controls.keys() == {"camera", "angle of view", "aperture", "focus", "bounces", "structure", "show", "exposure",
                                   "auto exposure", "tone mapping", "resolution"}
        for name in controls:
            for value in NONSENSE:
                if not any(value is each or (value == each and type(value) is type(each)) for each in SENSE.get(name, ())):
                    bad.set(name, value)
        bad.set("fees", 1)
        for text in ("no JSON", b"\xc1", "[" * 60000, b"", "{}"):
            bad.socket.send(text)
        assert moves(bad) == 20 and moves(good) == 20
        assert {name: control.get() for name, control in page.panel.controls.items()} == {
            name: control["value"] for name, control in controls.items()}
    for name in controls:
        lines = [line for line in served.warnings if line.startswith(f"viewer: dropped {name}: ")]
        assert len(lines) == 1, name
    assert all("\n" not in line and len(line) < 200 for line in served.warnings)
    out, err = capfd.readouterr()
    assert (out, err) == ("", "") and page.thread.is_alive()


def test_values_that_a_control_can_have_arrive(served: Served) -> None:
    page = served.page
    with client(page.url) as somebody:
        somebody.open()
        for name, value in (("bounces", 0), ("bounces", 12.0), ("aperture", 0), ("focus", 2), ("exposure", -8), ("auto exposure", True),
                            ("tone mapping", "reinhard"), ("resolution", "1/4"), ("structure", "bvh8"), ("show", "nodes")):
            somebody.set(name, value)
            wait(lambda name=name, value=value: page.panel.controls[name].get() == value, somebody)
    assert served.warnings == []


def test_a_camera_beyond_the_numbers_is_dropped(rendering: Served) -> None:
    page = rendering.page
    with client(page.url) as somebody:
        somebody.open()
        somebody.picture()
        before = page.steering.pose
        for _ in range(1000):
            somebody.send("move", kind="dolly", by=[2.0, 0.0, 0.0], begin=False)
        wait(lambda: any("error: " in line for line in rendering.warnings), somebody)
        somebody.send("undo")
        wait(lambda: page.steering.pose is before, somebody)
        somebody.move(0.1)
        somebody.picture()


def test_a_flood_does_not_keep_others_from_the_view(rendering: Served) -> None:
    """A second browser gets pictures, and its moves count, while the first sends as fast as it can."""
    page = rendering.page
    with client(page.url) as flood, client(page.url) as other:
        for who in (flood, other):
            who.open()
        other.picture()
        for _ in range(20_000):
            flood.move(1e-6, begin=False)
        begin = time.monotonic()
        other.set("bounces", 0)
        wait(lambda: page.viewer.view.max_depth == 0, other)
        other.picture()
        assert time.monotonic() - begin < PATIENCE / 10


def test_a_slow_browser_keeps_one_picture(rendering: Served) -> None:
    """What is not sent is replaced by what is newer."""
    page = rendering.page
    with client(page.url) as somebody:
        somebody.open()
        somebody.picture()
        browser, = page.server.browsers
        for i in range(1000):
            browser.put("activity", {"text": str(i)})
        texts = []
        while not texts or texts[-1] != "999":
            texts.append(somebody.next("activity")["text"])
        assert len(texts) < 1000 and len(browser._unsent) <= 5


def test_a_large_message_ends_the_connection_and_too_many_are_closed(served: Served, monkeypatch: pytest.MonkeyPatch,
                                                                     capfd: pytest.CaptureFixture[str]) -> None:
    from websockets.exceptions import ConnectionClosedError

    from wrt.viewer import server as module

    with client(served.page.url) as other:
        other.controls()
        other.socket.send("x" * (module.LARGEST_MESSAGE + 1))
        with pytest.raises(ConnectionClosedError) as closed:
            other.until(lambda message: False)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009
    monkeypatch.setattr(module, "MOST_CONNECTIONS", 2)
    idle = [socket.create_connection(("127.0.0.1", served.port), timeout=30.0) for _ in range(4)]
    assert [connection.recv(1) for connection in idle[2:]] == [b"", b""]
    for connection in idle:
        connection.close()
    with client(served.page.url) as again:  # closed connections no longer count
        again.controls()
    out, err = capfd.readouterr()
    assert (out, err) == ("", "")


def test_each_page_has_its_own_token(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: False)
    made = [Served() for _ in range(2)]
    try:
        for served in made:
            for other in made:
                came = raw_answer(served.port, f"GET /{other.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\n\r\n".encode())
                assert came.startswith(b"HTTP/1.1 200 " if other is served else b"HTTP/1.1 403 ")
    finally:
        for served in made:
            served.page.close()
