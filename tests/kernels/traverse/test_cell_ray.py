"""Margins of walks through cells that list only the triangles that touch them: no far or grazing ray is lost."""

import numpy as np
import pytest

from tests.kernel_tools import rounded, unit  # isort: skip (starts Warp)

from tests.cell_cases import assert_same, grazing, soup
from wrt.accel.scenes.build import build

FINE = {"grid": {"density": 100.0}, "octree": {"max_leaf": 1, "by_cost": False, "max_growth": 100.0}}


@pytest.mark.parametrize("name", FINE)
@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6, 1e8])
def test_far_origins(distance, name):
    # From a distance of 1e6 on, rounding is as wide as a cell. The walk then visits more cells, up to all cells.
    rng = np.random.default_rng(2)
    geometry = soup(rng, size=0.3)
    cells, brute = build(geometry, name), build(geometry, "brute_force")
    away = distance * unit(rng.normal(size=(3000, 3)))
    away[::5] *= [1.0, 0.0, 0.0]
    origin = rounded(rng.uniform(-1.0, 1.0, (3000, 3)) + away)
    direction = rounded(rng.uniform(-1.0, 1.0, (3000, 3)) - origin)
    direction[~direction.any(axis=1), 0] = 1.0
    expected = brute.closest_hit(origin, direction)
    assert_same(cells.closest_hit(origin, direction), expected)
    assert (expected.prim_id >= 0).sum() > 300


@pytest.mark.parametrize("name", FINE)
def test_grazing_rays_find_the_same(name):
    geometry, origin, direction = grazing(np.random.default_rng(3), 50_000)
    cells, brute = build(geometry, name, **FINE[name]), build(geometry, "brute_force")
    expected = brute.closest_hit(origin, direction)
    assert (expected.prim_id >= 0).sum() > 5000
    assert_same(cells.closest_hit(origin, direction), expected)
    hit = expected.prim_id >= 0
    at = expected.t[hit]
    assert_same(cells.closest_hit(origin[hit], direction[hit], at, at), brute.closest_hit(origin[hit], direction[hit], at, at))
