"""Shading normals at a wave's hits, on the side of the ray's origin, in vectorised loops."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import HITS, NORMALS, SURFACES, TEXELS
from wrt.kernels.loops.wave_textures import textures_vectorised
from wrt.kernels.rows import Rows
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.shading import Texels, bump
from wrt.kernels.shade.surface import Surface, visible_normal
from wrt.kernels.structs import Surfaces, noinline


def normal_rows(features: Features) -> Rows | None:
    """Return the rows that hold the shading normals; None if normals are computed one by one."""
    if features.instances or (features.normal_maps and not textures_vectorised(features)):
        return None
    return NORMALS if features.smooth or features.normal_maps else SURFACES.field("shading")


def make_compute_normals(features: Features) -> Any:
    """Return compute_normals(rows, count): fill the rows NORMALS of `count` hits from the rows HITS, SURFACES and TEXELS."""
    load_hit, load_surface, load_normal = HITS.load(), SURFACES.load(), TEXELS.field("normal").load()
    store_normal = NORMALS.store()

    @noinline
    def compute_normals(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            hit = load_hit(rows, i)
            s = load_surface(rows, i)
            n = s.shading
            if wp.static(features.normal_maps):
                n = where_vec3(hit.is_mapped != 0, bump(s, hit.normal_scale, load_normal(rows, i)), n)
            store_normal(rows, i, visible_normal(n, -hit.direction))
            i = i + 1

    return compute_normals


def make_wave_normals(features: Features, shading_normal: Any) -> tuple[Any, Any]:
    """Return compute_normals or None, and normal_at(wave, surfaces, surface, texels, wo, i) -> vec3 for hit i of the block.

    normal_at loads the result of compute_normals. If this is None, it calls `shading_normal` (from make_shading)."""
    vectorised = normal_rows(features) == NORMALS
    load_normal = NORMALS.load()

    @wp.func
    def normal_at(wave: Wave, surfaces: Surfaces, s: Surface, texels: Texels, wo: wp.vec3, i: int) -> wp.vec3:
        if wp.static(not vectorised):
            return shading_normal(surfaces, s, texels, wo)
        return load_normal(wave.block.rows, i)

    return make_compute_normals(features) if vectorised else None, normal_at
