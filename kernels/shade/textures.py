"""Textures: 8-bit pictures, sampled bilinearly, and the checkerboard."""

from typing import Any

import warp as wp

from wrt.kernels.structs import Surfaces, Texture

WRAP_REPEAT = 0
WRAP_CLAMP = 1
WRAP_MIRROR = 2
FARTHEST = wp.constant(2.0**30)  # Largest distance from a picture's first texel, in texels.


@wp.func
def wrapped(i: int, size: int, wrap: int) -> int:
    """Wrap column (or line) i into 0 .. size - 1. wrap: WRAP_REPEAT, WRAP_CLAMP or WRAP_MIRROR."""
    if i >= 0 and i < size:  # Usually true; the division below is as slow as the rest of a look-up.
        return i
    if wrap == wp.static(WRAP_CLAMP):
        return wp.clamp(i, 0, size - 1)
    period = wp.where(wrap == wp.static(WRAP_MIRROR), 2 * size, size)
    j = i % period
    j = wp.where(j < 0, j + period, j)
    return wp.where(j >= size, 2 * size - 1 - j, j)


@wp.func
def texel(surfaces: Surfaces, texture: Texture, column: int, row: int) -> wp.vec4:
    """Return the linear RGBA of one texel. Alpha is never sRGB-encoded. Column and row must be within the picture."""
    packed = surfaces.texels[texture.first + row * texture.width + column]
    r = int(packed & wp.uint32(255))
    g = int((packed >> wp.uint32(8)) & wp.uint32(255))
    b = int((packed >> wp.uint32(16)) & wp.uint32(255))
    a = int(packed >> wp.uint32(24))
    # Entries 0 .. 255 of the table decode sRGB; entries 256 .. 511 decode linear bytes.
    base = wp.where(texture.srgb != 0, 0, 256)
    table = surfaces.srgb_to_linear
    return wp.vec4(table[base + r], table[base + g], table[base + b], table[256 + a])


@wp.func
def texel_place(at: float, size: int) -> float:
    """Convert a texture coordinate to a position in texels, with 0 at the centre of the first texel. size: number of texels."""
    # The bound keeps the integer below 2^31: beyond that, its value depends on the device.
    return wp.clamp(at * float(size) - 0.5, -FARTHEST, FARTHEST)


@wp.func
def picture(surfaces: Surfaces, texture: Texture, u: float, v: float) -> wp.vec4:
    """Return the bilinearly interpolated linear RGBA of a picture at texture coordinates (u, v)."""
    x = texel_place(u, texture.width)
    y = texel_place(v, texture.height)
    left = wrapped(int(wp.floor(x)), texture.width, texture.wrap_u)
    right = wrapped(int(wp.floor(x)) + 1, texture.width, texture.wrap_u)
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    above = wp.vec4(0.0, 0.0, 0.0, 0.0)
    here = wp.vec4(0.0, 0.0, 0.0, 0.0)
    rows = wp.where(texture.height > 0, 2, 0)  # With a constant 2, the compiler would unroll the loop in each texture's code.
    for i in range(rows):
        row = wrapped(int(wp.floor(y)) + i, texture.height, texture.wrap_v)
        above = here
        here = (1.0 - fx) * texel(surfaces, texture, left, row) + fx * texel(surfaces, texture, right, row)
    return (1.0 - fy) * above + fy * here


@wp.func
def checkerboard(texture: Texture, u: float, v: float) -> wp.vec4:
    end = wp.static(2.0**24)  # All larger floats are even.
    parity = (int(wp.floor(wp.clamp(u, -end, end))) + int(wp.floor(wp.clamp(v, -end, end)))) & 1
    color = wp.where(parity == 0, texture.color_a, texture.color_b)
    return wp.vec4(color[0], color[1], color[2], 1.0)


def make_sample_texture(pictures: bool, checkerboards: bool) -> Any:
    """Return sample_texture(surfaces, index, uv) -> RGBA. It has code only for the kinds of texture in the scene."""

    @wp.func
    def sample_texture(surfaces: Surfaces, index: int, uv: wp.vec2) -> wp.vec4:
        """Return the linear RGBA of texture `index` at uv; white if index < 0, which means no texture."""
        if index < 0:
            return wp.vec4(1.0, 1.0, 1.0, 1.0)
        texture = surfaces.textures[index]
        u = texture.row_u[0] * uv[0] + texture.row_u[1] * uv[1] + texture.row_u[2]
        v = texture.row_v[0] * uv[0] + texture.row_v[1] * uv[1] + texture.row_v[2]
        result = wp.vec4(1.0, 1.0, 1.0, 1.0)
        if wp.static(checkerboards):
            if texture.width == 0:
                result = checkerboard(texture, u, v)
        if wp.static(pictures):
            if texture.width > 0:
                result = picture(surfaces, texture, u, v)
        return result

    return sample_texture
