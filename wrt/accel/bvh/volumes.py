"""Binary BVHs with other bounding volumes: the trees of bvh2, with spheres or 14-DOPs in place of boxes."""

from __future__ import annotations

import numpy as np
import warp as wp

from wrt.accel.bvh.binary import BinaryBvh
from wrt.accel.bvh.builders import expected_cost, root_area, sah_cost
from wrt.accel.bvh.refit import Fitting, parents_of, tree_of
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.accel.store import check_links
from wrt.core.device import launch, on_host, records, start, upload
from wrt.core.types import WarpType
from wrt.kernels.build import volumes as fits
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.traverse.bvh2_volumes import KDOPS, SPHERES, KdopNode, SphereNode
from wrt.kernels.units.kdop import KDOP_PAD

NODES_PER_LAUNCH = 512
SQRT_3 = np.float32(1.7320510)  # rounded up


class VolumeBvh(BinaryBvh):
    """The tree of bvh2 with other volumes, which `_around` fits to the primitives. Options: BinaryOptions."""

    def _boxes(self, built: Built) -> np.ndarray:
        """Return Bvh2Node records with the links of built.arrays["nodes"] and boxes around the geometry; a missing child is empty."""
        cpu = start("cpu")
        nodes = upload(with_common_fields(Bvh2Node, built.arrays["nodes"]), Bvh2Node, cpu)
        fitting = Fitting(cpu, len(self.geometry), len(nodes))
        fitting.refit(tree_of(fitting, nodes, parents_of(nodes), upload(built.order.copy(), wp.int32, cpu)), self.geometry.on(cpu))
        return on_host(nodes).copy()

    def _refit(self, built: Built) -> Built:
        return self._around(self._boxes(built), built.order, built.leaves, built.depth)


class Bvh2Sphere(VolumeBvh):
    """A binary BVH of bounding spheres around the primitives' padded boxes. Options: BinaryOptions."""

    name = "bvh2_sphere"
    kernels = SPHERES

    def _around(self, nodes: np.ndarray, order: np.ndarray, leaves: int, depth: int) -> Built:
        spheres = fit_spheres(nodes, order, self.geometry, self.threads)
        radius = np.stack([spheres["sphere_0"][:, 3], spheres["sphere_1"][:, 3]]).astype(np.float64)
        areas = np.where(radius >= 0.0, 4.0 * np.pi * radius * radius, 0.0)
        # Parts of spheres outside of the root's box count, too.
        cost = expected_cost(2.0 * root_area(nodes), areas, np.stack([nodes["count_0"], nodes["count_1"]]))
        return Built({"nodes": spheres}, order, len(nodes), leaves, depth, cost)

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        empty = [nodes[f"sphere_{side}"][:, 3] < 0.0 for side in "01"]
        check_links(nodes, empty, len(built.order), STACK_SIZE)


class Bvh2Kdop(VolumeBvh):
    """A binary BVH of 14-DOPs: the boxes of bvh2, cut by eight diagonal planes. Options: BinaryOptions.

    All 14-DOPs have the same plane normals, unlike oriented boxes. So they are fitted from the leaves up without a search, and a ray
    is prepared once for all nodes. Three of the seven slabs are the box itself. AccelStats.sah_cost is that of the boxes, a bound.
    """

    name = "bvh2_kdop"
    kernels = KDOPS

    def _around(self, nodes: np.ndarray, order: np.ndarray, leaves: int, depth: int) -> Built:
        middle = middle_of(nodes)
        kdops = fit_kdops(nodes, order, self.geometry, middle)
        return Built({"nodes": kdops, "middle": middle}, order, len(nodes), leaves, depth, sah_cost(nodes))


def spans_of(nodes: np.ndarray) -> list[np.ndarray]:
    """Return begin and end, (2 N,) each, of the range of primitives below each child. Node i has the children 2 i and 2 i + 1."""
    first, count = (np.stack([nodes[f"{what}_0"], nodes[f"{what}_1"]], axis=1).reshape(-1) for what in ("first", "count"))
    ends = []
    for side in range(2):
        at = np.arange(len(first))  # goes down to the first or the last leaf
        while (inner := np.flatnonzero((count[at] == 0) & (first[at] > 0))).size:
            at[inner] = 2 * first[at[inner]] + side
        ends.append(first[at] + side * count[at])
    return [ends[0], ends[1]]


def with_common_fields(struct: WarpType, nodes: np.ndarray) -> np.ndarray:
    """Make records of `struct`, and copy the values of all fields that `struct` and the records `nodes` have in common."""
    out = records(struct, len(nodes))
    for name in set(out.dtype.names or ()) & set(nodes.dtype.names or ()):
        out[name] = nodes[name]
    return out


def fit_spheres(nodes: np.ndarray, order: np.ndarray, geometry: Geometry, threads: int) -> np.ndarray:
    """Make a SphereNode record for each Bvh2Node record, with spheres around the padded boxes of the primitives below."""
    cpu = start("cpu")
    lo, hi = geometry.bounds()
    out = upload(with_common_fields(SphereNode, nodes), SphereNode, cpu)
    spans = upload(np.stack(spans_of(nodes), axis=1), wp.vec2i, cpu)
    launch(fits.fit_spheres, len(nodes), upload(nodes, Bvh2Node, cpu), spans, upload(order.copy(), wp.int32, cpu),
           upload(lo, wp.vec3, cpu), upload(hi, wp.vec3, cpu), out, None, threads=threads, step=NODES_PER_LAUNCH)
    return on_host(out)


def middle_of(nodes: np.ndarray) -> np.ndarray:
    """Return the middle of the root's box, (3,) float32; 0 along infinite axes."""
    lo, hi = np.minimum(nodes["lo_0"][0], nodes["lo_1"][0]), np.maximum(nodes["hi_0"][0], nodes["hi_1"][0])
    with np.errstate(invalid="ignore", over="ignore"):
        middle = (np.float32(0.5) * lo + np.float32(0.5) * hi).astype(np.float32)
    return np.where(np.isfinite(middle), middle, np.float32(0.0))


def cuts(geometry: Geometry, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the padded extent of every primitive along the four diagonals, relative to `middle`: low and high (N, 4) float32."""
    n = len(geometry.faces)
    lo, hi = np.empty((len(geometry), 4), np.float32), np.empty((len(geometry), 4), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices, centers = project(geometry.vertices - middle), project(geometry.spheres[:, :3] - middle)
        corners = [vertices[geometry.faces[:, i]] for i in range(3)]
        lo[:n] = np.minimum(np.minimum(corners[0], corners[1]), corners[2])
        hi[:n] = np.maximum(np.maximum(corners[0], corners[1]), corners[2])
        reach = SQRT_3 * geometry.spheres[:, 3:]
        lo[n:], hi[n:] = centers - reach, centers + reach
        box_lo, box_hi = geometry.bounds()
        size = np.maximum(np.abs(box_lo - middle), np.abs(box_hi - middle)).sum(axis=1, keepdims=True)
        lo, hi = lo - np.float32(KDOP_PAD) * size, hi + np.float32(KDOP_PAD) * size
    finite = np.isfinite(lo) & np.isfinite(hi)
    return np.where(finite, lo, np.float32(-np.inf)), np.where(finite, hi, np.float32(np.inf))


def project(v: np.ndarray) -> np.ndarray:
    """Project points (N, 3) float32 onto the four diagonals, (N, 4), bit for bit as kernels.units.kdop.project does."""
    x, y, z = v[:, 0], v[:, 1], v[:, 2]
    return np.stack([x + y + z, y - x + z, x - y + z, x + y - z], axis=1)


def fit_kdops(nodes: np.ndarray, order: np.ndarray, geometry: Geometry, middle: np.ndarray) -> np.ndarray:
    """Make a KdopNode record for each Bvh2Node record, with 14-DOPs around the primitives below."""
    cpu = start("cpu")
    cut_lo, cut_hi = cuts(geometry, middle)
    out = upload(with_common_fields(KdopNode, nodes), KdopNode, cpu)
    launch(fits.fit_kdops, 1, upload(order.copy(), wp.int32, cpu), upload(cut_lo, wp.vec4, cpu), upload(cut_hi, wp.vec4, cpu), out)
    return on_host(out)
