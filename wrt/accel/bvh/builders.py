"""The builders of binary BVHs: the registry. Binary and wide structures offer them as the option `builder`."""

from __future__ import annotations

from collections.abc import Callable

from wrt.accel.base import Geometry
from wrt.accel.bvh_tree import BinaryTree, BvhOptions, sah_cost
from wrt.accel.registry import Registry

__all__ = ["BVH_BUILDERS", "BinaryTree", "BvhOptions", "build_binary", "sah_cost"]

BVH_BUILDERS: Registry[Callable[[Geometry, BvhOptions, int], BinaryTree]] = Registry("builder", {
    "binned": "wrt.accel.bvh_ranges:build_binned",
    "sweep": "wrt.accel.bvh_ranges:build_sweep",
    "sbvh": "wrt.accel.bvh_spatial:build_sbvh",
    "reinsertion": "wrt.accel.bvh_reinsertion:build_reinsertion",
    "median": "wrt.accel.bvh_ranges:build_median",
    "lbvh": "wrt.accel.bvh_ranges:build_lbvh",
})


def build_binary(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """A binary tree over the padded boxes of the geometry. Raises InputError for an unknown builder."""
    BVH_BUILDERS.check(options.builder)
    return BVH_BUILDERS[options.builder](geometry, options, threads)
