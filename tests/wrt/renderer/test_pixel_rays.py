"""Rays of a camera as arrays: they see what the picture's own rays see."""

from __future__ import annotations

import numpy as np
import pytest

import wrt
from tests.wrt.renderer.test_checkpoint import SCENE
from wrt.core.errors import InputError
from wrt.scene.shapes import box


def test_they_hit_what_the_picture_shows() -> None:
    mesh = box()
    camera = wrt.Camera.look_at((1.5, 2.0, 2.5), (0.1, 0.0, 0.0), aperture_radius=0.2)  # a lens: its middle
    scene = wrt.Scene(objects=(wrt.Object(mesh, (wrt.Material(),)),), cameras=(camera,))
    film = wrt.render(scene, size=(48, 27), spp=1, aov=("depth", "prim_id"))
    origins, directions = wrt.camera_rays(camera, "48x27")
    assert origins.shape == directions.shape == (48 * 27, 3) and origins.dtype == directions.dtype == np.float32
    hits = wrt.build(mesh).closest_hit(origins, directions)
    same = hits.prim_id.reshape(27, 48) == film.aov["prim_id"]
    assert (~same).sum() <= 2 and (hits.prim_id >= 0).sum() > 100  # but where an edge passes through a pixel's centre
    np.testing.assert_allclose(hits.t.reshape(27, 48)[same], film.aov["depth"][same], rtol=1e-5)


def test_the_corners_are_where_the_angle_of_view_ends() -> None:
    camera = wrt.Camera(fov_y=np.pi / 2)
    _, directions = wrt.camera_rays(camera, (2, 2))
    expected = np.array([(-1, 1, -2), (1, 1, -2), (-1, -1, -2), (1, -1, -2)]) / np.sqrt(6.0)
    np.testing.assert_allclose(directions, expected, atol=1e-7)


@pytest.mark.parametrize(("camera", "size", "told"), [(None, (4, 4), "camera"), (SCENE.cameras[0], (0, 4), "size")])
def test_mistakes_are_named(camera: wrt.Camera, size: tuple[int, int], told: str) -> None:
    with pytest.raises(InputError, match=told):
        wrt.camera_rays(camera, size)
