"""Shading normals at a wave's hits, as the eye and lights see them, many at a time (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import BENT, HITS, NORMAL_MAPS, SURFACES, TEXELS, NormalMap
from wrt.kernels.loops.wave_textures import in_lanes
from wrt.kernels.rows import Rows
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.shading import Texels, bump
from wrt.kernels.shade.surface import Surface, bent
from wrt.kernels.structs import Surfaces


def rows_of_normals(features: Features) -> Rows | None:
    """Return the rows where they are; None: they are computed one by one."""
    if features.instances or (features.normal_maps and not in_lanes(features)):
        return None
    return BENT if features.smooth or features.normal_maps else SURFACES.field("shading")


def make_gather_maps() -> Any:
    """gather_maps(wave, surfaces, first, end): the NormalMap of each of the hits first .. end - 1."""
    store_map = NORMAL_MAPS.store()

    @wp.func
    def gather_maps(wave: Wave, surfaces: Surfaces, first: int, end: int):
        for j in range(first, end):
            out = NormalMap()
            prim_id = wave.queue.hits.prim_id[wave.outcomes.hit[j]]
            if prim_id < surfaces.n_triangles:
                material = surfaces.prim_material[prim_id]
                out.scale = surfaces.materials[material].normal_scale
                out.is_mapped = wp.where(surfaces.materials[material].normal_texture >= 0, 1, 0)
            store_map(wave.block.rows, j - first, out)

    return gather_maps


def make_bend(features: Features) -> Any:
    """bend(wave, surfaces, first, end): put the normals of the hits first .. end - 1, whose surfaces and textures are found, to the
    rows BENT."""
    gather_maps = make_gather_maps()
    load_surface, load_direction = SURFACES.load("material", "exclude_plus_one"), HITS.field("direction").load()
    load_map, load_color, store_bent = NORMAL_MAPS.load(), TEXELS.field("normal").load(), BENT.store()

    @wp.func
    def bend(wave: Wave, surfaces: Surfaces, first: int, end: int):
        if wp.static(features.normal_maps):
            gather_maps(wave, surfaces, first, end)
        rows = wave.block.rows
        i = int(0)
        while i < end - first:
            s = load_surface(rows, i)
            n = s.shading
            if wp.static(features.normal_maps):
                map = load_map(rows, i)
                n = where_vec3(map.is_mapped != 0, bump(s, map.scale, load_color(rows, i)), n)
            store_bent(rows, i, bent(n, -load_direction(rows, i)))
            i = i + 1

    return bend


def make_wave_normals(features: Features, shading_normal: Any) -> tuple[Any, Any]:
    """Return bend (of make_bend), and normal_at(wave, surfaces, surface, texels, wo, i): for the i-th hit of a block, what was
    computed before, or by `shading_normal` (of make_shading)."""
    bends = rows_of_normals(features) == BENT
    load_bent = BENT.load()

    @wp.func
    def bend_nothing(wave: Wave, surfaces: Surfaces, first: int, end: int):
        pass

    @wp.func
    def normal_at(wave: Wave, surfaces: Surfaces, s: Surface, texels: Texels, wo: wp.vec3, i: int) -> wp.vec3:
        if wp.static(not bends):
            return shading_normal(surfaces, s, texels, wo)
        if wp.static(features.spheres):
            if s.exclude_plus_one == 0:
                return shading_normal(surfaces, s, texels, wo)
        return load_bent(wave.block.rows, i)

    return make_bend(features) if bends else bend_nothing, normal_at
