"""Limits of lights, in Python and in scene files."""

import math

import numpy as np
import pytest

from tests.refused import refused
from wrt.scene.cameras import Camera
from wrt.scene.lights import SpotLight
from wrt.scene.materials import Material

HALF = float(np.float32(math.pi / 2))  # larger than pi / 2


def spot(**angles: float) -> SpotLight:
    return SpotLight((0, 0, 0), (0, 0, 1), (1, 1, 1), **angles)


def test_a_value_that_rounding_takes_past_its_limit_is_the_limit():
    assert spot(outer=HALF).outer == math.pi / 2
    assert spot(inner=float(np.float32(0.3)), outer=0.3).inner == 0.3 < float(np.float32(0.3))
    assert spot(inner=0.25, outer=0.5).inner == 0.25
    assert Material(albedo=(1.0000001192, 0.5, 1.0), roughness=1.0000001192).albedo == (1.0, 0.5, 1.0)
    assert Camera(fov_y=math.radians(179.94) * 1.0000001).fov_y == pytest.approx(math.radians(179.94), rel=1e-15)


@pytest.mark.parametrize("angles, name", [
    ({"outer": 1.571}, "outer"), ({"inner": 0.301, "outer": 0.3}, "inner"), ({"inner": -1e-9}, "inner")])
def test_a_value_further_out_is_refused(angles, name):
    with refused(name):
        spot(**angles)
