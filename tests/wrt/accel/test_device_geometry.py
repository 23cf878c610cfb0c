"""Meshes in Warp arrays: builds, refits and errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.refused import Refusal, refused

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)
import warp as wp

import wrt
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.scenes.build import build, load_accel
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

BALL = icosphere(2)
FIELDS = "t", "u", "v", "prim_id"
RAYS = np.random.default_rng(1).normal(size=(2, 1000, 3)).astype(np.float32)


def there(array: np.ndarray, kind: Any) -> Any:
    return wp.array(array, dtype=kind, device=DEVICE)


def moved(step: float) -> np.ndarray:
    x, y, z = BALL.vertices.T
    return np.stack([x + step * y * y, y, z * (1.0 + step)], axis=1).astype(np.float32)


def assert_follows(accel: Accelerator, vertices: np.ndarray) -> None:
    truth = build(Geometry(vertices, BALL.faces, np.zeros((0, 4), np.float32)), "brute_force").closest_hit(*RAYS)
    hits = accel.closest_hit(*RAYS)
    assert 0.2 < (truth.prim_id >= 0).mean() < 1.0
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(hits, name), getattr(truth, name))
    np.testing.assert_array_equal(accel.geometry.vertices, vertices)


@pytest.mark.parametrize("name", ["bvh2", "bvh8", "bvh2_sphere", "grid"])
def test_any_structure_is_built_over_it_and_follows_if_it_can(name: str) -> None:
    geometry = wrt.DeviceGeometry(there(BALL.vertices, wp.vec3), there(BALL.faces, wp.vec3i))
    assert len(geometry) == geometry.n_triangles == len(BALL.faces)
    accel = build(geometry, name)
    assert_follows(accel, BALL.vertices)
    if name != "grid":
        accel.refit(there(moved(0.4), wp.vec3))
        assert_follows(accel, moved(0.4))


@pytest.mark.parametrize("options", [{"builder": "lbvh"}, {"builder": "sbvh"}, {"triangle": "moeller_trumbore"}])
def test_points_are_followed_and_may_be_written_to(options: dict[str, str]) -> None:
    accel = build(BALL, "bvh2", **options)
    points = there(moved(0.4), wp.vec3)
    done = accel.refit(points)
    points.zero_()
    assert done.growth > 1.0 and not done.rebuilt
    if "triangle" not in options:
        assert_follows(accel, moved(0.4))
    other = build(BALL, "bvh2", **options)
    assert other.refit(moved(0.4)).growth == done.growth
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(accel.closest_hit(*RAYS), name), getattr(other.closest_hit(*RAYS), name))
    assert accel.refit(there(moved(-0.7), wp.vec3), rebuild_at=1.0).rebuilt
    assert accel.stats.sah_cost == pytest.approx(build(accel.geometry, "bvh2", **options).stats.sah_cost)


@pytest.mark.parametrize(("name", "options"), [("bvh2", {"builder": "lbvh"}), ("bvh2", {}), ("bvh8", {})])
def test_in_place(name: str, options: dict[str, str]) -> None:
    accel = build(BALL, name, **options)
    points = there(moved(0.2), wp.vec3)
    done = accel.refit(points, in_place=True)
    assert np.isnan(done.growth) and np.isnan(accel.stats.sah_cost) and "SAH" not in repr(accel)
    assert_follows(accel, moved(0.2))
    data = accel.data
    points.assign(moved(0.5))
    assert_follows(accel, moved(0.2))  # no change before a refit
    accel.refit(points, in_place=True)
    assert accel.data is data
    assert_follows(accel, moved(0.5))
    assert accel.refit(moved(0.3)).growth > 0.5 and accel.data is not data  # back to a refit that is not in place
    assert_follows(accel, moved(0.3))
    accel.refit(points, in_place=True)
    assert_follows(accel, moved(0.5))


def test_what_was_made_on_a_device_is_saved(tmp_path: Any) -> None:
    accel = build(BALL, "bvh2", builder="lbvh")
    accel.refit(there(moved(0.4), wp.vec3))
    accel.save(tmp_path / "ball.accel")
    assert_follows(load_accel(tmp_path / "ball.accel", Mesh(moved(0.4), BALL.faces)), moved(0.4))


def test_points_may_be_written_to_before_it_is_saved(tmp_path: Any) -> None:
    geometry = wrt.DeviceGeometry(there(BALL.vertices, wp.vec3), there(BALL.faces, wp.vec3i))
    accel = build(geometry, "bvh2")
    geometry.points.assign(moved(0.5))
    accel.save(tmp_path / "ball.accel")
    assert_follows(load_accel(tmp_path / "ball.accel", BALL), BALL.vertices)


@pytest.mark.parametrize("name", ["bvh2", "bvh8"])
def test_what_a_refit_in_place_left_can_be_saved_and_grows(name: str, tmp_path: Any) -> None:
    accel = build(BALL, name)
    accel.refit(there(moved(0.2), wp.vec3), in_place=True)
    accel.save(tmp_path / "ball.accel")
    again = load_accel(tmp_path / "ball.accel", Mesh(moved(0.2), BALL.faces))
    assert again.refit(np.random.default_rng(0).permutation(moved(0.2)), rebuild_at=1.2).rebuilt


@pytest.mark.parametrize("name", ["grid", "octree", "kdtree", "bvh2", "bvh8"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_triangles_with_a_point_that_is_not_finite_are_hit_by_no_ray(name: str, value: float) -> None:
    points = BALL.vertices.copy()
    points[7] = value
    found = build(wrt.DeviceGeometry(there(points, wp.vec3), there(BALL.faces, wp.vec3i)), name).closest_hit(*RAYS)
    there_are = np.flatnonzero((BALL.faces != 7).all(axis=1))
    truth = build(Mesh(BALL.vertices, BALL.faces[there_are]), "brute_force").closest_hit(*RAYS)
    np.testing.assert_array_equal(found.t, truth.t)
    np.testing.assert_array_equal(found.prim_id, np.where(truth.prim_id < 0, -1, there_are[truth.prim_id]))


@pytest.mark.parametrize(("points", "indices", "message"), [
    (BALL.vertices, BALL.faces, ("points", "Warp array")),
    (there(BALL.vertices, wp.vec3), BALL.faces, ("indices", "Warp array")),
    (there(BALL.vertices, wp.vec3), there(np.arange(4), wp.int32), ("indices", "Warp array")),
    (there(BALL.vertices[:9], wp.vec3), there(BALL.faces, wp.vec3i), ("indices", "triangles have other")),
    (there(BALL.vertices, wp.vec3), there([-1, 0, 1], wp.int32), ("indices", "1 triangles have other")),
])
def test_what_is_refused(points: Any, indices: Any, message: Refusal) -> None:
    with refused(*message):
        wrt.DeviceGeometry(points, indices)


def test_refits_that_are_refused() -> None:
    accel = build(BALL, "bvh2")
    for given, message in ((there(BALL.vertices[1:], wp.vec3), ("vertices", "(162,)")),
                           (there(BALL.faces, wp.vec3i), ("vertices", "Warp array")), (BALL.vertices, ("vertices", "Warp array"))):
        with refused(*message):
            accel.refit(given, in_place=True)
    if wp.get_device(DEVICE).is_cpu:
        for in_place in (False, True):
            with refused("vertices", "finite"):
                accel.refit(there(np.full_like(BALL.vertices, np.nan), wp.vec3), in_place=in_place)
    for name, options, argument in (("bvh6", {}, None), ("bvh2_kdop", {}, None), ("bvh2", {"triangle": "plane"}, "vertices")):
        with refused(argument, "in place"):
            build(BALL, name, **options).refit(there(BALL.vertices, wp.vec3), in_place=True)
    assert_follows(accel, BALL.vertices)
