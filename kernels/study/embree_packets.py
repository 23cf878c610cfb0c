"""Embree's functions for packets of sixteen rays, called from a CPU kernel without Python in between, for comparison with wrt."""

from typing import TYPE_CHECKING

import warp as wp

from wrt.kernels.headers import constants, with_headers
from wrt.kernels.query import HitArrays
from wrt.kernels.structs import kernel

# Constants of rtcore_common.h and rtcore_ray.h. FLUSH has the bits of the MXCSR register that flush denormal inputs and results to 0.
LAYOUT_H = constants({"LANES": 16, "ALIGNMENT": 64, "NONE": 0xFFFFFFFF, "COHERENT": 1 << 16, "FLUSH": 0x8040})
HEADERS = with_headers("study/embree_packets.h", layout=LAYOUT_H)

if TYPE_CHECKING:  # type checkers skip device code (structs.py)
    from typing import no_type_check as embree_kernel
else:
    def embree_kernel(function):
        return kernel(function, extra_build_options=HEADERS)


@wp.func_native("wrt::trace_packets(function, scene, coherent, any_hit, origins, directions, hits);")
def packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
            directions: wp.array(dtype=wp.vec3), hits: HitArrays) -> None: ...


@embree_kernel
def embree_packets(function: wp.uint64, scene: wp.uint64, coherent: bool, any_hit: bool, origins: wp.array(dtype=wp.vec3),
                   directions: wp.array(dtype=wp.vec3), hits: HitArrays):
    """Trace all rays. On entry, hits.t has t_max of each ray. Then it has t of the hit; with any_hit, it has -inf for a ray that hits.
    `function`: address of Embree's rtcIntersect16 or rtcOccluded16. With any_hit, the other arrays of `hits` do not change."""
    packets(function, scene, coherent, any_hit, origins, directions, hits)
