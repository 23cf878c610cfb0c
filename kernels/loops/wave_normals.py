"""Shading normals at a wave's hits, as the eye and lights see them, many at a time (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import BLOCK, Wave
from wrt.kernels.loops.wave_surfaces import ROW, put_row_vec3, row_number, row_vec3
from wrt.kernels.loops.wave_textures import NORMAL, in_lanes
from wrt.kernels.memory import int_at
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.shading import Texels, bump
from wrt.kernels.shade.surface import Surface, bent
from wrt.kernels.structs import Surfaces


def row_of_normals(features: Any) -> int | None:
    """The row where they are; None: they are computed one by one."""
    if features.instances or (features.normal_maps and not in_lanes(features)):
        return None
    return ROW["bent"] if features.smooth or features.normal_maps else ROW["shading"]


def make_wave_normals(features: Any, shading_normal: Any) -> tuple[Any, Any]:
    """bend(wave, count): for the hits of a block whose surfaces and textures are found; normal_at(wave, surfaces, surface, texels,
    wo, i): for the i-th of them, what was computed before, or by `shading_normal` (of make_shading)."""
    bends = row_of_normals(features) == ROW["bent"]

    @wp.func
    def bend(wave: Wave, count: int):
        rows = wave.rows
        i = int(0)
        while i < count:
            n = row_vec3(rows, wp.static(ROW["shading"]), i)
            if wp.static(features.normal_maps):
                s = Surface()
                s.shading = n
                s.front = int(row_number(rows, wp.static(ROW["front"]), i))
                s.tangent = row_vec3(rows, wp.static(ROW["tangent"]), i)
                s.bitangent_sign = row_number(rows, wp.static(ROW["bitangent_sign"]), i)
                mapped = bump(s, row_number(rows, wp.static(ROW["normal_scale"]), i), row_vec3(rows, wp.static(ROW["mapped"]), i))
                is_mapped = int_at(wave.wanted, wp.static(NORMAL * BLOCK) + i) >= 0
                n = where_vec3(is_mapped, mapped, n)
            put_row_vec3(rows, wp.static(ROW["bent"]), i, bent(n, -row_vec3(rows, wp.static(ROW["direction"]), i)))
            i = i + 1

    @wp.func
    def bend_nothing(wave: Wave, count: int):
        pass

    @wp.func
    def normal_at(wave: Wave, surfaces: Surfaces, s: Surface, texels: Texels, wo: wp.vec3, i: int) -> wp.vec3:
        if wp.static(not bends):
            return shading_normal(surfaces, s, texels, wo)
        if wp.static(features.spheres):
            if s.exclude_plus_one == 0:
                return shading_normal(surfaces, s, texels, wo)
        return row_vec3(wave.rows, wp.static(ROW["bent"]), i)

    return bend if bends else bend_nothing, normal_at
