"""Embree's packets, called from a CPU kernel without Python in between: a rival to measure."""

import warp as wp

from wrt.kernels.native import source
from wrt.kernels.query import HitArrays
from wrt.kernels.structs import kernel

# From rtcore_common.h and rtcore_ray.h; FLUSH: bits of the MXCSR that flush denormal inputs and results.
LAYOUT = {"LANES": 16, "ALIGNMENT": 64, "NONE": 0xFFFFFFFF, "COHERENT": 1 << 16, "FLUSH": 0x8040}


@wp.func_native(source("study/embree_packets.h", **LAYOUT))
def packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
            directions: wp.array(dtype=wp.vec3), hits: HitArrays) -> None:
    """Trace all rays; hits.t is their reach, then t of the hit. any_hit: it becomes -inf, and other arrays stay."""


@kernel
def embree_packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
                   directions: wp.array(dtype=wp.vec3), hits: HitArrays):
    packets(function, scene, coherent, any_hit, origins, directions, hits)
