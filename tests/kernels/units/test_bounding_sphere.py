"""The test of a ray against a bounding sphere: it enters every sphere that the exact line meets, and rejects clear misses."""

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, floats, launch, rounded, unit, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.structs import Ray, kernel
from wrt.kernels.units.bounding_sphere import ray_bounding_sphere, sphere_ray


@kernel
def sphere_kernel(origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), t_min: wp.array(dtype=wp.float32),
                  t_max: wp.array(dtype=wp.float32), spheres: wp.array(dtype=wp.vec4), entry: wp.array(dtype=wp.float32)):
    i = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    ray.t_min = t_min[i]
    entry[i] = ray_bounding_sphere(sphere_ray(ray), spheres[i], t_max[i])


def entries(origin, direction, center, radius, t_min=0.0, t_max=np.inf):
    origin = np.atleast_2d(origin)
    n = len(origin)
    spheres = np.concatenate([np.broadcast_to(center, (n, 3)), np.broadcast_to(radius, n)[:, None]], axis=1)
    out = zeros(n)
    launch(sphere_kernel, n, vec3s(origin), vec3s(np.broadcast_to(direction, (n, 3))), floats(np.broadcast_to(t_min, n)),
           floats(np.broadcast_to(t_max, n)), wp.array(spheres.astype(np.float32), dtype=wp.vec4, device=DEVICE), out)
    return out.numpy()


def test_by_hand():
    # Rays towards the unit sphere from 5 away, from inside, away from it, and past it; then segments that end before it or begin behind.
    origin = [[-5, 0, 0], [0.5, 0, 0], [5, 0, 0], [-5, 2, 0], [-5, 0, 0], [-5, 0, 0], [-5, 0, 0]]
    found = entries(origin, [2.0, 0.0, 0.0], np.zeros(3), 1.0, [0, 0.1, 0, 0, 0, 3.5, 2.5], [np.inf] * 4 + [1.9, np.inf, np.inf])
    np.testing.assert_allclose(found, [2.0, 0.1, np.inf, np.inf, np.inf, np.inf, 2.5], rtol=1e-4)


def test_an_empty_sphere_is_never_entered_and_an_endless_one_always():
    assert entries(np.zeros((1, 3)), [1.0, 0.0, 0.0], np.zeros(3), -1.0)[0] == np.inf
    assert entries(np.full((1, 3), 1e30), [1.0, 0.0, 0.0], np.zeros(3), np.inf, 0.5)[0] == 0.5
    assert entries(np.full((1, 3), 1e30), [1.0, 0.0, 0.0], np.zeros(3), np.inf, 0.5, -np.inf)[0] == np.inf


def cases(seed, n=20_000):
    """Rays aimed at points on and in spheres of radius 1e-25 to 1e25, from near and far; many rays run along the surface."""
    rng = np.random.default_rng(seed)
    radius = rounded(10.0 ** rng.uniform(-25, 25, n))
    center = rounded(radius[:, None] * directions(rng, n) * 10.0 ** rng.uniform(-2, 3, (n, 1)))
    normal = directions(rng, n)
    inside = np.where(rng.random((n, 1)) < 0.5, 1.0 - 1e-9, rng.random((n, 1)))
    point = center + inside * radius[:, None] * normal
    along = unit(np.where(rng.random((n, 1)) < 0.5, np.cross(normal, directions(rng, n)), directions(rng, n)))
    origin = rounded(point - along * radius[:, None] * 10.0 ** rng.uniform(-2, 4, (n, 1)))
    return origin, rounded((point - origin) * 2.0 ** rng.integers(-3, 4, (n, 1))), center, radius


def exact(origin, direction, center, radius):
    """Distance of the line from the center in radii, and t where it enters and leaves, in extended precision."""
    o, d, c, r = (np.asarray(a, np.longdouble) for a in (origin, direction, center, radius))
    f = o - c
    dd = (d * d).sum(axis=1)
    middle = -(f * d).sum(axis=1) / dd
    near = np.sqrt(((f + middle[:, None] * d) ** 2).sum(axis=1))
    half = np.sqrt(np.maximum(r * r - near * near, 0.0) / dd)
    return near / r, middle - half, middle + half


@pytest.mark.parametrize("seed", [1, 2])
def test_every_line_that_meets_it_enters_in_time(seed):
    origin, direction, center, radius = cases(seed)
    with np.errstate(under="ignore"):
        near, enter, leave = exact(origin, direction, center, radius)
    meets = (near <= 1.0) & (leave >= 0.0)
    assert 0.3 < meets.mean()
    found = entries(origin, direction, center, radius)
    assert (found[meets] <= np.maximum(enter[meets], 0.0)).all()
    # A segment that ends at the exact entry, rounded up, enters too.
    end = np.nextafter(np.maximum(enter, 0.0).astype(np.float32), np.float32(np.inf))
    assert np.isfinite(entries(origin, direction, center, radius, 0.0, end)[meets]).all()


def test_clear_misses_are_rejected():
    origin, direction, center, radius = cases(3)
    near, enter, _ = exact(origin, direction, center, radius)
    size = np.linalg.norm(origin - center, axis=1) / radius  # The test's margin is 64 u of distance and radius, as sums of coordinates.
    found = entries(origin, direction, center, 0.98 * radius)
    large = (radius > 1e-12) & (radius < 1e14)  # The test takes smaller radii as 2^-60, and enters every larger sphere.
    outside = large & (near > 0.98 + 2.0**-17 * (size + 1.0)) & (size < 1e3)
    assert outside.sum() > 1000 and (found[outside] == np.inf).all()
    inside = large & (near < 0.9) & (size < 1e3) & (enter > 0.0)
    length = np.linalg.norm(direction, axis=1) / radius
    assert inside.sum() > 1000
    found = entries(origin, direction, center, radius)
    assert ((enter - found)[inside] * length[inside] < 2.0**-16 * (size[inside] + 1.0)).all()
