"""Tree for winding numbers: each subtree has a multipole expansion of its solid angle (kernels/winding.py)."""

from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.bvh.builders import BvhOptions, build_binary
from wrt.accel.geometry import Geometry
from wrt.accel.points.enclosing import finite_faces
from wrt.accel.queries.hit_points import device_scene
from wrt.accel.snapshot import Snapshot, once
from wrt.core.device import launch_on, records, upload
from wrt.core.types import WarpArray
from wrt.kernels.winding import WindingNode, expand_nodes

LEAF = 8  # triangles
NODES_PER_LAUNCH = 256


class WindingTree(NamedTuple):
    """Tree on the structure's device.

    nodes: WindingNode; node 0 is the root. faces: indices of faces, in the order of the leaves.
    """

    nodes: WarpArray
    faces: WarpArray


@once
def winding_tree(snapshot: Snapshot, threads: int) -> WindingTree:
    """Make the tree over the finite faces of a structure's mesh."""
    mesh, device = snapshot.mesh, snapshot.device
    used = finite_faces(mesh)
    nodes, order = nodes_over(Geometry(mesh.vertices, mesh.faces[used], np.zeros((0, 4), np.float32)), threads)
    begin, end = ranges_of(nodes)
    tree = WindingTree(upload(nodes, WindingNode, device), upload(used[order], wp.int32, device))
    launch_on(device, expand_nodes, len(nodes), device_scene(snapshot).surfaces, tree.faces, upload(begin, wp.int32, device),
              upload(end, wp.int32, device), tree.nodes, None, threads=threads, step=NODES_PER_LAUNCH)
    return tree


def nodes_over(geometry: Geometry, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Return WindingNode records without expansions, each before its children, and the triangles in the order of the leaves."""
    n = len(geometry)
    if n <= LEAF:
        nodes = records(WindingNode, 1)
        nodes["count"] = n
        return nodes, np.arange(n)
    tree = build_binary(geometry, BvhOptions("binned", max_leaf=LEAF), threads)
    # Child `side` of inner node i is node 2 i + side + 1 here.
    first, count = (np.stack([tree.nodes[f"{name}_{side}"] for side in "01"], axis=1).reshape(-1) for name in ("first", "count"))
    nodes = records(WindingNode, len(first) + 1)
    nodes["first"], nodes["count"] = np.append(1, np.where(count > 0, first, 2 * first + 1)), np.append(0, count)
    return nodes, tree.order


def ranges_of(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first triangle of each node's subtree, and the end of its triangles, (N,)."""
    begin, count = nodes["first"].copy(), nodes["count"].copy()
    waiting = np.flatnonzero(count == 0) if len(nodes) > 1 else np.zeros(0, np.int64)
    while len(waiting):
        child = nodes["first"][waiting]
        ready = (count[child] > 0) & (count[child + 1] > 0)
        some, child = waiting[ready], child[ready]
        begin[some], count[some] = begin[child], count[child] + count[child + 1]
        waiting = waiting[~ready]
    return begin, begin + count
