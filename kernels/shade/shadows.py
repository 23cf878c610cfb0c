"""Shadow rays: the share of a light that reaches a surface."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import exp
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import BLEND, Shading
from wrt.kernels.shade.surface import Surface, make_place_of, spawn_point
from wrt.kernels.structs import Hit, Material, Ray, Surfaces

OUTSIDE = wp.constant(-1)  # The medium of a ray that is outside all solid glass.
MAX_TRANSPARENT = wp.constant(256)  # A ray passes at most so many surfaces straight, in a row; then it is cut.


@wp.struct
class Shadow:
    """The transmittance of a shadow ray, and the number of rays traced for it."""

    transmittance: wp.vec3
    lost: wp.vec3  # The transmittance up to the cut; 0 if the ray was not cut.
    rays: int
    cut: int  # 1 if the ray met more than MAX_TRANSPARENT surfaces.


@wp.func
def attenuation(surfaces: Surfaces, medium: int, distance: float) -> wp.vec3:
    """Return Beer-Lambert's transmittance of material `medium` over a distance in world units."""
    sigma = surfaces.materials[medium].absorption
    return wp.vec3(exp(-sigma[0] * distance), exp(-sigma[1] * distance), exp(-sigma[2] * distance))


@wp.func
def covered(coverage: float, through: wp.vec3) -> wp.vec3:
    """Return the mean transmittance of a surface: `through` on the share `coverage` of its area, 1 on the rest."""
    return coverage * through + wp.vec3(1.0 - coverage, 1.0 - coverage, 1.0 - coverage)


@wp.struct
class Passage:
    """The transmittance of a shadow ray from its origin to the current point."""

    transmittance: wp.vec3  # Of all surfaces that the ray has passed, without the glass of `medium`.
    medium: int  # Material of the solid glass around the point, or OUTSIDE.
    coverage: float  # Alpha of this glass at the point where the ray entered it.
    inside: wp.vec3  # Transmittance of this glass so far, including the face where the ray entered.


@wp.func
def leave_glass(p: Passage) -> Passage:
    """Multiply the transmittance by that of the glass around the ray, if any, and set the medium to OUTSIDE."""
    out = Passage()
    out.transmittance = p.transmittance
    out.medium = OUTSIDE
    if p.medium >= 0:
        out.transmittance = wp.cw_mul(p.transmittance, covered(p.coverage, p.inside))
    return out


@wp.func
def is_opaque(m: Material) -> bool:
    """Return whether the material blocks all shadow rays, for any texture and direction."""
    return m.transmission <= 0.0 and m.alpha_mode != wp.static(BLEND)


def make_pass_surface(features: Features, scatter: Any, is_solid: Any) -> Any:
    """Return pass_surface(surfaces, passage, m, s, wo, distance) -> Passage behind surface s with material m."""

    @wp.func
    def straight_transmittance(m: Material, from_outside: Surface, wo: wp.vec3) -> wp.vec3:
        """Return the share of light that goes straight through a surface of alpha 1. from_outside: the surface, with front = 1.

        An unbent ray meets both faces of solid glass at the angle that it has outside. With front = 0, Fresnel's formula would
        find total reflection for some rays that leave the glass."""
        share = scatter(m, from_outside, wo, wp.vec3())
        if share.bends == 0:
            return share.transmitted
        if wp.static(features.tinted_shadows):
            return m.ior * m.ior * share.transmitted  # Undoes the 1 / ior^2 of `scatter`: an unbent beam keeps its solid angle.
        return wp.vec3(0.0, 0.0, 0.0)

    @wp.func
    def pass_surface(surfaces: Surfaces, before: Passage, m: Material, s: Surface, wo: wp.vec3, distance: float) -> Passage:
        """Return the passage behind surface s, which is `distance` (world units) from the last surface or the ray's origin.

        Solid glass that is blended has one alpha for the whole way through it: the alpha where the ray enters."""
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
            p = leave_glass(p)  # Glass in glass: each boundary counts as a boundary to air.
            p.medium = s.material
            p.coverage = coverage
            p.inside = through
        elif p.medium == s.material:
            p.inside = wp.cw_mul(p.inside, through)
            p = leave_glass(p)
        else:  # The ray began inside this glass.
            p = leave_glass(p)
            if wp.static(features.absorption):
                through = wp.cw_mul(through, attenuation(surfaces, s.material, distance))
            p.transmittance = wp.cw_mul(p.transmittance, covered(coverage, through))
        return p

    return pass_surface


@wp.struct
class ShadowWalk:
    """A shadow ray that passes one transparent surface after another."""

    ray: Ray  # The part that is not traced yet.
    end: wp.vec3  # Point on the light where the ray ends. Unread if the light is at infinity.
    passage: Passage
    surfaces: int  # Number of surfaces passed so far.
    shadow: Shadow  # The result, once done = 1.
    done: int  # 1 if the walk has ended, else 0.


@wp.func
def begin_shadow(ray: Ray, end: wp.vec3) -> ShadowWalk:
    walk = ShadowWalk()
    walk.ray = ray
    walk.end = end
    walk.passage.transmittance = wp.vec3(1.0, 1.0, 1.0)
    walk.passage.medium = OUTSIDE
    return walk


def make_pass_hit(features: Features, shading: Shading) -> Any:
    """Return pass_hit(surfaces, walk, hit) -> ShadowWalk: pass the surface at `hit`, or end the walk there if it is opaque."""
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
        if wp.static(features.clearcoat):
            s.smooth = s.shading
            m.clearcoat_roughness = 0.0
            if s.front == 0 and shading.is_solid(m):
                m.clearcoat = 0.0  # As in add_coat: light inside solid glass meets no coat. pass_surface takes each side as the front.
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
            if wp.dot(walk.ray.direction, d) <= 0.0:  # The light is within the rounding error of the surface's point.
                walk.shadow.transmittance = now.transmittance
                walk.done = 1
        return walk

    return pass_hit


def make_advance_shadow(features: Features, shading: Shading) -> Any:
    """Return advance_shadow(surfaces, walk, hit) -> ShadowWalk. The caller traces walk.ray and passes its closest hit."""
    pass_hit = make_pass_hit(features, shading)

    @wp.func
    def at_end(surfaces: Surfaces, before: ShadowWalk) -> ShadowWalk:
        walk = before
        p = walk.passage
        if wp.static(features.absorption):
            if p.medium >= 0 and walk.ray.t_max <= 1.0:  # The light is inside the glass.
                p.inside = wp.cw_mul(p.inside, attenuation(surfaces, p.medium, wp.length(walk.ray.direction)))
        p = leave_glass(p)
        walk.shadow.transmittance = p.transmittance
        walk.done = 1
        return walk

    @wp.func
    def advance_shadow(surfaces: Surfaces, before: ShadowWalk, hit: Hit) -> ShadowWalk:
        """Advance the walk past `hit`, the closest hit of the walk's ray. If `hit` is a miss, advance to the light."""
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
    """Return transmittance(accel, surfaces, ray, end) -> Shadow: trace the shadow ray `ray`, which ends at the point `end`.

    It takes one any-hit query. In scenes with transparent shadows, it takes one closest-hit query after another."""
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
