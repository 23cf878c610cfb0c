"""Shadow rays: what is left of a light on its way to a surface."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import exp
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import BLEND, Shading
from wrt.kernels.shade.surface import Surface, make_place_of, spawn_point
from wrt.kernels.structs import Hit, Material, Ray, Surfaces

OUTSIDE = wp.constant(-1)  # of any glass
MAX_TRANSPARENT = wp.constant(256)  # surfaces in a row that a ray may go straight through


@wp.struct
class Shadow:
    """What is left of the light on a shadow ray, and how many rays it took to know.

    cut: 1 where the ray met more than MAX_TRANSPARENT surfaces; `lost` is what it still had, and transmittance 0.
    """

    transmittance: wp.vec3
    lost: wp.vec3
    rays: int
    cut: int


@wp.func
def attenuation(surfaces: Surfaces, medium: int, distance: float) -> wp.vec3:
    """Beer-Lambert over a distance in world units."""
    sigma = surfaces.materials[medium].absorption
    return wp.vec3(exp(-sigma[0] * distance), exp(-sigma[1] * distance), exp(-sigma[2] * distance))


@wp.func
def covered(coverage: float, through: wp.vec3) -> wp.vec3:
    """What passes a thing that is there with this share, and where it is lets `through` through."""
    return coverage * through + wp.vec3(1.0 - coverage, 1.0 - coverage, 1.0 - coverage)


@wp.struct
class Passage:
    """Light on its way through surfaces, from the shadow ray's origin on.

    transmittance: of all that lies behind it; medium: the solid glass that it is in, or OUTSIDE; coverage: the share with which
    that glass is there (its alpha where it was entered), and inside: what it has let through so far where it is.
    """

    transmittance: wp.vec3
    medium: int
    coverage: float
    inside: wp.vec3


@wp.func
def leave_glass(p: Passage) -> Passage:
    """Out of the glass at hand, if any."""
    out = Passage()
    out.transmittance = p.transmittance
    out.medium = OUTSIDE
    if p.medium >= 0:
        out.transmittance = wp.cw_mul(p.transmittance, covered(p.coverage, p.inside))
    return out


@wp.func
def is_opaque(m: Material) -> bool:
    """Whether no light goes straight through, whatever the textures say and wherever it comes from."""
    return m.transmission <= 0.0 and m.alpha_mode != wp.static(BLEND)


def make_pass_surface(features: Features, scatter: Any, is_solid: Any) -> Any:
    """One more surface on light's way."""

    @wp.func
    def straight_transmittance(m: Material, from_outside: Surface, wo: wp.vec3) -> wp.vec3:
        """Share of light that goes straight on through a surface which is there (alpha = 1).

        An unbent ray meets both sides of solid glass at its angle outside: from_outside.front must be 1, or a ray on its way
        out would be held for totally reflected.
        """
        share = scatter(m, from_outside, wo, wp.vec3())
        if share.bends == 0:
            return share.transmitted
        if wp.static(features.tinted_shadows):
            return m.ior * m.ior * share.transmitted  # straight through, the solid angle is not squeezed
        return wp.vec3(0.0, 0.0, 0.0)

    @wp.func
    def pass_surface(surfaces: Surfaces, before: Passage, m: Material, s: Surface, wo: wp.vec3, distance: float) -> Passage:
        """distance: in world units, from the last surface or the ray's origin.

        Blended solid glass is there as a whole or not at all, with its alpha where it is entered.
        """
        p = before
        inward = s.front != 0
        s.front = 1
        through = straight_transmittance(m, s, wo)
        coverage = float(1.0)
        if wp.static(features.blend):
            coverage = wp.where(m.alpha_mode == wp.static(BLEND), m.alpha, 1.0)
        if wp.static(features.absorption):
            if p.medium >= 0:
                p.inside = wp.cw_mul(p.inside, attenuation(surfaces, p.medium, distance))
        if not is_solid(m):
            p.transmittance = wp.cw_mul(p.transmittance, covered(coverage, through))
        elif inward:
            p = leave_glass(p)  # glass within glass: each boundary is one to air
            p.medium = s.material
            p.coverage = coverage
            p.inside = through
        elif p.medium == s.material:
            p.inside = wp.cw_mul(p.inside, through)
            p = leave_glass(p)
        else:  # the ray began inside
            p = leave_glass(p)
            if wp.static(features.absorption):
                through = wp.cw_mul(through, attenuation(surfaces, s.material, distance))
            p.transmittance = wp.cw_mul(p.transmittance, covered(coverage, through))
        return p

    return pass_surface


@wp.struct
class ShadowWalk:
    """A shadow ray on its way through surfaces. ray: what is left of it, and end: where the segment ends; surfaces: how many it has
    met; shadow: what is known when done = 1."""

    ray: Ray
    end: wp.vec3
    passage: Passage
    surfaces: int
    shadow: Shadow
    done: int


@wp.func
def begin_shadow(ray: Ray, end: wp.vec3) -> ShadowWalk:
    walk = ShadowWalk()
    walk.ray = ray
    walk.end = end
    walk.passage.transmittance = wp.vec3(1.0, 1.0, 1.0)
    walk.passage.medium = OUTSIDE
    return walk


def make_pass_hit(features: Features, shading: Shading) -> Any:
    """Return pass_hit(surfaces, walk, hit) -> ShadowWalk: through the closest surface on the way, or no farther."""
    place_of = make_place_of(features.instances)
    pass_surface = make_pass_surface(features, shading.scatter, shading.is_solid)

    @wp.func
    def pass_hit(surfaces: Surfaces, before: ShadowWalk, hit: Hit) -> ShadowWalk:
        walk = before
        if is_opaque(surfaces.materials[place_of(surfaces, hit.prim_id).material]):
            walk.done = 1
            return walk
        ray = walk.ray
        s = shading.surface_at(surfaces, ray, hit)
        texels = shading.look_up(surfaces, s)
        m = shading.resolve(surfaces, s, texels)
        m.roughness = 0.0
        d = wp.normalize(ray.direction)
        s.shading = shading.shading_normal(surfaces, s, texels, -d)
        walk.passage = pass_surface(surfaces, walk.passage, m, s, -d, hit.t * wp.length(ray.direction))
        now = leave_glass(walk.passage)
        if wp.max(now.transmittance) <= 0.0:
            walk.done = 1
            return walk
        walk.ray.origin = spawn_point(s.point, s.error, s.geometric, d)
        walk.ray.exclude_plus_one = s.exclude_plus_one
        if ray.t_max <= 1.0:
            walk.ray.direction = walk.end - walk.ray.origin
            if wp.dot(walk.ray.direction, d) <= 0.0:  # the light is within the surface's rounding error
                walk.shadow.transmittance = now.transmittance
                walk.done = 1
        return walk

    return pass_hit


def make_advance_shadow(features: Features, shading: Shading) -> Any:
    """Return advance_shadow(surfaces, walk, hit) -> ShadowWalk. Nothing here traces a ray."""
    pass_hit = make_pass_hit(features, shading)

    @wp.func
    def at_end(surfaces: Surfaces, before: ShadowWalk) -> ShadowWalk:
        walk = before
        p = walk.passage
        if wp.static(features.absorption):
            if p.medium >= 0 and walk.ray.t_max <= 1.0:  # the light is inside it
                p.inside = wp.cw_mul(p.inside, attenuation(surfaces, p.medium, wp.length(walk.ray.direction)))
        p = leave_glass(p)
        walk.shadow.transmittance = p.transmittance
        walk.done = 1
        return walk

    @wp.func
    def advance_shadow(surfaces: Surfaces, before: ShadowWalk, hit: Hit) -> ShadowWalk:
        """hit: the closest one of walk.ray."""
        walk = before
        walk.shadow.rays += 1
        if hit.prim_id < 0:
            return at_end(surfaces, walk)
        if walk.surfaces == MAX_TRANSPARENT:
            p = leave_glass(walk.passage)
            walk.shadow.lost = p.transmittance
            walk.shadow.cut = 1
            walk.done = 1
            return walk
        walk.surfaces += 1
        return pass_hit(surfaces, walk, hit)

    return advance_shadow


def make_transmittance(features: Features, shading: Shading, accel_struct: Any, closest_hit: Any, any_hit: Any) -> Any:
    """Shadow rays: one any-hit query, or where a scene lets light through surfaces, one closest hit after another."""
    advance_shadow = make_advance_shadow(features, shading)

    @wp.func
    def transmittance(accel: accel_struct, surfaces: Surfaces, ray: Ray, end: wp.vec3) -> Shadow:
        out = Shadow()
        if wp.static(features.transparent_shadows):
            walk = begin_shadow(ray, end)
            while walk.done == 0:
                walk = advance_shadow(surfaces, walk, closest_hit(accel, surfaces, walk.ray))
            out = walk.shadow
        else:
            out.rays = 1
            hit = any_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.transmittance = wp.vec3(1.0, 1.0, 1.0)
        return out

    return transmittance
