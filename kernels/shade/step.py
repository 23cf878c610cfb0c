"""The integrator's step: shades the hit of a path. It traces no rays; kernels/loops does.

It is Whitted 1980, "An Improved Illumination Model for Shaded Display", without recursion. A hit yields emission, the ambient term,
a shadow request for each light, and at most four new paths: straight on through a partly transparent surface, reflected, refracted,
and reflected by a clear coat. Each path carries its throughput. follow_up.py decides which paths are followed and which are cut."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.direct import make_reflected_light, shadow_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import COATED, ONWARD, REFLECTED, REFRACTED, UNKNOWN, Path, child
from wrt.kernels.shade.sampling import cap_point, make_sample_2d
from wrt.kernels.shade.shading import BLEND, Shading, Texels
from wrt.kernels.shade.shadows import OUTSIDE, Shadow, attenuation
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Lighting, Material, Ray, Surfaces, any_positive

FACET = wp.constant(2)  # Dimension of the samples that choose a microfacet; 0 is the film, 1 the lens.


@wp.struct
class Shaded:
    """The result of shading a path's hit. A path of throughput 0 means no path."""

    light: wp.vec3  # Emission and the ambient term, unless it is occluded.
    throughput: wp.vec3  # Weight of this surface's light in the sample.
    surface: Surface  # The surface at the hit, where shadow rays start.
    scatter: Scatter
    wo: wp.vec3  # Unit vector from the hit to the origin of the path's ray.
    key: wp.uint32  # Seed of the light samples.
    onward: Path  # Straight through a partly transparent surface.
    reflected: Path
    refracted: Path
    coated: Path  # Reflected by the clear coat.


@wp.struct
class ShadowRequest:
    """A shadow ray, and the radiance that it adds if nothing occludes the light."""

    value: wp.vec3  # Radiance towards the eye, if unoccluded. 0: there is no ray to trace.
    ray: Ray  # The shadow ray.
    end: wp.vec3  # Point on the light where the ray ends. Unread if the light is at infinity.


@wp.struct
class Sample:
    """The radiance along one camera ray, and counts of the rays traced and cut for it."""

    radiance: wp.vec3
    rays: int  # Number of rays, with shadow rays.
    cut_depth: int  # Number of rays cut by max_depth, MAX_TRANSPARENT or MAX_RAYS.
    cut_throughput: int  # Number of rays cut by min_throughput.
    lost: float  # Radiance (mean of channels) that the cut rays would have added if all surroundings had radiance 1.


@wp.func
def mean3(v: wp.vec3) -> float:
    return (v[0] + v[1] + v[2]) / 3.0


@wp.func
def absorbed(surfaces: Surfaces, throughput: wp.vec3, medium: int, distance: float) -> wp.vec3:
    """Return the throughput after `distance` (world units) in material `medium`. A negative medium absorbs nothing."""
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
    """A surface's own light. It is added to the sample together with the direct light, after the shadow rays are traced."""

    light: wp.vec3  # Shaded.light.
    throughput: wp.vec3  # Shaded.throughput.
    lost_reflected: float  # What the reflected path and that of a clear coat add to Sample.lost: 0 unless they are cut.
    lost_refracted: float  # What the refracted path adds to Sample.lost: 0 unless it is cut.


@wp.struct
class DirectLight:
    """The radiance that a surface reflects from all lights, and counts of its shadow rays."""

    radiance: wp.vec3
    lost: wp.vec3  # What the cut shadow rays would have added if the lights were surroundings of radiance 1.
    rays: int
    cut: int  # Number of shadow rays cut by MAX_TRANSPARENT.


@wp.func
def receives_light(scatter: Scatter) -> bool:
    """Return whether a surface with this scattering reflects direct light."""
    return any_positive(scatter.diffuse) or any_positive(scatter.highlight) or scatter.coat_exponent > 0.0


@wp.func
def add_light(before: DirectLight, value: wp.vec3, scatter: Scatter, shadow: Shadow) -> DirectLight:
    """Add one light to the direct light. value: the light's ShadowRequest.value."""
    out = before
    out.radiance += wp.cw_mul(value, shadow.transmittance)
    out.rays += shadow.rays
    if shadow.cut > 0:
        out.cut += shadow.cut
        out.lost += wp.cw_mul(scatter.diffuse + scatter.highlight, shadow.lost)
    return out


@wp.func
def add_surface_light(before: Sample, pending: PendingLight, direct: DirectLight) -> Sample:
    """Add a surface's pending light and its direct light to the sample."""
    out = before
    out.radiance += wp.cw_mul(pending.throughput, pending.light + direct.radiance)
    out.rays += direct.rays
    out.cut_depth += direct.cut
    if direct.cut > 0:
        out.lost += mean3(wp.cw_mul(pending.throughput, direct.lost))
    out.lost += pending.lost_reflected
    out.lost += pending.lost_refracted
    return out


def make_transparency(features: Features, is_solid: Any) -> Any:
    """Return transparency(m, surface, medium) -> share of a path that goes straight on."""

    @wp.func
    def transparency(m: Material, s: Surface, medium: int) -> float:
        """Return 1 - alpha for a blended surface, else 0.

        For solid glass, if the path's medium is known, the front decides for the back, too. A path that went straight through
        the front ignores the back (1). A path that was refracted at the front meets all of the back (0). Otherwise a path could
        enter unbent and leave with ior^2 of its light."""
        if m.alpha_mode != wp.static(BLEND):
            return 0.0
        if wp.static(features.refraction):
            if s.front == 0 and medium != UNKNOWN and is_solid(m):
                return wp.where(medium == s.material, 0.0, 1.0)
        return 1.0 - m.alpha

    return transparency


def make_straight_on(features: Features, is_solid: Any) -> Any:
    """Return straight_on(surfaces, path, m, surface, share, distance) -> Path behind a blended surface."""

    @wp.func
    def straight_on(surfaces: Surfaces, path: Path, m: Material, s: Surface, share: float, distance: float) -> Path:
        """Return the path that goes straight on with the share `share` of the throughput. This is no bounce: the depth stays."""
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


def make_shade(features: Features, shading: Shading) -> Any:
    """Return shade(surfaces, lighting, path, surface, texels, t, facet) -> Shaded."""
    transparency, straight_on = make_transparency(features, shading.is_solid), make_straight_on(features, shading.is_solid)

    @wp.func
    def medium_at(m: Material, s: Surface, medium: int) -> int:
        """Correct `medium` at solid glass: a ray at a back face is inside that glass; an UNKNOWN medium at a front face is OUTSIDE."""
        if not shading.is_solid(m):
            return medium
        return wp.where(s.front == 0, s.material, wp.where(medium == UNKNOWN, OUTSIDE, medium))

    @wp.func
    def shade(surfaces: Surfaces, lighting: Lighting, arriving: Path, surface: Surface, texels: Texels, t: float,
              facet: wp.vec3) -> Shaded:
        """Shade `surface`, which path `arriving` hits at distance t (world units). surface.shading: result of Shading.shading_normal."""
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
            if wp.static(features.clearcoat):
                out.light += scatter.below * emitted(m, s)
            else:
                out.light += emitted(m, s)
        if wp.static(features.reflection):
            out.reflected = child(path, s, scatter.reflection, wp.cw_mul(path.throughput, scatter.reflected), REFLECTED)
        if wp.static(features.refraction):
            out.refracted = child(path, s, scatter.refraction, wp.cw_mul(path.throughput, scatter.transmitted), REFRACTED)
            if scatter.bends != 0:
                out.refracted.medium = wp.where(s.front != 0, s.material, OUTSIDE)
        if wp.static(features.clearcoat):
            out.coated = child(path, s, scatter.coat_reflection, scatter.coated * path.throughput, COATED)
        return out

    return shade


class Step(NamedTuple):
    """The device functions that both loops call at a hit."""

    choose_facet: Any  # (key, index) -> vec3, a cap_point: the facet for `shade`, in sample `index` at the path with this key.
    shade: Any  # (surfaces, lighting, path, surface, texels, t, facet) -> Shaded.
    extra_lights: int  # Features.extra_lights: lights lighting.count and following are the background and the ambient term.
    sample_light: Any  # (lighting, surfaces, i, surface, point) -> LightSample of light i; `point` comes from LightPoints.
    shadow_request: Any  # (shaded, sample) -> ShadowRequest.


def make_step(features: Features, shading: Shading) -> Step:
    """Return the Step of a scene."""
    sample_2d = make_sample_2d(features)
    sample_light, reflected_light = make_reflected_light(features)

    @wp.func
    def choose_facet(key: wp.uint32, index: wp.uint32) -> wp.vec3:
        if wp.static(features.rough):
            return cap_point(sample_2d(key, index, FACET))
        return wp.vec3()

    @wp.func
    def shadow_request(shaded: Shaded, sample: LightSample) -> ShadowRequest:
        out = ShadowRequest()
        s = shaded.surface
        out.value = reflected_light(sample, s, shaded.scatter, shaded.wo)
        if any_positive(out.value):
            out.ray = shadow_ray(s, sample)
            out.end = sample.end
        return out

    return Step(choose_facet, make_shade(features, shading), features.extra_lights, sample_light, shadow_request)
