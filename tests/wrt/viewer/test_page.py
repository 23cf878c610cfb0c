"""The viewer in a real browser, and the command that starts it."""

from __future__ import annotations

import http.server
import io
import os
import shutil
import socket
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
from PIL import Image

from tests.command_line import wrt as run
from tests.data import ROOT
from tests.wrt.viewer.client import answer
from tests.wrt.viewer.test_refine import CAMERA, SCENE
from wrt.lab.costs import CostCounter
from wrt.renderer.options import Options
from wrt.renderer.render import render
from wrt.viewer.access import Place

WHITTED = ROOT / "scenes" / "whitted.toml"
SIZE = {"width": 640, "height": 480}
ROUGHLY = 0.5  # Mean difference in codes on the screen, where a texture draws the picture.
PATIENCE = 120.0  # Seconds, since a busy machine draws slowly and may have to compile kernels.


# --- the command ------------------------------------------------------------------------------------------------------


def test_without_viser_there_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    result = run("view", WHITTED)
    assert result.code == 2 and result.out == "" and result.errors == [result.err.strip()]
    assert 'pip install "wrt[viewer]"' in result.err


@pytest.mark.parametrize(("host", "port", "part"), [
    ("127.0.0.1", None, "(Address already in use);"), ("no.such.host.invalid", 0, "no.such.host.invalid")])
def test_an_address_that_cannot_be_listened_on(host: str, port: int | None, part: str) -> None:
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1] if port is None else port
        result = run("view", WHITTED, "--host", host, "--port", port, "--no-open")
    assert result.code == 2 and result.out == "" and len(result.errors) == 1
    assert part in result.err and f"port {port}" in result.err and "--port" in result.err


def test_the_command_serves_until_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    from wrt.viewer.page import Page

    seen: list[Page] = []

    def wait(self: Page) -> None:
        seen.append(self)
        port = self.server.get_port()
        came = answer(port, f"/{self.guard.access.token}/", [f"Host: localhost:{port}"])
        assert came.startswith(b"HTTP/1.1 200") and answer(port, "/", [f"Host: localhost:{port}"]).startswith(b"HTTP/1.1 403")
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "wait", wait)
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: True)  # this test compiles nothing
    result = run("view", WHITTED, "--port", 0, "--no-open")
    assert result.code == 0 and result.out == f"{seen[0].url}\n" and seen[0].url.startswith("http://127.0.0.1:")
    refused = "viewer: refused a request without the token of the printed address (reported once)"
    assert result.err.splitlines() == ["Ctrl-C ends the viewer", refused]
    seen[0].thread.join(10.0)
    assert not seen[0].thread.is_alive()
    assert "no camera 'nobody'" in run("view", WHITTED, "--camera", "nobody", "--port", 0).err


def test_quiet_and_other_origins(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    from wrt.viewer.page import Page

    def wait(self: Page) -> None:
        port = self.server.get_port()
        answer(port, "/", [f"Host: localhost:{port}"])
        assert {"https://example.org", "http://localhost:9000"} <= self.guard.access.origins
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "wait", wait)
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: True)
    options = "--port", 0, "--no-open", "-q", "--allow-origin", "https://Example.org", "--allow-origin", "http://localhost:9000"
    result = run("view", WHITTED, *options)
    assert result.code == 0 and result.err == ""
    result = run("view", WHITTED, "--port", 0, "--allow-origin", "example.org")
    assert result.code == 2 and result.out == "" and len(result.errors) == 1 and "'example.org' is no origin" in result.err


def test_the_browsers_command_line_does_not_hold_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    """All users of the machine can read the command line."""
    pytest.importorskip("viser")
    from wrt.cli import view as cli_view
    from wrt.viewer.page import Page

    opened: list[Path] = []

    def open_browser(address: str) -> None:
        path = Path(url2pathname(urlsplit(address).path))
        opened.append(path)
        token = urls[0].partition("token=")[2]
        assert token and token not in address and urls[0] in path.read_text(encoding="utf-8")
        if os.name == "posix":
            assert path.parent.stat().st_mode & 0o777 == 0o700

    urls: list[str] = []

    def wait(self: Page) -> None:
        assert opened[0].exists()
        raise KeyboardInterrupt

    in_browser = cli_view.in_browser
    monkeypatch.setattr(cli_view, "in_browser", lambda url: (urls.append(url), in_browser(url))[1])
    monkeypatch.setattr(cli_view, "has_desktop", lambda: True)
    monkeypatch.setattr("webbrowser.open", open_browser)
    monkeypatch.setattr(Page, "wait", wait)
    monkeypatch.setattr("wrt.viewer.refine.Viewer._prepare", lambda self, view: True)
    assert run("view", WHITTED, "--port", 0).code == 0
    assert len(opened) == 1 and not opened[0].exists() and not opened[0].parent.exists()


# --- the page ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    pytest.importorskip("viser")
    from wrt.viewer.page import Page

    page = Page(SCENE, Options(threads=1), Place(port=0), spp=4, counter_of=CostCounter.beside)
    yield page
    page.close()


@pytest.fixture(scope="module")
def browser_page(page: Any) -> Iterator[Any]:
    """Open the page in Chromium; `mistakes` collects the errors of its console."""
    api = pytest.importorskip("playwright.sync_api")
    chromium = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("needs a Chromium")
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=[
            "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
        view = browser.new_page(viewport=SIZE)
        view.set_default_timeout(1000.0 * PATIENCE)
        view.mistakes = []
        view.on("console", lambda message: view.mistakes.append(message.text) if message.type == "error" else None)
        view.on("pageerror", lambda error: view.mistakes.append(str(error)))
        view.goto(f"{page.url}&fixedDpr=1")  # otherwise viser shrinks the canvas on a slow machine
        settle(page, view)
        yield view
        browser.close()


def until(condition: Callable[[], Any], browser_page: Any) -> Any:
    """Wait until the condition is true, while the browser handles events; return the condition's value."""
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, "the condition never held"
        browser_page.wait_for_timeout(50)
    return value


def settle(page: Any, browser_page: Any) -> None:
    """Wait until the view stays at the scene's camera, because a slow browser starts with viser's default camera."""
    for _ in range(2):
        until(lambda: page.watching >= 0 and np.allclose(page.viewer.view.camera.camera_to_world, CAMERA.camera_to_world),
              browser_page)
        browser_page.wait_for_timeout(1500)


def finished(page: Any, browser_page: Any, **view: Any) -> Any:
    """Wait for the finished picture of the view with these fields, and return it."""

    def done() -> Any:
        shown = page.viewer.shown
        return shown if (shown is not None and shown.done and shown.view is page.viewer.view
                         and all(getattr(shown.view, name) == value for name, value in view.items())) else None

    return until(done, browser_page)


def seen(browser_page: Any, shown: Any) -> np.ndarray:
    """Return the screen left of the panel, in pixels of the picture, once the screen no longer changes."""
    last, same, deadline = None, 0, time.monotonic() + PATIENCE
    while same < 2:
        assert time.monotonic() < deadline, "the screen never rests"
        data = browser_page.screenshot()
        same, last = (same + 1, last) if data == last else (0, data)
        browser_page.wait_for_timeout(100)
    height, width = shown.codes.shape[:2]
    with Image.open(io.BytesIO(data)) as image:
        pixels = np.asarray(image.convert("RGB").resize((width, height), Image.Resampling.BILINEAR)).astype(float)
    return pixels[height // 3 :, : width * 7 // 16]  # below viser's message about software rendering


def expected(shown: Any, shift: tuple[int, int] = (0, 0)) -> np.ndarray:
    height, width = shown.codes.shape[:2]
    return np.roll(shown.codes, shift, axis=(0, 1)).astype(float)[height // 3 :, : width * 7 // 16]


def difference(browser_page: Any, shown: Any) -> float:
    return float(np.abs(seen(browser_page, shown) - expected(shown)).mean())


def test_the_picture_is_there_and_lines_up(page: Any, browser_page: Any) -> None:
    shown = finished(page, browser_page)
    camera = shown.view.camera
    np.testing.assert_allclose(camera.camera_to_world, CAMERA.camera_to_world, atol=1e-9)
    assert camera.fov_y == pytest.approx(CAMERA.fov_y) and camera.aperture_radius == CAMERA.aperture_radius
    width, height = shown.view.size
    assert width / height == pytest.approx(SIZE["width"] / SIZE["height"], rel=0.01)
    film = render(SCENE, size=shown.view.size, spp=4, camera=camera)
    assert np.abs(film.to_srgb8().astype(int) - shown.codes).max() <= 1
    until(lambda: "4 of 4 spp" in browser_page.inner_text("body"), browser_page)
    there = seen(browser_page, shown)
    off = {shift: np.abs(there - expected(shown, shift)).mean() for shift in np.ndindex(3, 3)}
    off |= {(-y, -x): np.abs(there - expected(shown, (-y, -x))).mean() for y, x in np.ndindex(3, 3)}
    assert off[0, 0] < ROUGHLY and min(off, key=lambda shift: off[shift]) == (0, 0), off
    assert browser_page.mistakes == []


def test_a_drag_orbits_and_stays_level(page: Any, browser_page: Any) -> None:
    before = finished(page, browser_page)
    browser_page.mouse.move(200, 300)
    browser_page.mouse.down()
    browser_page.mouse.move(250, 320, steps=5)
    browser_page.mouse.up()
    until(lambda: page.viewer.view.camera is not before.view.camera, browser_page)
    still, deadline = 0, time.monotonic() + PATIENCE
    while still < 10:  # viser moves the camera on after the drag
        assert time.monotonic() < deadline, "the camera never rests"
        camera = page.viewer.view.camera
        browser_page.wait_for_timeout(100)
        still = still + 1 if page.viewer.view.camera is camera else 0
    after = finished(page, browser_page)
    pose, old = after.view.camera.camera_to_world, before.view.camera.camera_to_world
    target = CAMERA.camera_to_world[:3] @ (0, 0, -CAMERA.focus_distance, 1)
    assert np.linalg.norm(pose[:3, 3] - old[:3, 3]) > 0.2
    assert np.linalg.norm(pose[:3, 3] - target) == pytest.approx(CAMERA.focus_distance, rel=1e-6)
    assert abs(pose[1, 0]) < 1e-9 and pose[1, 1] > 0.0
    assert difference(browser_page, after) < ROUGHLY


def set_number(browser_page: Any, label: str, value: str) -> None:
    """Write into the number beside a slider, or into a number field."""
    row = browser_page.locator(f"xpath=//label[text()='{label}']/ancestor::*[.//input][1]")
    field = row.locator("input[type=text], input[inputmode]").last
    field.fill(value)
    field.press("Enter")


def choose(browser_page: Any, label: str, value: str) -> None:
    row = browser_page.locator(f"xpath=//label[text()='{label}']/ancestor::*[.//input][1]")
    row.locator("input").first.click()
    browser_page.get_by_role("option", name=value, exact=True).click()


def test_controls_change_the_picture(page: Any, browser_page: Any) -> None:
    bright = finished(page, browser_page)
    set_number(browser_page, "bounces", "0")
    flat = finished(page, browser_page, max_depth=0)
    assert flat.codes.mean() < bright.codes.mean() - 20.0 and difference(browser_page, flat) < ROUGHLY
    choose(browser_page, "show", "nodes")
    heat = finished(page, browser_page, cost="nodes")
    until(lambda: "nodes per pixel" in browser_page.inner_text("body"), browser_page)
    assert heat.mean > 1.0 and difference(browser_page, heat) < ROUGHLY
    choose(browser_page, "show", "picture")
    choose(browser_page, "structure", "bvh8")
    finished(page, browser_page, cost="", accel="bvh8")
    set_number(browser_page, "angle of view", "60")
    until(lambda: abs(page.viewer.view.camera.fov_y - np.radians(60.0)) < 1e-6, browser_page)
    wide = finished(page, browser_page)
    film = render(SCENE, size=wide.view.size, spp=4, camera=wide.view.camera, max_depth=0)
    assert np.abs(film.to_srgb8().astype(int) - wide.codes).max() <= 1
    choose(browser_page, "tone mapping", "reinhard")
    until(lambda: np.array_equal(page.viewer.shown.codes, replace(film, tonemap="reinhard").to_srgb8()), browser_page)
    assert browser_page.mistakes == []


def test_a_click_focuses(page: Any, browser_page: Any) -> None:
    shown = finished(page, browser_page)
    browser_page.mouse.click(150, 440)
    browser_page.locator("xpath=//label[text()='click to focus']/ancestor::*[.//input][1]").locator("input").check()
    until(lambda: page.by_click.value, browser_page)
    assert page.viewer.view.camera.focus_distance == shown.view.camera.focus_distance  # the first click did not focus
    browser_page.mouse.click(150, 440)
    wanted = page.viewer.renderers.focus_at(page.viewer.view, 150.5 / SIZE["width"], 440.5 / SIZE["height"])
    until(lambda: page.viewer.view.camera.focus_distance == pytest.approx(wanted, rel=0.01), browser_page)
    assert page.focus.value == page.viewer.view.camera.focus_distance != shown.view.camera.focus_distance


def test_a_reloaded_page_gets_the_picture(page: Any, browser_page: Any) -> None:
    finished(page, browser_page)
    page.viewer.spp = 1 << 20  # the browser is reloaded during a refinement
    try:
        set_number(browser_page, "bounces", "2")
        until(lambda: page.viewer.shown.view.max_depth == 2, browser_page)
    finally:
        page.viewer.spp = 4
    browser_page.reload()  # viser may report its default camera before it receives the first camera
    until(lambda: page.viewer.shown.done and np.allclose(page.viewer.shown.view.camera.camera_to_world, CAMERA.camera_to_world,
                                                         rtol=0.0, atol=1e-9), browser_page)
    again = finished(page, browser_page, max_depth=2)
    assert difference(browser_page, again) < ROUGHLY
    assert page.thread.is_alive() and page.failure is None and browser_page.mistakes == []


def test_a_second_browser_gets_the_picture_and_leaves_it_to_the_first(page: Any, browser_page: Any) -> None:
    shown = finished(page, browser_page)
    first = page.watching
    other = browser_page.context.browser.new_page(viewport=SIZE)
    other.goto(browser_page.url)
    until(lambda: page.watching != first, other)
    settle(page, other)
    assert other.get_by_text("2 browsers are connected").is_visible()
    assert difference(other, finished(page, other, size=shown.view.size)) < ROUGHLY
    other.close()
    until(lambda: page.watching == first, browser_page)
    until(lambda: not browser_page.get_by_text("browsers are connected").is_visible(), browser_page)
    set_number(browser_page, "bounces", "1")
    assert difference(browser_page, finished(page, browser_page, max_depth=1)) < ROUGHLY


def test_saved_files(page: Any, browser_page: Any, tmp_path: Path) -> None:
    shown = finished(page, browser_page)
    for name, suffix in (("picture as PNG", ".png"), ("picture as EXR", ".exr")):
        with browser_page.expect_download() as download:
            browser_page.get_by_role("button", name=name).click()
        path = tmp_path / f"saved{suffix}"
        download.value.save_as(path)
        if suffix == ".png":
            with Image.open(path) as image:
                np.testing.assert_array_equal(np.asarray(image), page.viewer.shown.codes)
        else:
            from wrt.picture.image import read_image

            np.testing.assert_allclose(read_image(path), page.viewer.picture().pixels, rtol=1e-3, atol=1e-6)
    browser_page.get_by_role("button", name="camera as TOML").click()
    with browser_page.expect_download() as download:
        browser_page.get_by_role("button", name="save as a file").click()
    download.value.save_as(tmp_path / "camera.toml")
    table = tomllib.loads((tmp_path / "camera.toml").read_text())["cameras"]["view"]
    np.testing.assert_array_equal(table["position"], shown.view.camera.camera_to_world[:3, 3])
    until(lambda: "[cameras.view]" in browser_page.inner_text("body"), browser_page)
    browser_page.get_by_role("button", name="close").click()
    assert browser_page.mistakes == []


def test_the_private_file_forwards_to_the_page(page: Any, browser_page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from wrt.cli import view as cli_view

    shown = finished(page, browser_page)
    first, other = page.watching, browser_page.context.browser.new_page(viewport=SIZE)
    monkeypatch.setattr("webbrowser.open", lambda address: other.goto(address))
    with cli_view.in_browser(f"{page.url}&fixedDpr=1"):
        until(lambda: page.watching != first, other)
    settle(page, other)
    assert other.url.startswith(f"{page.url.partition('?')[0]}{page.guard.access.token}/")
    assert difference(other, finished(page, other, size=shown.view.size)) < ROUGHLY
    other.reload()
    second = page.watching
    until(lambda: page.watching not in (first, second), other)
    other.close()
    until(lambda: page.watching == first, browser_page)


def test_a_page_of_another_origin_has_no_access(page: Any, browser_page: Any) -> None:
    """In a real browser, even with the token: a page from another port or another host name has no access."""
    port, token = page.server.get_port(), page.guard.access.token
    before = page.server.get_clients().keys()

    class Stranger(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>stranger</title>")

        def log_message(self, *rest: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stranger) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stranger = browser_page.context.browser.new_page()
        stranger.goto(f"http://127.0.0.1:{server.server_port}/")
        for way in (f"/{token}/", f"/?token={token}", "/"):
            for name in ("127.0.0.1", "localhost"):
                opened = stranger.evaluate(
                    "address => new Promise(done => { const s = new WebSocket(address, ['viser-v1.1.1']);"
                    " s.onopen = () => done('open'); s.onclose = s.onerror = () => done('closed'); })", f"ws://{name}:{port}{way}")
                read = stranger.evaluate("address => fetch(address).then(r => r.text()).catch(() => 'nothing')",
                                         f"http://{name}:{port}{way}")
                assert (opened, read) == ("closed", "nothing"), (name, way)
        stranger.close()
        server.shutdown()
    assert page.server.get_clients().keys() == before
