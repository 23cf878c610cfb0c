"""Materials: what a surface sends back, and where rays go on from it."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.sampling import PI, ggx_normal, ggx_visible_share
from wrt.kernels.shade.surface import Surface, make_place_of, make_surface_at
from wrt.kernels.shade.textures import make_sample_texture
from wrt.kernels.structs import Material, Surfaces

DIFFUSE = 0
MIRROR = 1
CONDUCTOR = 2
GLASS = 3
METALLIC_ROUGHNESS = 4

OPAQUE = 0
MASK = 1
BLEND = 2


@wp.func
def fresnel_dielectric(cos_i: float, eta: float) -> float:
    """Share of unpolarised light that a smooth boundary reflects; 1 at total internal reflection.

    cos_i >= 0: angle of incidence; eta: index behind the boundary over the one in front (Born and Wolf, section 1.5).
    """
    sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
    if sin2_t >= 1.0:
        return 1.0
    cos_t = wp.sqrt(1.0 - sin2_t)
    parallel = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    perpendicular = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular)


@wp.func
def fresnel_schlick(cos_i: float, eta: float) -> float:
    """Schlick 1994's approximation, with the angle on the thinner side; 1 at total internal reflection."""
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
    """(a - b) / (a + b); 1 where both are 0, its limit where they vanish here: at grazing incidence, or without any metal."""
    return wp.where(a + b > 0.0, (a - b) / (a + b), 1.0)


@wp.func
def fresnel_conductor(cos_i: float, eta: float, k: float) -> float:
    """Share that a metal of index eta + i k reflects, unpolarised (Born and Wolf, section 14.2)."""
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
    """Schlick's curve from the colour f0 at normal incidence to white at a right angle: glTF 2.0's metals."""
    m = 1.0 - cos_i
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m * m * m * m * m)


@wp.func
def blinn_phong(n: wp.vec3, wi: wp.vec3, wo: wp.vec3, exponent: float) -> float:
    """Blinn's highlight, per steradian, scaled so that no more leaves than comes in at normal incidence.

    (e + 2)(e + 4) / (8 pi (2^(-e/2) + e)) cos^e (Akenine-Moeller et al. 2008, "Real-Time Rendering", 3rd ed., section 7.6).
    """
    h = wp.normalize(wi + wo)
    scale = (exponent + 2.0) * (exponent + 4.0) / (8.0 * PI * (wp.pow(2.0, -0.5 * exponent) + exponent))
    return scale * wp.pow(wp.max(0.0, wp.dot(n, h)), exponent)


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


def make_resolve(features, sample_texture):
    """The material at a point: parameters times textures."""

    @wp.func
    def resolve(surfaces: Surfaces, s: Surface) -> Material:
        m = surfaces.materials[s.material]
        if wp.static(features.textures or features.checkerboards):
            color = sample_texture(surfaces, m.albedo_texture, s.uv)
            m.albedo = wp.cw_mul(m.albedo, wp.vec3(color[0], color[1], color[2]))
            m.alpha = m.alpha * color[3]
            light = sample_texture(surfaces, m.emission_texture, s.uv)
            m.emission = wp.cw_mul(m.emission, wp.vec3(light[0], light[1], light[2]))
        if wp.static(features.metallic_roughness and features.textures):
            mr = sample_texture(surfaces, m.metallic_roughness_texture, s.uv)
            m.roughness = m.roughness * mr[1]
            m.metallic = m.metallic * mr[2]
            m.transmission = m.transmission * sample_texture(surfaces, m.transmission_texture, s.uv)[0]
        return m

    return resolve


def make_cutout(features):
    """Cut-outs: a hit on a masked texture's clear part is none. For the traversal units, which call it at every hit."""
    sample_texture = make_sample_texture(features.textures, features.checkerboards)
    place_of = make_place_of(features.instances)

    @wp.func
    def accepts(surfaces: Surfaces, prim_id: int, u: float, v: float) -> bool:
        place = place_of(surfaces, prim_id)
        m = surfaces.materials[place.material]
        if m.alpha_mode != wp.static(MASK):
            return True
        alpha = m.alpha
        if wp.static(features.textures or features.checkerboards):
            if prim_id < surfaces.n_triangles:
                face = surfaces.faces[place.face]
                uv = (1.0 - u - v) * surfaces.uvs[face[0]] + u * surfaces.uvs[face[1]] + v * surfaces.uvs[face[2]]
                alpha = alpha * sample_texture(surfaces, m.albedo_texture, uv)[3]
        return alpha >= m.alpha_cutoff

    return accepts


def make_bump(features, sample_texture):
    """Normal maps: the shading normal that the picture says."""

    @wp.func
    def bump(surfaces: Surfaces, m: Material, s: Surface) -> wp.vec3:
        if m.normal_texture < 0:
            return s.shading
        side = wp.where(s.front != 0, 1.0, -1.0)
        outward = side * s.shading
        t = s.tangent - wp.dot(s.tangent, outward) * outward
        length = wp.length(t)
        if length == 0.0:
            return s.shading
        t = t / length
        color = sample_texture(surfaces, m.normal_texture, s.uv)
        x = (2.0 * color[0] - 1.0) * m.normal_scale
        y = (2.0 * color[1] - 1.0) * m.normal_scale
        z = 2.0 * color[2] - 1.0
        # glTF: +y is up in the picture, while v runs down; the bitangent is cross(n, t) for pictures that are not mirrored.
        n = wp.normalize(x * t + y * s.bitangent_sign * wp.cross(outward, t) + z * outward)
        return side * n

    return bump


class Shading(NamedTuple):
    """What is known at a hit: surface_at(surfaces, ray, hit); resolve(surfaces, surface) -> Material; shading_normal(surfaces,
    material, surface, wo); scatter(material, surface, wo, xi) -> Scatter; is_solid(material)."""

    surface_at: Any
    resolve: Any
    shading_normal: Any
    scatter: Any
    is_solid: Any


def make_shading(features):
    """Once for a kernel: the integrator's step, shadow rays and AOVs share it."""
    sample_texture = make_sample_texture(features.textures, features.checkerboards)
    uvs = features.textures or features.checkerboards
    surface_at = make_surface_at(features.spheres, features.smooth, uvs, features.normal_maps, features.instances)
    resolve = make_resolve(features, sample_texture)
    bump = make_bump(features, sample_texture)

    @wp.func
    def shading_normal(surfaces: Surfaces, m: Material, s: Surface, wo: wp.vec3) -> wp.vec3:
        """The interpolated or mapped normal, bent no farther than it is still seen from wo."""
        n = s.shading
        if wp.static(features.normal_maps):
            n = bump(surfaces, m, s)
        if wp.static(features.smooth or features.normal_maps):
            facing = wp.dot(n, wo)
            if facing < 1.0e-3:
                n = wp.normalize(n + (1.0e-3 - facing) * wo)
        return n

    return Shading(surface_at, resolve, shading_normal, make_scatter(features), make_is_solid(features))


def make_is_solid(features):
    """Glass with an inside: what a ray enters at the front of a surface and leaves at its back."""

    @wp.func
    def is_solid(m: Material) -> bool:
        clear = m.kind == wp.static(GLASS) or (m.kind == wp.static(METALLIC_ROUGHNESS) and m.transmission > 0.0)
        if wp.static(features.thin_glass):
            clear = clear and m.thin == 0
        return clear

    return is_solid


def make_scatter(features):
    """How a surface splits what arrives: the one place where the kinds of material differ."""
    fresnel = fresnel_schlick if features.schlick else fresnel_dielectric

    @wp.func
    def dielectric(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
        """Reflection and refraction at a boundary to index m.ior, or at a thin pane of it."""
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

    @wp.func
    def metallic_roughness(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
        """glTF 2.0, appendix B: a metal and a coated diffuse (or clear) body, mixed by `metallic`."""
        metal = fresnel_tint(wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.albedo)
        body = Scatter()
        if wp.static(features.transmission):
            body = dielectric(m, s, n, wo, body)
        coat = fresnel(wp.clamp(wp.dot(n, wo), 0.0, 1.0), m.ior)
        opaque = wp.vec3(coat, coat, coat)
        out.reflected = m.metallic * metal + (1.0 - m.metallic) * (
            m.transmission * body.reflected + (1.0 - m.transmission) * opaque
        )
        out.transmitted = (1.0 - m.metallic) * m.transmission * body.transmitted
        out.refraction = body.refraction
        out.bends = body.bends
        out.diffuse = ((1.0 - m.metallic) * (1.0 - m.transmission) * (1.0 - coat)) * m.albedo
        return out

    @wp.func
    def scatter(m: Material, s: Surface, wo: wp.vec3, xi: wp.vec2) -> Scatter:
        """What a ray from direction -wo turns into. xi: two numbers in [0, 1) that choose a microfacet where it is rough."""
        out = Scatter()
        n = s.shading
        rough = bool(False)
        alpha = m.roughness * m.roughness
        if wp.static(features.rough):
            # Below this a facet deviates by less than a float32 direction can tell.
            rough = alpha > 1.0e-4 and m.kind != wp.static(DIFFUSE) and m.kind != wp.static(MIRROR)
            if rough:
                n = ggx_normal(xi, s.shading, wo, alpha)
        cos_o = wp.clamp(wp.dot(n, wo), 0.0, 1.0)
        if m.kind == wp.static(DIFFUSE):
            out.diffuse = m.albedo
            out.highlight = m.specular
            out.exponent = m.exponent
        if wp.static(features.mirror):
            if m.kind == wp.static(MIRROR):
                out.reflected = m.albedo
        if wp.static(features.conductor):
            if m.kind == wp.static(CONDUCTOR):
                out.reflected = wp.vec3(
                    fresnel_conductor(cos_o, m.eta[0], m.k[0]),
                    fresnel_conductor(cos_o, m.eta[1], m.k[1]),
                    fresnel_conductor(cos_o, m.eta[2], m.k[2]),
                )
        if wp.static(features.glass):
            if m.kind == wp.static(GLASS):
                out = dielectric(m, s, n, wo, out)
        if wp.static(features.metallic_roughness):
            if m.kind == wp.static(METALLIC_ROUGHNESS):
                out = metallic_roughness(m, s, n, wo, out)
        if wp.static(features.rough):
            if rough and m.kind != wp.static(GLASS):
                # No ray can hit a point light: its reflection is Blinn's, of the same width (Walter et al. 2007, eq. 41).
                out.highlight = out.reflected
                out.exponent = wp.min(2.0 / (alpha * alpha) - 2.0, 1.0e5)
                out.traced = 1

        out.reflection = 2.0 * wp.dot(n, wo) * n - wo
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
