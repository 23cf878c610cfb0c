"""Texels at a wave's hits, in vectorised loops."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import BLOCK, Wave
from wrt.kernels.loops.wave_rows import HITS, SURFACES, TEXELS
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import TEXTURES, MaterialTexture, Texels, textures_of
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Surfaces, noinline


def textures_vectorised(features: Features) -> bool:
    """Return whether textures are sampled for a block of hits at a time."""
    return features.textures and not features.checkerboards and not features.instances


def make_sample_texture(name: str, texture: MaterialTexture) -> Any:
    """Return sample_texture(surfaces, rows, count): store texels of one entry of TEXTURES, at `count` hits, in the rows TEXELS."""
    material, u, v = (rows.first * BLOCK for rows in (HITS.field("material"), SURFACES.field("u"), SURFACES.field("v")))
    channels = sum(1 << channel for channel in texture.channels)
    to = TEXELS.field(next(iter(texture.fields))).first * BLOCK

    @wp.func_native(f"""
    int wanted[{BLOCK}];
    for (int i = 0; i < {BLOCK}; ++i) {{
        int material = -1;
        if (i < count) memcpy(&material, rows.data + {material} + i, sizeof(material));
        wanted[i] = material < 0 ? -1 : surfaces.materials.data[material].{name};
    }}
    wrt::sample_texture<{BLOCK}>(surfaces, wanted, rows.data + {u}, rows.data + {v}, count, {channels}, rows.data + {to});
    """)
    def sample_texture(surfaces: Surfaces, rows: wp.array(dtype=wp.float32), count: int) -> None: ...

    return sample_texture


def make_link(sample: Any, sample_others: Any) -> Any:
    """Return the function that calls `sample_others` and then `sample`."""

    @noinline
    def sample_all(surfaces: Surfaces, rows: wp.array(dtype=wp.float32), count: int):
        sample_others(surfaces, rows, count)
        sample(surfaces, rows, count)

    return sample_all


def make_wave_textures(features: Features, look_up: Any) -> tuple[Any, Any]:
    """Return sample(surfaces, rows, count) or None, and texels_at(wave, surfaces, surface, i) -> Texels of hit i of the block.

    texels_at loads the result of `sample`. If `sample` is None, it calls `look_up` (from make_shading)."""
    textures = textures_of(features) if textures_vectorised(features) else {}
    sample = None
    for name, texture in textures.items():
        sample_one = make_sample_texture(name, texture)
        sample = make_link(sample_one, sample) if sample else sample_one
    load = TEXELS.load(*(field for name in TEXTURES.keys() - textures.keys() for field in TEXTURES[name].fields))

    @wp.func
    def texels_at(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        if wp.static(not textures):
            return look_up(surfaces, s)
        return load(wave.block.rows, i)

    return sample, texels_at
