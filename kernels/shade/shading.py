"""What is known at a hit: the surface, its material with the textures in it, its normal, and how it scatters light."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.materials import make_scatter
from wrt.kernels.shade.surface import SEEN, Surface, bent, make_place_of, make_surface_at, triangle_uv
from wrt.kernels.shade.textures import make_sample_texture
from wrt.kernels.structs import Material, Surfaces

MASK = 1  # alpha modes; 0 is opaque
BLEND = 2


def make_resolve(features: Any, sample_texture: Any) -> Any:
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
        if wp.static(features.parameter_textures):
            mr = sample_texture(surfaces, m.metallic_roughness_texture, s.uv)
            m.roughness = m.roughness * mr[1]
            m.metallic = m.metallic * mr[2]
            m.transmission = m.transmission * sample_texture(surfaces, m.transmission_texture, s.uv)[0]
        return m

    return resolve


def make_cutout(features: Any) -> Any:
    """Cut-outs: a hit on a masked texture's clear part is none. For the traversal units, which call it at every hit; None where a
    scene has no cut-outs."""
    if not features.cutout:
        return None
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
                alpha = alpha * sample_texture(surfaces, m.albedo_texture, triangle_uv(surfaces, place.face, u, v))[3]
        return alpha >= m.alpha_cutoff

    return accepts


def make_bump(features: Any, sample_texture: Any) -> Any:
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


def make_is_solid(features: Any) -> Any:
    """Glass with an inside: what a ray enters at the front of a surface and leaves at its back."""

    @wp.func
    def is_solid(m: Material) -> bool:
        clear = m.transmission > 0.0
        if wp.static(features.thin_glass):
            clear = clear and m.thin == 0
        return clear

    return is_solid


class Shading(NamedTuple):
    """What is known at a hit: surface_at(surfaces, ray, hit); resolve(surfaces, surface) -> Material; shading_normal(surfaces,
    material, surface, wo); scatter(material, surface, wo, xi) -> Scatter; is_solid(material)."""

    surface_at: Any
    resolve: Any
    shading_normal: Any
    scatter: Any
    is_solid: Any


def make_shading(features: Any) -> Any:
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
            if wp.dot(n, wo) < SEEN:  # seldom: what `bent` does beyond this test takes a while
                n = bent(n, wo)
        return n

    return Shading(surface_at, resolve, shading_normal, make_scatter(features), make_is_solid(features))
