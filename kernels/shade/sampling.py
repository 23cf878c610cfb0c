"""Samples: points of a low-discrepancy sequence in [0, 1)^2, and maps from the unit square to disks, triangles and directions.

Random numbers depend on seed, pixel, path, sample and dimension only, so that pictures do not depend on tiles, threads or passes.
Each pair of dimensions is the two-dimensional Sobol sequence, shuffled and Owen-scrambled by hashing (Burley 2020, "Practical
Hash-based Owen Scrambling", JCGT 9(4)). The hash of the nested scramble has the constants of Vegdahl 2021 ("Building a Better LK
Hash"). Independent random numbers serve for comparison."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import near_sin_cos, sin_cos
from wrt.kernels.shade.features import Features
from wrt.kernels.structs import unit

# The multipliers of the hash, the multipliers of the scramble, and the seeds of a point's two coordinates.
HASH_1, HASH_2 = 0x21F0AAAD, 0xD35A2D97
LK_1, LK_2, LK_3 = 0x3D20ADEA, 0x05526C56, 0x53A22864
SEED_X, SEED_Y = 0xA511E9B3, 0x63D83595
# Masks of every second bit, 2-bit, 4-bit and 8-bit group, and the step between 24-bit numbers in [0, 1).
BITS_1, BITS_2, BITS_4, BITS_8 = 0x55555555, 0x33333333, 0x0F0F0F0F, 0x00FF00FF
UNIT = wp.constant(2.0**-24)
LANES = 16  # Entries that vectorised code computes at a time.
TWO_PI = wp.constant(6.283185307179586)
PI = wp.constant(3.141592653589793)


@wp.func
def hash_u32(x: wp.uint32) -> wp.uint32:
    """Permute the 32-bit integers pseudo-randomly, by two rounds of xor-shift and multiplication (Wellons 2018)."""
    x = x ^ (x >> wp.uint32(16))
    x = x * wp.static(wp.uint32(HASH_1))
    x = x ^ (x >> wp.uint32(15))
    x = x * wp.static(wp.uint32(HASH_2))
    return x ^ (x >> wp.uint32(15))


@wp.func
def hash_pair(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Hash two integers to one. Their order matters."""
    return hash_u32(a + wp.static(wp.uint32(0x9E3779B9)) * hash_u32(b + wp.static(wp.uint32(0x85EBCA6B))))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __brev(x);
#else
    return __builtin_bitreverse32(x);
#endif
""")
def reverse_bits(x: wp.uint32) -> wp.uint32: ...


@wp.func
def laine_karras(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Permute the integers so that each bit depends only on itself and lower bits: a nested scramble of the reversed bits."""
    x = x ^ (x * wp.static(wp.uint32(LK_1)))
    x = x + seed
    x = x * ((seed >> wp.uint32(16)) | wp.uint32(1))
    x = x ^ (x * wp.static(wp.uint32(LK_2)))
    return x ^ (x * wp.static(wp.uint32(LK_3)))


@wp.func
def sobol_second(index: wp.uint32) -> wp.uint32:
    """Return the bits of the second Sobol dimension, lowest bit first: the Pascal matrix modulo 2 times the bits of `index`.

    Entry (i, j) is odd exactly if the set bits of j are also set in i (Lucas), so that five xor-shifts compute the product."""
    x = index
    x = x ^ ((x >> wp.uint32(1)) & wp.static(wp.uint32(BITS_1)))
    x = x ^ ((x >> wp.uint32(2)) & wp.static(wp.uint32(BITS_2)))
    x = x ^ ((x >> wp.uint32(4)) & wp.static(wp.uint32(BITS_4)))
    x = x ^ ((x >> wp.uint32(8)) & wp.static(wp.uint32(BITS_8)))
    return x ^ (x >> wp.uint32(16))


@wp.func
def unit_float(x: wp.uint32) -> float:
    """Map the upper 24 bits of x to a float in [0, 1)."""
    return float(x >> wp.uint32(8)) * UNIT


@wp.func
def sample_2d(key: wp.uint32, index: wp.uint32, dimension: int) -> wp.vec2:
    """Return point `index`, in [0, 1)^2, of the sequence for key and dimension. Each aligned block of 2^k points is a (0, k, 2)-net."""
    seed = hash_pair(key, wp.uint32(dimension))
    i = reverse_bits(laine_karras(reverse_bits(index), seed))
    x = reverse_bits(laine_karras(i, hash_u32(seed ^ wp.static(wp.uint32(SEED_X)))))
    y = reverse_bits(laine_karras(sobol_second(i), hash_u32(seed ^ wp.static(wp.uint32(SEED_Y)))))
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func
def independent_2d(key: wp.uint32, index: wp.uint32, dimension: int) -> wp.vec2:
    """Return an independent random point in place of sample_2d: plain Monte Carlo, for comparison."""
    seed = hash_pair(key, wp.uint32(dimension))
    x = hash_pair(seed, index)
    y = hash_pair(seed ^ wp.static(wp.uint32(SEED_Y)), index)
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func_native("wrt::sample_2d(seed, first, count, (float*)(out.data + (long long)at));")
def sample_points(seed: wp.uint32, first: int, count: int, out: wp.array(dtype=wp.vec2), at: int) -> None:
    """Store the points first, first + 1 ... of sample_2d's sequence in out[at], out[at + 1] ... For kernels with lanes_kernel.

    `seed` is hash_pair(key, dimension). `out` must have room for LANES - 1 more points, which are overwritten."""


@wp.func_native("wrt::quantile(icdf.data, icdf.shape[0], (float*)(points.data + (long long)first), 2 * count);")
def quantiles(icdf: wp.array(dtype=wp.float32), points: wp.array(dtype=wp.vec2), first: int, count: int) -> None:
    """Replace both coordinates of the points first .. first + count - 1 by `quantile`. For kernels with lanes_kernel."""


@wp.func
def quantile(icdf: wp.array(dtype=wp.float32), x: float) -> float:
    """Map the sample x in [0, 1) to a value of a distribution. icdf: its inverse cdf, which is interpolated linearly."""
    position = x * float(icdf.shape[0] - 1)
    i = wp.min(int(position), icdf.shape[0] - 2)
    return wp.lerp(icdf[i], icdf[i + 1], position - float(i))


def make_draw(features: Features) -> Any:
    """Return draw(key, dimension, first, count, out, at), which draws many samples of one pixel on the CPU."""
    sample = make_sample_2d(features)

    @wp.func
    def draw(key: wp.uint32, dimension: int, first: int, count: int, out: wp.array(dtype=wp.vec2), at: int):
        """Store sample_2d(key, first + i, dimension) in out[at + i] for i < count. `out` needs room for LANES - 1 more points."""
        if wp.static(features.independent):
            for i in range(count):
                out[at + i] = sample(key, wp.uint32(first + i), dimension)
        else:
            sample_points(hash_pair(key, wp.uint32(dimension)), first, count, out, at)

    return draw


def make_sample_2d(features: Features) -> Any:
    """Return independent_2d or sample_2d, as the scene's settings choose."""
    return independent_2d if features.independent else sample_2d


@wp.func
def point_at(angle: float) -> wp.vec2:
    """Return the point of the unit circle at an angle in radians."""
    sin, cos = sin_cos(angle)
    return wp.vec2(cos, sin)


@wp.func
def disk(xi: wp.vec2) -> wp.vec2:
    """Map [0, 1)^2 uniformly to the unit disk, so that concentric squares become circles (Shirley and Chiu 1997)."""
    a = 2.0 * xi[0] - 1.0
    b = 2.0 * xi[1] - 1.0
    wide = wp.abs(a) > wp.abs(b)
    radius = wp.where(wide, a, b)
    away = radius != 0.0
    share = PI / 4.0 * (wp.where(wide, b, a) / wp.where(away, radius, 1.0))
    sin, cos = near_sin_cos(wp.where(wide, share, PI / 2.0 - share))
    return wp.vec2(wp.where(away, radius * cos, 0.0), wp.where(away, radius * sin, 0.0))


@wp.func
def polygon(xi: wp.vec2, sides: int, rotation: float) -> wp.vec2:
    """Map [0, 1)^2 uniformly to a regular polygon in the unit circle, rotated by `rotation` radians.

    The first coordinate chooses a sector. Its remainder and the second coordinate choose a point of the sector's triangle."""
    scaled = xi[0] * float(sides)
    sector = wp.min(int(scaled), sides - 1)
    r = wp.sqrt(scaled - float(sector))
    step = TWO_PI / float(sides)
    a = rotation + step * float(sector)
    return (r * (1.0 - xi[1])) * point_at(a) + (r * xi[1]) * point_at(a + step)


@wp.func
def triangle_numbers(x: float, y: float) -> tuple[float, float]:
    """Return the result of `triangle` as two floats. Branch-free, because a random branch is mispredicted half the time."""
    half = 0.5 * wp.where(y > x, x, y)
    return wp.where(y > x, half, x - half), wp.where(y > x, y - half, half)


@wp.func
def triangle(xi: wp.vec2) -> wp.vec2:
    """Map [0, 1)^2 to barycentrics (of v1, v2), uniformly over a triangle, without folding or square root (Heitz 2019)."""
    u, v = triangle_numbers(xi[0], xi[1])
    return wp.vec2(u, v)


@wp.func
def where_vec3(condition: bool, a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Choose a or b component by component: wp.where of vectors does not vectorise (kernels.rows)."""
    return wp.vec3(wp.where(condition, a[0], b[0]), wp.where(condition, a[1], b[1]), wp.where(condition, a[2], b[2]))


@wp.func
def frame_x(n: wp.vec3) -> wp.vec3:
    """Return a unit vector perpendicular to the unit vector n (Duff et al. 2017, "Building an Orthonormal Basis, Revisited")."""
    sign = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def cosine_point(xi: wp.vec2) -> wp.vec3:
    """Map [0, 1)^2 to unit directions around the z axis with density cos / pi per steradian (Malley's method)."""
    d = disk(xi)
    return wp.vec3(d[0], d[1], wp.sqrt(wp.max(0.0, 1.0 - d[0] * d[0] - d[1] * d[1])))


@wp.func
def rotated_to(point: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Rotate `point` by a rotation that takes the z axis to the unit vector n."""
    x = frame_x(n)
    return unit(point[0] * x + point[1] * wp.cross(n, x) + point[2] * n)


@wp.func
def cosine_hemisphere(xi: wp.vec2, n: wp.vec3) -> wp.vec3:
    """Map [0, 1)^2 to unit directions around n with density cos / pi per steradian."""
    return rotated_to(cosine_point(xi), n)


@wp.func
def cap_point(xi: wp.vec2) -> wp.vec3:
    """Map [0, 1)^2 to a spherical cap. (x, y) is a point on the unit circle; z is the depth below the pole over the cap's height."""
    sin, cos = near_sin_cos(TWO_PI * xi[0])
    return wp.vec3(cos, sin, xi[1])


@wp.func
def ggx_normal(cap: wp.vec3, n: wp.vec3, wo: wp.vec3, alpha: float) -> wp.vec3:
    """Return a GGX microfacet normal, drawn from the normals visible from wo (Dupuy and Benyoub 2023). cap: result of cap_point."""
    x = frame_x(n)
    y = wp.cross(n, x)
    w = wp.normalize(wp.vec3(alpha * wp.dot(wo, x), alpha * wp.dot(wo, y), wp.dot(wo, n)))
    z = (1.0 - cap[2]) * (1.0 + w[2]) - w[2]
    r = wp.sqrt(wp.max(0.0, 1.0 - z * z))
    h = wp.vec3(r * cap[0], r * cap[1], z) + w
    return wp.normalize(alpha * h[0] * x + alpha * h[1] * y + wp.max(h[2], 1.0e-6) * n)


@wp.func
def ggx_lambda(cos_theta: float, alpha: float) -> float:
    """Return Smith's Lambda, the ratio of hidden to visible microfacet area at an angle to the normal (Heitz 2014, eq. 72)."""
    c2 = cos_theta * cos_theta
    tan2 = wp.max(0.0, 1.0 - c2) / wp.max(c2, 1.0e-12)
    return 0.5 * (wp.sqrt(1.0 + alpha * alpha * tan2) - 1.0)


@wp.func
def ggx_visible_share(cos_o: float, cos_i: float, alpha: float) -> float:
    """Return G2 / G1(wo), height-correlated: the weight of a ray reflected from a visible microfacet (Heitz 2018)."""
    a = ggx_lambda(cos_o, alpha)
    return (1.0 + a) / (1.0 + a + ggx_lambda(cos_i, alpha))


@wp.func
def search_cdf(cdf: wp.array(dtype=wp.float32), first: int, count: int, x: float) -> int:
    """Return the lowest i with x < cdf[first + i]; the `count` entries from `first` on rise to 1."""
    low = int(0)
    high = int(count - 1)
    while low < high:
        middle = (low + high) / 2
        below = x < cdf[first + middle]
        high = wp.where(below, middle, high)
        low = wp.where(below, low, middle + 1)
    return low


@wp.func
def share_of_row(cdf: wp.array(dtype=wp.float32), first: int, i: int) -> float:
    """Return the probability of entry i in the cdf that begins at `first`."""
    below = float(0.0)
    if i > 0:
        below = cdf[first + i - 1]
    return cdf[first + i] - below
