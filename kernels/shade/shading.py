"""The data at a hit: the surface, its material with textures, its shading normal, and its scattering."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.parameters import PARAMETERS, TEXTURES, Material, MaterialTexture, Texels
from wrt.kernels.rows import numbers_of
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.materials import make_scatter
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.surface import MIN_COSINE, Surface, make_place_of, make_surface_at, triangle_uv, visible_normal
from wrt.kernels.shade.textures import make_sample_texture
from wrt.kernels.structs import Surfaces, unit

MASK, BLEND = 1, 2  # Values of Material.alpha_mode; 0 is opaque.


def textures_of(features: Features) -> dict[str, MaterialTexture]:
    """Return the entries of TEXTURES that a scene's kernel needs."""
    if not features.textures and not features.checkerboards:
        return {}
    return {name: texture for name, texture in TEXTURES.items() if not texture.feature or getattr(features, texture.feature)}


def numbers_in(names: Iterable[str], struct: str) -> list[str]:
    """Return the C++ expressions of the numbers of these parameters in the variable `struct`."""
    return [number for name in names for number in numbers_of(PARAMETERS[name].dtype, f"{struct}.{name}")]


def make_look_up(features: Features) -> Any:
    """Return look_up(surfaces, surface) -> Texels of the surface's material at its texture coordinates."""
    sample_texture = make_sample_texture(features.textures, features.checkerboards)
    look_up = no_texels
    for name, texture in textures_of(features).items():
        look_up = make_texture_link(name, texture, sample_texture, look_up)
    return look_up


@wp.func
def no_texels(surfaces: Surfaces, s: Surface) -> Texels:
    return Texels()


def make_texture_link(name: str, texture: MaterialTexture, sample_texture: Any, others: Any) -> Any:
    """Return a function look_up that calls the look_up function `others` and then samples one more texture."""
    numbers = zip(texture.channels, numbers_in(texture.parameters, "texels"), strict=True)

    @wp.func_native(f"return materials.data[(long long)material].{name};")
    def index_of(materials: wp.array(dtype=Material), material: int) -> int: ...

    @wp.func_native("\n".join(f"{number} = color[{channel}];" for channel, number in numbers))
    def store_color(texels: wp.ref[Texels], color: wp.vec4) -> None: ...

    @wp.func
    def look_up(surfaces: Surfaces, s: Surface) -> Texels:
        texels = others(surfaces, s)
        store_color(texels, sample_texture(surfaces, index_of(surfaces.materials, s.material), wp.vec2(s.u, s.v)))
        return texels

    return look_up


def make_resolve(features: Features) -> Any:
    """Return resolve(surfaces, surface, texels) -> Material at a point: parameters times textures."""
    names = [name for texture in textures_of(features).values() for name in texture.parameters if PARAMETERS[name].is_factor]
    numbers = zip(numbers_in(names, "material"), numbers_in(names, "texels"), strict=True)

    @wp.func_native("\n".join(f"{number} = {number} * {texel};" for number, texel in numbers))
    def multiply(texels: Texels, material: wp.ref[Material]) -> None: ...

    @wp.func_native("material = materials.data[(long long)i];")
    def load(materials: wp.array(dtype=Material), i: int, material: wp.ref[Material]) -> None: ...

    @wp.func
    def resolve(surfaces: Surfaces, s: Surface, texels: Texels) -> Material:
        if wp.static(not names):
            return surfaces.materials[s.material]
        m = Material()
        load(surfaces.materials, s.material, m)
        multiply(texels, m)
        return m

    return resolve


def make_cutout(features: Features) -> Any:
    """Return accepts(surfaces, prim_id, u, v) -> bool, or None in scenes without cut-outs.

    The result is False for a hit whose alpha is below the cutoff. Traversal ignores such hits."""
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


@wp.func
def bump(s: Surface, scale: float, color: wp.vec3) -> wp.vec3:
    """Return the unit shading normal for a normal map's linear RGB. scale: Material.normal_scale. Branch-free, so that loops vectorise."""
    side = wp.where(s.front != 0, 1.0, -1.0)
    outward = side * s.shading
    t = s.tangent - wp.dot(s.tangent, outward) * outward
    length = wp.sqrt(wp.dot(t, t))
    t = t / length
    x = (2.0 * color[0] - 1.0) * scale
    y = (2.0 * color[1] - 1.0) * scale
    z = 2.0 * color[2] - 1.0
    # In glTF, +y points up in the picture, while v runs down. The bitangent is cross(n, t), negated if the texture is mirrored.
    n = unit(x * t + y * s.bitangent_sign * wp.cross(outward, t) + z * outward)
    return where_vec3(length == 0.0, s.shading, side * n)


def make_is_solid(features: Features) -> Any:
    """Return is_solid(m) -> bool: True for solid glass, which a ray enters at a front face and leaves at a back face."""

    @wp.func
    def is_solid(m: Material) -> bool:
        clear = m.transmission > 0.0
        if wp.static(features.thin_glass):
            clear = clear and m.thin == 0
        return clear

    return is_solid


class Shading(NamedTuple):
    """The device functions for the data at a hit."""

    surface_at: Any  # (surfaces, ray, hit) -> Surface.
    look_up: Any  # (surfaces, surface) -> Texels.
    resolve: Any  # (surfaces, surface, texels) -> Material.
    shading_normal: Any  # (surfaces, surface, texels, wo) -> unit vec3 on the side of wo.
    scatter: Any  # (material, surface, wo, facet) -> Scatter.
    is_solid: Any  # (material) -> bool.


def make_shading(features: Features) -> Any:
    """Return the Shading of a scene, which the step, shadow rays and AOVs share."""
    uvs = features.textures or features.checkerboards
    surface_at = make_surface_at(features.spheres, features.smooth, uvs, features.normal_maps, features.instances)
    look_up, resolve = make_look_up(features), make_resolve(features)

    @wp.func
    def shading_normal(surfaces: Surfaces, s: Surface, texels: Texels, wo: wp.vec3) -> wp.vec3:
        """Return the interpolated or mapped normal, made visible from wo as `visible_normal` does."""
        n = s.shading
        if wp.static(features.normal_maps):
            material = s.material
            if surfaces.materials[material].normal_texture >= 0:
                n = bump(s, surfaces.materials[material].normal_scale, texels.normal)
        if wp.static(features.smooth or features.normal_maps):
            if wp.dot(n, wo) < MIN_COSINE:  # Rarely true; the rest of `visible_normal` is slow.
                n = visible_normal(n, wo)
        return n

    return Shading(surface_at, look_up, resolve, shading_normal, make_scatter(features), make_is_solid(features))
