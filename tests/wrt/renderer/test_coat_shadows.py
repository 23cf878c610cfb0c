"""Shadow rays through clear coats lose the light that the coat reflects at the angle of the ray."""

import numpy as np
import pytest

import wrt
from tests.fresnel import fresnel
from wrt.scene.shapes import box, quad

SIZE = 40.0


def floor_under(pane: wrt.Object, degrees: float) -> float:
    """Return the mean radiance of a white floor that a directional light reaches only through the pane."""
    floor = wrt.Object(quad((-SIZE, 0.0, SIZE), (2 * SIZE, 0.0, 0.0), (0.0, 0.0, -2 * SIZE)), wrt.Material(albedo=(1.0, 1.0, 1.0)))
    way = np.array([np.sin(np.radians(degrees)), -np.cos(np.radians(degrees)), 0.0])
    scene = wrt.Scene((floor, pane), lights=(wrt.DirectionalLight(tuple(way), (1.0, 1.0, 1.0)),),
                      cameras=(wrt.Camera.look_at((0.0, 0.5, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), fov_y=0.5),),
                      settings=wrt.Settings(size=(4, 4), spp=4, glass_shadows="tinted"))
    film = wrt.render(scene)
    assert film.pixels.std() < 1e-5
    return float(film.pixels.mean())


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("degrees", [5.0, 40.0, 75.0])
def test_a_coat_takes_its_share_at_the_angle_of_the_ray(solid: bool, degrees: float) -> None:
    """Where light leaves solid glass it meets no coat, so that a slab takes as much as a pane."""
    clear = {"kind": "metallic_roughness", "transmission": 1.0, "albedo": (1.0, 1.0, 1.0), "thin": not solid}
    mesh = (box((-SIZE, 1.0, -SIZE), (SIZE, 2.0, SIZE)) if solid else
            quad((-SIZE, 1.0, SIZE), (2 * SIZE, 0.0, 0.0), (0.0, 0.0, -2 * SIZE)))
    bare, coated = (floor_under(wrt.Object(mesh, wrt.Material(clearcoat=coat, **clear)), degrees)  # type: ignore[arg-type]
                    for coat in (0.0, 0.8))
    assert bare > 0.01 and coated / bare == pytest.approx(1.0 - 0.8 * float(fresnel(np.cos(np.radians(degrees)), 1.5)), rel=1e-4)
