"""wrt.viewer.refine without a browser: order of pictures, abandoned views, and work that is not repeated."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import wrt
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE as PINHOLE
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.render import Renderer
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera, FisheyeCamera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad
from wrt.viewer import refine as module
from wrt.viewer.refine import Shown, Viewer

# A box on a mirror, seen through an open lens, because the viewer always compiles a lens. All tests here share one kernel.
CAMERA = Camera.look_at((2, 2, 4), (0, 0, 0), aperture_radius=0.05, focus_distance=4.0)
SCENE = Scene(
    objects=(Object(box(), (Material(albedo=(0.7, 0.6, 0.5)),)),
             Object(quad((-4, -1, -4), (0, 0, 8), (8, 0, 0)), (Material("mirror", albedo=(0.5, 0.7, 0.9)),))),
    lights=(DirectionalLight((-1, -2, -1.5), (1.5, 1.4, 1.3)),), cameras=(CAMERA,), background=GradientBackground(),
    settings=Settings(size=(61, 34), max_depth=3),
)


class Eye:
    """Records a viewer's pictures and reports; `react` is called with each picture."""

    def __init__(self, scene: Scene = SCENE, spp: int = 4, **options: Any) -> None:
        self.pictures: list[Shown] = []
        self.words: list[str] = []
        self.react: Callable[[Shown], Any] = lambda shown: None
        self.viewer = Viewer(scene, Options(**options), self._show, self.words.append, spp)

    def _show(self, shown: Shown) -> None:
        self.pictures.append(shown)
        self.react(shown)

    def see(self, **changes: Any) -> Shown:
        """Change the view, and return the last picture."""
        self.viewer.change(**changes)
        self.viewer.step()
        return self.pictures[-1]


def turned(degrees: float) -> Camera:
    angle = np.radians(degrees)
    return Camera.look_at((2 * np.cos(angle), 2, 4 + np.sin(angle)), (0, 0, 0), aperture_radius=0.05, focus_distance=4.0)


def test_pictures_get_finer_and_end_with_that_of_render() -> None:
    eye = Eye()
    last = eye.see(size=(61, 34))
    scales = [shown.scale for shown in eye.pictures]
    assert scales[0] == 8 and scales == sorted(scales, reverse=True) and set(scales) == {8, 4, 2, 1}
    assert eye.pictures[0].codes.shape == (5, 8, 3) and not any(shown.done for shown in eye.pictures[:-1])
    film = eye.viewer.film
    assert isinstance(film, Film) and last.done and last.spp == 4
    expected = wrt.render(SCENE, spp=4)
    np.testing.assert_array_equal(film.pixels, expected.pixels)
    np.testing.assert_array_equal(last.codes, expected.to_srgb8())
    assert last.rays_per_sample == pytest.approx(expected.stats["rays_per_sample"]) and last.speed > 0.0


def test_a_coarse_picture_covers_the_same_view() -> None:
    """61 and 34 are no multiples of 8, but the picture of 8x5 pixels has the same angles of view."""
    eye = Eye(spp=64)
    eye.see(size=(61, 34))
    prepared = eye.viewer.renderers.prepared(eye.viewer.view)
    assert prepared.camera.tan_x == pytest.approx(np.tan(0.5 * CAMERA.fov_y) * 61 / 34)


def test_a_change_ends_the_refinement_and_the_next_view_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "EVERY", 0.0)
    eye = Eye(spp=1 << 20)

    def react(shown: Shown) -> None:
        if shown.scale == 1 and shown.view.max_depth == 3:
            eye.viewer.spp = 2
            assert eye.viewer.change(max_depth=0)

    eye.react = react
    first = eye.see(size=(61, 34))
    assert first.scale == 1 and not first.done and first.view.max_depth == 3
    eye.viewer.step()
    assert eye.pictures[-1].done and [shown.view.max_depth for shown in eye.pictures] == sorted(
        (shown.view.max_depth for shown in eye.pictures), reverse=True)
    assert sum(shown.scale == 1 and shown.view.max_depth == 3 for shown in eye.pictures) == 1


def test_a_camera_that_never_rests_is_followed() -> None:
    eye = Eye()
    eye.react = lambda shown: eye.viewer.change(camera=turned(len(eye.pictures)))
    for _ in range(6):
        eye.see(size=(61, 34))
    assert len(eye.pictures) == 6  # one for each view: a new request ends a view after its first picture
    assert len({shown.view for shown in eye.pictures}) == 6


def test_nothing_is_rendered_twice() -> None:
    eye = Eye()
    eye.see(size=(61, 34))
    pictures = len(eye.pictures)
    same = Camera.look_at((2, 2, 4), (0, 0, 0), aperture_radius=0.05, focus_distance=4.0)
    assert not eye.viewer.change(camera=same, size=(61, 34))
    eye.viewer.step()
    assert len(eye.pictures) == pictures
    eye.viewer.pause()  # no browser is connected; then the same view is requested
    eye.viewer.step()
    assert len(eye.pictures) == pictures and eye.viewer.change(camera=same)


def test_another_tone_keeps_the_film() -> None:
    eye = Eye()
    eye.see(size=(61, 34))
    film = eye.viewer.film
    eye.viewer.tone(exposure=-1.5, tonemap="aces")
    eye.viewer.step()
    assert isinstance(film, Film) and eye.viewer.film is film and eye.pictures[-1].done
    np.testing.assert_array_equal(eye.pictures[-1].codes, replace(film, exposure=-1.5, tonemap="aces").to_srgb8())


def test_auto_exposure_is_that_of_render() -> None:
    eye = Eye(SCENE.with_settings(exposure=0.5, auto_exposure=True))
    shown = eye.see(size=(61, 34))
    expected = wrt.render(SCENE, spp=4, exposure=0.5, auto_exposure=True)
    np.testing.assert_array_equal(shown.codes, expected.to_srgb8())
    eye.viewer.tone(auto_exposure=False)
    eye.viewer.step()
    np.testing.assert_array_equal(eye.pictures[-1].codes, replace(expected, exposure=0.5).to_srgb8())


def test_an_unknown_structure_is_refused() -> None:
    with refused("accel", "no structure 'bhv'"):
        Eye().viewer.change(accel="bhv")


def test_a_thread_follows_until_it_is_stopped() -> None:
    eye = Eye(spp=1 << 20)
    fine = threading.Event()
    eye.react = lambda shown: fine.set() if shown.spp > 1 else None
    thread = threading.Thread(target=eye.viewer.run, daemon=True)
    thread.start()
    eye.viewer.change(size=(61, 34))
    assert fine.wait(240.0)
    eye.viewer.pause()
    pictures = -1
    for _ in range(60):  # after a pause, no more pictures arrive
        if pictures == (pictures := len(eye.pictures)):
            break
        time.sleep(3 * module.EVERY)
    else:
        pytest.fail("pictures still arrive")
    fine.clear()
    eye.viewer.change(max_depth=1)
    assert fine.wait(240.0)
    eye.viewer.stop()
    thread.join(120.0)
    assert not thread.is_alive()


def test_a_renderer_takes_another_camera_that_its_kernels_support() -> None:
    renderer = Renderer(PINHOLE, Options())
    other = Camera.look_at((-3, 1, 4), (0, 0, 0))
    renderer.aim(other, size=(20, 31), spp=2, max_depth=1)
    expected = wrt.render(PINHOLE, camera=other, size=(20, 31), spp=2, max_depth=1)
    np.testing.assert_array_equal(renderer.run().pixels, expected.pixels)
    for camera, settings, message in ((replace(other, aperture_radius=0.1), {}, "a camera's lens"),
                                      (FisheyeCamera(), {}, "a camera of the kind fisheye"),
                                      (other, {"max_depth": 9}, "so many bounces"), (other, {"filter": "box"}, "other settings")):
        with pytest.raises(InputError, match=f"not made for {message}"):
            renderer.aim(camera, **settings)
