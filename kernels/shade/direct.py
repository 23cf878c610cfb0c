"""Direct light: the shadow ray and the reflected radiance of one sample of a light."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.backgrounds import make_sky_point, make_sky_sample
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LIGHTS, WITHOUT_AREA, LightSample, make_light_sample
from wrt.kernels.shade.materials import Scatter, blinn_phong
from wrt.kernels.shade.sampling import PI, cosine_point, hash_pair, make_sample_2d, rotated_to
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Lighting, Ray, Surfaces, any_positive, gamma, make_ray

AMBIENT = wp.constant(2)  # LightSample.area of the ambient term, which has no highlight.


@wp.func
def shadow_ray(s: Surface, sample: LightSample) -> Ray:
    """Return the shadow ray from a surface to a light sample. It ends at the light, at t = 1, unless the light is at infinity.

    For a light with an area, t_max is 32 roundings below 1, so that the light does not occlude itself. Direction and t have rounding
    errors of about 16 ulps, which grow with the distance. The error bound of the light's point does not cover them."""
    ray = make_ray(spawn_point(s.point, s.error, s.geometric, sample.wi), sample.wi)
    ray.exclude_plus_one = s.exclude_plus_one
    if sample.distant == 0:
        ray.direction = sample.end - ray.origin
        ray.t_max = wp.where(sample.area != 0, 1.0 - gamma(32.0), 1.0)
    return ray


@wp.func
def ambient_sample(lighting: Lighting, s: Surface, point: wp.vec3) -> LightSample:
    """Sample the ambient term: a direction by the cosine, whose shadow ray ends at lighting.ambient_radius. point: a cosine_point.

    The mean is the ambient occlusion of Zhukov, Iones, Kronin 1998, "An Ambient Light Illumination Model", with visibility 0 or 1."""
    sample = LightSample()
    sample.wi = rotated_to(point, s.shading)
    sample.weight = lighting.ambient * (PI / wp.max(wp.dot(sample.wi, s.shading), 1.0e-9))
    sample.end = s.point + lighting.ambient_radius * sample.wi
    sample.area = AMBIENT
    return sample


def make_reflected_light(features: Features) -> Any:
    """Return sample_light, and reflected_light, the radiance that a surface reflects from an unoccluded light sample towards wo."""
    light_sample = make_light_sample(features)
    sky_sample = make_sky_sample(features)
    lights, ambient = bool(features.lights), features.extra_lights - 1

    @wp.func
    def sample_light(lighting: Lighting, surfaces: Surfaces, i: int, s: Surface, point: wp.vec3) -> LightSample:
        """Sample light i, the background or the ambient term (Features.extra_lights). `point` comes from LightPoints.point."""
        sample = LightSample()
        if wp.static(lights):
            if i < lighting.count:
                sample = light_sample(lighting, surfaces, lighting.lights[i], s, wp.vec2(point[0], point[1]))
        if wp.static(features.sky_light):
            if i == lighting.count:
                sample = sky_sample(lighting.background, s.shading, point)
        if wp.static(features.ambient_occlusion):
            if i == lighting.count + wp.static(ambient):
                sample = ambient_sample(lighting, s, point)
        return sample

    @wp.func
    def reflected_light(sample: LightSample, s: Surface, scatter: Scatter, wo: wp.vec3) -> wp.vec3:
        cosine = wp.dot(s.shading, sample.wi)
        if cosine <= 0.0 or wp.dot(s.geometric, sample.wi) <= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        value = scatter.diffuse / PI
        if wp.static(features.highlight):
            # A traced reflection finds area lights by itself. The background has no highlight: it is no small light.
            if sample.area == 0 or (scatter.traced == 0 and sample.distant == 0 and sample.area != AMBIENT):
                if any_positive(scatter.highlight):
                    value = value + scatter.highlight * blinn_phong(s.shading, sample.wi, wo, scatter.exponent)
            if wp.static(features.clearcoat):
                if sample.area == 0 and scatter.coat_exponent > 0.0:
                    share = scatter.coated * wp.max(0.0, wp.dot(s.smooth, sample.wi)) / cosine
                    glint = share * blinn_phong(s.smooth, sample.wi, wo, scatter.coat_exponent)
                    value = value + wp.vec3(glint, glint, glint)
        return cosine * wp.cw_mul(value, sample.weight)

    return sample_light, reflected_light


class LightPoints(NamedTuple):
    """The functions for random points on light i. key: seed of the hit that the light illuminates. index: index of the sample."""

    xi: Any  # (key, index, i) -> vec2 in [0, 1)^2, which places a sample on light i.
    # (lighting, key, index, i) -> vec3: sky_point(xi) for the background, cosine_point(xi) for the ambient term, else (xi[0], xi[1], 0).
    point: Any


def make_light_points(features: Features) -> LightPoints:
    """Return the LightPoints of a scene."""
    sample_2d = make_sample_2d(features)
    sky_point, ambient = make_sky_point(features), features.extra_lights - 1
    single = {kind for kind, name in enumerate(LIGHTS) if name in features.lights and name in WITHOUT_AREA}
    is_single = wp.types.vector(len(LIGHTS), int)(*(int(kind in single) for kind in range(len(LIGHTS))))

    @wp.func
    def light_xi(key: wp.uint32, index: wp.uint32, i: int) -> wp.vec2:
        return sample_2d(hash_pair(key, wp.static(wp.uint32(0x4C49))), index, i)

    @wp.func
    def light_point(lighting: Lighting, key: wp.uint32, index: wp.uint32, i: int) -> wp.vec3:
        if wp.static(bool(single)):
            if i < lighting.count:
                if is_single[lighting.lights[i].kind] != 0:
                    return wp.vec3(0.0, 0.0, 0.0)
        xi = light_xi(key, index, i)
        if wp.static(features.sky_light):
            if i == lighting.count:
                return sky_point(xi)
        if wp.static(features.ambient_occlusion):
            if i == lighting.count + wp.static(ambient):
                return cosine_point(xi)
        return wp.vec3(xi[0], xi[1], 0.0)

    return LightPoints(light_xi, light_point)
