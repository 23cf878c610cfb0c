"""camera_rays: they hit the same surfaces as the rays of a render."""

from __future__ import annotations

import numpy as np
import pytest

import wrt
from tests.refused import Refusal, refused
from tests.wrt.renderer.test_checkpoint import SCENE
from wrt.scene.cameras import CAMERAS, CameraKind
from wrt.scene.shapes import box


def test_camera_rays_hit_what_the_picture_shows() -> None:
    mesh = box()
    camera = wrt.Camera.look_at((1.5, 2.0, 2.5), (0.1, 0.0, 0.0), aperture_radius=0.2)  # a lens; the rays go through its centre
    scene = wrt.Scene(objects=(wrt.Object(mesh, (wrt.Material(),)),), cameras=(camera,))
    film = wrt.render(scene, size=(48, 27), spp=1, aov=("depth", "prim_id"))
    origins, directions = wrt.camera_rays(camera, "48x27")
    assert origins.shape == directions.shape == (48 * 27, 3) and origins.dtype == directions.dtype == np.float32
    hits = wrt.build(mesh).closest_hit(origins, directions)
    np.testing.assert_array_equal(hits.prim_id.reshape(27, 48), film.aov["prim_id"])
    np.testing.assert_array_equal(hits.t.reshape(27, 48), film.aov["depth"])
    assert (hits.prim_id >= 0).sum() > 100


@pytest.mark.parametrize("kind", CAMERAS.values(), ids=list(CAMERAS))
def test_pictures_and_aovs_of_a_sphere_are_those_of_the_rays(kind: type[CameraKind]) -> None:
    center, radius = np.array([0.3, -0.1, 0.2]), 1.6
    camera = kind.look_at((1.5, 2.0, 2.5), (0.1, 0.0, 0.0))
    ball = wrt.Material(albedo=(0.0, 0.0, 0.0), emission=(1.0, 1.0, 1.0))
    scene = wrt.Scene(spheres=(wrt.Sphere(tuple(center), radius, ball),), cameras=(camera,),
                      background=wrt.GradientBackground((0.0, 0.0, 0.0), (0.2, 0.2, 0.2)))
    film = wrt.render(scene, size=(48, 30), spp=4, filter="box", aov=("depth", "prim_id", "material_id"))
    origins, directions = (array.reshape(30, 48, 3).astype(np.float64) for array in wrt.camera_rays(camera, (48, 30)))
    lit = directions.any(axis=2)
    assert lit.all() == (kind.kind != "fisheye")
    along = ((center - origins) * directions).sum(axis=2)
    across = radius**2 - ((center - origins) ** 2).sum(axis=2) + along**2
    sure = np.abs(across) > 1e-4
    hit = lit & (across > 0.0) & (along > 0.0)
    assert hit.sum() > 20 and (film.aov["prim_id"] >= 0)[sure].tolist() == hit[sure].tolist()
    assert np.array_equal(film.aov["prim_id"] >= 0, film.aov["material_id"] >= 0)
    np.testing.assert_allclose(film.aov["depth"][hit & sure], (along - np.sqrt(np.abs(across)))[hit & sure], rtol=1e-5)
    assert np.isinf(film.aov["depth"][~hit & sure]).all()
    # A pixel's value is that of its centre if all neighbours hit the same surface. The sky is linear in the direction's y.
    value = np.where(hit, 1.0, np.where(lit, 0.2 * 0.5 * (1.0 + directions[..., 1]), 0.0))
    padded = np.pad(np.where(lit, value, -1.0), 1, constant_values=-1.0)
    near = np.stack([padded[i : i + 30, j : j + 48] for i in range(3) for j in range(3)])
    flat = np.ptp(near, axis=0) < 0.05
    assert flat.mean() > 0.6
    np.testing.assert_allclose(film.pixels[..., 0][flat], value[flat], atol=0.02)
    assert film.pixels[~lit & flat].max(initial=0.0) == 0.0


def test_the_corners_are_where_the_angle_of_view_ends() -> None:
    camera = wrt.Camera(fov_y=np.pi / 2)
    _, directions = wrt.camera_rays(camera, (2, 2))
    expected = np.array([(-1, 1, -2), (1, 1, -2), (-1, -1, -2), (1, -1, -2)]) / np.sqrt(6.0)
    np.testing.assert_allclose(directions, expected, atol=1e-7)


@pytest.mark.parametrize(("camera", "size", "reported"), [(None, (4, 4), ("camera", "amera")), (SCENE.cameras[0], (0, 4), ("size",))])
def test_mistakes_are_named(camera: wrt.Camera, size: tuple[int, int], reported: Refusal) -> None:
    with refused(*reported):
        wrt.camera_rays(camera, size)
