"""The acceleration structures by name, and where each one is. The command line's help reads it too, and must not wait for Warp."""

from __future__ import annotations

STRUCTURES = {
    "bvh": "wrt.accel.bvh.wide:Bvh8",  # the default: the best one there is
    "bvh2": "wrt.accel.bvh.binary:Bvh2",
    "bvh4": "wrt.accel.bvh.wide:Bvh4",
    "bvh8": "wrt.accel.bvh.wide:Bvh8",
    "bvh2_sphere": "wrt.accel.bvh.volumes:Bvh2Sphere",
    "bvh2_kdop": "wrt.accel.bvh.volumes:Bvh2Kdop",
    "bvh8c": "wrt.accel.bvh.wide:Bvh8c",
    "kdtree": "wrt.accel.cells.kdtree:KdTree",
    "bsp": "wrt.accel.cells.bsp:Bsp",
    "brute_force": "wrt.accel.brute_force:BruteForce",
    "grid": "wrt.accel.cells.grid:Grid",
    "octree": "wrt.accel.cells.octree:Octree",
}
