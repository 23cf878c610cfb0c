"""Shading normals at a wave's hits, as the eye and lights see them, many at a time (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import BENT, HITS, SURFACES, TEXELS
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


def make_bend(features: Features) -> Any:
    """Return bend(rows, count): put the normals of a block's first hits, whose surfaces and textures are found, to BENT."""
    load_met, load_surface, load_color = HITS.load(), SURFACES.load(), TEXELS.field("normal").load()
    store_bent = BENT.store()

    @wp.func
    def bend(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            met = load_met(rows, i)
            s = load_surface(rows, i)
            n = s.shading
            if wp.static(features.normal_maps):
                n = where_vec3(met.is_mapped != 0, bump(s, met.normal_scale, load_color(rows, i)), n)
            store_bent(rows, i, bent(n, -met.direction))
            i = i + 1

    return bend


def make_wave_normals(features: Features, shading_normal: Any) -> tuple[Any, Any]:
    """Return bend (of make_bend), and normal_at(wave, surfaces, surface, texels, wo, i): of the i-th hit of a block, what was
    computed before, or by `shading_normal` (of make_shading)."""
    bends = rows_of_normals(features) == BENT
    load_bent = BENT.load()

    @wp.func
    def bend_nothing(rows: wp.array(dtype=wp.float32), count: int):
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
