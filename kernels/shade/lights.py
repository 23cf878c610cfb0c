"""Light kinds: one sample of a light, as seen from a surface. Each kind is a function and an entry of LIGHTS.

wrt/scene/lights.py has the lights' parameters. docs/extending.md, "A light", adds a kind."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import PI, TWO_PI, cosine_hemisphere, frame_x, point_at, search_cdf, share_of_row, triangle
from wrt.kernels.shade.surface import (
    Surface,
    Triangle,
    spawn_point,
    triangle_point,
    triangle_point_error,
    world_error,
    world_normal,
    world_point,
)
from wrt.kernels.structs import Emitter, Light, Lighting, Surfaces


@wp.struct
class LightSample:
    """A sampled point or direction of a light, as seen from a surface."""

    wi: wp.vec3  # Unit direction to the light.
    end: wp.vec3  # End of the shadow ray, unless `distant`.
    distant: int  # 1: the shadow ray has no end.
    weight: wp.vec3  # Radiance over density, or a light without area's irradiance at normal incidence.
    area: int  # 1 if a ray could hit this light.


# --- the kinds --------------------------------------------------------------------------------------------------------
# Each is (lighting, surfaces, light, surface, xi) -> sample, placed by xi in [0, 1)^2. A weight of 0 is no light.


@wp.func
def point_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample a point light, equal in all directions."""
    sample = LightSample()
    way = light.position - s.point
    distance2 = wp.dot(way, way)
    if distance2 > 0.0:
        sample.wi = way / wp.sqrt(distance2)
        sample.end = light.position
        sample.weight = light.color / distance2
    return sample


@wp.func
def directional_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample a light at infinity."""
    sample = LightSample()
    sample.wi = -light.direction
    sample.weight = light.color
    sample.distant = 1
    return sample


@wp.func
def spot_falloff(light: Light, cos_angle: float) -> float:
    """Return 1 inside the inner cone, 0 outside the outer one, and in between the square of a linear ramp in the cosine."""
    if cos_angle <= light.cos_outer:
        return 0.0
    if cos_angle >= light.cos_inner:
        return 1.0
    ramp = (cos_angle - light.cos_outer) / (light.cos_inner - light.cos_outer)
    return ramp * ramp


@wp.func
def spot_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample a point light that shines into a cone."""
    sample = point_light(lighting, surfaces, light, s, xi)
    if wp.max(sample.weight) > 0.0:
        sample.weight = sample.weight * spot_falloff(light, -wp.dot(sample.wi, light.direction))
    return sample


@wp.func
def choose_emitter(lighting: Lighting, light: Light, xi: float) -> tuple[int, float]:
    """Choose an emitter by power. Return its index, and the place of xi within its share, in [0, 1), which is uniform again."""
    chosen = search_cdf(lighting.emitter_cdf, light.first, light.count, xi)
    share = share_of_row(lighting.emitter_cdf, light.first, chosen)
    left = lighting.emitter_cdf[light.first + chosen] - xi
    return light.first + chosen, wp.clamp(1.0 - left / wp.max(share, 1.0e-30), 0.0, 0.99999994)


@wp.func
def emitter_corners(emitter: Emitter) -> Triangle:
    t = Triangle()
    t.v0 = emitter.v0
    t.v1 = emitter.v1
    t.v2 = emitter.v2
    return t


@wp.func
def from_emitter(point: wp.vec3, error: wp.vec3, n: wp.vec3, emission: wp.vec3, two_sided: bool, pdf_area: float,
                 eye: wp.vec3) -> LightSample:
    """Return the sample of an emitter's point, with normal n, as seen from `eye`. It is branch-free, so that loops vectorise."""
    sample = LightSample()
    way = point - eye
    distance2 = wp.dot(way, way)
    sample.wi = way / wp.sqrt(wp.max(distance2, wp.static(2.0**-126)))
    cos_light = -wp.dot(sample.wi, n)
    cos_light = wp.where(two_sided, wp.abs(cos_light), cos_light)
    lit = cos_light > 0.0 and distance2 > 0.0
    sample.weight = wp.where(lit, cos_light / (distance2 * pdf_area), 0.0) * emission  # The emission is finite.
    # The shadow ray ends just before the light, whose own surface must not occlude it.
    sample.end = spawn_point(point, error, n, eye - point)
    sample.area = 1
    return sample


def make_mesh_light(features: Features) -> Any:
    """Return the function that samples a mesh: an emitter by power, then a point uniformly by area."""

    @wp.func
    def mesh_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
        chosen, within = choose_emitter(lighting, light, xi[0])
        emitter = lighting.emitters[chosen]
        b = triangle(wp.vec2(within, xi[1]))
        t = emitter_corners(emitter)
        point = triangle_point(t, b[0], b[1])
        n = emitter.normal
        error = triangle_point_error(t, b[0], b[1])
        if wp.static(features.instances):
            instance = surfaces.instances[emitter.instance]
            local = point
            point = world_point(instance, local)
            n = world_normal(instance, n)
            error = world_error(instance, local, error, point)
        material = surfaces.materials[emitter.material]
        return from_emitter(point, error, n, material.emission, material.two_sided != 0, emitter.pdf_area, s.point)

    return mesh_light


@wp.func
def is_within(light: Light, s: Surface, way: wp.vec3) -> bool:
    """Return whether a surface is inside a sphere light. On the sphere, to rounding, its normal decides. `way` points to the
    centre."""
    rounding = wp.length(s.error) + wp.static(16.0 * 2.0**-24) * (light.radius + wp.length(light.position))
    distance = wp.length(way)
    if distance < light.radius - rounding:
        return True
    return distance < light.radius + rounding and wp.dot(s.geometric, way) > 0.0


@wp.func
def sphere_light_from_within(light: Light, s: Surface, way: wp.vec3, xi: wp.vec2) -> LightSample:
    """Sample the normal's hemisphere by the cosine: all directions meet the inside of the sphere, if that emits."""
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
def sphere_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample the cone that the sphere subtends, uniformly (PBR, section 6.2.4); from inside, the hemisphere by the cosine."""
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
    around = sin_theta * point_at(TWO_PI * xi[1])
    sample.wi = wp.normalize((1.0 - h) * axis + around[0] * x + around[1] * wp.cross(axis, x))
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


# By the names in wrt.scene.lights.LIGHTS, and mesh and sphere for emissive surfaces: from a scene's features to the device function.
# Light.kind is the index here.
LIGHTS = {
    "point": lambda features: point_light,
    "directional": lambda features: directional_light,
    "spot": lambda features: spot_light,
    "mesh": make_mesh_light,
    "sphere": lambda features: sphere_light,
}


# Kinds with a single sample, which takes no random numbers. A kind of another module adds its name.
WITHOUT_AREA = {"point", "directional", "spot"}


# --- any of them ------------------------------------------------------------------------------------------------------


def make_light_sample(features: Features) -> Any:
    """Return the function that samples a light of any kind of the scene: one `if` after another, as in materials.py."""
    light_sample = no_light
    for number, name in reversed(list(enumerate(LIGHTS))):
        if name in features.lights:
            light_sample = make_link(number, LIGHTS[name](features), light_sample)
    return light_sample


@wp.func
def no_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    return LightSample()


def make_link(number: int, function: Any, others: Any) -> Any:
    """Return the function that takes `function` for lights of kind `number`, and `others` for the rest."""

    @wp.func
    def light_sample(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
        if light.kind == wp.static(number):
            return function(lighting, surfaces, light, s, xi)
        return others(lighting, surfaces, light, s, xi)

    return light_sample
