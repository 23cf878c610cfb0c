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

import wrt
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.wrt.viewer.client import answer, client
from tests.wrt.viewer.test_refine import CAMERA, SCENE
from wrt.lab.costs import CostCounter
from wrt.renderer.options import Options
from wrt.renderer.pixel_rays import film_rays
from wrt.renderer.render import render
from wrt.scene.cameras import Camera, OrthographicCamera
from wrt.viewer.access import Place

WHITTED = ROOT / "scenes" / "whitted.toml"
SIZE = {"width": 800, "height": 480}
PATIENCE = 25.0  # Seconds, since a busy machine draws slowly and may have to compile kernels.


# --- the command ------------------------------------------------------------------------------------------------------


def test_without_websockets_there_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    result = run("view", WHITTED)
    assert result.code == 2 and result.out == "" and result.errors == [result.err.strip()]
    assert 'pip install "wrt[viewer]"' in result.err


@pytest.mark.parametrize(("host", "port", "part"), [
    ("127.0.0.1", None, "(Address already in use);"), ("no.such.host.invalid", 0, "no.such.host.invalid")])
def test_an_address_that_cannot_be_listened_on(host: str, port: int | None, part: str) -> None:
    pytest.importorskip("websockets")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1] if port is None else port
        result = run("view", WHITTED, "--host", host, "--port", port, "--no-open")
    assert result.code == 2 and result.out == "" and len(result.errors) == 1
    assert part in result.err and f"port {port}" in result.err and "--port" in result.err


def test_the_command_serves_until_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page

    seen: list[Page] = []

    def wait(self: Page) -> None:
        seen.append(self)
        port = self.port
        came = answer(port, f"/{self.server.access.token}/", [f"Host: localhost:{port}"])
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
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page

    def wait(self: Page) -> None:
        port = self.port
        answer(port, "/", [f"Host: localhost:{port}"])
        assert {"https://example.org", "http://localhost:9000"} <= self.server.access.origins
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
    pytest.importorskip("websockets")
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

TOP = replace(CAMERA, camera_to_world=Camera.look_at((1, 5, 1), (0, 0, 0)).camera_to_world, name="top")
ROOM = replace(SCENE, name="a box", cameras=(replace(CAMERA, name="main"), TOP))
SPP = 4


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page, Tools

    page = Page(ROOM, Options(threads=1), Place(port=0), spp=SPP, tools=Tools(CostCounter.beside, wrt.walk))
    yield page
    page.close()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api")
    path = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
    if path is None:
        pytest.skip("needs a Chromium")
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(page: Any, browser: Any, **settings: Any) -> Any:
    """Open the page in a new window; `mistakes` collects the errors of its console."""
    view = browser.new_page(**{"viewport": SIZE, **settings})
    view.set_default_timeout(1000.0 * PATIENCE)
    view.mistakes = []
    view.on("console", lambda message: view.mistakes.append(message.text) if message.type == "error" else None)
    view.on("pageerror", lambda error: view.mistakes.append(str(error)))
    view.goto(page.url)
    view.locator("body[data-pictures]").wait_for()
    return view


@pytest.fixture(scope="module")
def window(page: Any, chromium: Any) -> Iterator[Any]:
    view = opened(page, chromium)
    yield view
    view.close()
    assert view.mistakes == []


@pytest.fixture(autouse=True)
def start_again(request: pytest.FixtureRequest) -> None:
    """Start each test of the page at the scene's camera and settings."""
    if "window" in request.fixturenames:
        page, window = request.getfixturevalue("page"), request.getfixturevalue("window")
        window.keyboard.press("Escape")
        for name, value in (("bounces", 3), ("show", "picture"), ("structure", "bvh"), ("exposure", 0.0), ("tone mapping", "none"),
                            ("resolution", "full"), ("camera", "main")):
            page.panel.controls[name].apply(value)
        window.keyboard.press("r")
        until(lambda: np.allclose(page.viewer.view.camera.camera_to_world, CAMERA.camera_to_world, atol=1e-12), window)


def until(condition: Callable[[], Any], window: Any) -> Any:
    """Wait until the condition is true, while the browser handles events; return the condition's value."""
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, "the condition never held"
        window.wait_for_timeout(30)
    return value


def finished(page: Any, window: Any, **view: Any) -> Any:
    """Wait for the finished picture of the view with these fields, and return it."""

    def done() -> Any:
        shown = page.viewer.shown
        return shown if (shown is not None and shown.done and shown.view is page.viewer.view
                         and all(getattr(shown.view, name) == value for name, value in view.items())) else None

    return until(done, window)


def on_screen(window: Any) -> np.ndarray:
    """Return the part of the screen with the picture, (h, w, 3), in device pixels."""
    data = window.locator("#picture").screenshot()
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"))


def appears(window: Any, shown: Any, first: int = 0) -> bool:
    """Wait until the screen has the picture, to the pixel. first: number of rows that are not compared."""
    return bool(until(lambda: np.array_equal(on_screen(window)[first:], shown.codes[first:]), window))


def set_number(window: Any, name: str, value: str) -> None:
    field = window.locator(f"input[type=number][aria-label='{name}']")
    field.fill(value)
    field.press("Enter")


def choose(window: Any, name: str, value: str) -> None:
    window.locator(f"select[aria-label='{name}']").select_option(value)


def drag(window: Any, right: float, down: float, **keys: Any) -> None:
    """Drag from the middle of the picture, in CSS pixels."""
    box = window.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    window.mouse.move(x, y)
    window.mouse.down(**keys)
    window.mouse.move(x + right, y + down, steps=5)
    window.mouse.up(**keys)
    window.wait_for_timeout(200)  # the page sends the last moves with its next frame


def test_the_picture_fills_the_free_part_pixel_by_pixel(page: Any, window: Any) -> None:
    shown = finished(page, window)
    stage, panel = (window.locator(name).bounding_box() for name in ("#stage", "#panel"))
    assert stage["width"] + panel["width"] == SIZE["width"] and window.locator("#frame").bounding_box() == stage
    assert shown.view.size == (stage["width"], stage["height"]) and shown.codes.shape[:2] == shown.view.size[::-1]
    np.testing.assert_allclose(shown.view.camera.camera_to_world, CAMERA.camera_to_world, atol=1e-12)
    film = render(ROOM, size=shown.view.size, spp=SPP, camera=shown.view.camera)
    np.testing.assert_array_equal(film.to_srgb8(), shown.codes)
    assert appears(window, shown) and window.title() == "a box - wrt" and window.inner_text("#title") == "a box"
    until(lambda: "4 of 4 samples per pixel" in window.inner_text("#line") and "done" in window.inner_text("#line"), window)
    window.keyboard.press("p")
    wide = finished(page, window, size=(SIZE["width"], SIZE["height"]))
    assert appears(window, wide, first=50)  # below the button that brings the panel back
    window.get_by_role("button", name="panel").click()
    finished(page, window, size=shown.view.size)


def test_drags_and_keys_steer_and_can_be_undone(page: Any, window: Any) -> None:
    before, distance = finished(page, window), page.steering.pose.distance
    drag(window, 60, 20)
    until(lambda: page.viewer.view.camera is not before.view.camera, window)
    after = finished(page, window)
    pose, old = after.view.camera.camera_to_world, before.view.camera.camera_to_world
    target = CAMERA.camera_to_world[:3] @ (0, 0, -CAMERA.focus_distance, 1)
    assert np.linalg.norm(pose[:3, 3] - old[:3, 3]) > 0.2
    assert np.linalg.norm(pose[:3, 3] - target) == pytest.approx(CAMERA.focus_distance, rel=1e-6)
    assert abs(pose[1, 0]) < 1e-9 and pose[1, 1] > 0.0 and appears(window, after)
    drag(window, 30, 0, button="right")
    until(lambda: not np.allclose(page.steering.pose.target, target), window)
    window.keyboard.press("u")
    until(lambda: np.allclose(page.steering.pose.camera.camera_to_world, pose, atol=1e-9), window)
    window.keyboard.press("w")
    until(lambda: page.steering.pose.distance == pytest.approx(distance) and not np.allclose(page.steering.pose.target, target), window)
    window.mouse.wheel(0, -500)
    until(lambda: page.steering.pose.distance < 0.7 * distance, window)
    window.get_by_role("button", name="reset").click()
    until(lambda: np.array_equal(page.steering.pose.camera.camera_to_world, CAMERA.camera_to_world), window)
    window.keyboard.press("2")
    top = until(lambda: page.panel.camera_name == "top" and finished(page, window), window)
    np.testing.assert_array_equal(top.view.camera.camera_to_world, TOP.camera_to_world)
    assert appears(window, top)
    window.keyboard.press("?")
    assert window.get_by_text("back to the scene's camera").is_visible()
    window.get_by_role("button", name="close").click()


def test_controls_change_the_picture(page: Any, window: Any) -> None:
    bright = finished(page, window)
    set_number(window, "bounces", "0")
    flat = finished(page, window, max_depth=0)
    assert flat.codes.mean() < bright.codes.mean() - 5.0 and appears(window, flat)
    choose(window, "show", "nodes")
    heat = finished(page, window, cost="nodes")
    until(lambda: "nodes per pixel" in window.inner_text("#status") and window.locator("#legend").is_visible(), window)
    assert heat.mean > 1.0 and appears(window, heat)
    choose(window, "show", "picture")
    choose(window, "structure", "bvh8")
    finished(page, window, cost="", accel="bvh8")
    set_number(window, "angle of view", "60")
    until(lambda: abs(page.viewer.view.camera.fov_y - np.radians(60.0)) < 1e-6, window)
    wide = finished(page, window)
    film = render(ROOM, size=wide.view.size, spp=SPP, camera=wide.view.camera, max_depth=0)
    np.testing.assert_array_equal(film.to_srgb8(), wide.codes)
    choose(window, "tone mapping", "reinhard")
    window.keyboard.press("]")
    expected = replace(film, tonemap="reinhard", exposure=0.5).to_srgb8()
    until(lambda: np.array_equal(page.viewer.shown.codes, expected), window)
    choose(window, "resolution", "1/2")
    half = finished(page, window, size=tuple(round(side / 2) for side in wide.view.size))
    until(lambda: f"{half.view.size[0]} x {half.view.size[1]} pixels" in window.inner_text("#status"), window)


def place_of(camera: Any, size: tuple[int, int], point: np.ndarray) -> tuple[float, float]:
    """Return the pixel coordinates of a point, by the definition of a perspective camera."""
    x, y, z = camera.camera_to_world[:3, :3].T @ (point - camera.camera_to_world[:3, 3])
    tangent = max(np.tan(0.5 * camera.fov_y), np.tan(0.5 * camera.least_fov_x) * size[1] / size[0])
    scale = 0.5 * size[1] / tangent
    return 0.5 * size[0] - scale * x / z, 0.5 * size[1] + scale * y / z


def test_a_click_shows_the_surface_and_the_rays_of_the_pixel(page: Any, window: Any) -> None:
    shown = finished(page, window)
    corner = SCENE.objects[0].mesh.vertices.max(axis=0)  # the box's corner nearest to the camera
    x, y = (int(value) for value in place_of(shown.view.camera, shown.view.size, corner - 0.05))
    window.locator("#stage").click(position={"x": x, "y": y})
    window.locator("#tree li").first.wait_for()
    assert "object 0 (material 0), primitive" in window.inner_text("#picked")
    inspected = page.rays.shown
    assert inspected.pixel == (x, y) and len(window.locator("#tree li").all()) == len(inspected.nodes) >= 2
    samples = [page.rays.inspect(shown.view, (x + 0.5) / shown.view.size[0], (y + 0.5) / shown.view.size[1], i, SPP).sample
               for i in range(SPP)]
    mean = np.zeros(3, np.float32)
    for n, sample in enumerate(samples, 1):  # the film's running mean
        mean = mean + (sample.radiance - mean) / np.float32(n)
    np.testing.assert_array_equal(mean, page.viewer.picture().pixels[y, x])
    drag(window, 40, 10)  # the rays stay at their places in the scene
    until(lambda: page.viewer.view.camera is not shown.view.camera, window)
    turned = finished(page, window)
    expected = place_of(turned.view.camera, turned.view.size, inspected.sample.root.end.astype(float))
    circle = window.locator("#overlay circle[data-node='0']")
    until(lambda: np.allclose([float(circle.get_attribute(name)) for name in ("cx", "cy")], expected, atol=0.1), window)
    window.locator("#tree span").first.hover()
    assert window.locator("#overlay .picked").count() >= 1
    before = page.viewer.view.camera.focus_distance
    window.get_by_role("button", name="focus here").click()
    until(lambda: page.viewer.view.camera.focus_distance != before, window)
    hit = inspected.sample.root.end.astype(float)
    along = (hit - shown.view.camera.camera_to_world[:3, 3]) @ -shown.view.camera.camera_to_world[:3, 2]
    assert page.viewer.view.camera.focus_distance == pytest.approx(along, rel=0.02)  # another ray through the same pixel
    window.keyboard.press("Escape")
    until(lambda: window.locator("#overlay line").count() == 0 and page.rays.shown is None, window)
    window.locator("#stage").click(position={"x": 2, "y": 2})
    until(lambda: "no surface: the background" in window.inner_text("#picked"), window)


def test_a_walk_steps_the_clicked_ray_through_the_structure(page: Any, window: Any) -> None:
    view = finished(page, window).view
    corner = SCENE.objects[0].mesh.vertices.max(axis=0)
    x, y = (int(value) for value in place_of(view.camera, view.size, corner - 0.05))
    window.locator("#stage").click(position={"x": x, "y": y})
    window.locator("#tree li").first.wait_for()
    origins, directions = film_rays(view.camera, view.size, np.array([[x / view.size[0], y / view.size[1]]]))
    steps = wrt.walk(page.viewer.renderers.prepared(view).accel, origins[0], directions[0]).steps

    def shows(step: int) -> bool:
        return bool(until(lambda: window.inner_text("#steptext") == steps[step].text and window.input_value("#step") == str(step), window))

    window.get_by_role("button", name="walk").click()
    assert shows(0) and window.inner_text("#last") == f"of {len(steps) - 1}"
    until(lambda: window.evaluate("document.getElementById('drawing').naturalWidth") > 300, window)
    window.keyboard.press(".")
    assert shows(1)
    window.fill("#step", str(len(steps) + 5))
    window.press("#step", "Enter")
    assert shows(len(steps) - 1)
    window.get_by_role("button", name="<", exact=True).click()
    assert shows(len(steps) - 2)
    window.keyboard.press("Escape")
    until(lambda: not window.locator("#walking").is_visible(), window)


def test_a_phone_leaves_the_picture_free_and_shows_the_whole_width(page: Any, window: Any, chromium: Any) -> None:
    wide = finished(page, window)
    phone = opened(page, chromium, viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True)
    phone.get_by_role("button", name="reset").click()  # the phone steers now
    shown = until(lambda: page.viewer.view.size[0] == 780 and finished(page, phone), phone)
    phone.touchscreen.tap(195, 300)
    until(lambda: phone.locator("#found").is_visible() and page.rays.shown is not None, phone)
    phone.keyboard.press("Escape")
    stage = phone.locator("#stage").bounding_box()
    assert stage["height"] > 0.85 * 844 and not phone.locator("#controls").is_visible()
    assert shown.view.size == (780, round(2 * stage["height"])) and appears(phone, shown)  # full resolution is full
    phone.get_by_role("button", name="panel").click()
    small = until(lambda: page.viewer.view.size[1] < shown.view.size[1] and finished(page, phone), phone)
    box, stage = phone.locator("#frame").bounding_box(), phone.locator("#stage").bounding_box()
    assert phone.locator("#controls").is_visible() and box == pytest.approx(stage, abs=1.0) and stage["height"] > 0.4 * 844
    for view in (shown.view, small.view):  # a point at the edge of the scene's picture is inside
        right = CAMERA.camera_to_world[:3] @ (np.tan(0.5 * CAMERA.fov_y) * 61 / 34, 0.0, -1.0, 1.0)
        assert place_of(view.camera, view.size, right)[0] <= view.size[0] + 0.01
    assert phone.mistakes == []
    phone.close()
    until(lambda: page.viewer.view.size == wide.view.size, window)


def test_browsers_share_the_view(page: Any, window: Any, chromium: Any) -> None:
    shown = finished(page, window)
    other = opened(page, chromium)
    until(lambda: window.inner_text("#title") == "a box (2 browsers)", window)
    assert appears(other, shown)
    drag(other, 30, 0)
    until(lambda: page.viewer.view.camera is not shown.view.camera, other)
    turned = finished(page, other)
    assert appears(other, turned) and appears(window, turned)
    other.reload()
    assert appears(other, turned)
    other.close()
    until(lambda: window.inner_text("#title") == "a box", window)
    set_number(window, "bounces", "1")
    assert appears(window, finished(page, window, max_depth=1)) and page.thread.is_alive() and page.failure is None


def test_a_change_of_exposure_sends_no_whole_png(page: Any, window: Any) -> None:
    finished(page, window)

    def is_png(message: dict[str, Any]) -> bool:
        return message["type"] == "picture" and message["mime"] == "image/png"

    with client(page.url) as other:
        other.open(*page.viewer.view.size)
        before = other.until(is_png)["data"]
        while other.listen(1.5) is not None:  # until the picture rests
            pass
        other.set("exposure", 1.0)
        changing, rests = other.next("picture"), other.until(is_png)
        assert changing["mime"] == "image/jpeg" and rests["data"] != before and len(changing["data"]) < len(rests["data"])


def test_a_camera_of_another_kind_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page

    flat = OrthographicCamera(CAMERA.camera_to_world, height=3.0, name="flat")
    page = Page(replace(ROOM, cameras=(CAMERA, flat)), Options(threads=1), Place(port=0), spp=1)
    try:
        with client(page.url) as somebody:
            somebody.open()
            assert somebody.controls()["focus"]["shown"]
            somebody.set("camera", "flat")
            until_done = somebody.until(lambda message: message["type"] == "picture" and message["left"] == "done"
                                        and page.viewer.shown.view.camera.kind == "orthographic")
            assert until_done["size"] == [64, 48] and not somebody.controls()["focus"]["shown"]
            np.testing.assert_array_equal(page.viewer.shown.codes, render(ROOM, camera=flat, size=(64, 48), spp=1).to_srgb8())
    finally:
        page.close()


def test_saved_files(page: Any, window: Any, tmp_path: Path) -> None:
    finished(page, window)
    until(lambda: "done" in window.inner_text("#line"), window)
    for name, suffix in (("picture as PNG", ".png"), ("picture as EXR", ".exr"), ("camera as TOML", ".toml")):
        with window.expect_download() as download:
            window.get_by_role("link", name=name).click()
        path = tmp_path / f"saved{suffix}"
        assert download.value.suggested_filename == ("camera.toml" if suffix == ".toml" else f"a box{suffix}")
        download.value.save_as(path)
        if suffix == ".png":
            with Image.open(path) as image:
                np.testing.assert_array_equal(np.asarray(image), page.viewer.shown.codes)
        elif suffix == ".exr":
            from wrt.picture.image import read_image

            np.testing.assert_allclose(read_image(path), page.viewer.picture().pixels, rtol=1e-3, atol=1e-6)
        else:
            table = tomllib.loads(path.read_text())["cameras"]["view"]
            assert path.read_text() == window.locator("#camera").text_content()
            np.testing.assert_allclose(table["position"], CAMERA.camera_to_world[:3, 3], atol=1e-4)
    window.context.grant_permissions(["clipboard-read", "clipboard-write"])
    window.get_by_role("button", name="copy TOML").click()
    window.get_by_role("button", name="copied").wait_for()


def test_the_private_file_forwards_to_the_page(page: Any, window: Any, chromium: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from wrt.cli import view as cli_view

    shown = finished(page, window)
    other = chromium.new_page(viewport=SIZE)
    monkeypatch.setattr("webbrowser.open", lambda address: other.goto(address))
    with cli_view.in_browser(page.url):
        until(lambda: len(page.server.browsers) == 2, other)
    assert appears(other, shown) and other.url.startswith(f"{page.url.partition('?')[0]}{page.server.access.token}/")
    other.close()
    until(lambda: len(page.server.browsers) == 1, window)


def test_a_page_of_another_origin_has_no_access(page: Any, window: Any, chromium: Any) -> None:
    """In a real browser, even with the token: a page from another port or another host name has no access."""
    port, token, before = page.port, page.server.access.token, page.server.browsers

    class Stranger(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>stranger</title>")

        def log_message(self, *rest: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stranger) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stranger = chromium.new_page()
        stranger.goto(f"http://127.0.0.1:{server.server_port}/")
        for way in (f"/{token}/", f"/?token={token}", "/"):
            for name in ("127.0.0.1", "localhost"):
                opened = stranger.evaluate(
                    "address => new Promise(done => { const s = new WebSocket(address);"
                    " s.onopen = () => done('open'); s.onclose = s.onerror = () => done('closed'); })", f"ws://{name}:{port}{way}")
                read = stranger.evaluate("address => fetch(address).then(r => r.text()).catch(() => 'nothing')",
                                         f"http://{name}:{port}{way}")
                assert (opened, read) == ("closed", "nothing"), (name, way)
        stranger.close()
        server.shutdown()
    assert page.server.browsers == before
