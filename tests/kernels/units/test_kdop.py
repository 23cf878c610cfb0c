"""The 14-DOP test: it enters for every hit of the triangle test, also for grazing rays, and rejects the box's cut corners."""

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, floats, launch, rounded, unit, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.bvh.volumes import cuts
from wrt.accel.bvh.volumes import project as host_project
from wrt.accel.geometry import Geometry
from wrt.kernels.structs import Ray, kernel
from wrt.kernels.units.box import box_ray, ray_aabb
from wrt.kernels.units.kdop import kdop_ray, project, ray_kdop
from wrt.kernels.units.triangle import ray_triangle, triangle_ray

INF = np.float32(np.inf)


@wp.struct
class Around:
    """A triangle and a 14-DOP for each ray."""

    corners: wp.array(dtype=wp.vec3)
    lo: wp.array(dtype=wp.vec3)
    hi: wp.array(dtype=wp.vec3)
    cut_lo: wp.array(dtype=wp.vec4)
    cut_hi: wp.array(dtype=wp.vec4)
    middle: wp.vec3


@kernel
def kdop_kernel(origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), t_max: wp.array(dtype=wp.float32),
                around: Around, t_hit: wp.array(dtype=wp.float32), entry: wp.array(dtype=wp.float32),
                box_entry: wp.array(dtype=wp.float32)):
    """Store t of the triangle's hit, and t at the entry into the 14-DOP and its box for a segment that ends at min(t_max, t_hit)."""
    i = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    box = box_ray(ray)
    hit = ray_triangle(box, triangle_ray(ray), around.corners[3 * i], around.corners[3 * i + 1], around.corners[3 * i + 2])
    t_hit[i] = wp.where(hit.prim_id == 0, hit.t, float(wp.inf))
    end = wp.min(t_max[i], t_hit[i])
    entry[i] = ray_kdop(kdop_ray(ray, box, around.middle), around.lo[i], around.hi[i], around.cut_lo[i], around.cut_hi[i], end)
    box_entry[i] = ray_aabb(box, around.lo[i], around.hi[i], end)


@kernel
def project_kernel(v: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec4)):
    out[wp.tid()] = project(v[wp.tid()])


def run(origin, direction, corners, middle, t_max=INF):
    n = len(origin)
    geometry = Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * n, dtype=np.int32).reshape(-1, 3),
                        np.zeros((0, 4), np.float32))
    around = Around()
    lo, hi = geometry.bounds()
    cut_lo, cut_hi = cuts(geometry, np.asarray(middle, np.float32))
    around.corners, around.lo, around.hi = vec3s(geometry.vertices), vec3s(lo), vec3s(hi)
    around.cut_lo, around.cut_hi = (wp.array(c, dtype=wp.vec4, device=DEVICE) for c in (cut_lo, cut_hi))
    around.middle = wp.vec3(*np.asarray(middle, float).tolist())
    out = [zeros(n) for _ in range(3)]
    launch(kdop_kernel, n, vec3s(origin), vec3s(direction), floats(np.broadcast_to(t_max, n)), around, *out)
    return [array.numpy() for array in out]


def test_host_and_device_project_alike():
    v = rounded(np.random.default_rng(1).normal(size=(1000, 3)) * 10.0 ** np.random.default_rng(2).uniform(-9, 9, (1000, 1)))
    out = wp.zeros(1000, dtype=wp.vec4, device=DEVICE)
    launch(project_kernel, 1000, vec3s(v), out)
    np.testing.assert_array_equal(out.numpy(), host_project(v.astype(np.float32)))


@pytest.mark.parametrize("kind", ["any", "edge", "grazing", "sliver", "far", "axis", "corner"])
def test_every_hit_of_the_triangle_is_let_through(kind):
    # The rays are aimed at points on the triangles. The 14-DOPs' common centre `middle` is near the triangles or far from them.
    rng = np.random.default_rng(3)
    n = 40_000
    scale = 10.0 ** rng.uniform(-6, 6, (n, 1))
    shape = np.array([1.0, 1.0, 1e-4]) if kind == "sliver" else np.ones(3)
    place = 10.0 * rng.random((n, 1, 1)) * rng.normal(size=(n, 1, 3))
    corners = rounded(scale[:, None] * (shape * rng.normal(size=(n, 3, 3)) + place))
    if kind == "axis":
        corners[:, :, 1] = corners[:, :1, 1]  # In planes perpendicular to an axis.
    weight = rng.dirichlet([0.5, 0.5, 0.5], n)
    if kind == "edge":
        weight[:, 2] = 0.0
        weight /= weight.sum(axis=1, keepdims=True)
    point = (weight[:, :, None] * corners).sum(axis=1)
    direction = directions(rng, n)
    if kind in ("grazing", "axis"):
        direction = unit(rng.normal(size=(n, 1)) * (corners[:, 1] - corners[:, 0]) + rng.normal(size=(n, 1)) * (
            corners[:, 2] - corners[:, 0]))
        direction += 10.0 ** rng.uniform(-9, -4, (n, 1)) * rng.normal(size=(n, 3))
    away = 10.0 ** (rng.uniform(2, 6, (n, 1)) if kind == "far" else rng.uniform(-1, 2, (n, 1)))
    origin = rounded(point - away * scale * direction)
    if kind == "corner":  # From the middle, where the ray's own pad is 0: only the pad of the 14-DOP covers the rounding.
        point, origin = corners[:, 0], np.zeros((n, 3))
    for middle in ([0.0, 0.0, 0.0], [1e3, -2e3, 500.0]):
        t_hit, entry, box_entry = run(origin, rounded(point - origin), corners, middle)
        hit = (t_hit >= 0.0) & (t_hit < np.inf)
        assert hit.sum() > (100 if kind in ("grazing", "axis") else 5000)
        assert (entry[hit] <= t_hit[hit]).all()
        np.testing.assert_array_equal(entry[hit], box_entry[hit])


def test_the_corners_of_the_box_are_cut_off():
    # A triangle perpendicular to the unit cube's diagonal: rays through the cube's other corners meet its box but not its 14-DOP.
    corners = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([[0.9, 0.9, 9.0], [0.1, 0.1, 9.0], [0.9, 0.9, 9.0]])
    direction = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [1e-9, -0.0, -1.0]])
    _, entry, box_entry = run(origin, direction, np.broadcast_to(corners, (3, 3, 3)), [0.3, 0.3, 0.3])
    assert (box_entry < np.inf).all()
    assert entry[0] == entry[2] == np.inf and entry[1] == box_entry[1]


def test_more_than_half_of_the_rays_that_meet_a_slanted_triangles_box_are_rejected():
    rng = np.random.default_rng(5)
    corners = np.broadcast_to([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 1.0]], (20_000, 3, 3))
    origin = 3.0 * directions(rng, 20_000)
    direction = rounded(rng.random((20_000, 3)) - origin)
    t_hit, entry, box_entry = run(origin, direction, corners, [0.3, 0.3, 0.3])
    assert (np.isfinite(entry) <= np.isfinite(box_entry)).all() and (np.isfinite(t_hit) <= np.isfinite(entry)).all()
    assert np.isfinite(entry).sum() < 0.6 * np.isfinite(box_entry).sum()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_ray_that_is_not_finite_ends(value):
    corners = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    _, entry, _ = run([[value, 0.0, 0.0]], [[0.0, 1.0, 0.0]], corners, [0.0, 0.0, 0.0], -INF)
    assert entry[0] == np.inf
