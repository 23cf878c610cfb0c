"""What textures say at a wave's hits, many at a time."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import BLOCK, Wave
from wrt.kernels.loops.wave_surfaces import ROW, put_row_number, row_number, row_vec3
from wrt.kernels.memory import put_int
from wrt.kernels.native import source
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import Texels
from wrt.kernels.shade.surface import Surface
from wrt.kernels.shade.textures import FARTHEST, WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT
from wrt.kernels.structs import Surfaces, noinline

# Textures of a material, and which of their channels are read.
ALBEDO, EMISSION, PARAMETERS, TRANSMISSION, NORMAL = range(5)
SLOTS = 5


@wp.func_native(source("loops/texture_lanes.h", LANES=LANES, BLOCK=BLOCK, U_ROW=ROW["tex_u"], V_ROW=ROW["tex_v"],
                       FARTHEST=FARTHEST, WRAP_REPEAT=WRAP_REPEAT, WRAP_CLAMP=WRAP_CLAMP, WRAP_MIRROR=WRAP_MIRROR))
def sample_lanes(surfaces: Surfaces, wanted: wp.array(dtype=wp.int32), first: int, count: int, channels: int,
                 rows: wp.array(dtype=wp.float32), to: int) -> None:
    """Of the textures wanted[first] and what follows it, -1 behind the last up to a multiple of LANES, at the texture coordinates
    in two rows, to the rows from `to` on."""


@noinline
def sample_slot(wave: Wave, surfaces: Surfaces, slot: int, count: int, channels: int, to: int):
    """One texture of each of a block's hits."""
    sample_lanes(surfaces, wave.wanted, slot * BLOCK, count, channels, wave.rows, to)


def in_lanes(features: Any) -> bool:
    """Whether a wave's textures are sampled many at a time."""
    return features.textures and not features.checkerboards and not features.instances


def make_wave_textures(features: Any, look_up: Any) -> tuple[Any, Any]:
    """sample_textures(wave, surfaces, first, end): for the hits first .. end - 1, at most BLOCK, whose surfaces are found;
    texels_at(wave, surfaces, surface, i) -> Texels for the i-th of them: what was computed before, or by `look_up` (of
    make_shading)."""
    parameters, normals = features.parameter_textures, features.normal_maps

    @wp.func
    def want(wave: Wave, slot: int, i: int, texture: int):
        put_int(wave.wanted, slot * BLOCK + i, texture)

    @wp.func
    def sample_textures(wave: Wave, surfaces: Surfaces, first: int, end: int):
        count = end - first
        for i in range((count + LANES - 1) / LANES * LANES):
            albedo, emission, mr, transmission, normal = int(-1), int(-1), int(-1), int(-1), int(-1)
            if i < count:
                prim_id = wave.hits.prim_id[wave.met[first + i]]
                if prim_id < surfaces.n_triangles:
                    m = surfaces.prim_material[prim_id]
                    albedo = surfaces.materials[m].albedo_texture
                    emission = surfaces.materials[m].emission_texture
                    if wp.static(parameters):
                        mr = surfaces.materials[m].metallic_roughness_texture
                        transmission = surfaces.materials[m].transmission_texture
                    if wp.static(normals):
                        normal = surfaces.materials[m].normal_texture
                        put_row_number(wave.rows, wp.static(ROW["normal_scale"]), i, surfaces.materials[m].normal_scale)
            want(wave, ALBEDO, i, albedo)
            want(wave, EMISSION, i, emission)
            if wp.static(parameters):
                want(wave, PARAMETERS, i, mr)
                want(wave, TRANSMISSION, i, transmission)
            if wp.static(normals):
                want(wave, NORMAL, i, normal)
        sample_slot(wave, surfaces, ALBEDO, count, 15, wp.static(ROW["albedo"]))
        sample_slot(wave, surfaces, EMISSION, count, 7, wp.static(ROW["emissive"]))
        if wp.static(parameters):
            sample_slot(wave, surfaces, PARAMETERS, count, 6, wp.static(ROW["parameters"]))
            sample_slot(wave, surfaces, TRANSMISSION, count, 1, wp.static(ROW["transmission"]))
        if wp.static(normals):
            sample_slot(wave, surfaces, NORMAL, count, 7, wp.static(ROW["mapped"]))

    @wp.func
    def texels_at(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        if wp.static(features.spheres):
            if s.exclude_plus_one == 0:
                return look_up(surfaces, s)
        rows = wave.rows
        out = Texels()
        out.albedo = row_vec3(rows, wp.static(ROW["albedo"]), i)
        out.alpha = row_number(rows, wp.static(ROW["albedo"] + 3), i)
        out.emission = row_vec3(rows, wp.static(ROW["emissive"]), i)
        if wp.static(parameters):
            out.roughness = row_number(rows, wp.static(ROW["parameters"] + 1), i)
            out.metallic = row_number(rows, wp.static(ROW["parameters"] + 2), i)
            out.transmission = row_number(rows, wp.static(ROW["transmission"]), i)
        if wp.static(normals):
            out.normal = row_vec3(rows, wp.static(ROW["mapped"]), i)
        return out

    @wp.func
    def sample_nothing(wave: Wave, surfaces: Surfaces, first: int, end: int):
        pass

    @wp.func
    def look_up_alone(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        return look_up(surfaces, s)

    return (sample_textures, texels_at) if in_lanes(features) else (sample_nothing, look_up_alone)
