"""The viewer in a real browser, and the command that starts it."""

from __future__ import annotations

import io
import math
import os
import shutil
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
from tests.wrt.viewer.client import Client, answer, client, wait
from tests.wrt.viewer.test_refine import CAMERA, SCENE
from wrt.renderer.options import Options
from wrt.renderer.render import render
from wrt.renderer.upload import film_rays
from wrt.scene.cameras import Camera, OrthographicCamera
from wrt.viewer.access import Place
from wrt.viewer.rays import project

WHITTED = ROOT / "scenes" / "whitted.toml"
SIZE = {"width": 800, "height": 480}
PATIENCE = 25.0  # Seconds, since a busy machine draws slowly and may have to compile kernels.


# --- the command ------------------------------------------------------------------------------------------------------


def test_an_address_that_cannot_be_listened_on() -> None:
    pytest.importorskip("websockets")
    result = run("view", WHITTED, "--host", "no.such.host.invalid", "--port", 0, "--no-open")
    assert result.code == 2 and result.out == "" and len(result.errors) == 1 and "no.such.host.invalid" in result.err


def test_the_command_serves_until_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page

    seen: list[Page] = []

    def wait(self: Page) -> None:
        seen.append(self)
        host = [f"Host: localhost:{self.port}"]
        assert answer(self.port, f"/{self.server.access.token}/", host).startswith(b"HTTP/1.1 200")
        assert answer(self.port, "/", host).startswith(b"HTTP/1.1 403")
        assert "https://example.org" in self.server.access.origins
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "wait", wait)
    options = "--port", 0, "--no-open", "--allow-origin", "https://Example.org"
    result = run("view", WHITTED, *options)
    assert result.code == 0 and result.out == f"{seen[0].url}\n" and seen[0].url.startswith("http://127.0.0.1:")
    assert result.err.splitlines()[0] == "Ctrl-C ends the viewer" and "without the token" in result.err.splitlines()[1]
    assert run("view", WHITTED, *options, "-q").err == ""
    assert "no camera 'nobody'" in run("view", WHITTED, "--camera", "nobody", "--port", 0).err
    assert "'example.org' is no origin" in run("view", WHITTED, "--port", 0, "--allow-origin", "example.org").err


def test_the_browsers_command_line_does_not_hold_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    """All users of the machine can read the command line."""
    from wrt.cli import view as cli_view

    opened: list[Path] = []

    def open_browser(address: str) -> None:
        path = Path(url2pathname(urlsplit(address).path))
        opened.append(path)
        assert "secret" not in address and "http://127.0.0.1:1/secret/" in path.read_text(encoding="utf-8")
        assert os.name != "posix" or path.parent.stat().st_mode & 0o777 == 0o700

    monkeypatch.setattr("webbrowser.open", open_browser)
    with cli_view.in_browser("http://127.0.0.1:1/secret/"):
        assert opened[0].exists()
    assert len(opened) == 1 and not opened[0].parent.exists()


# --- the page, by messages --------------------------------------------------------------------------------------------

TOP = replace(CAMERA, camera_to_world=Camera.look_at((1, 5, 1), (0, 0, 0)).camera_to_world, name="top")
FLAT = OrthographicCamera(CAMERA.camera_to_world, height=3.0, name="flat")
ROOM = replace(SCENE, name="a box", cameras=(replace(CAMERA, name="main"), TOP, FLAT))
SPP = 4


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    pytest.importorskip("websockets")
    from wrt.viewer.page import Page

    warnings: list[str] = []
    page: Any = Page(ROOM, Options(threads=1), Place(port=0), spp=SPP, walk_of=wrt.walk, warn=warnings.append)
    page.warnings = warnings
    yield page
    page.close()
    page.thread.join()
    assert page.failure is None


def done(somebody: Client, **fields: Any) -> dict[str, Any]:
    """Wait for a finished picture with these fields of the message."""
    return somebody.until(lambda message: message["type"] == "picture" and message["left"] == "done"
                          and all(message[name] == value for name, value in fields.items()))


def codes_of(message: dict[str, Any]) -> np.ndarray:
    with Image.open(io.BytesIO(message["data"])) as image:
        return np.asarray(image)


def test_a_control_takes_its_values_and_no_others(page: Any) -> None:
    wrong = (None, True, {}, "", math.nan, 1e308, "1")
    with client(page.url) as somebody:
        somebody.open()
        done(somebody)
        controls = somebody.controls()
        assert list(controls) == ["camera", "angle of view", "bounces", "structure", "exposure", "tone mapping"]
        for name in controls:
            for value in wrong:
                somebody.set(name, value)
        somebody.set("bounces", 0.5)
        somebody.set("fees", 1)
        for name, value in (("bounces", 1), ("bounces", 2.0), ("exposure", -1), ("tone mapping", "reinhard"), ("structure", "bvh8"),
                            ("angle of view", 50), ("camera", "top")):
            somebody.set(name, value)
            wait(lambda name=name, value=value: page.controls[name].get() == value, somebody)
        for name, control in controls.items():
            somebody.set(name, control["value"])
        wait(lambda: {name: control.get() for name, control in page.controls.items()} == {
            name: control["value"] for name, control in controls.items()}, somebody)
    for name in controls:
        assert len([line for line in page.warnings if line.startswith(f"viewer: dropped {name}: ")]) == 1


def test_pictures_are_those_of_render(page: Any) -> None:
    with client(page.url) as somebody:
        somebody.open(64, 48)
        somebody.set("camera", "flat")
        flat = codes_of(somebody.until(lambda message: message["type"] == "picture" and message["left"] == "done"
                                       and page.viewer.shown.view.camera.kind == "orthographic"))
        np.testing.assert_array_equal(flat, render(ROOM, camera=FLAT, size=(64, 48), spp=SPP).to_srgb8())
        assert not somebody.controls()["angle of view"]["shown"]
        somebody.set("camera", "main")
        somebody.set("bounces", 0)
        wait(lambda: page.viewer.shown.done and page.viewer.shown.view.max_depth == 0, somebody)
        film = render(ROOM, camera=page.viewer.view.camera, size=(64, 48), spp=SPP, max_depth=0)
        np.testing.assert_array_equal(page.viewer.shown.codes, film.to_srgb8())
        somebody.set("exposure", 1.0)
        somebody.set("tone mapping", "reinhard")
        expected = replace(film, exposure=1.0, tonemap="reinhard").to_srgb8()
        wait(lambda: np.array_equal(page.viewer.shown.codes, expected), somebody)
        for name, value in (("bounces", 3), ("exposure", 0.0), ("tone mapping", "none")):
            somebody.set(name, value)
        wait(lambda: page.viewer.shown.done and page.viewer.shown.view.max_depth == 3, somebody)


def place_of(camera: Any, size: tuple[int, int], point: np.ndarray) -> tuple[float, float]:
    """Return the pixel coordinates of a point, by the definition of a perspective camera."""
    x, y, z = camera.camera_to_world[:3, :3].T @ (point - camera.camera_to_world[:3, 3])
    tangent = max(np.tan(0.5 * camera.fov_y), np.tan(0.5 * camera.least_fov_x) * size[1] / size[0])
    scale = 0.5 * size[1] / tangent
    return 0.5 * size[0] - scale * x / z, 0.5 * size[1] + scale * y / z


def test_a_click_tells_the_surface_the_rays_and_the_walk(page: Any) -> None:
    with client(page.url) as somebody:
        somebody.open(64, 48)
        done(somebody, size=[64, 48])
        view = page.viewer.view
        corner = SCENE.objects[0].mesh.vertices.max(axis=0) - 0.05  # near the box's corner nearest to the camera
        x, y = (int(value) for value in place_of(view.camera, view.size, corner))
        mean = np.zeros(3, np.float32)
        for i in range(SPP):
            somebody.send("click", x=(x + 0.5) / 64, y=(y + 0.5) / 48, sample=i)
            surface, rays = somebody.next("picked")["surface"], somebody.next("rays")
            assert (surface["object"], surface["material"]) == ("object 0", "material 0")
            assert rays["pixel"] == [x, y] and rays["sample"] == i and rays["nodes"][0]["parent"] == -1
            mean = mean + (page.rays.shown.sample.radiance - mean) / np.float32(i + 1)  # the film's running mean
        np.testing.assert_array_equal(mean, page.viewer.film.pixels[y, x])
        somebody.move(0.1)  # the rays stay at their places in the scene
        wait(lambda: page.viewer.view.camera is not view.camera)
        traced = page.rays.shown.sample
        expected = np.divide(place_of(page.viewer.view.camera, (64, 48), traced.root.end.astype(float)), (64, 48))
        somebody.until(lambda message: message["type"] == "picture" and message["overlay"] and np.allclose(
            message["overlay"][-len(traced.rays)]["ends"][2:], expected, atol=1e-3))
        origins, directions = film_rays(view.camera, view.size, np.array([[(x + 0.5) / 64, (y + 0.5) / 48]]))
        steps = wrt.walk(page.viewer.renderers.prepared(view).accel, origins[0], directions[0]).steps
        for asked, step in ((0, 0), (1, 1), (999, len(steps) - 1)):
            somebody.send("walk", step=asked)
            found = somebody.next("step")
            assert (found["step"], found["last"], found["text"]) == (step, len(steps) - 1, steps[step].text)
            assert codes_of(found).shape[1] > 300
        somebody.send("click", x=0.01, y=0.01, sample=0)
        assert somebody.next("picked")["surface"] is None
        somebody.next("rays")
        somebody.send("clear")
        somebody.send("reset")
        wait(lambda: page.rays.shown is None, somebody)


def test_a_line_is_cut_at_the_camera(page: Any) -> None:
    camera = Camera(fov_y=np.pi / 2)  # at the origin, along -z
    ends = np.array([[(0.0, 0.0, -1.0), (0.5, 0.5, -1.0)], [(0.0, 0.0, 1.0), (1.0, 0.0, -1.0)], [(0.0, 0.0, 1.0), (0.0, 0.0, 2.0)]])
    flat = project(camera, (100, 100), ends)
    np.testing.assert_allclose(flat[0], [(0.5, 0.5), (0.75, 0.25)])
    np.testing.assert_allclose(flat[1, 1], (1.0, 0.5))
    assert flat[1, 0, 0] > 100.0 and flat[1, 0, 1] == 0.5 and np.isnan(flat[2]).all()


# --- the page, in a browser -------------------------------------------------------------------------------------------


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


def appears(window: Any, shown: Any, first: int = 0) -> bool:
    """Wait until the screen has the picture, to the pixel. first: number of rows that are not compared."""

    def on_screen() -> np.ndarray:
        with Image.open(io.BytesIO(window.locator("#picture").screenshot())) as image:
            return np.asarray(image.convert("RGB"))

    return bool(until(lambda: np.array_equal(on_screen()[first:], shown.codes[first:]), window))


def drag(window: Any, right: float, down: float, **keys: Any) -> None:
    """Drag from the middle of the picture, in CSS pixels."""
    box = window.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    window.mouse.move(x, y)
    window.mouse.down(**keys)
    window.mouse.move(x + right, y + down, steps=5)
    window.mouse.up(**keys)
    window.wait_for_timeout(200)  # the page sends the last moves with its next frame


def test_the_picture_fills_the_free_part_pixel_by_pixel(page: Any, window: Any, tmp_path: Path) -> None:
    window.keyboard.press("1")
    shown = finished(page, window)
    stage, panel = (window.locator(name).bounding_box() for name in ("#stage", "#panel"))
    assert stage["width"] + panel["width"] == SIZE["width"] and window.locator("#frame").bounding_box() == stage
    assert shown.view.size == (stage["width"], stage["height"]) and shown.codes.shape[:2] == shown.view.size[::-1]
    assert appears(window, shown) and window.title() == "a box - wrt" and window.inner_text("#title") == "a box"
    until(lambda: "4 of 4 samples per pixel" in window.inner_text("#line") and "done" in window.inner_text("#line"), window)
    with window.expect_download() as download:
        window.get_by_role("button", name="save").click()
    download.value.save_as(tmp_path / "saved.png")
    assert download.value.suggested_filename == "a box.png"
    with Image.open(tmp_path / "saved.png") as image:
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), shown.codes)
    window.keyboard.press("p")
    wide = finished(page, window, size=(SIZE["width"], SIZE["height"]))
    assert appears(window, wide, first=50)  # below the button that brings the panel back
    window.get_by_role("button", name="panel").click()
    finished(page, window, size=shown.view.size)


def test_drags_keys_and_controls(page: Any, window: Any) -> None:
    before, distance = finished(page, window), page.steering.pose.distance
    drag(window, 60, 20)
    until(lambda: page.viewer.view.camera is not before.view.camera, window)
    after = finished(page, window)
    pose, target = after.view.camera.camera_to_world, page.steering.pose.target
    assert np.linalg.norm(pose[:3, 3] - before.view.camera.camera_to_world[:3, 3]) > 0.2 and appears(window, after)
    table = tomllib.loads(window.locator("#camera").text_content())["cameras"]["view"]
    np.testing.assert_allclose(table["position"], pose[:3, 3], atol=1e-4)
    drag(window, 30, 0, button="right")
    until(lambda: not np.allclose(page.steering.pose.target, target), window)
    window.keyboard.press("w")
    until(lambda: page.steering.pose.distance == pytest.approx(distance), window)
    window.mouse.wheel(0, -500)
    until(lambda: page.steering.pose.distance < 0.7 * distance, window)
    window.get_by_role("button", name="reset").click()
    until(lambda: np.array_equal(page.steering.pose.camera.camera_to_world, CAMERA.camera_to_world), window)
    window.keyboard.press("2")
    top = until(lambda: page.steering.name == "top" and finished(page, window), window)
    np.testing.assert_array_equal(top.view.camera.camera_to_world, TOP.camera_to_world)
    assert appears(window, top)
    window.keyboard.press("1")
    window.keyboard.press("?")
    assert window.get_by_text("back to the scene's camera").is_visible()
    window.get_by_role("button", name="close").click()
    field = window.locator("input[type=number][aria-label='angle of view']")
    field.fill("60")
    field.press("Enter")
    until(lambda: abs(page.viewer.view.camera.fov_y - np.radians(60.0)) < 1e-6, window)
    assert appears(window, finished(page, window))
    window.keyboard.press("r")


def test_a_click_shows_the_tree_and_the_rays(page: Any, window: Any) -> None:
    shown = finished(page, window)
    corner = SCENE.objects[0].mesh.vertices.max(axis=0) - 0.05
    x, y = (int(value) for value in place_of(shown.view.camera, shown.view.size, corner))
    window.locator("#stage").click(position={"x": x, "y": y})
    window.locator("#tree li").first.wait_for()
    assert "object 0 (material 0), primitive" in window.inner_text("#picked")
    inspected = page.rays.shown
    assert inspected.pixel == (x, y) and len(window.locator("#tree li").all()) == len(inspected.nodes) >= 2
    expected = place_of(shown.view.camera, shown.view.size, inspected.sample.root.end.astype(float))
    circle = window.locator("#overlay circle[data-node='0']")
    until(lambda: np.allclose([float(circle.get_attribute(name)) for name in ("cx", "cy")], expected, atol=0.1), window)
    window.locator("#tree span").first.hover()
    assert window.locator("#overlay .picked").count() >= 1
    window.get_by_role("button", name="walk").click()
    until(lambda: window.evaluate("document.getElementById('drawing').naturalWidth") > 300, window)
    window.keyboard.press(".")
    until(lambda: window.input_value("#step") == "1", window)
    window.keyboard.press("Escape")
    until(lambda: window.locator("#overlay line").count() == 0 and not window.locator("#walking").is_visible(), window)


def test_a_phone_shares_the_view_and_shows_the_whole_width(page: Any, window: Any, chromium: Any) -> None:
    finished(page, window)
    phone = opened(page, chromium, viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True)
    shown = until(lambda: page.viewer.view.size[0] == 780 and finished(page, phone), phone)  # the window that was opened last
    until(lambda: window.inner_text("#title") == "a box (2 browsers)", window)
    phone.touchscreen.tap(195, 300)
    until(lambda: phone.locator("#found").is_visible() and page.rays.shown is not None, phone)
    phone.keyboard.press("Escape")
    stage = phone.locator("#stage").bounding_box()
    assert stage["height"] > 0.85 * 844 and not phone.locator("#controls").is_visible()
    assert shown.view.size == (780, round(2 * stage["height"])) and appears(phone, shown)  # full resolution is full
    phone.get_by_role("button", name="panel").click()
    small = until(lambda: page.viewer.view.size[1] < shown.view.size[1] and finished(page, phone), phone)
    assert phone.locator("#controls").is_visible() and phone.locator("#stage").bounding_box()["height"] > 0.4 * 844
    for view in (shown.view, small.view):  # a point at the edge of the scene's picture is inside
        right = CAMERA.camera_to_world[:3] @ (np.tan(0.5 * CAMERA.fov_y) * 61 / 34, 0.0, -1.0, 1.0)
        assert place_of(view.camera, view.size, right)[0] <= view.size[0] + 0.01
    assert phone.mistakes == []
    phone.close()
    until(lambda: window.inner_text("#title") == "a box", window)
