"""What textures say at a wave's hits, many at a time."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import BLOCK, Wave
from wrt.kernels.loops.wave_rows import SURFACES, TEXELS
from wrt.kernels.memory import put
from wrt.kernels.native import source
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import TEXTURES, MaterialTexture, Texels, make_texture_index, textures_of
from wrt.kernels.shade.surface import Surface
from wrt.kernels.shade.textures import FARTHEST, WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT
from wrt.kernels.structs import Surfaces, noinline


@wp.func_native(source("loops/texture_lanes.h", LANES=LANES, BLOCK=BLOCK, U_ROW=SURFACES.field("u").first,
                       V_ROW=SURFACES.field("v").first, FARTHEST=FARTHEST, WRAP_REPEAT=WRAP_REPEAT, WRAP_CLAMP=WRAP_CLAMP,
                       WRAP_MIRROR=WRAP_MIRROR))
def sample_lanes(surfaces: Surfaces, wanted: wp.array(dtype=wp.int32), first: int, count: int, channels: int,
                 rows: wp.array(dtype=wp.float32), to: int) -> None:
    """Of the textures wanted[first] and what follows it, -1 behind the last up to a multiple of LANES, at the texture coordinates
    in two rows: the channels in the mask `channels`, one after another to the rows from `to` on."""


@noinline
def sample_slot(wave: Wave, surfaces: Surfaces, slot: int, count: int, channels: int, to: int):
    """One texture of each of a block's hits."""
    sample_lanes(surfaces, wave.block.wanted, slot * BLOCK, count, channels, wave.block.rows, to)


def in_lanes(features: Features) -> bool:
    """Whether a wave's textures are sampled many at a time."""
    return features.textures and not features.checkerboards and not features.instances


@wp.func
def want_nothing(wave: Wave, surfaces: Surfaces, i: int, material: int):
    pass


@wp.func
def sample_nothing(wave: Wave, surfaces: Surfaces, count: int):
    pass


def make_texture_link(slot: int, name: str, texture: MaterialTexture, want_others: Any, sample_others: Any) -> tuple[Any, Any]:
    """want(wave, surfaces, i, material): put the textures of hit i of a block to wave.block.wanted, -1 where `material` is; and
    sample(wave, surfaces, count): sample them for the first hits of a block. This one, in its slot, and the others."""
    index = make_texture_index(name)
    channels = sum(1 << channel for channel, _ in texture.numbers)
    to = TEXELS.field(texture.fields[0]).first

    @wp.func
    def want(wave: Wave, surfaces: Surfaces, i: int, material: int):
        want_others(wave, surfaces, i, material)
        texture = int(-1)
        if material >= 0:
            texture = index(surfaces.materials, material)
        put(wave.block.wanted, wp.static(slot * BLOCK) + i, texture)

    @wp.func
    def sample(wave: Wave, surfaces: Surfaces, count: int):
        sample_others(wave, surfaces, count)
        sample_slot(wave, surfaces, slot, count, channels, to)

    return want, sample


def make_wave_textures(features: Features, look_up: Any) -> tuple[Any, Any]:
    """sample_textures(wave, surfaces, first, end): for the hits first .. end - 1, at most BLOCK, whose surfaces are found;
    texels_at(wave, surfaces, surface, i) -> Texels for the i-th of them: what was computed before, or by `look_up` (of
    make_shading)."""

    @wp.func
    def sample_none(wave: Wave, surfaces: Surfaces, first: int, end: int):
        pass

    @wp.func
    def look_up_alone(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        return look_up(surfaces, s)

    if not in_lanes(features):
        return sample_none, look_up_alone
    textures = textures_of(features)
    want, sample = want_nothing, sample_nothing
    for slot, (name, texture) in enumerate(textures.items()):
        want, sample = make_texture_link(slot, name, texture, want, sample)
    load = TEXELS.load(*(field for name in TEXTURES.keys() - textures.keys() for field in TEXTURES[name].fields))

    @wp.func
    def sample_textures(wave: Wave, surfaces: Surfaces, first: int, end: int):
        count = end - first
        for i in range((count + LANES - 1) / LANES * LANES):
            material = int(-1)
            if i < count:
                prim_id = wave.queue.hits.prim_id[wave.outcomes.hit[first + i]]
                if prim_id < surfaces.n_triangles:
                    material = surfaces.prim_material[prim_id]
            want(wave, surfaces, i, material)
        sample(wave, surfaces, count)

    @wp.func
    def texels_at(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        if wp.static(features.spheres):
            if s.exclude_plus_one == 0:
                return look_up(surfaces, s)
        return load(wave.block.rows, i)

    return sample_textures, texels_at
