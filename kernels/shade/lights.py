"""Lights: what arrives at a surface directly, and what lies behind everything."""

import warp as wp

from wrt.kernels.shade.materials import Scatter, blinn_phong
from wrt.kernels.shade.sampling import PI, TWO_PI, cosine_hemisphere, frame_x, hash_pair, make_sample_2d, search_cdf, triangle
from wrt.kernels.shade.surface import (
    Surface,
    make_place_of,
    spawn_point,
    triangle_normal,
    triangle_point,
    triangle_point_error,
    world_error,
    world_normal,
    world_point,
)
from wrt.kernels.structs import Background, Light, Lighting, Ray, Surfaces, gamma, make_ray

LIGHT_POINT = 0
LIGHT_DIRECTIONAL = 1
LIGHT_SPOT = 2
LIGHT_MESH = 3
LIGHT_SPHERE = 4


@wp.struct
class LightSample:
    """One way from a surface to a light.

    wi: unit direction; weight: radiance over density (or irradiance at right angles, for lights without area): times BSDF
    and cosine it is the light's share; end: where the way ends, or, if `distant`, no end. area: a ray could hit this light.
    """

    wi: wp.vec3
    end: wp.vec3
    distant: int
    weight: wp.vec3
    area: int


@wp.func
def rotate_y(d: wp.vec3, angle: float) -> wp.vec3:
    """Turned about +y, counter-clockwise seen from above."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec3(c * d[0] + s * d[2], d[1], c * d[2] - s * d[0])


@wp.func
def environment_pixel(b: Background, column: int, row: int) -> wp.vec3:
    """Columns go round; rows end at the poles."""
    x = wp.where(column < 0, column + b.width, wp.where(column >= b.width, column - b.width, column))
    return b.pixels[wp.clamp(row, 0, b.height - 1) * b.width + x]


@wp.func
def environment_radiance(b: Background, direction: wp.vec3) -> wp.vec3:
    """Bilinear look-up in the equirectangular picture; the unit direction is in world space."""
    d = rotate_y(direction, -b.rotation)
    x = (0.5 + wp.atan2(d[0], -d[2]) / TWO_PI) * float(b.width) - 0.5
    y = wp.acos(wp.clamp(d[1], -1.0, 1.0)) / PI * float(b.height) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    top = (1.0 - fx) * environment_pixel(b, column, row) + fx * environment_pixel(b, column + 1, row)
    low = (1.0 - fx) * environment_pixel(b, column, row + 1) + fx * environment_pixel(b, column + 1, row + 1)
    return b.scale * ((1.0 - fy) * top + fy * low)


def make_background(features):
    """Radiance from beyond all surfaces."""

    @wp.func
    def background_radiance(b: Background, direction: wp.vec3) -> wp.vec3:
        """direction: unit length, world space."""
        if wp.static(features.environment):
            return environment_radiance(b, direction)
        if wp.static(features.gradient):
            return wp.lerp(b.bottom, b.top, 0.5 * (direction[1] + 1.0))
        return b.bottom

    return background_radiance


@wp.func
def share_of_row(cdf: wp.array(dtype=wp.float32), first: int, i: int) -> float:
    below = float(0.0)
    if i > 0:
        below = cdf[first + i - 1]
    return cdf[first + i] - below


def make_sky_sample(features, background_radiance):
    """One direction to the background: by its brightness where it is a picture, else by the cosine."""

    @wp.func
    def by_brightness(b: Background, xi: wp.vec2) -> LightSample:
        row = search_cdf(b.row_cdf, 0, b.height, xi[0])
        first = row * b.width
        column = search_cdf(b.column_cdf, first, b.width, xi[1])
        p_row = share_of_row(b.row_cdf, 0, row)
        p_column = share_of_row(b.column_cdf, first, column)
        # Where in its cell the number fell is uniform again: it places the direction within the pixel.
        v = 1.0 - (b.row_cdf[row] - xi[0]) / p_row
        u = 1.0 - (b.column_cdf[first + column] - xi[1]) / p_column
        theta = PI * (float(row) + wp.clamp(v, 0.0, 1.0)) / float(b.height)
        phi = TWO_PI * ((float(column) + wp.clamp(u, 0.0, 1.0)) / float(b.width) - 0.5)
        sin_theta = wp.sin(theta)
        sample = LightSample()
        local = wp.vec3(sin_theta * wp.sin(phi), wp.cos(theta), -sin_theta * wp.cos(phi))
        sample.wi = rotate_y(local, b.rotation)
        density = p_row * p_column * float(b.width * b.height) / (TWO_PI * PI * wp.max(sin_theta, 1.0e-9))
        sample.weight = environment_radiance(b, sample.wi) / density
        return sample

    @wp.func
    def sky_sample(b: Background, n: wp.vec3, xi: wp.vec2) -> LightSample:
        sample = LightSample()
        if wp.static(features.environment):
            sample = by_brightness(b, xi)
        else:
            sample.wi = cosine_hemisphere(xi, n)
            cosine = wp.max(wp.dot(sample.wi, n), 1.0e-9)
            sample.weight = background_radiance(b, sample.wi) * (PI / cosine)
        sample.distant = 1
        sample.area = 1
        return sample

    return sky_sample


@wp.func
def spot_falloff(light: Light, cos_angle: float) -> float:
    """1 within the inner cone, 0 beyond the outer one, the square of a linear ramp in the cosine between them."""
    if cos_angle <= light.cos_outer:
        return 0.0
    if cos_angle >= light.cos_inner:
        return 1.0
    ramp = (cos_angle - light.cos_outer) / (light.cos_inner - light.cos_outer)
    return ramp * ramp


def make_mesh_light_sample(features):
    """A point on the emitters of one light, by power and then uniformly by area."""
    place_of = make_place_of(features.instances)

    @wp.func
    def mesh_light_sample(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
        chosen = search_cdf(lighting.emitter_cdf, light.first, light.count, xi[0])
        emitter = lighting.emitters[light.first + chosen]
        share = share_of_row(lighting.emitter_cdf, light.first, chosen)
        left = lighting.emitter_cdf[light.first + chosen] - xi[0]
        within = wp.clamp(1.0 - left / wp.max(share, 1.0e-30), 0.0, 0.99999994)
        b = triangle(wp.vec2(within, xi[1]))
        place = place_of(surfaces, emitter.prim_id)
        point = triangle_point(surfaces, place.face, b[0], b[1])
        n = triangle_normal(surfaces, place.face)
        error = triangle_point_error(surfaces, place.face, b[0], b[1])
        if wp.static(features.instances):
            instance = surfaces.instances[place.instance]
            local = point
            point = world_point(instance, local)
            n = world_normal(instance, n)
            error = world_error(instance, local, error, point)
        material = surfaces.materials[place.material]
        sample = LightSample()
        way = point - s.point
        distance2 = wp.dot(way, way)
        sample.wi = way / wp.sqrt(wp.max(distance2, wp.static(2.0**-126)))
        cos_light = -wp.dot(sample.wi, n)
        if material.two_sided != 0:
            cos_light = wp.abs(cos_light)
        if cos_light > 0.0 and distance2 > 0.0:
            sample.weight = material.emission * (cos_light / (distance2 * emitter.pdf_area))
        # The way ends just before the light: its own surface must not shade it.
        sample.end = spawn_point(point, error, n, s.point - point)
        sample.area = 1
        return sample

    return mesh_light_sample


@wp.func
def is_within(light: Light, s: Surface, way: wp.vec3) -> bool:
    """Whether a surface is inside a sphere; on the sphere itself, but for rounding, its normal decides. way: to the center."""
    rounding = wp.length(s.error) + wp.static(16.0 * 2.0**-24) * (light.radius + wp.length(light.position))
    distance = wp.length(way)
    if distance < light.radius - rounding:
        return True
    return distance < light.radius + rounding and wp.dot(s.geometric, way) > 0.0


@wp.func
def sphere_light_from_within(light: Light, s: Surface, way: wp.vec3, xi: wp.vec2) -> LightSample:
    """A direction by the cosine around the normal: every one of them meets the sphere's inside, where that emits."""
    sample = LightSample()
    if light.two_sided == 0:
        return sample
    sample.wi = cosine_hemisphere(xi, s.shading)
    along = wp.dot(sample.wi, way)
    across = way - along * sample.wi
    half_chord = wp.sqrt(wp.max(0.0, light.radius * light.radius - wp.dot(across, across)))
    n = wp.normalize(s.point + (along + half_chord) * sample.wi - light.position)
    extent = wp.vec3(light.radius, light.radius, light.radius) + wp.abs(light.position)
    sample.end = spawn_point(light.position + light.radius * n, wp.static(16.0 * 2.0**-24) * extent, n, -n)
    sample.weight = light.color * (PI / wp.max(wp.dot(sample.wi, s.shading), 1.0e-9))
    sample.area = 1
    return sample


@wp.func
def sphere_light_sample(light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """A direction in the cone that the sphere fills, uniformly (PBR, section 6.2.4); from within, one by the cosine."""
    sample = LightSample()
    way = light.position - s.point
    distance2 = wp.dot(way, way)
    if is_within(light, s, way):
        return sphere_light_from_within(light, s, way, xi)
    sin2_max = light.radius * light.radius / distance2
    if sin2_max >= 1.0:
        return sample
    # 1 - cos of the cone's half angle without cancellation for a far (small) sphere.
    one_minus_cos = sin2_max / (1.0 + wp.sqrt(1.0 - sin2_max))
    h = one_minus_cos * xi[0]
    sin_theta = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    axis = way / wp.sqrt(distance2)
    x = frame_x(axis)
    phi = TWO_PI * xi[1]
    sample.wi = wp.normalize((1.0 - h) * axis + sin_theta * (wp.cos(phi) * x + wp.sin(phi) * wp.cross(axis, x)))
    # The near crossing with the sphere; pulled out by more than its rounding error.
    along = wp.dot(sample.wi, way)
    across = way - along * sample.wi
    half_chord = wp.sqrt(wp.max(0.0, light.radius * light.radius - wp.dot(across, across)))
    n = wp.normalize(s.point + (along - half_chord) * sample.wi - light.position)
    extent = wp.vec3(light.radius, light.radius, light.radius) + wp.abs(light.position)
    sample.end = spawn_point(light.position + light.radius * n, wp.static(16.0 * 2.0**-24) * extent, n, n)
    sample.weight = light.color * (TWO_PI * one_minus_cos)
    sample.area = 1
    return sample


def make_light_sample(features):
    """One sample of one light, as seen from a surface."""
    mesh_light_sample = make_mesh_light_sample(features)

    @wp.func
    def light_sample(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
        sample = LightSample()
        if wp.static(features.mesh_lights):
            if light.kind == wp.static(LIGHT_MESH):
                return mesh_light_sample(lighting, surfaces, light, s, xi)
        if wp.static(features.sphere_lights):
            if light.kind == wp.static(LIGHT_SPHERE):
                return sphere_light_sample(light, s, xi)
        if wp.static(features.directional_lights):
            if light.kind == wp.static(LIGHT_DIRECTIONAL):
                sample.wi = -light.direction
                sample.weight = light.color
                sample.distant = 1
                return sample
        if wp.static(features.point_lights or features.spot_lights):
            way = light.position - s.point
            distance2 = wp.dot(way, way)
            if distance2 > 0.0:
                sample.wi = way / wp.sqrt(distance2)
                sample.end = light.position
                sample.weight = light.color / distance2
                if wp.static(features.spot_lights):
                    if light.kind == wp.static(LIGHT_SPOT):
                        sample.weight = sample.weight * spot_falloff(light, -wp.dot(sample.wi, light.direction))
        return sample

    return light_sample


@wp.func
def shadow_ray(s: Surface, sample: LightSample) -> Ray:
    """The segment from a surface to a light: t = 1 is the light's end of it.

    A light with an area ends it a little earlier: the rounding of the segment's direction and of t, some 16 steps, grows with
    the distance, and not with the light's own error bound.
    """
    ray = make_ray(spawn_point(s.point, s.error, s.geometric, sample.wi), sample.wi)
    ray.exclude_plus_one = s.exclude_plus_one
    if sample.distant == 0:
        ray.direction = sample.end - ray.origin
        ray.t_max = wp.where(sample.area != 0, 1.0 - gamma(32.0), 1.0)
    return ray


def make_reflected_light(features):
    """The light that one sample sends to the eye, before shadows, and which sample that is."""
    light_sample = make_light_sample(features)
    sky_sample = make_sky_sample(features, make_background(features))

    @wp.func
    def choose(lighting: Lighting, surfaces: Surfaces, i: int, s: Surface, xi: wp.vec2) -> LightSample:
        """Lights are numbered; the background comes after the last one."""
        sample = LightSample()
        if wp.static(features.lights):
            if i < lighting.count:
                sample = light_sample(lighting, surfaces, lighting.lights[i], s, xi)
        if wp.static(features.sky_light):
            if i == lighting.count:
                sample = sky_sample(lighting.background, s.shading, xi)
        return sample

    @wp.func
    def reflected(sample: LightSample, s: Surface, scatter: Scatter, wo: wp.vec3) -> wp.vec3:
        cosine = wp.dot(s.shading, sample.wi)
        if cosine <= 0.0 or wp.dot(s.geometric, sample.wi) <= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        value = scatter.diffuse / PI
        if wp.static(features.highlight):
            # A traced reflection finds lights that have an area by itself; the background is no small light.
            if sample.area == 0 or (scatter.traced == 0 and sample.distant == 0):
                if wp.max(scatter.highlight) > 0.0:
                    value = value + scatter.highlight * blinn_phong(s.shading, sample.wi, wo, scatter.exponent)
        return cosine * wp.cw_mul(value, sample.weight)

    return choose, reflected


def make_light_xi(features):
    """The numbers that place a sample on a light."""
    sample_2d = make_sample_2d(features)

    @wp.func
    def light_xi(key: wp.uint32, index: wp.uint32, i: int) -> wp.vec2:
        """Two numbers for light i at the path vertex `key`."""
        return sample_2d(hash_pair(key, wp.static(wp.uint32(0x4C49))), index, i)

    return light_xi
