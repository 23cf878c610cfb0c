"""The integrator: Whitted 1980, "An Improved Illumination Model for Shaded Display", without recursion.

At each hit: emission, the ambient term and light straight from the lights, then at most three rays more: reflected, refracted,
and onward through what is partly transparent. Those wait on a stack with what they will be worth (throughput); a ray is
cut at max_depth bounces or below min_throughput, and counted.
"""

import warp as wp

from wrt.kernels.lights import (
    make_background,
    make_light_sample,
    make_light_xi,
    make_reflected_light,
    make_sky_sample,
    shadow_ray,
)
from wrt.kernels.materials import BLEND, GLASS, Scatter, make_bump, make_resolve, make_scatter
from wrt.kernels.sampling import hash_pair, make_sample_2d
from wrt.kernels.structs import Lighting, Limits, Material, Ray, Surfaces
from wrt.kernels.surface import Surface, make_surface_at, spawn_point
from wrt.kernels.textures import make_sample_texture

OUTSIDE = wp.constant(-1)
MAX_TRANSPARENT = wp.constant(256)  # surfaces that one shadow ray may pass through


@wp.struct
class Path:
    """A pending ray: how much its light counts, how many bounces it has behind it, which material it is in, its samples' key,
    and the triangle that it starts on."""

    origin: wp.vec3
    direction: wp.vec3
    throughput: wp.vec3
    depth: int
    medium: int
    exclude: int
    key: wp.uint32


@wp.struct
class Sample:
    """The radiance along one camera ray, and what it took."""

    radiance: wp.vec3
    rays: int
    cut_depth: int
    cut_throughput: int
    lost: float


@wp.func
def mean3(v: wp.vec3) -> float:
    return (v[0] + v[1] + v[2]) / 3.0


@wp.func
def attenuation(surfaces: Surfaces, medium: int, distance: float) -> wp.vec3:
    """Beer-Lambert over a distance in world units."""
    sigma = surfaces.materials[medium].absorption
    return wp.vec3(wp.exp(-sigma[0] * distance), wp.exp(-sigma[1] * distance), wp.exp(-sigma[2] * distance))


@wp.func
def emitted(m: Material, s: Surface) -> wp.vec3:
    if s.front != 0 or m.two_sided != 0:
        return m.emission
    return wp.vec3(0.0, 0.0, 0.0)


@wp.struct
class Shadow:
    """What is left of the light on a shadow ray, and how many rays it took to know."""

    transmittance: wp.vec3
    rays: int


def make_shade(features):
    """Surface and material at a hit, and the scattering there: shared by the integrator, shadow rays and AOVs."""
    sample_texture = make_sample_texture(features.textures, features.checkerboards)
    uvs = features.textures or features.checkerboards
    surface_at = make_surface_at(features.spheres, features.smooth, uvs, features.normal_maps)
    resolve = make_resolve(features, sample_texture)
    bump = make_bump(features, sample_texture)

    @wp.func
    def shading_normal(surfaces: Surfaces, m: Material, s: Surface, wo: wp.vec3) -> wp.vec3:
        """The interpolated or mapped normal, bent no farther than it is still seen from wo."""
        n = s.shading
        if wp.static(features.normal_maps):
            n = bump(surfaces, m, s)
        if wp.static(features.smooth or features.normal_maps):
            facing = wp.dot(n, wo)
            if facing < 1.0e-3:
                n = wp.normalize(n + (1.0e-3 - facing) * wo)
        return n

    return surface_at, resolve, shading_normal


def make_transmittance(features, accel_struct, closest_hit, any_hit):
    """Shadow rays: one any-hit query, or where a scene lets light through surfaces, one closest hit after another."""
    surface_at, resolve, shading_normal = make_shade(features)
    scatter = make_scatter(features)

    @wp.func
    def let_through(m: Material, from_outside: Surface, wo: wp.vec3) -> wp.vec3:
        """Share of light that goes straight on through a surface.

        An unbent ray meets both sides of solid glass at its angle outside: from_outside.front must be 1, or a ray on its way
        out would be held for totally reflected.
        """
        share = scatter(m, from_outside, wo, wp.vec2(0.0, 0.0))
        through = wp.vec3(0.0, 0.0, 0.0)
        if share.bends == 0 or wp.static(features.tinted_shadows):
            through = share.transmitted
            if share.bends != 0:
                through = m.ior * m.ior * through  # straight through, the solid angle is not squeezed
        if wp.static(features.blend):
            through = m.alpha * through + wp.vec3(1.0 - m.alpha, 1.0 - m.alpha, 1.0 - m.alpha)
        return through

    @wp.func
    def through_surfaces(accel: accel_struct, surfaces: Surfaces, first: Ray, end: wp.vec3) -> Shadow:
        out = Shadow()
        out.transmittance = wp.vec3(1.0, 1.0, 1.0)
        ray = first
        medium = int(OUTSIDE)
        for _i in range(MAX_TRANSPARENT):
            out.rays += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                if wp.static(features.absorption):
                    if medium >= 0 and ray.t_max <= 1.0:  # the light is inside it
                        out.transmittance = wp.cw_mul(out.transmittance, attenuation(surfaces, medium, wp.length(ray.direction)))
                return out
            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            m.roughness = 0.0
            d = wp.normalize(ray.direction)
            s.shading = shading_normal(surfaces, m, s, -d)
            inward = s.front != 0
            s.front = 1
            out.transmittance = wp.cw_mul(out.transmittance, let_through(m, s, -d))
            if wp.static(features.absorption):
                if not inward and m.thin == 0:
                    inside = attenuation(surfaces, s.material, hit.t * wp.length(ray.direction))
                    out.transmittance = wp.cw_mul(out.transmittance, inside)
            if wp.max(out.transmittance) <= 0.0:
                return out
            ray.origin = spawn_point(s.point, s.error, s.geometric, d)
            ray.exclude = s.exclude
            medium = wp.where(inward and m.thin == 0, s.material, OUTSIDE)
            if ray.t_max <= 1.0:
                ray.direction = end - ray.origin
                if wp.dot(ray.direction, d) <= 0.0:
                    return out  # the light is within the surface's rounding error
        out.transmittance = wp.vec3(0.0, 0.0, 0.0)
        return out

    @wp.func
    def transmittance(accel: accel_struct, surfaces: Surfaces, ray: Ray, end: wp.vec3) -> Shadow:
        out = Shadow()
        if wp.static(features.transparent_shadows):
            out = through_surfaces(accel, surfaces, ray, end)
        else:
            out.rays = 1
            hit = any_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.transmittance = wp.vec3(1.0, 1.0, 1.0)
        return out

    return transmittance


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
        """In `transmittance`: the radiance towards wo."""
        out = Shadow()
        for i in range(lighting.count + wp.static(extra)):
            sample = choose(lighting, surfaces, i, s, light_xi(key, index, i))
            value = reflected(sample, m, s, scatter, wo)
            if wp.max(value) > 0.0:
                shadow = transmittance(accel, surfaces, shadow_ray(s, sample), sample.end)
                out.transmittance += wp.cw_mul(value, shadow.transmittance)
                out.rays += shadow.rays
        return out

    return direct_light


def make_radiance(features, accel_struct, closest_hit, any_hit):
    """The whole tree of rays behind one camera ray. `features`: wrt.features.Features."""
    sample_2d = make_sample_2d(features)
    surface_at, resolve, shading_normal = make_shade(features)
    background_radiance = make_background(features)
    scatter_at = make_scatter(features)
    direct_light = make_direct_light(features, accel_struct, closest_hit, any_hit)
    lit = features.lights or features.sky_light

    @wp.func
    def child(path: Path, s: Surface, direction: wp.vec3, throughput: wp.vec3, branch: int) -> Path:
        out = Path()
        out.origin = spawn_point(s.point, s.error, s.geometric, direction)
        out.direction = direction
        out.throughput = throughput
        out.depth = path.depth + 1
        out.medium = path.medium
        out.exclude = s.exclude
        out.key = hash_pair(path.key, wp.uint32(branch))
        return out

    @wp.func
    def keep(next: Path, limits: Limits) -> int:
        """0: carries nothing; 1: to be followed; 2: cut by depth; 3: cut by throughput."""
        largest = wp.max(next.throughput)
        if largest <= 0.0:
            return 0
        if next.depth > limits.max_depth:
            return 2
        return wp.where(largest < limits.min_throughput, 3, 1)

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
        path.medium = OUTSIDE
        path.exclude = -1
        path.key = key
        stack[0] = path
        size = int(1)
        while size > 0:
            size = size - 1
            path = stack[size]
            ray = Ray()
            ray.origin = path.origin
            ray.direction = path.direction
            ray.t_min = 0.0
            ray.t_max = float(wp.inf)
            ray.exclude = path.exclude
            out.rays += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.radiance += wp.cw_mul(path.throughput, background_radiance(lighting.background, path.direction))
                continue

            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            wo = -path.direction
            s.shading = shading_normal(surfaces, m, s, wo)
            if wp.static(features.absorption):
                # A back side is seen from within, whatever the path knows of: the camera may stand in the glass.
                clear = m.thin == 0 and (m.kind == wp.static(GLASS) or m.transmission > 0.0)
                medium = wp.where(s.front == 0 and clear, s.material, path.medium)
                if medium >= 0:
                    path.throughput = wp.cw_mul(path.throughput, attenuation(surfaces, medium, hit.t))
            xi = wp.vec2(0.0, 0.0)
            if wp.static(features.rough):
                xi = sample_2d(path.key, index, 2)
            scatter = scatter_at(m, s, wo, xi)
            if wp.static(features.blend):
                if m.alpha_mode == wp.static(BLEND) and m.alpha < 1.0:
                    onward = child(path, s, path.direction, (1.0 - m.alpha) * path.throughput, 3)
                    path.throughput = m.alpha * path.throughput
                    verdict = keep(onward, limits)
                    if verdict == 1:
                        stack[size] = onward
                        size = size + 1
                    out = tally(out, onward, verdict)

            light = wp.cw_mul(scatter.diffuse, lighting.ambient)
            if wp.static(features.emission):
                light += emitted(m, s)
            if wp.static(lit):
                if wp.max(scatter.diffuse) > 0.0 or wp.max(scatter.highlight) > 0.0:
                    direct = direct_light(accel, surfaces, lighting, m, s, wo, scatter, path.key, index)
                    light += direct.transmittance
                    out.rays += direct.rays
            out.radiance += wp.cw_mul(path.throughput, light)

            if wp.static(features.reflection):
                next = child(path, s, scatter.reflection, wp.cw_mul(path.throughput, scatter.reflected), 1)
                verdict = keep(next, limits)
                if verdict == 1:
                    stack[size] = next
                    size = size + 1
                out = tally(out, next, verdict)
            if wp.static(features.refraction):
                next = child(path, s, scatter.refraction, wp.cw_mul(path.throughput, scatter.transmitted), 2)
                if scatter.bends != 0:
                    next.medium = wp.where(s.front != 0, s.material, OUTSIDE)
                verdict = keep(next, limits)
                if verdict == 1:
                    stack[size] = next
                    size = size + 1
                out = tally(out, next, verdict)
        return out

    return radiance


@wp.func
def tally(out: Sample, next: Path, verdict: int) -> Sample:
    """Keeps the count of rays that were cut."""
    if verdict == 2:
        out.cut_depth += 1
        out.lost += mean3(next.throughput)
    if verdict == 3:
        out.cut_throughput += 1
        out.lost += mean3(next.throughput)
    return out
