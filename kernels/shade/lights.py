"""Light kinds: functions that sample a light as seen from a surface. Each kind is a function and an entry of LIGHTS.

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
    end: wp.vec3  # Point where the shadow ray ends. Unread if `distant`.
    distant: int  # 1 if the light is at infinity, else 0.
    weight: wp.vec3  # Radiance over density per steradian. For a light without area: irradiance at normal incidence.
    area: int  # 1 if a ray can hit this light, 2 for the ambient term (direct.AMBIENT), else 0.


# --- the kinds --------------------------------------------------------------------------------------------------------
# Each kind is a function (lighting, surfaces, light, surface, xi) -> LightSample, where xi in [0, 1)^2 places the sample. A sample of
# weight 0 adds no light.


@wp.func
def point_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample a point light, which shines equally in all directions."""
    sample = LightSample()
    to_light = light.position - s.point
    distance2 = wp.dot(to_light, to_light)
    if distance2 > 0.0:
        sample.wi = to_light / wp.sqrt(distance2)
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
    """Return 1 inside the inner cone, 0 outside the outer cone, and between them the square of a linear ramp in the cosine."""
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
    """Choose an emitter by power. Return its index, and a uniform random number in [0, 1) that the choice has not used up."""
    chosen = search_cdf(lighting.emitter_cdf, light.first, light.count, xi)
    share = share_of_row(lighting.emitter_cdf, light.first, chosen)
    left = lighting.emitter_cdf[light.first + chosen] - xi
    return light.first + chosen, wp.clamp(1.0 - left / wp.max(share, 1.0e-30), 0.0, 0.99999994)


@wp.func
def emitter_corners(emitter: Emitter) -> Triangle:
    """Return the emitter as a Triangle with corners only."""
    t = Triangle()
    t.v0 = emitter.v0
    t.v1 = emitter.v1
    t.v2 = emitter.v2
    return t


@wp.func
def from_emitter(point: wp.vec3, error: wp.vec3, n: wp.vec3, emission: wp.vec3, two_sided: bool, pdf_area: float,
                 eye: wp.vec3) -> LightSample:
    """Return the sample for a point with normal n on an emitter, as seen from the point `eye`. Branch-free, so that loops vectorise."""
    sample = LightSample()
    to_light = point - eye
    distance2 = wp.dot(to_light, to_light)
    sample.wi = to_light / wp.sqrt(wp.max(distance2, wp.static(2.0**-126)))
    cos_light = -wp.dot(sample.wi, n)
    cos_light = wp.where(two_sided, wp.abs(cos_light), cos_light)
    lit = cos_light > 0.0 and distance2 > 0.0
    sample.weight = wp.where(lit, cos_light / (distance2 * pdf_area), 0.0) * emission  # 0 * emission is 0, as emissions are finite.
    # The shadow ray ends just before the light, so that the light's own surface does not occlude it.
    sample.end = spawn_point(point, error, n, eye - point)
    sample.area = 1
    return sample


def make_mesh_light(features: Features) -> Any:
    """Return the function that samples an emissive mesh: an emitter by power, then a point uniformly by area."""

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
def is_within(light: Light, s: Surface, to_center: wp.vec3) -> bool:
    """Return whether surface s is inside a sphere light. If s is on the sphere within the rounding error, the normal of s decides."""
    rounding = wp.length(s.error) + wp.static(16.0 * 2.0**-24) * (light.radius + wp.length(light.position))
    distance = wp.length(to_center)
    if distance < light.radius - rounding:
        return True
    return distance < light.radius + rounding and wp.dot(s.geometric, to_center) > 0.0


@wp.func
def crossing(light: Light, s: Surface, wi: wp.vec3, to_center: wp.vec3, side: float) -> wp.vec3:
    """Return the end of a shadow ray to a sphere light: the first crossing (side = -1) or, from inside, the second (side = 1).

    The point is moved towards the ray's origin by more than the rounding error of the crossing."""
    along = wp.dot(wi, to_center)
    across = to_center - along * wi
    half_chord = wp.sqrt(wp.max(0.0, light.radius * light.radius - wp.dot(across, across)))
    n = wp.normalize(s.point + (along + side * half_chord) * wi - light.position)
    extent = wp.vec3(light.radius, light.radius, light.radius) + wp.abs(light.position)
    return spawn_point(light.position + light.radius * n, wp.static(16.0 * 2.0**-24) * extent, n, -side * n)


@wp.func
def sphere_light_from_within(light: Light, s: Surface, to_center: wp.vec3, xi: wp.vec2) -> LightSample:
    """Sample the hemisphere of s by the cosine: all directions meet the sphere's inside. A one-sided light gives no light there."""
    sample = LightSample()
    if light.two_sided == 0:
        return sample
    sample.wi = cosine_hemisphere(xi, s.shading)
    sample.end = crossing(light, s, sample.wi, to_center, 1.0)
    sample.weight = light.color * (PI / wp.max(wp.dot(sample.wi, s.shading), 1.0e-9))
    sample.area = 1
    return sample


@wp.func
def sphere_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    """Sample the cone that the sphere subtends, uniformly (PBR, section 6.2.4); from inside, the hemisphere by the cosine."""
    sample = LightSample()
    to_center = light.position - s.point
    distance2 = wp.dot(to_center, to_center)
    if is_within(light, s, to_center):
        return sphere_light_from_within(light, s, to_center, xi)
    sin2_max = light.radius * light.radius / distance2
    if sin2_max >= 1.0:
        return sample
    # 1 - cos of the cone's half angle, without cancellation for a distant sphere.
    one_minus_cos = sin2_max / (1.0 + wp.sqrt(1.0 - sin2_max))
    h = one_minus_cos * xi[0]
    sin_theta = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    axis = to_center / wp.sqrt(distance2)
    x = frame_x(axis)
    around = sin_theta * point_at(TWO_PI * xi[1])
    sample.wi = wp.normalize((1.0 - h) * axis + around[0] * x + around[1] * wp.cross(axis, x))
    sample.end = crossing(light, s, sample.wi, to_center, -1.0)
    sample.weight = light.color * (TWO_PI * one_minus_cos)
    sample.area = 1
    return sample


# Functions from a scene's features to the device function of a kind. The keys are the names in wrt.scene.lights.LIGHTS, and "mesh" and
# "sphere" for emissive surfaces. Light.kind is the index in this table.
LIGHTS = {
    "point": lambda features: point_light,
    "directional": lambda features: directional_light,
    "spot": lambda features: spot_light,
    "mesh": make_mesh_light,
    "sphere": lambda features: sphere_light,
}
# Kinds whose sample takes no random numbers. A module that adds such a kind adds its name here, too.
WITHOUT_AREA = {"point", "directional", "spot"}


# --- all kinds of a scene ------------------------------------------------------------------------------------------------------


def make_light_sample(features: Features) -> Any:
    """Return the function that samples a light of any kind of the scene, one `if` after another (see materials.make_of_kind)."""
    light_sample = no_light
    for kind, name in reversed(list(enumerate(LIGHTS))):
        if name in features.lights:
            light_sample = make_link(kind, LIGHTS[name](features), light_sample)
    return light_sample


@wp.func
def no_light(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
    return LightSample()


def make_link(kind: int, function: Any, others: Any) -> Any:
    """Return the function that calls `function` for lights of this kind, and `others` for lights of all other kinds."""

    @wp.func
    def light_sample(lighting: Lighting, surfaces: Surfaces, light: Light, s: Surface, xi: wp.vec2) -> LightSample:
        if light.kind == wp.static(kind):
            return function(lighting, surfaces, light, s, xi)
        return others(lighting, surfaces, light, s, xi)

    return light_sample
