"""The integrator: Whitted 1980, "An Improved Illumination Model for Shaded Display", without recursion.

At each hit: emission, the ambient term and light straight from the lights, then at most three rays more: reflected, refracted,
and onward through what is partly transparent. Those wait on a stack with what they will be worth (throughput); a ray is
cut at max_depth bounces, after MAX_TRANSPARENT surfaces that it went straight through, or below min_throughput, and counted.
So is what comes after MAX_RAYS: where nothing is cut by throughput, a tree of 64 levels has no end.
"""

from functools import cache

import warp as wp

from wrt.kernels.shade.lights import (
    make_background,
    make_light_sample,
    make_light_xi,
    make_reflected_light,
    make_sky_sample,
    shadow_ray,
)
from wrt.kernels.shade.materials import BLEND, Scatter, make_is_solid, make_scatter, make_shade
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d
from wrt.kernels.shade.shadows import MAX_TRANSPARENT, OUTSIDE, Shadow, attenuation, make_transmittance
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Lighting, Limits, Material, Ray, Surfaces, make_ray
from wrt.kernels.study.ray_log import label

MAX_RAYS = wp.constant(1 << 16)  # behind one camera ray, without those to lights: a whole tree of 15 bounces
UNKNOWN = wp.constant(-2)  # where a camera ray begins: within glass, or not


@cache
def make_path(counting):
    """A pending ray; `counting`: it also knows what kind of ray it is."""

    @wp.struct
    class Path:
        """How much its light counts, how many bounces it has behind it and how many surfaces in a row it went straight
        through, which solid glass it is in (a material, OUTSIDE or UNKNOWN), its samples' key, 1 + the triangle that it starts
        on (0: none), and where rays are counted the branch that made it (0: the camera)."""

        origin: wp.vec3
        direction: wp.vec3
        throughput: wp.vec3
        depth: int
        passed: int
        medium: int
        exclude_plus_one: int
        key: wp.uint32
        if counting:
            branch: int

    return Path


@wp.struct
class Sample:
    """The radiance along one camera ray, and what it took.

    lost: what the rays that were cut would have added to it in a room of radiance 1 (ior^2 within glass), channels' mean.
    """

    radiance: wp.vec3
    rays: int
    cut_depth: int
    cut_throughput: int
    lost: float


@wp.func
def mean3(v: wp.vec3) -> float:
    return (v[0] + v[1] + v[2]) / 3.0


@wp.func
def absorbed(surfaces: Surfaces, throughput: wp.vec3, medium: int, distance: float) -> wp.vec3:
    """What is left of it after so far a way (world units) in a medium, which may be none."""
    if medium < 0:
        return throughput
    return wp.cw_mul(throughput, attenuation(surfaces, medium, distance))


@wp.func
def emitted(m: Material, s: Surface) -> wp.vec3:
    if s.front != 0 or m.two_sided != 0:
        return m.emission
    return wp.vec3(0.0, 0.0, 0.0)


def make_direct_light(features, accel_struct, closest_hit, any_hit):
    """Light straight from every light (and the background) by one shadow ray each."""
    light_sample = make_light_sample(features)
    sky_sample = make_sky_sample(features, make_background(features))
    light_xi = make_light_xi(features)
    choose, reflected = make_reflected_light(features, light_sample, sky_sample)
    transmittance = make_transmittance(features, accel_struct, closest_hit, any_hit)
    extra = 1 if features.sky_light else 0

    @wp.func
    def direct_light(
        accel: accel_struct,
        surfaces: Surfaces,
        lighting: Lighting,
        m: Material,
        s: Surface,
        wo: wp.vec3,
        scatter: Scatter,
        key: wp.uint32,
        index: wp.uint32,
    ) -> Shadow:
        """In `transmittance`: the radiance towards wo. cut: shadow rays that were, and lost: the light they were worth in
        a room of radiance 1."""
        out = Shadow()
        for i in range(lighting.count + wp.static(extra)):
            sample = choose(lighting, surfaces, i, s, light_xi(key, index, i))
            value = reflected(sample, m, s, scatter, wo)
            if wp.max(value) > 0.0:
                shadow = transmittance(accel, surfaces, shadow_ray(s, sample), sample.end)
                out.transmittance += wp.cw_mul(value, shadow.transmittance)
                out.rays += shadow.rays
                if wp.static(features.transparent_shadows):
                    out.cut += shadow.cut
                    out.lost += wp.cw_mul(scatter.diffuse + scatter.highlight, shadow.lost)
        return out

    return direct_light


def make_radiance(features, accel_struct, closest_hit, any_hit, counting=False):
    """The whole tree of rays behind one camera ray. `features`: wrt.renderer.features.Features; counting: rays carry a label."""
    Path = make_path(counting)
    sample_2d = make_sample_2d(features)
    surface_at, resolve, shading_normal = make_shade(features)
    background_radiance = make_background(features)
    scatter_at = make_scatter(features)
    direct_light = make_direct_light(features, accel_struct, closest_hit, any_hit)
    is_solid = make_is_solid(features)
    lit = features.lights or features.sky_light

    @wp.func
    def child(path: Path, s: Surface, direction: wp.vec3, throughput: wp.vec3, branch: int) -> Path:
        out = Path()
        out.origin = spawn_point(s.point, s.error, s.geometric, direction)
        out.direction = direction
        out.throughput = throughput
        out.depth = path.depth + 1
        out.medium = path.medium
        out.exclude_plus_one = s.exclude_plus_one
        out.key = hash_pair(path.key, wp.uint32(branch))
        if wp.static(counting):
            out.branch = branch
        return out

    @wp.func
    def keep(next: Path, limits: Limits, traced: int) -> int:
        """0: carries nothing; 1: to be followed; 2: cut by depth, or by the number of rays so far; 3: cut by throughput."""
        largest = wp.max(next.throughput)
        if largest <= 0.0:
            return 0
        if next.depth > limits.max_depth or next.passed > MAX_TRANSPARENT or traced >= MAX_RAYS:
            return 2
        return wp.where(largest < limits.min_throughput, 3, 1)

    @wp.func
    def tally(before: Sample, surfaces: Surfaces, next: Path, verdict: int) -> Sample:
        """Keeps the count of rays that were cut."""
        out = before
        if verdict < 2:
            return out
        if verdict == 2:
            out.cut_depth += 1
        else:
            out.cut_throughput += 1
        worth = mean3(next.throughput)
        if wp.static(features.refraction):
            if next.medium >= 0:  # within, light is denser, and the throughput was divided by as much
                worth = worth * surfaces.materials[next.medium].ior * surfaces.materials[next.medium].ior
        out.lost += worth
        return out

    @wp.func
    def missing(m: Material, s: Surface, medium: int) -> float:
        """Share of a ray for which the surface is not there: 1 - alpha.

        Blended solid glass is there as a whole or not at all, which is decided where a ray enters: what did not enter it meets
        nothing at its back, and what did meets all of it. Else a ray could go in unbent and come out with ior^2 of its light.
        """
        if m.alpha_mode != wp.static(BLEND):
            return 0.0
        if wp.static(features.refraction):
            if s.front == 0 and medium != UNKNOWN and is_solid(m):
                return wp.where(medium == s.material, 0.0, 1.0)
        return 1.0 - m.alpha

    @wp.func
    def medium_at(m: Material, s: Surface, medium: int) -> int:
        """The solid glass on the ray's side of a surface. A back is seen from within, whatever the path knows of."""
        if not is_solid(m):
            return medium
        return wp.where(s.front == 0, s.material, wp.where(medium == UNKNOWN, OUTSIDE, medium))

    @wp.func
    def radiance(
        accel: accel_struct, surfaces: Surfaces, lighting: Lighting, limits: Limits, camera_ray: Ray, key: wp.uint32,
        index: wp.uint32,
    ) -> Sample:
        out = Sample()
        stack = wp.zeros(shape=wp.static(features.stack_size), dtype=Path)
        path = Path()
        path.origin = camera_ray.origin
        path.direction = camera_ray.direction
        path.throughput = wp.vec3(1.0, 1.0, 1.0)
        path.medium = UNKNOWN
        path.key = key
        stack[0] = path
        size = int(1)
        traced = int(0)
        while size > 0:
            size = size - 1
            path = stack[size]
            ray = make_ray(path.origin, path.direction)
            ray.exclude_plus_one = path.exclude_plus_one
            if wp.static(counting):
                ray.slot = label(path.branch, path.depth)
            out.rays += 1
            traced += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.radiance += wp.cw_mul(path.throughput, background_radiance(lighting.background, path.direction))
                continue

            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            wo = -path.direction
            s.shading = shading_normal(surfaces, m, s, wo)
            if wp.static(features.blend):
                share = missing(m, s, path.medium)
                if share > 0.0:
                    onward = child(path, s, path.direction, share * path.throughput, 3)
                    onward.depth = path.depth
                    onward.passed = path.passed + 1
                    if wp.static(features.refraction):
                        if path.medium == UNKNOWN and is_solid(m):
                            onward.medium = OUTSIDE
                    if wp.static(features.absorption):
                        onward.throughput = absorbed(surfaces, onward.throughput, path.medium, hit.t)
                    verdict = keep(onward, limits, traced)
                    if verdict == 1:
                        stack[size] = onward
                        size = size + 1
                    out = tally(out, surfaces, onward, verdict)
                    if share >= 1.0:
                        continue
                    path.throughput = (1.0 - share) * path.throughput
            if wp.static(features.refraction):
                path.medium = medium_at(m, s, path.medium)
            if wp.static(features.absorption):
                path.throughput = absorbed(surfaces, path.throughput, path.medium, hit.t)
            xi = wp.vec2(0.0, 0.0)
            if wp.static(features.rough):
                xi = sample_2d(path.key, index, 2)
            scatter = scatter_at(m, s, wo, xi)

            light = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(features.ambient):
                light = wp.cw_mul(scatter.diffuse, lighting.ambient)
            if wp.static(features.emission):
                light += emitted(m, s)
            if wp.static(lit):
                if wp.max(scatter.diffuse) > 0.0 or wp.max(scatter.highlight) > 0.0:
                    direct = direct_light(accel, surfaces, lighting, m, s, wo, scatter, path.key, index)
                    light += direct.transmittance
                    out.rays += direct.rays
                    if wp.static(features.transparent_shadows):
                        out.cut_depth += direct.cut
                        out.lost += mean3(wp.cw_mul(path.throughput, direct.lost))
            out.radiance += wp.cw_mul(path.throughput, light)

            if wp.static(features.reflection):
                next = child(path, s, scatter.reflection, wp.cw_mul(path.throughput, scatter.reflected), 1)
                verdict = keep(next, limits, traced)
                if verdict == 1:
                    stack[size] = next
                    size = size + 1
                out = tally(out, surfaces, next, verdict)
            if wp.static(features.refraction):
                next = child(path, s, scatter.refraction, wp.cw_mul(path.throughput, scatter.transmitted), 2)
                if scatter.bends != 0:
                    next.medium = wp.where(s.front != 0, s.material, OUTSIDE)
                verdict = keep(next, limits, traced)
                if verdict == 1:
                    stack[size] = next
                    size = size + 1
                out = tally(out, surfaces, next, verdict)
        return out

    return radiance
