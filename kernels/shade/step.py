"""The integrator's step: what a surface does with a path that meets it. Nothing here traces a ray.

Whitted 1980, "An Improved Illumination Model for Shaded Display", without recursion. At a hit: emission and the ambient term,
a shadow ray asked for each light, and at most three new paths: straight on through what is partly transparent, reflected, and
refracted. Each carries what it will be worth (throughput); a path is cut at max_depth bounces, after MAX_TRANSPARENT surfaces
that it went straight through, or below min_throughput, and counted. So is what comes after MAX_RAYS: where nothing is cut by
throughput, a tree of 64 levels has no end. kernels/loops traces.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.direct import make_reflected_light, shadow_ray
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.sampling import cap_point, hash_pair, make_sample_2d
from wrt.kernels.shade.shading import BLEND, Texels
from wrt.kernels.shade.shadows import MAX_TRANSPARENT, OUTSIDE, Shadow, attenuation
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Lighting, Limits, Material, Ray, Surfaces, any_positive, make_ray

MAX_RAYS = wp.constant(1 << 16)  # behind one camera ray, without those to lights: a whole tree of 15 bounces
UNKNOWN = wp.constant(-2)  # where a camera ray begins: within glass, or not
FACET = wp.constant(2)  # the dimension of what chooses a microfacet
BRANCHES = wp.constant(4)  # camera, reflection, refraction, straight on: the numbers that make_step gives its new paths


@wp.func
def label(branch: int, depth: int) -> int:
    """What Ray.slot of a path's ray holds until it is logged. A shadow ray has 0: it belongs to the path's ray before it."""
    return 1 + branch + BRANCHES * depth


@cache
def make_path(counting: bool) -> Any:
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


@cache
def make_shaded(counting: bool) -> Any:
    """What `shade` makes of a path and a hit."""
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
class Lit:
    """A surface while its lights are asked: light and throughput as of Shaded; reflected, refracted: what is lost with those of its
    new paths that are cut (Sample.lost)."""

    light: wp.vec3
    throughput: wp.vec3
    reflected: float
    refracted: float


@wp.func
def is_lit(scatter: Scatter) -> bool:
    """Whether light from elsewhere can be seen on a surface."""
    return any_positive(scatter.diffuse) or any_positive(scatter.highlight)


@wp.func
def lit_by(before: Shadow, value: wp.vec3, scatter: Scatter, shadow: Shadow) -> Shadow:
    """The light of all lamps so far, and of one more, whose ShadowRequest has this value."""
    out = before
    out.transmittance += wp.cw_mul(value, shadow.transmittance)
    out.rays += shadow.rays
    if shadow.cut > 0:
        out.cut += shadow.cut
        out.lost += wp.cw_mul(scatter.diffuse + scatter.highlight, shadow.lost)
    return out


@wp.func
def add_up(before: Sample, lit: Lit, direct: Shadow) -> Sample:
    """A sample with what a surface sends to the eye. direct: in `transmittance` the radiance by the lights' rays, and in `lost`
    what was cut of it."""
    out = before
    out.radiance += wp.cw_mul(lit.throughput, lit.light + direct.transmittance)
    out.rays += direct.rays
    out.cut_depth += direct.cut
    if direct.cut > 0:
        out.lost += mean3(wp.cw_mul(lit.throughput, direct.lost))
    out.lost += lit.reflected
    out.lost += lit.refracted
    return out


@wp.func
def counted(before: Sample, verdict: int) -> Sample:
    """A sample with one more new path; verdict: of Step.keep."""
    out = before
    out.cut_depth += wp.where(verdict == 2, 1, 0)
    out.cut_throughput += wp.where(verdict == 3, 1, 0)
    return out


class Step(NamedTuple):
    """What a loop is made of.

    Path: the struct; first_path(ray, key); ray_of(path). choose_facet(key, index) -> vec3: what chooses a microfacet at the end of
    a path with that key, for the sample `index`. shade(surfaces, lighting, path, met, texels, t, facet) ->
    Shaded.
    extra_lights: how many there are beside those of `lighting` (the background is one); choose(lighting, surfaces, i, surface,
    point) -> LightSample of light i (the background comes after the last one; point: of LightPoints), and shadow_request(shaded,
    sample) -> ShadowRequest. keep(path, limits, traced): whether a new path is followed, and
    worth(surfaces, path, verdict) what is lost where it is not.
    """

    Path: Any
    first_path: Any
    ray_of: Any
    choose_facet: Any
    shade: Any
    extra_lights: int
    choose: Any
    shadow_request: Any
    keep: Any
    worth: Any


def make_step(features: Any, shading: Any, counting: bool = False) -> Any:
    """The step of a scene's kernel. `features`: wrt.renderer.features.Features; `shading`: of make_shading."""
    Path = make_path(counting)
    first_path, ray_of, child = make_paths(counting)
    return Step(Path, first_path, ray_of, make_choose_facet(features), make_shade(features, shading, child, counting),
                1 if features.sky_light else 0, *make_shadow_request(features, counting), *make_keep(features, counting))


def make_paths(counting: bool = False) -> Any:
    """Where paths begin: at the camera, or at a surface."""
    Path = make_path(counting)

    @wp.func
    def first_path(camera_ray: Ray, key: wp.uint32) -> Path:
        path = Path()
        path.origin = camera_ray.origin
        path.direction = camera_ray.direction
        path.throughput = wp.vec3(1.0, 1.0, 1.0)
        path.medium = UNKNOWN
        path.key = key
        return path

    @wp.func
    def ray_of(path: Path) -> Ray:
        ray = make_ray(path.origin, path.direction)
        ray.exclude_plus_one = path.exclude_plus_one
        if wp.static(counting):
            ray.slot = label(path.branch, path.depth)
        return ray

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

    return first_path, ray_of, child


def make_missing(features: Any, is_solid: Any) -> Any:
    """How far a blended surface is not there."""

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

    return missing


def make_choose_facet(features: Any) -> Any:
    """Nothing is drawn where nothing is rough."""
    sample_2d = make_sample_2d(features)

    @wp.func
    def choose_facet(key: wp.uint32, index: wp.uint32) -> wp.vec3:
        if wp.static(features.rough):
            return cap_point(sample_2d(key, index, FACET))
        return wp.vec3()

    return choose_facet


def make_shade(features: Any, shading: Any, child: Any, counting: bool = False) -> Any:
    """One device function from a path and its hit to everything that follows from them."""
    Path, Shaded = make_path(counting), make_shaded(counting)
    _, _, resolve, _, scatter_at, is_solid = shading
    missing = make_missing(features, is_solid)

    @wp.func
    def medium_at(m: Material, s: Surface, medium: int) -> int:
        """The solid glass on the ray's side of a surface. A back is seen from within, whatever the path knows of."""
        if not is_solid(m):
            return medium
        return wp.where(s.front == 0, s.material, wp.where(medium == UNKNOWN, OUTSIDE, medium))

    @wp.func
    def straight_on(surfaces: Surfaces, path: Path, m: Material, s: Surface, share: float, distance: float) -> Path:
        """The part of a path that finds nothing at a blended surface. It takes no bounce."""
        onward = child(path, s, path.direction, share * path.throughput, 3)
        onward.depth = path.depth
        onward.passed = path.passed + 1
        if wp.static(features.refraction):
            if path.medium == UNKNOWN and is_solid(m):
                onward.medium = OUTSIDE
        if wp.static(features.absorption):
            onward.throughput = absorbed(surfaces, onward.throughput, path.medium, distance)
        return onward

    @wp.func
    def shade(surfaces: Surfaces, lighting: Lighting, arriving: Path, met: Surface, texels: Texels, t: float,
              facet: wp.vec3) -> Shaded:
        """met: the surface at the end of the path's ray (of ray_of), whose shading normal is as seen from there; its texels; t of
        the hit; facet: of choose_facet."""
        out = Shaded()
        path = arriving
        s = met
        m = resolve(surfaces, s, texels)
        out.wo = -path.direction
        if wp.static(features.blend):
            share = missing(m, s, path.medium)
            if share > 0.0:
                out.onward = straight_on(surfaces, path, m, s, share, t)
                if share >= 1.0:
                    return out
                path.throughput = (1.0 - share) * path.throughput
        if wp.static(features.refraction):
            path.medium = medium_at(m, s, path.medium)
        if wp.static(features.absorption):
            path.throughput = absorbed(surfaces, path.throughput, path.medium, t)
        scatter = scatter_at(m, s, out.wo, facet)
        out.throughput = path.throughput
        out.surface = s
        out.scatter = scatter
        out.key = path.key
        if wp.static(features.ambient):
            out.light = wp.cw_mul(scatter.diffuse, lighting.ambient)
        if wp.static(features.emission):
            out.light += emitted(m, s)
        if wp.static(features.reflection):
            out.reflected = child(path, s, scatter.reflection, wp.cw_mul(path.throughput, scatter.reflected), 1)
        if wp.static(features.refraction):
            out.refracted = child(path, s, scatter.refraction, wp.cw_mul(path.throughput, scatter.transmitted), 2)
            if scatter.bends != 0:
                out.refracted.medium = wp.where(s.front != 0, s.material, OUTSIDE)
        return out

    return shade


def make_shadow_request(features: Any, counting: bool = False) -> Any:
    """What a surface asks of a light."""
    Shaded = make_shaded(counting)
    choose, reflected = make_reflected_light(features)

    @wp.func
    def shadow_request(shaded: Shaded, sample: LightSample) -> ShadowRequest:
        out = ShadowRequest()
        s = shaded.surface
        out.value = reflected(sample, s, shaded.scatter, shaded.wo)
        if any_positive(out.value):
            out.ray = shadow_ray(s, sample)
            out.end = sample.end
        return out

    return choose, shadow_request


def make_keep(features: Any, counting: bool = False) -> Any:
    """Which paths are followed, and what is lost with those that are not."""
    Path = make_path(counting)

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
    def worth(surfaces: Surfaces, next: Path, verdict: int) -> float:
        """What is lost with a path that is cut; 0 for one that is not."""
        if verdict < 2:
            return 0.0
        worth = mean3(next.throughput)
        if wp.static(features.refraction):
            if next.medium >= 0:  # within, light is denser, and the throughput was divided by as much
                worth = worth * surfaces.materials[next.medium].ior * surfaces.materials[next.medium].ior
        return worth

    return keep, worth
