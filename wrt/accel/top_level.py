"""Upper level of instances: a binary tree for each world, all in one array of nodes. For the traversal of many rays
(kernels.wide.instances) the same trees have nodes with eight children. Moves: kernels/build/moves.py."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.bvh.builders import BvhOptions, half_areas
from wrt.accel.geometry import MAX_SPREAD, InstancedGeometry
from wrt.accel.queries.raw_launches import launch_raw
from wrt.accel.queries.transforms import transforms_of
from wrt.core.device import empty_aligned, launch_on, load_kernel, on_host, records, start, upload
from wrt.core.types import Device, Kernel, WarpArray, WarpStruct
from wrt.kernels.build import moves as kernels
from wrt.kernels.traverse.instances import Placement
from wrt.kernels.warp_private import fields_of
from wrt.kernels.wide.layout import PLANES, WIDTH, first_reference, node_size
from wrt.kernels.wide.references import EMPTY, leaf_reference
from wrt.scene.values import MAX_REACH

BOXES = 1 << 22  # primitives' boxes to transform in a build, summed over all instances.
MOVED_BOXES = 64  # Boxes of a part in a move: fewer boxes take less time, and make the boxes of instances slightly larger.
INSTANCES_PER_JOB = 1024
WRITTEN = ("placements", "low", "high", "slack", "slot_slack", "node_slack", "nodes", "wide", "pending", "invalid")  # by a move
NONE = -1

Boxes = tuple[np.ndarray, np.ndarray]  # centers and halves, (G, 3) float64 each


@dataclass(frozen=True, eq=False)
class TopLevel:
    """Trees over instances."""

    data: WarpStruct  # kernels.build.moves.TopLevel on the structure's device.
    roots: np.ndarray  # (W,) indices of the roots among the nodes.
    order: np.ndarray  # (I,) int32, instance of each placement.
    depth: int  # Depth of the deepest tree.
    threads: int

    @property
    def cost(self) -> float:
        """Sum of the surface areas of all boxes, each divided by the area of its tree's root."""
        nodes = on_host(self.data.nodes)
        areas = np.stack([half_areas(nodes["lo_" + side], nodes["hi_" + side]) for side in "01"])
        of_root = [end(nodes[name + "_0"], nodes[name + "_1"])[self.roots] for name, end in (("lo", np.minimum), ("hi", np.maximum))]
        whole = np.repeat(half_areas(*of_root), np.diff([*self.roots, len(nodes)]))
        return float((areas.sum(axis=0)[whole > 0.0] / whole[whole > 0.0]).sum())

    def copied(self) -> "TopLevel":
        """Return the trees with copies of the arrays that a move writes, and without `to_world`."""
        out = kernels.TopLevel()
        for name in fields_of(out):
            value = getattr(self.data, name)
            setattr(out, name, None if name == "to_world" else wp.clone(value) if name in WRITTEN and value is not None else value)
        return replace(self, data=out)

    def movable(self, rows: np.ndarray, geometry: InstancedGeometry, boxes: list[Boxes]) -> "TopLevel":
        """Return the trees with what moves need. rows: instance of each value of hits.instance; boxes: see `part_boxes`."""
        out, device = self.copied(), self.data.nodes.device
        origins = np.array([np.zeros(3) if part.origin is None else part.origin for part in geometry.parts])
        out.data.rows, out.data.invalid = upload(rows, wp.int32, device), wp.zeros(len(rows), dtype=wp.int32, device=device)
        out.data.own_origin, out.data.most_spread, out.data.reach = upload(origins, wp.vec3d, device), MAX_SPREAD, MAX_REACH
        set_boxes(out.data, boxes, device)
        for kernel in (kernels.place, kernels.fit):
            load_kernel(kernel, device)
        return out

    def place(self, ids: WarpArray, transforms: WarpStruct) -> None:
        """Write placements and boxes. ids: values of hits.instance; transforms: kernels.transforms.Transforms. Call `fit` afterwards."""
        launch(kernels.place, self.data, ids, transforms, threads=self.threads)

    def follow(self, ids: WarpArray, part: int, tree: WarpStruct) -> None:
        """Write the boxes of a refitted part and of its instances. ids: values of hits.instance; tree: of InPlaceBvh. Call `fit` then."""
        step, to_world = -(-len(tree.order) // MOVED_BOXES), self.data.to_world
        count = len(tree.low) if step <= 1 else -(-len(tree.order) // step)
        launch_on(ids.device, kernels.measure, count, self.data, part, step, tree.order, tree.low, tree.high, captured=True)
        transforms = transforms_of(wp.array(ptr=to_world.ptr, dtype=wp.float64, shape=4 * len(to_world), device=ids.device), 12, ids.device)
        transforms.own = True
        self.place(ids, transforms)

    def fit(self, ids: WarpArray) -> None:
        """Fit the trees to the instances that `place` or `follow` changed."""
        launch(kernels.fit, self.data, ids, threads=self.threads)


def launch(kernel: Kernel, data: WarpStruct, ids: WarpArray, *inputs: WarpStruct, threads: int) -> None:
    """Launch a kernel over `ids`, so that a graph can capture it. On the CPU, its threads share the work."""
    device: Device = ids.device
    if device.is_cpu and not device.is_capturing:
        launch_raw(kernel, len(ids), data, ids, *inputs, None, threads=threads, step=INSTANCES_PER_JOB)
    else:
        launch_on(device, kernel, len(ids), data, ids, *inputs, None, captured=True)


def set_boxes(data: WarpStruct, boxes: list[Boxes], device: Device) -> None:
    """Set the boxes of parts in a kernels.build.moves.TopLevel."""
    data.first_box = upload(np.cumsum([0, *(len(center) for center, _ in boxes)]), wp.int32, device)
    data.center, data.half = (upload(np.concatenate(each), wp.vec3d, device) for each in zip(*boxes, strict=True))


def build_top(geometry: InstancedGeometry, boxes: list[Boxes], device: Device, threads: int, wide: bool) -> TopLevel:
    """Build the trees. boxes: see `part_boxes`. wide: make the wide nodes, too."""
    n, cpu, data = len(geometry.part), start("cpu"), kernels.TopLevel()
    placements, everything = records(Placement, n), upload(np.arange(n), wp.int32, cpu)
    placements["bottom"], placements["first_prim"] = geometry.part, geometry.first_prim_in_world
    data.placements, data.rows, data.place = upload(placements, Placement, cpu), everything, everything
    data.low, data.high = (wp.empty(n, dtype=wp.vec3, device=cpu) for _ in range(2))
    data.slack, data.invalid = wp.empty(n, dtype=float, device=cpu), wp.empty(n, dtype=wp.int32, device=cpu)
    data.most_spread = data.reach = np.inf
    set_boxes(data, boxes, cpu)
    launch(kernels.place, data, everything, transforms_of(geometry.to_world, 12, cpu), threads=threads)
    return plant(data, geometry.first_instance, device, threads, wide)


def plant(data: WarpStruct, first_instance: np.ndarray, device: Device, threads: int, wide: bool) -> TopLevel:
    """Build trees over instances whose boxes and placements are known. first_instance: see InstancedGeometry."""
    from wrt.accel.bvh.top_down import build_forest  # builders are imported when they are needed: most scenes have no instances

    low, high, place = (on_host(getattr(data, name)) for name in ("low", "high", "place"))
    forest, roots = build_forest("binned", low, high, first_instance, BvhOptions(max_leaf=1))
    nodes, order, count = forest.nodes, forest.order, len(forest.nodes)
    first, size = sides(nodes, "first"), sides(nodes, "count")
    leaf, inner = np.flatnonzero(size > 0), np.flatnonzero((size == 0) & (first > 0))
    arrays = {"place": np.empty(len(order), np.int32), "slot": np.empty(len(order), np.int32), "up": np.full(count, NONE, np.int32),
              "slot_slack": np.zeros(2 * count, np.float32), "node_slack": np.zeros(count, np.float32), "nodes": nodes,
              "pending": np.bincount(np.concatenate([leaf, inner]) // 2, minlength=count).astype(np.int32),
              "placements": on_host(data.placements)[place[order]], "low": low, "high": high, "slack": on_host(data.slack)}
    arrays["place"][order] = np.arange(len(order))
    arrays["slot"][order[first[leaf]]], arrays["up"][first[inner]] = leaf, inner
    if wide:
        arrays |= widen(nodes, roots)
    cpu, out = start("cpu"), kernels.TopLevel()
    for name, kind in fields_of(out).items():
        given = getattr(data, name)
        if name in arrays:
            setattr(out, name, upload(arrays[name], kind.dtype, cpu))
        elif isinstance(given, wp.array) and name not in ("wide", "wide_slot", "wide_node", "to_world", "rows"):
            setattr(out, name, given.to(cpu))
    out.rows = every = upload(np.arange(len(order)), wp.int32, cpu)
    launch(kernels.fit, out, every, threads=threads)
    out.rows, out.origin, out.most_spread, out.reach = data.rows, data.origin, data.most_spread, data.reach
    for name in fields_of(out) if device.is_cuda else ():
        array = getattr(out, name)
        if isinstance(array, wp.array):
            setattr(out, name, upload(on_host(array), array.dtype, device))
    return TopLevel(out, roots, order, forest.depth, threads)


def part_boxes(geometry: InstancedGeometry, bottoms: list[OneMesh], groups: int) -> list[Boxes]:
    """Return boxes around groups of each part's primitives, about `groups` per part.

    bottoms: the parts' structures, whose order puts near primitives next to each other. A box around the mesh is not enough for the box
    of an instance: a hit may lie anywhere in its primitive's padded box, which extends beyond the mesh.
    """
    out = []
    for part, bottom in zip(geometry.parts, bottoms, strict=True):
        order = bottom.built.order
        low, high = (np.clip(corner, -kernels.LARGEST, kernels.LARGEST, dtype=np.float64) for corner in part.bounds())
        if len(order) > groups:
            first = np.arange(0, len(order), -(-len(order) // groups))
            low, high = np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)
        out.append((0.5 * (low + high), 0.5 * (high - low)))
    return out


def sides(binary: np.ndarray, name: str) -> np.ndarray:
    """Return a field of both children of all binary nodes, in the order 2 * node + side."""
    return np.stack([binary[name + "_0"], binary[name + "_1"]], axis=1).reshape(2 * len(binary), *binary[name + "_0"].shape[1:])


def widen(binary: np.ndarray, roots: np.ndarray) -> dict[str, np.ndarray]:
    """Make wide trees, in the layout of kernels.wide.nodes, without boxes. Return the fields wide, wide_slot and wide_node of
    kernels.build.moves.TopLevel. The trees' roots come first.

    A node takes the place of its largest child, by area, until it has eight children or only leaves. The row behind the references has
    the box around all children and the largest slack (instances.h: widening).
    """
    first, count, area = sides(binary, "first"), sides(binary, "count"), half_areas(sides(binary, "lo"), sides(binary, "hi"))
    exists, at, size = (count > 0) | (first > 0), first_reference(WIDTH, False), node_size(WIDTH, False)
    level, rows, made = roots.astype(np.int64), [], 0
    wide_slot, wide_node = np.full(2 * len(binary), NONE, np.int32), np.full(len(binary), NONE, np.int32)
    while len(level):
        code = np.full((len(level), WIDTH), NONE)
        code[:, 0], code[:, 1] = 2 * level, 2 * level + 1
        for slot in range(2, WIDTH):
            inner = (code != NONE) & (count[code] == 0) & exists[code]
            largest = np.where(inner, area[code], -1.0).argmax(axis=1)
            row = np.flatnonzero(inner[np.arange(len(code)), largest])
            child = first[code[row, largest[row]]]
            code[row, largest[row]], code[row, slot] = 2 * child, 2 * child + 1
        code[~exists[code]] = NONE
        leaf, inner = (code != NONE) & (count[code] > 0), (code != NONE) & (count[code] == 0)
        index = made + np.arange(len(level))
        made += len(level)
        wide_node[level] = size * index + at + WIDTH
        wide_slot[code[leaf | inner]] = (size * index[:, None] + np.arange(WIDTH))[leaf | inner]
        children = np.full(code.shape, EMPTY, np.int32)
        children[leaf] = leaf_reference.func(first[code[leaf]].astype(np.int64), 1)
        children[inner] = made + np.arange(inner.sum())
        rows.append(children)
        level = first[code[inner]].astype(np.int64)
    wide = empty_aligned((made, size), np.float32)
    wide[:, :at].reshape(-1, len(PLANES), WIDTH)[:, ::2], wide[:, :at].reshape(-1, len(PLANES), WIDTH)[:, 1::2] = np.inf, -np.inf
    wide[:, at : at + WIDTH], wide[:, at + WIDTH :] = np.concatenate(rows).view(np.float32), 0.0
    return {"wide": wide.reshape(-1), "wide_slot": wide_slot, "wide_node": wide_node}
