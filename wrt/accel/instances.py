"""Two levels: meshes that stand in several places are kept once, and a tree over the places leads to them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.answers import AccelStats, Refit
from wrt.accel.base import Accelerator, array_bytes
from wrt.accel.built import Built, State
from wrt.accel.bvh.top_down import in_order, split_ranges
from wrt.accel.bvh.tree import BinaryTree, BvhOptions
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.structure import Structure, check_units
from wrt.core.device import records, start, thread_count, upload
from wrt.core.errors import InputError
from wrt.core.seconds import seconds_without_loads
from wrt.kernels.structs import Surfaces
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.instances import Placement
from wrt.kernels.units.box import PAD_COORDINATE

ROUNDOFF = 2.0**-24
SLACK = 32.0 * ROUNDOFF  # see kernels.traverse.instances.enter
BOXES = 1 << 22  # box transforms that finding the instances' own boxes may take
ALIGNMENT = 64  # bytes, between the addresses of structures


class Instances(Accelerator):
    """A binary BVH over instances of structures of one kind, each built once. Options: those of the kind; `wrt.build` makes it.

    Same answers for every kind of structure and every tree: the closest of what the structures say of the ray in their spaces.
    """

    name = "instances"

    def __init__(self, kind: type[Accelerator], geometry: InstancedGeometry, device: str = "cpu", threads: int | None = None, *,
                 triangle: str = "watertight", box: str = "conservative", **options: Any) -> None:
        check_units(triangle, box)
        begin = time.perf_counter()
        self.device = start(device)
        self._state = State(geometry)  # type: ignore[arg-type]  # it has what a Geometry is asked for here
        self.threads = thread_count(threads)
        self.structure = Structure(kind, Units(triangle, box, len(geometry.spheres) > 0, instances=True))
        self._surfaces = Surfaces()
        self._surfaces.n_triangles = geometry.n_triangles
        self._surfaces.spheres = upload(geometry.spheres.copy(), wp.vec4, self.device)
        self.bottoms = [kind(part, device, threads, triangle=triangle, box=box, **options) for part in geometry.parts]
        self._place(begin)

    def _place(self, begin: float) -> None:
        """The upper level around the structures as they are."""
        # As they are now: a Warp array of structs holds addresses, and does not keep what a refit would replace.
        self._placed = [bottom._state for bottom in self.bottoms]
        tree = top_tree(self.geometry, self.bottoms, self.threads)  # type: ignore[arg-type]
        data = self._upload_top(tree)
        stats = [state.stats for state in self._placed]
        told = AccelStats(
            seconds_without_loads(begin), len(tree.nodes) + sum(s.nodes for s in stats), tree.leaves + sum(s.leaves for s in stats),
            tree.depth + max((s.depth for s in stats), default=0), sum(s.references for s in stats),
            array_bytes(data) + sum(s.bytes for s in stats), float("nan"))
        self._state = State(self.geometry, None, data, told)

    def _upload_top(self, tree: BinaryTree) -> Any:
        geometry: Any = self.geometry
        data = self.structure.struct()
        rows = records(Placement, len(tree.order))
        rows["bottom"], rows["first_prim"] = geometry.part[tree.order], geometry.first_prim[tree.order]
        to_local = geometry.to_local[tree.order]
        rows["local_x"], rows["local_y"], rows["local_z"] = to_local[:, 0], to_local[:, 1], to_local[:, 2]
        sizes = np.array([tree.nodes.nbytes, *(state.stats.bytes for state in self._placed)], np.int64)
        data.nodes = upload(tree.nodes, data._cls.vars["nodes"].type.dtype, self.device)
        data.placements = upload(rows, Placement, self.device)
        data.bottoms = wp.array([state.data for state in self._placed], dtype=self.structure.bottom, device=self.device)
        data.bases = upload(np.cumsum((sizes + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT)[:-1], wp.int64, self.device)
        data.slack = slack(geometry)
        return data

    def _build(self, *args: Any, **options: Any) -> Built:
        raise InputError("instances are built by wrt.build")

    def refit(self, vertices: Any, rebuild_at: float = np.inf, *, in_place: bool = False) -> Refit:
        """Raises InputError: one array of vertices cannot say where instances go."""
        raise InputError("instances cannot follow vertices that move; build them again")

    def save(self, path: Any) -> None:
        """Raises InputError: files hold one structure."""
        raise InputError("instances cannot be written to a file", path)

    def __repr__(self) -> str:
        s, geometry = self.stats, self.geometry
        return (f"Instances({len(geometry)} primitives in {len(geometry.part)} instances of "  # type: ignore[attr-defined]
                f"{len(self.bottoms)} {self.structure.accel.name}, {s.bytes / 1e6:.1f} MB, built in {s.build_seconds:.3f} s)")


def slack(geometry: InstancedGeometry) -> float:
    """The part of the distance by which boxes are widened: see kernels.traverse.instances.enter."""
    spread = np.abs(geometry.to_world[:, :, :3]) @ np.abs(geometry.to_local[:, :, :3])
    return float(np.float32(SLACK * spread.sum(axis=2).max(initial=1.0)))


def top_tree(geometry: InstancedGeometry, bottoms: list[Accelerator], threads: int) -> BinaryTree:
    lo, hi = world_boxes(geometry, bottoms)
    return split_ranges("binned", in_order(lo, hi), BvhOptions(max_leaf=1), threads)


def world_boxes(geometry: InstancedGeometry, bottoms: list[Accelerator]) -> tuple[np.ndarray, np.ndarray]:
    """The box of each instance, two (I, 3) float32: of the boxes of its primitives, transformed, and rounded outwards.

    A box around a transformed mesh would do for most hits; but t is held to the box of the primitive that is hit, which may
    stand out of the mesh.
    """
    lo, hi = np.full((len(geometry.part), 3), np.inf, np.float32), np.full((len(geometry.part), 3), -np.inf, np.float32)
    groups = max(BOXES // max(len(geometry.part), 1), 8)
    for index, bottom in enumerate(bottoms):
        chosen = np.nonzero(geometry.part == index)[0]
        low, high = grouped_boxes(geometry.parts[index], bottom.built.order, groups)
        if not len(low):
            continue
        center, half = 0.5 * (low + high), 0.5 * (high - low)
        for i in chosen:
            linear, offset = geometry.to_world[i, :, :3], geometry.to_world[i, :, 3]
            middle, reach = center @ linear.T + offset, half @ np.abs(linear).T
            lo[i], hi[i] = rounded_out((middle - reach).min(axis=0), (middle + reach).max(axis=0))
    return lo, hi


def grouped_boxes(geometry: Geometry, order: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, no more than about `groups`, two (G, 3) float64, that together hold all boxes of a geometry. order: of prim_ids,
    so that neighbours are near."""
    low, high = (corner.astype(np.float64) for corner in geometry.bounds())
    if len(low) <= groups:
        return low, high
    first = np.arange(0, len(order), -(-len(order) // groups))
    return np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)


def rounded_out(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners in float64 to float32, outwards, with room for the rounding of the origin's coordinates."""
    pad = 2.0 * PAD_COORDINATE * np.maximum(np.abs(low), np.abs(high))
    return np.nextafter((low - pad).astype(np.float32), np.float32(-np.inf)), \
        np.nextafter((high + pad).astype(np.float32), np.float32(np.inf))
