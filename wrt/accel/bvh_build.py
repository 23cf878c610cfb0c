"""The builders of binary BVHs: the registry. Binary and wide structures offer them as the option `builder`."""

from __future__ import annotations

from collections.abc import Callable

from wrt.accel.base import Geometry
from wrt.accel.bvh_ranges import build_binned, build_lbvh, build_median, build_sweep
from wrt.accel.bvh_reinsertion import build_reinsertion
from wrt.accel.bvh_spatial import build_sbvh
from wrt.accel.bvh_tree import BinaryTree, BvhOptions, sah_cost
from wrt.errors import InputError

__all__ = ["BVH_BUILDERS", "BinaryTree", "BvhOptions", "build_binary", "sah_cost"]

BVH_BUILDERS: dict[str, Callable[[Geometry, BvhOptions, int], BinaryTree]] = {
    "binned": build_binned,
    "sweep": build_sweep,
    "sbvh": build_sbvh,
    "reinsertion": build_reinsertion,
    "median": build_median,
    "lbvh": build_lbvh,
}


def build_binary(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """A binary tree over the padded boxes of the geometry. Raises InputError for an unknown builder."""
    if options.builder not in BVH_BUILDERS:
        raise InputError(f"no builder {options.builder!r}; there is {', '.join(BVH_BUILDERS)}")
    return BVH_BUILDERS[options.builder](geometry, options, threads)
