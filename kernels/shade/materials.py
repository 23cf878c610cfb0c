"""Material kinds: how a surface scatters light, and the directions of new rays. Each kind is a function and an entry of MATERIALS."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import LOG_2, exp, power
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import PI, ggx_normal, ggx_visible_share
from wrt.kernels.shade.surface import Surface, visible_normal
from wrt.kernels.structs import Material

SMOOTH = wp.constant(1.0e-4)  # Largest GGX alpha of a smooth surface: its facets deviate by less than float32 directions resolve.

COAT_IOR = wp.constant(1.5)  # Index of refraction of a clear coat (KHR_materials_clearcoat).


@wp.struct
class Scatter:
    """Weights and directions of the light that a surface scatters. A weight of 0 means no ray."""

    reflected: wp.vec3  # Weight of the ray in direction `reflection`, on the side of wo.
    reflection: wp.vec3
    transmitted: wp.vec3  # Weight of the ray in direction `refraction`, on the other side.
    refraction: wp.vec3
    bends: int  # 1 if the transmitted ray enters another medium, else 0.
    diffuse: wp.vec3  # Albedo of Lambert's law.
    highlight: wp.vec3  # Colour of the highlight of lights that no ray can hit.
    exponent: float  # Exponent of the highlight (blinn_phong).
    traced: int  # 1 if reflected rays find area lights, so that these have no highlight.
    below: float  # Share of the light that the clear coat leaves to everything below it.
    coated: float  # Weight of the ray in direction `coat_reflection`, which the clear coat reflects.
    coat_reflection: wp.vec3
    coat_exponent: float  # Exponent of the highlight of a rough clear coat; 0: none.


# --- Fresnel's formulas: the reflectance of a smooth boundary ----------------------------------------------------------------------


@wp.func
def fresnel_dielectric(cos_i: float, eta: float) -> float:
    """Return the reflectance of a dielectric for unpolarised light; 1 at total internal reflection (Born and Wolf, section 1.5).

    cos_i >= 0 is the cosine of the angle of incidence. eta: the refractive index behind the boundary, divided by that in front."""
    sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
    if sin2_t >= 1.0:
        return 1.0
    cos_t = wp.sqrt(1.0 - sin2_t)
    parallel = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    perpendicular = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular)


@wp.func
def fresnel_schlick(cos_i: float, eta: float) -> float:
    """Return Schlick's approximation (1994) of fresnel_dielectric. It uses the cosine in the medium of lower index."""
    c = cos_i
    if eta < 1.0:
        sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
        if sin2_t >= 1.0:
            return 1.0
        c = wp.sqrt(1.0 - sin2_t)
    r = (eta - 1.0) / (eta + 1.0)
    m = 1.0 - c
    return r * r + (1.0 - r * r) * m * m * m * m * m


@wp.func
def contrast(a: float, b: float) -> float:
    """Return (a - b) / (a + b), or 1 if both are 0, as in the limit of grazing incidence."""
    return wp.where(a + b > 0.0, (a - b) / (a + b), 1.0)


@wp.func
def fresnel_conductor(cos_i: float, eta: float, k: float) -> float:
    """Return the reflectance of a metal of index eta + i k for unpolarised light (Born and Wolf, section 14.2)."""
    c2 = cos_i * cos_i
    s2 = 1.0 - c2
    t0 = eta * eta - k * k - s2
    a2_b2 = wp.sqrt(t0 * t0 + 4.0 * eta * eta * k * k)
    a = wp.sqrt(wp.max(0.0, 0.5 * (a2_b2 + t0)))
    t1 = a2_b2 + c2
    t2 = 2.0 * a * cos_i
    perpendicular = contrast(t1, t2)
    t3 = c2 * a2_b2 + s2 * s2
    t4 = t2 * s2
    parallel = perpendicular * contrast(t3, t4)
    return 0.5 * (perpendicular + parallel)


@wp.func
def fresnel_tint(cos_i: float, f0: wp.vec3) -> wp.vec3:
    """Return Schlick's reflectance of glTF 2.0's metals, from the colour f0 at normal incidence to white at grazing incidence."""
    m = 1.0 - cos_i
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m * m * m * m * m)


# --- highlights of lights without area -----------------------------------------------------------------------------------------


@wp.func
def blinn_phong(n: wp.vec3, wi: wp.vec3, wo: wp.vec3, exponent: float) -> float:
    """Return Blinn's highlight per steradian, scaled so that at normal incidence no more light leaves than arrives.

    `(e + 2)(e + 4) / (8 pi (2^(-e/2) + e)) cos^e` (Akenine-Moeller et al. 2008, "Real-Time Rendering", 3rd ed., section 7.6)."""
    h = wp.normalize(wi + wo)
    scale = (exponent + 2.0) * (exponent + 4.0) / (8.0 * PI * (exp(-0.5 * LOG_2 * exponent) + exponent))
    return scale * power(wp.max(0.0, wp.dot(n, h)), exponent)


@wp.func
def highlight_exponent(alpha: float) -> float:
    """Return the exponent of a highlight as wide as the reflection of a rough surface (Walter et al. 2007, eq. 41)."""
    return wp.min(2.0 / (alpha * alpha) - 2.0, 1.0e5)


@wp.func
def with_highlight(m: Material, before: Scatter) -> Scatter:
    """Add to a rough surface a highlight for lights that no ray can hit, as wide as its reflection."""
    out = before
    alpha = m.roughness * m.roughness
    if alpha > SMOOTH:
        out.highlight = out.reflected
        out.exponent = highlight_exponent(alpha)
        out.traced = 1
    return out


# --- the kinds --------------------------------------------------------------------------------------------------------
# Each kind is a function (material, surface, n, wo, out) -> out. n is the shading normal, or a microfacet's normal on a rough surface.
# The unit vector wo points to the ray's origin. On entry, only out.reflection is set, to wo mirrored at n. The sum of the results
# `reflected`, `transmitted` and `diffuse` is at most 1.


@wp.func
def diffuse(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """Scatter by Lambert's law, with a highlight."""
    result = out
    result.diffuse = m.albedo
    result.highlight = m.specular
    result.exponent = m.exponent
    return result


@wp.func
def mirror(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """Reflect the share m.albedo of light at every angle."""
    result = out
    result.reflected = m.albedo
    return result


@wp.func
def conductor(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """Reflect as a metal with the complex index m.eta + i m.k, for red, green and blue."""
    result = out
    cos_o = wp.clamp(wp.dot(n, wo), 0.0, 1.0)
    result.reflected = wp.vec3(
        fresnel_conductor(cos_o, m.eta[0], m.k[0]),
        fresnel_conductor(cos_o, m.eta[1], m.k[1]),
        fresnel_conductor(cos_o, m.eta[2], m.k[2]),
    )
    return with_highlight(m, result)


def make_reflectance(features: Features, scaled: bool) -> Any:
    """Return reflectance(m, cos_i, eta) -> vec3 of a dielectric; `scaled`: by m.specular_factor and m.specular_color.

    The source of the scale is KHR_materials_specular: `f + (1 - f) rise`, with the colour f at normal incidence. There, the rise to
    1 at grazing incidence is Schlick's. Here, it is that of the formula in use. Total internal reflection is not scaled."""
    fresnel = fresnel_schlick if features.schlick else fresnel_dielectric

    @wp.func
    def reflectance(m: Material, cos_i: float, eta: float) -> wp.vec3:
        share = fresnel(cos_i, eta)
        white = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(scaled):
            if share < 1.0:
                normal = (eta - 1.0) * (eta - 1.0) / ((eta + 1.0) * (eta + 1.0))
                f = wp.min(normal * m.specular_color, white)
                # For an index above 3.7, the reflectance first falls, below 0 for a dark f.
                return m.specular_factor * wp.max(f + ((share - normal) / (1.0 - normal)) * (white - f), wp.vec3(0.0, 0.0, 0.0))
        return share * white

    return reflectance


def make_glass(features: Features, scaled: bool = False) -> Any:
    """Return the function that reflects and refracts at a boundary to a medium of index m.ior, or at a thin pane.

    scaled: of make_reflectance. As in KHR_materials_specular, the light that the strongest channel does not reflect is transmitted."""
    reflectance = make_reflectance(features, scaled)

    @wp.func
    def glass(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, before: Scatter) -> Scatter:
        out = before
        cos_o = wp.clamp(wp.dot(n, wo), 0.0, 1.0)
        if wp.static(features.thin_glass):
            if m.thin != 0:
                # The sum over all reflections between the two faces: R + T^2 R + T^2 R^3 + ... = 2 R / (1 + R).
                r = reflectance(m, cos_o, m.ior)
                out.reflected = wp.cw_div(2.0 * r, wp.vec3(1.0, 1.0, 1.0) + r)
                out.transmitted = (1.0 - wp.max(out.reflected)) * m.albedo
                out.refraction = -wo
                return out
        eta = wp.where(s.front != 0, m.ior, 1.0 / m.ior)
        out.reflected = reflectance(m, cos_o, eta)
        share = wp.max(out.reflected)
        if share < 1.0:
            cos_t = wp.sqrt(wp.max(0.0, 1.0 - (1.0 - cos_o * cos_o) / (eta * eta)))
            out.refraction = wp.normalize((cos_o / eta - cos_t) * n - wo / eta)
            # Radiance is squeezed into a smaller solid angle behind the boundary (PBR, section 9.5.2).
            out.transmitted = ((1.0 - share) / (eta * eta)) * m.albedo
            out.bends = 1
        return out

    return glass


def make_metallic_roughness(features: Features) -> Any:
    """Return the function for glTF 2.0's material (appendix B): a metal, mixed by `metallic` with a coated diffuse or clear body."""
    reflectance, glass = make_reflectance(features, features.specular), make_glass(features, features.specular)

    @wp.func
    def metallic_roughness(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, before: Scatter) -> Scatter:
        out = before
        metal = fresnel_tint(wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.albedo)
        body = Scatter()
        if wp.static(features.transmission):
            body = glass(m, s, n, wo, body)
        opaque = reflectance(m, wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.ior)
        out.reflected = m.metallic * metal + (1.0 - m.metallic) * (
            m.transmission * body.reflected + (1.0 - m.transmission) * opaque
        )
        out.transmitted = (1.0 - m.metallic) * m.transmission * body.transmitted
        out.refraction = body.refraction
        out.bends = body.bends
        out.diffuse = ((1.0 - m.metallic) * (1.0 - m.transmission) * (1.0 - wp.max(opaque))) * m.albedo
        return with_highlight(m, out)

    return metallic_roughness


# Functions from a scene's features to the device function of a kind. Material.kind is the index in this table.
MATERIALS = {
    "diffuse": lambda features: diffuse,
    "mirror": lambda features: mirror,
    "conductor": lambda features: conductor,
    "glass": make_glass,
    "metallic_roughness": make_metallic_roughness,
}


# --- all kinds of a scene ------------------------------------------------------------------------------------------------------


def make_of_kind(features: Features) -> Any:
    """Return the function that scatters at a surface of any kind in the scene. It tests one kind after another.

    A kernel that looked up MATERIALS would not be recompiled after an edit of the table: Warp does not hash it."""
    of_kind = no_kind
    for kind, name in reversed(list(enumerate(MATERIALS))):
        if name in features.materials:
            of_kind = make_link(kind, MATERIALS[name](features), of_kind)
    return of_kind


@wp.func
def no_kind(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    return out


def make_link(kind: int, function: Any, others: Any) -> Any:
    """Return the function that calls `function` for materials of this kind, and `others` for materials of all other kinds."""

    @wp.func
    def of_kind(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
        if m.kind == wp.static(kind):
            return function(m, s, n, wo, out)
        return others(m, s, n, wo, out)

    return of_kind


def make_add_coat(features: Features) -> Any:
    """Return add_coat(m, surface, wo, facet, scatter) -> Scatter: put the clear coat of KHR_materials_clearcoat on a surface.

    The coat reflects by its own normal, which no normal map bends, and takes the reflected light from everything below. A ray inside
    solid glass does not meet it: glass and coat have about the same index."""
    fresnel = fresnel_schlick if features.schlick else fresnel_dielectric

    @wp.func
    def add_coat(m: Material, s: Surface, wo: wp.vec3, facet: wp.vec3, before: Scatter) -> Scatter:
        out = before
        out.below = 1.0
        if m.clearcoat <= 0.0 or (s.front == 0 and m.transmission > 0.0 and m.thin == 0):
            return out
        smooth = visible_normal(s.smooth, wo)
        n = smooth
        alpha = m.clearcoat_roughness * m.clearcoat_roughness
        if wp.static(features.rough):
            if alpha > SMOOTH:
                n = ggx_normal(facet, smooth, wo, alpha)
        out.coated = m.clearcoat * fresnel(wp.clamp(wp.dot(n, wo), 0.0, 1.0), COAT_IOR)
        out.coat_reflection = 2.0 * wp.dot(n, wo) * n - wo
        out.below = 1.0 - out.coated
        out.reflected = out.below * out.reflected
        out.transmitted = out.below * out.transmitted
        out.diffuse = out.below * out.diffuse
        out.highlight = out.below * out.highlight
        if wp.static(features.rough):
            if alpha > SMOOTH:
                out.coat_exponent = highlight_exponent(alpha)
                cos_i = wp.dot(smooth, out.coat_reflection)
                out.coated = wp.where(cos_i > 0.0, ggx_visible_share(wp.dot(smooth, wo), cos_i, alpha), 0.0) * out.coated
        if wp.dot(out.coat_reflection, s.geometric) <= 0.0:
            out.coat_reflection = 2.0 * wp.dot(s.geometric, wo) * s.geometric - wo
        return out

    return add_coat


def make_scatter(features: Features) -> Any:
    """Return scatter(m, surface, wo, facet) -> Scatter, for every kind of the scene."""
    of_kind, add_coat = make_of_kind(features), make_add_coat(features)

    @wp.func
    def scatter(m: Material, s: Surface, wo: wp.vec3, facet: wp.vec3) -> Scatter:
        """Scatter a ray of direction -wo. facet: the result of cap_point, which chooses the microfacet of a rough surface."""
        out = Scatter()
        n = s.shading
        rough = bool(False)
        alpha = m.roughness * m.roughness
        if wp.static(features.rough):
            rough = alpha > SMOOTH
            if rough:
                n = ggx_normal(facet, s.shading, wo, alpha)
        out.reflection = 2.0 * wp.dot(n, wo) * n - wo
        out = of_kind(m, s, n, wo, out)
        if rough:
            cos_s = wp.dot(s.shading, wo)
            weight_r = ggx_visible_share(cos_s, wp.dot(s.shading, out.reflection), alpha)
            weight_t = ggx_visible_share(cos_s, wp.dot(s.shading, out.refraction), alpha)
            # A facet may send light below the surface, to another facet. Single scattering leaves such light out.
            out.reflected = wp.where(wp.dot(out.reflection, s.shading) > 0.0, weight_r, 0.0) * out.reflected
            out.transmitted = wp.where(wp.dot(out.refraction, s.shading) < 0.0, weight_t, 0.0) * out.transmitted
        # A shading normal may mirror the ray into the surface. Then the geometric normal mirrors it instead.
        if wp.dot(out.reflection, s.geometric) <= 0.0:
            out.reflection = 2.0 * wp.dot(s.geometric, wo) * s.geometric - wo
        if wp.dot(out.refraction, s.geometric) >= 0.0:
            out.refraction = -wo
        if wp.static(features.clearcoat):
            out = add_coat(m, s, wo, facet, out)
        return out

    return scatter
