"""Material kinds: what a surface sends back, and where rays go on from it. One function a kind, and a row in MATERIALS."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import LOG_2, exp, power
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.fresnel import fresnel_conductor, fresnel_dielectric, fresnel_schlick, fresnel_tint
from wrt.kernels.shade.sampling import PI, ggx_normal, ggx_visible_share
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Material

SMOOTH = wp.constant(1.0e-4)  # GGX's alpha: below, a facet deviates by less than a float32 direction can tell


@wp.struct
class Scatter:
    """Where rays go on from a surface; a weight of 0 means that none does.

    reflected: towards `reflection`, on the side the ray came from; transmitted: towards `refraction`, through the surface.
    diffuse: what is left for Lambert's law; highlight and exponent: for lights that no ray can hit. traced: 1 where the highlight
    stands for a reflection whose rays find the other lights.
    """

    reflected: wp.vec3
    reflection: wp.vec3
    transmitted: wp.vec3
    refraction: wp.vec3
    bends: int
    diffuse: wp.vec3
    highlight: wp.vec3
    exponent: float
    traced: int


@wp.func
def blinn_phong(n: wp.vec3, wi: wp.vec3, wo: wp.vec3, exponent: float) -> float:
    """Blinn's highlight, per steradian, scaled so that no more leaves than comes in at normal incidence.

    (e + 2)(e + 4) / (8 pi (2^(-e/2) + e)) cos^e (Akenine-Moeller et al. 2008, "Real-Time Rendering", 3rd ed., section 7.6).
    """
    h = wp.normalize(wi + wo)
    scale = (exponent + 2.0) * (exponent + 4.0) / (8.0 * PI * (exp(-0.5 * LOG_2 * exponent) + exponent))
    return scale * power(wp.max(0.0, wp.dot(n, h)), exponent)


@wp.func
def with_highlight(m: Material, before: Scatter) -> Scatter:
    """What a rough reflection makes of lights that no ray can hit: Blinn's highlight, of the same width (Walter et al. 2007,
    eq. 41)."""
    out = before
    alpha = m.roughness * m.roughness
    if alpha > SMOOTH:
        out.highlight = out.reflected
        out.exponent = wp.min(2.0 / (alpha * alpha) - 2.0, 1.0e5)
        out.traced = 1
    return out


# --- the kinds --------------------------------------------------------------------------------------------------------
# Each is (material, surface, n, wo, out) -> out. n: the normal to reflect at, a microfacet's where it is rough; wo: unit vector to
# where the ray came from; out: empty, but for `reflection`, the mirrored direction. The sum of what is reflected, transmitted and
# diffuse is at most 1 at every angle.


@wp.func
def diffuse(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """Lambert's law, and a highlight of its own."""
    result = out
    result.diffuse = m.albedo
    result.highlight = m.specular
    result.exponent = m.exponent
    return result


@wp.func
def mirror(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """The same share at every angle."""
    result = out
    result.reflected = m.albedo
    return result


@wp.func
def conductor(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    """A metal, by its complex index at red, green and blue."""
    result = out
    cos_o = wp.clamp(wp.dot(n, wo), 0.0, 1.0)
    result.reflected = wp.vec3(
        fresnel_conductor(cos_o, m.eta[0], m.k[0]),
        fresnel_conductor(cos_o, m.eta[1], m.k[1]),
        fresnel_conductor(cos_o, m.eta[2], m.k[2]),
    )
    return with_highlight(m, result)


def make_glass(features: Features) -> Any:
    """Reflection and refraction at a boundary to index m.ior, or at a thin pane of it."""
    fresnel = fresnel_schlick if features.schlick else fresnel_dielectric

    @wp.func
    def glass(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, before: Scatter) -> Scatter:
        out = before
        cos_o = wp.clamp(wp.dot(n, wo), 0.0, 1.0)
        if wp.static(features.thin_glass):
            if m.thin != 0:
                # Light goes to and fro between the faces: R + T^2 R + T^2 R^3 + ... = 2 R / (1 + R).
                r = fresnel(cos_o, m.ior)
                both = 2.0 * r / (1.0 + r)
                out.reflected = wp.vec3(both, both, both)
                out.transmitted = (1.0 - both) * m.albedo
                out.refraction = -wo
                return out
        eta = wp.where(s.front != 0, m.ior, 1.0 / m.ior)
        share = fresnel(cos_o, eta)
        out.reflected = wp.vec3(share, share, share)
        if share < 1.0:
            cos_t = wp.sqrt(wp.max(0.0, 1.0 - (1.0 - cos_o * cos_o) / (eta * eta)))
            out.refraction = wp.normalize((cos_o / eta - cos_t) * n - wo / eta)
            # Radiance is squeezed into a smaller solid angle behind the boundary (PBR, section 9.5.2).
            out.transmitted = ((1.0 - share) / (eta * eta)) * m.albedo
            out.bends = 1
        return out

    return glass


def make_metallic_roughness(features: Features) -> Any:
    """glTF 2.0, appendix B: a metal and a coated diffuse (or clear) body, mixed by `metallic`."""
    fresnel = fresnel_schlick if features.schlick else fresnel_dielectric
    glass = make_glass(features)

    @wp.func
    def metallic_roughness(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, before: Scatter) -> Scatter:
        out = before
        metal = fresnel_tint(wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.albedo)
        body = Scatter()
        if wp.static(features.transmission):
            body = glass(m, s, n, wo, body)
        coat = fresnel(wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.ior)
        opaque = wp.vec3(coat, coat, coat)
        out.reflected = m.metallic * metal + (1.0 - m.metallic) * (
            m.transmission * body.reflected + (1.0 - m.transmission) * opaque
        )
        out.transmitted = (1.0 - m.metallic) * m.transmission * body.transmitted
        out.refraction = body.refraction
        out.bends = body.bends
        out.diffuse = ((1.0 - m.metallic) * (1.0 - m.transmission) * (1.0 - coat)) * m.albedo
        return with_highlight(m, out)

    return metallic_roughness


# By the name in wrt.scene.materials.MATERIALS: from a scene's features to the device function. Material.kind is the place here.
MATERIALS = {
    "diffuse": lambda features: diffuse,
    "mirror": lambda features: mirror,
    "conductor": lambda features: conductor,
    "glass": make_glass,
    "metallic_roughness": make_metallic_roughness,
}


# --- any of them ------------------------------------------------------------------------------------------------------


def make_of_kind(features: Features) -> Any:
    """The scene's kinds, one `if` after another: a table that is looked up in a device function keeps the code of before an
    edit."""
    of_kind = no_kind
    for number, name in reversed(list(enumerate(MATERIALS))):
        if name in features.materials:
            of_kind = make_link(number, MATERIALS[name](features), of_kind)
    return of_kind


@wp.func
def no_kind(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    return out


def make_link(number: int, function: Any, others: Any) -> Any:
    """`function` for materials of that number, and the others for all other ones."""

    @wp.func
    def of_kind(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
        if m.kind == wp.static(number):
            return function(m, s, n, wo, out)
        return others(m, s, n, wo, out)

    return of_kind


def make_scatter(features: Features) -> Any:
    """How a surface splits what arrives."""
    of_kind = make_of_kind(features)

    @wp.func
    def scatter(m: Material, s: Surface, wo: wp.vec3, facet: wp.vec3) -> Scatter:
        """What a ray from direction -wo turns into. facet: of cap_point, what chooses a microfacet where it is rough."""
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
            # A facet may send light below the surface: it would meet another facet, which single scattering leaves out.
            out.reflected = wp.where(wp.dot(out.reflection, s.shading) > 0.0, weight_r, 0.0) * out.reflected
            out.transmitted = wp.where(wp.dot(out.refraction, s.shading) < 0.0, weight_t, 0.0) * out.transmitted
        # Interpolated normals can point a mirrored ray into the surface: the flat normal mirrors it instead.
        if wp.dot(out.reflection, s.geometric) <= 0.0:
            out.reflection = 2.0 * wp.dot(s.geometric, wo) * s.geometric - wo
        if wp.dot(out.refraction, s.geometric) >= 0.0:
            out.refraction = -wo
        return out

    return scatter
