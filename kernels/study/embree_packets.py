"""Embree's packets, called from a kernel, so that no Python stands between two of them: a rival to measure, on the CPU only."""

import warp as wp

from wrt.kernels.native import source
from wrt.kernels.query import HitArrays
from wrt.kernels.structs import kernel

# rtcore_common.h, rtcore_ray.h; FLUSH: of the MXCSR, denormals that come in and that go out.
LAYOUT = {"LANES": 16, "ALIGNMENT": 64, "NONE": 0xFFFFFFFF, "COHERENT": 1 << 16, "FLUSH": 0x8040}


@wp.func_native(source("study/embree_packets.h", **LAYOUT))
def packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
            directions: wp.array(dtype=wp.vec3), hits: HitArrays) -> None:
    """All rays. hits.t: how far they reach, and then where they hit; any hit: -inf, and no other array is touched."""


@kernel
def embree_packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
                   directions: wp.array(dtype=wp.vec3), hits: HitArrays):
    packets(function, scene, coherent, any_hit, origins, directions, hits)
