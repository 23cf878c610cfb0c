"""Shadow rays: what is left of a light on its way to a surface."""

import warp as wp

from wrt.kernels.shade.shading import BLEND
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Material, Ray, Surfaces

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
    return wp.vec3(wp.exp(-sigma[0] * distance), wp.exp(-sigma[1] * distance), wp.exp(-sigma[2] * distance))


@wp.func
def mixed(there: float, through: wp.vec3) -> wp.vec3:
    """What passes a thing that is there with this share, and where it is lets `through` through."""
    return there * through + wp.vec3(1.0 - there, 1.0 - there, 1.0 - there)


@wp.struct
class Passage:
    """Light on its way through surfaces, from the shadow ray's origin on.

    transmittance: of all that lies behind it; medium: the solid glass that it is in, or OUTSIDE; there: the share with which
    that glass is there (its alpha where it was entered), and inside: what it has let through so far where it is.
    """

    transmittance: wp.vec3
    medium: int
    there: float
    inside: wp.vec3


@wp.func
def left(p: Passage) -> Passage:
    """Out of the glass at hand, if any."""
    out = Passage()
    out.transmittance = p.transmittance
    out.medium = OUTSIDE
    if p.medium >= 0:
        out.transmittance = wp.cw_mul(p.transmittance, mixed(p.there, p.inside))
    return out


def make_pass_surface(features, scatter, is_solid):
    """One more surface on light's way."""

    @wp.func
    def let_through(m: Material, from_outside: Surface, wo: wp.vec3) -> wp.vec3:
        """Share of light that goes straight on through a surface which is there (alpha = 1).

        An unbent ray meets both sides of solid glass at its angle outside: from_outside.front must be 1, or a ray on its way
        out would be held for totally reflected.
        """
        share = scatter(m, from_outside, wo, wp.vec2(0.0, 0.0))
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
        through = let_through(m, s, wo)
        there = float(1.0)
        if wp.static(features.blend):
            there = wp.where(m.alpha_mode == wp.static(BLEND), m.alpha, 1.0)
        if wp.static(features.absorption):
            if p.medium >= 0:
                p.inside = wp.cw_mul(p.inside, attenuation(surfaces, p.medium, distance))
        if not is_solid(m):
            p.transmittance = wp.cw_mul(p.transmittance, mixed(there, through))
        elif inward:
            p = left(p)  # glass within glass: each boundary is one to air
            p.medium = s.material
            p.there = there
            p.inside = through
        elif p.medium == s.material:
            p.inside = wp.cw_mul(p.inside, through)
            p = left(p)
        else:  # the ray began inside
            p = left(p)
            if wp.static(features.absorption):
                through = wp.cw_mul(through, attenuation(surfaces, s.material, distance))
            p.transmittance = wp.cw_mul(p.transmittance, mixed(there, through))
        return p

    return pass_surface


def make_transmittance(features, shading, accel_struct, closest_hit, any_hit):
    """Shadow rays: one any-hit query, or where a scene lets light through surfaces, one closest hit after another."""
    surface_at, resolve, shading_normal, scatter, is_solid = shading
    pass_surface = make_pass_surface(features, scatter, is_solid)

    @wp.func
    def through_surfaces(accel: accel_struct, surfaces: Surfaces, first: Ray, end: wp.vec3) -> Shadow:
        out = Shadow()
        p = Passage()
        p.transmittance = wp.vec3(1.0, 1.0, 1.0)
        p.medium = OUTSIDE
        ray = first
        for i in range(MAX_TRANSPARENT + 1):
            out.rays += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                if wp.static(features.absorption):
                    if p.medium >= 0 and ray.t_max <= 1.0:  # the light is inside it
                        p.inside = wp.cw_mul(p.inside, attenuation(surfaces, p.medium, wp.length(ray.direction)))
                p = left(p)
                out.transmittance = p.transmittance
                return out
            if i == MAX_TRANSPARENT:
                break
            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            m.roughness = 0.0
            d = wp.normalize(ray.direction)
            s.shading = shading_normal(surfaces, m, s, -d)
            p = pass_surface(surfaces, p, m, s, -d, hit.t * wp.length(ray.direction))
            now = left(p)
            if wp.max(now.transmittance) <= 0.0:
                return out
            ray.origin = spawn_point(s.point, s.error, s.geometric, d)
            ray.exclude_plus_one = s.exclude_plus_one
            if ray.t_max <= 1.0:
                ray.direction = end - ray.origin
                if wp.dot(ray.direction, d) <= 0.0:  # the light is within the surface's rounding error
                    out.transmittance = now.transmittance
                    return out
        p = left(p)
        out.lost = p.transmittance
        out.cut = 1
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
