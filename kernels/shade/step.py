"""The integrator's step: what a surface does with a path that meets it. Nothing here traces a ray.

Whitted 1980, "An Improved Illumination Model for Shaded Display", without recursion. At a hit: emission and the ambient term,
a shadow ray asked for each light, and at most three new paths: straight on through what is partly transparent, reflected, and
refracted. Each carries its share of the picture (throughput). follow_up.py says which of them are followed; kernels/loops traces.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.direct import make_reflected_light, shadow_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import ONWARD, REFLECTED, REFRACTED, UNKNOWN, make_path, make_paths
from wrt.kernels.shade.sampling import cap_point, make_sample_2d
from wrt.kernels.shade.shading import BLEND, Shading, Texels
from wrt.kernels.shade.shadows import OUTSIDE, Shadow, attenuation
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Lighting, Material, Ray, Surfaces, any_positive

FACET = wp.constant(2)  # the dimension of what chooses a microfacet


@cache
def make_shaded(counting: bool) -> Any:
    """Return the struct Shaded, of which `shade` makes one of a path and a hit. counting: as of Features."""
    path_struct = make_path(counting)

    @wp.struct
    class Shaded:
        """light: emission and the ambient term; throughput: what light from here is worth in the picture. surface, scatter, key:
        what the lights are asked with. onward, reflected, refracted: the new paths; a throughput of 0 is none."""

        light: wp.vec3
        throughput: wp.vec3
        surface: Surface
        scatter: Scatter
        wo: wp.vec3
        key: wp.uint32
        onward: path_struct
        reflected: path_struct
        refracted: path_struct

    return Shaded


@wp.struct
class ShadowRequest:
    """value: the light that one lamp sends to the eye by way of a surface, if nothing is between them; 0: none, and nothing to
    trace. ray: the segment to look along, and end: where it ends."""

    value: wp.vec3
    ray: Ray
    end: wp.vec3


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


@wp.struct
class PendingLight:
    """A surface while its lights are asked: light and throughput as of Shaded; lost_reflected, lost_refracted: what is lost with
    those of its new paths that are cut (Sample.lost)."""

    light: wp.vec3
    throughput: wp.vec3
    lost_reflected: float
    lost_refracted: float


@wp.func
def receives_light(scatter: Scatter) -> bool:
    """Whether light from elsewhere can be seen on a surface."""
    return any_positive(scatter.diffuse) or any_positive(scatter.highlight)


@wp.func
def add_light(before: Shadow, value: wp.vec3, scatter: Scatter, shadow: Shadow) -> Shadow:
    """The light of all lamps so far, and of one more, whose ShadowRequest has this value."""
    out = before
    out.transmittance += wp.cw_mul(value, shadow.transmittance)
    out.rays += shadow.rays
    if shadow.cut > 0:
        out.cut += shadow.cut
        out.lost += wp.cw_mul(scatter.diffuse + scatter.highlight, shadow.lost)
    return out


@wp.func
def add_surface_light(before: Sample, pending: PendingLight, direct: Shadow) -> Sample:
    """A sample with what a surface sends to the eye. direct: in `transmittance` the radiance by the lights' rays, and in `lost`
    what was cut of it."""
    out = before
    out.radiance += wp.cw_mul(pending.throughput, pending.light + direct.transmittance)
    out.rays += direct.rays
    out.cut_depth += direct.cut
    if direct.cut > 0:
        out.lost += mean3(wp.cw_mul(pending.throughput, direct.lost))
    out.lost += pending.lost_reflected
    out.lost += pending.lost_refracted
    return out


def make_transparency(features: Features, is_solid: Any) -> Any:
    """How far a blended surface is not there."""

    @wp.func
    def transparency(m: Material, s: Surface, medium: int) -> float:
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

    return transparency


def make_choose_facet(features: Features) -> Any:
    """Return the function that draws a microfacet, where anything is rough."""
    sample_2d = make_sample_2d(features)

    @wp.func
    def choose_facet(key: wp.uint32, index: wp.uint32) -> wp.vec3:
        if wp.static(features.rough):
            return cap_point(sample_2d(key, index, FACET))
        return wp.vec3()

    return choose_facet


def make_straight_on(features: Features, is_solid: Any) -> Any:
    """Return the function for what goes on straight through a blended surface."""
    Path = make_path(features.counting)
    child = make_paths(features.counting).child

    @wp.func
    def straight_on(surfaces: Surfaces, path: Path, m: Material, s: Surface, share: float, distance: float) -> Path:
        """Return the part of a path that finds nothing at the surface. It takes no bounce."""
        onward = child(path, s, path.direction, share * path.throughput, ONWARD)
        onward.depth = path.depth
        onward.passed = path.passed + 1
        if wp.static(features.refraction):
            if path.medium == UNKNOWN and is_solid(m):
                onward.medium = OUTSIDE
        if wp.static(features.absorption):
            onward.throughput = absorbed(surfaces, onward.throughput, path.medium, distance)
        return onward

    return straight_on


def make_medium_at(is_solid: Any) -> Any:
    """Return the function for the medium of a ray at a surface."""

    @wp.func
    def medium_at(m: Material, s: Surface, medium: int) -> int:
        """Return the solid glass on the ray's side of a surface. A back is seen from within, whatever the path knows of."""
        if not is_solid(m):
            return medium
        return wp.where(s.front == 0, s.material, wp.where(medium == UNKNOWN, OUTSIDE, medium))

    return medium_at


def make_shade(features: Features, shading: Shading) -> Any:
    """Return one device function from a path and its hit to everything that follows from them."""
    Path, Shaded = make_path(features.counting), make_shaded(features.counting)
    child = make_paths(features.counting).child
    transparency, medium_at = make_transparency(features, shading.is_solid), make_medium_at(shading.is_solid)
    straight_on = make_straight_on(features, shading.is_solid)

    @wp.func
    def shade(surfaces: Surfaces, lighting: Lighting, arriving: Path, surface: Surface, texels: Texels, t: float,
              facet: wp.vec3) -> Shaded:
        """surface: the surface at the end of the path's ray, whose shading normal is as seen from there; its texels; t of the hit;
        facet: of choose_facet."""
        out = Shaded()
        path = arriving
        s = surface
        m = shading.resolve(surfaces, s, texels)
        out.wo = -path.direction
        if wp.static(features.blend):
            share = transparency(m, s, path.medium)
            if share > 0.0:
                out.onward = straight_on(surfaces, path, m, s, share, t)
                if share >= 1.0:
                    return out
                path.throughput = (1.0 - share) * path.throughput
        if wp.static(features.refraction):
            path.medium = medium_at(m, s, path.medium)
        if wp.static(features.absorption):
            path.throughput = absorbed(surfaces, path.throughput, path.medium, t)
        scatter = shading.scatter(m, s, out.wo, facet)
        out.throughput = path.throughput
        out.surface = s
        out.scatter = scatter
        out.key = path.key
        if wp.static(features.ambient):
            out.light = wp.cw_mul(scatter.diffuse, lighting.ambient)
        if wp.static(features.emission):
            out.light += emitted(m, s)
        if wp.static(features.reflection):
            out.reflected = child(path, s, scatter.reflection, wp.cw_mul(path.throughput, scatter.reflected), REFLECTED)
        if wp.static(features.refraction):
            out.refracted = child(path, s, scatter.refraction, wp.cw_mul(path.throughput, scatter.transmitted), REFRACTED)
            if scatter.bends != 0:
                out.refracted.medium = wp.where(s.front != 0, s.material, OUTSIDE)
        return out

    return shade


def make_shadow_request(features: Features, reflected: Any) -> Any:
    """Return the function for what a surface asks of a light. reflected: of make_reflected_light."""
    Shaded = make_shaded(features.counting)

    @wp.func
    def shadow_request(shaded: Shaded, sample: LightSample) -> ShadowRequest:
        out = ShadowRequest()
        s = shaded.surface
        out.value = reflected(sample, s, shaded.scatter, shaded.wo)
        if any_positive(out.value):
            out.ray = shadow_ray(s, sample)
            out.end = sample.end
        return out

    return shadow_request


class Step(NamedTuple):
    """The device functions that a loop is made of.

    choose_facet(key, index) -> vec3: the sample that chooses a microfacet at the end of a path with that key, for the sample
    `index` of a pixel. shade(surfaces, lighting, path, surface, texels, t, facet) -> Shaded.
    extra_lights: how many there are beside those of `lighting` (the background is one); choose(lighting, surfaces, i, surface,
    point) -> LightSample of light i (the background comes after the last one; point: of LightPoints), and shadow_request(shaded,
    sample) -> ShadowRequest.
    """

    choose_facet: Any
    shade: Any
    extra_lights: int
    choose: Any
    shadow_request: Any


def make_step(features: Features, shading: Shading) -> Step:
    """Return the step of a scene's kernel."""
    choose, reflected = make_reflected_light(features)
    return Step(make_choose_facet(features), make_shade(features, shading), 1 if features.sky_light else 0, choose,
                make_shadow_request(features, reflected))
