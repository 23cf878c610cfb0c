"""Registry of builders of binary BVHs: the option `builder` of binary and wide structures."""

from collections.abc import Callable

from wrt.accel.bvh.tree import BinaryOptions, BinaryTree, BvhOptions, sah_cost
from wrt.accel.geometry import Geometry
from wrt.core.registry import Registry

__all__ = ["BVH_BUILDERS", "BinaryOptions", "BinaryTree", "BvhOptions", "build_binary", "sah_cost"]

BVH_BUILDERS: Registry[Callable[[Geometry, BvhOptions, int], BinaryTree]] = Registry("builder", {
    "binned": "wrt.accel.bvh.top_down:build_binned",
    "sweep": "wrt.accel.bvh.top_down:build_sweep",
    "sbvh": "wrt.accel.bvh.spatial:build_sbvh",
    "refined": "wrt.accel.bvh.reinsertion:build_refined",
    "reinsertion": "wrt.accel.bvh.reinsertion:build_reinsertion",
    "median": "wrt.accel.bvh.top_down:build_median",
    "lbvh": "wrt.accel.bvh.lbvh:build_lbvh",
})


def build_binary(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build a binary tree over the padded boxes of the geometry. Raises InputError for an unknown builder."""
    BVH_BUILDERS.check(options.builder, "builder")
    return BVH_BUILDERS[options.builder](geometry, options, threads)
