"""Traversals in plain Python of the structures that the RT core model uses; kernels must have exactly the same counters.

REWALK[name](structure, ray) traverses with one ray and returns its `Walk`. The hits with triangles come from brute force (`rays`).
So a traversal shares with the code under test only the layout of the arrays and the constants that pad the boxes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from tests.kernels.every_hit import HitList, make_all_hits_kernel
from wrt.core.device import load_kernel, upload
from wrt.kernels.query import RayArrays
from wrt.kernels.units.box import FAR_PAD
from wrt.kernels.wide.lanes import LANE_PAD

INF = np.float32(np.inf)
PRIMITIVES = 1 << 40  # address of the first primitive in a trace
PRIMITIVE_BYTES = 40


@dataclass
class Walk:
    """The counters of one ray. stack: the largest number of entries; trace: (address, bytes) of each fetch."""

    nodes: int = 0
    boxes: int = 0
    box_operations: int = 0
    primitives: int = 0
    leaves: int = 0
    pushes: int = 0
    pops: int = 0
    stack: int = 0
    trace: list[tuple[int, int]] = field(default_factory=list)

    def node(self, index: int, size: int, boxes: int) -> None:
        self.nodes += 1
        self.boxes += boxes
        self.box_operations += 1
        self.trace.append((index * size, size))

    def push(self, size: int) -> None:
        self.pushes += 1
        self.stack = max(self.stack, size)


@dataclass
class WalkRay:
    """One ray. hits: all its hits, t by prim_id; best: (t, prim_id) of the closest hit so far."""

    origin: np.ndarray
    direction: np.ndarray
    t_min: np.float32
    t_max: np.float32
    hits: dict[int, np.float32]
    best: tuple[np.float32, int] = (INF, -1)

    def __post_init__(self) -> None:
        self.best = (self.t_max, 1 << 31)
        with np.errstate(divide="ignore"):
            self.inv_dir = np.float32(1.0) / self.direction

    def test(self, walk: Walk, accel, index: int) -> None:
        """Test the primitive in record `index`."""
        walk.primitives += 1
        walk.trace.append((PRIMITIVES + index * PRIMITIVE_BYTES, PRIMITIVE_BYTES))
        prim_id = int(prim_ids(accel)[index])
        if prim_id in self.hits:
            self.best = min(self.best, (self.hits[prim_id], prim_id))

    def enter(self, lo: np.ndarray, hi: np.ndarray) -> np.float32:
        """Return the t at which the ray enters a box before its best hit, else inf: the conservative slab test in float32."""
        backwards = self.inv_dir < 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            near = (np.where(backwards, hi, lo) - self.origin) * self.inv_dir
            far = (np.where(backwards, lo, hi) - self.origin) * self.inv_dir
        enter = np.fmax.reduce(near, initial=self.t_min)
        leave = np.minimum(np.float32(np.fmin.reduce(far, initial=INF) * np.float32(FAR_PAD)), self.best[0])
        return enter if enter <= leave else INF


def prim_ids(accel) -> np.ndarray:
    """Return the prim_id of every record; wide structures store blocks of `width` records, field by field."""
    primitives = accel.data.primitives.numpy()
    if primitives.dtype.names:
        return primitives["prim_id"]
    return primitives.reshape(-1, PRIMITIVE_BYTES // 4, accel.width)[:, -1].copy().view(np.int32).reshape(-1)


def rays(geometry, origins, directions, t_min=0.0, t_max=np.inf, capacity=256) -> list[WalkRay]:
    """Return the rays with all their hits, by brute force with the default units."""
    from wrt.accel.scenes.build import build

    yardstick = build(geometry, "brute_force")
    kernel = make_all_hits_kernel(yardstick.structure.units)
    n, device = len(origins), yardstick.device
    arrays = RayArrays()
    arrays.origin, arrays.direction = (upload(np.ascontiguousarray(a, np.float32), wp.vec3, device) for a in (origins, directions))
    arrays.t_min, arrays.t_max = (upload(np.full(n, t, np.float32), wp.float32, device) for t in (t_min, t_max))
    out = HitList()
    out.capacity = capacity
    out.count = wp.zeros(n, dtype=wp.int32, device=device)
    out.prim_id = wp.zeros(n * capacity, dtype=wp.int32, device=device)
    out.t = wp.zeros(n * capacity, dtype=wp.float32, device=device)
    load_kernel(kernel, device)
    wp.launch(kernel, dim=n, inputs=[yardstick.data.primitives, yardstick.snapshot.surfaces, arrays, out, 0], device=device)
    count = out.count.numpy()
    assert count.max(initial=0) <= capacity, "more hits on a ray than there is room for"
    prim_id, t = out.prim_id.numpy().reshape(n, capacity), out.t.numpy().reshape(n, capacity)
    origin, direction = arrays.origin.numpy(), arrays.direction.numpy()
    return [WalkRay(origin[i], direction[i], np.float32(t_min), np.float32(t_max),
                    dict(zip(prim_id[i, :count[i]].tolist(), t[i, :count[i]], strict=True))) for i in range(n)]


def brute_force(accel, ray: WalkRay) -> Walk:
    walk = Walk()
    for i in range(len(accel.geometry)):
        ray.test(walk, accel, i)
    return walk


def bvh2(accel, ray: WalkRay) -> Walk:
    walk, nodes, stack = Walk(), accel.data.nodes.numpy(), [(np.float32(0.0), 0, 0)]
    first_visit = True
    while stack:
        t, first, count = stack.pop()
        if not first_visit:
            walk.pops += 1
            if t > ray.best[0]:
                continue
        first_visit = False
        while True:
            if count:
                walk.leaves += 1
                for i in range(first, first + count):
                    ray.test(walk, accel, i)
                break
            node = nodes[first]
            walk.node(first, nodes.itemsize, 2)
            near = sorted((t, k) for k in (0, 1) if (t := ray.enter(node[f"lo_{k}"], node[f"hi_{k}"])) < INF)
            if not near:
                break
            if len(near) == 2:
                t, k = near[1]
                stack.append((t, int(node[f"first_{k}"]), int(node[f"count_{k}"])))
                walk.push(len(stack))
            k = near[0][1]
            first, count = int(node[f"first_{k}"]), int(node[f"count_{k}"])
    return walk


def wide(accel, ray: WalkRay) -> Walk:
    """Traverse a wide BVH. A child's reference is 0 (no child), an inner node, or ~(64 * begin + primitives - 1) for a leaf.

    `begin` counts blocks of `width` primitives, but in a compressed BVH single primitives."""
    walk, stack, width = Walk(), [], accel.width
    tree, references = accel._tree(accel.built), accel._references(accel.built)
    unit, size = (1, 96) if accel.compressed else (width, 32 * width)
    current: int | None = 0
    while current is not None:
        if current < 0:
            walk.leaves += 1
            first, count = -1 - current >> 6, (-1 - current & 63) + 1
            for i in range(first * unit, first * unit + count):
                ray.test(walk, accel, i)
        else:
            walk.node(current, size, int((references[current] != 0).sum()))
            entered = [(t, int(references[current, k])) for k in range(width)
                       if (t := enter_lane(ray, tree.lo[current, k], tree.hi[current, k])) < INF]
            if entered:
                current = visit_order(walk, stack, entered)
                continue
        current = None
        while stack and current is None:
            t, reference = stack.pop()
            walk.pops += 1
            if t <= ray.best[0]:
                current = reference
    return walk


def enter_lane(ray: WalkRay, lo: np.ndarray, hi: np.ndarray) -> np.float32:
    """Return the t at which the ray enters a box, as WalkRay.enter does, but pad the reciprocals of the far planes, and end the ray
    at the largest float32."""
    backwards = ray.inv_dir < 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        near = (np.where(backwards, hi, lo) - ray.origin) * ray.inv_dir
        far = (np.where(backwards, lo, hi) - ray.origin) * (ray.inv_dir * np.float32(LANE_PAD))
    enter = np.fmax.reduce(near, initial=ray.t_min)
    return enter if enter <= np.fmin.reduce(far, initial=min(ray.best[0], np.finfo(np.float32).max)) else INF


def visit_order(walk: Walk, stack: list[tuple[np.float32, int]], entered: list[tuple[np.float32, int]]) -> int:
    """Push all entries but the nearest, and return the nearest's reference. Entries are compared by t, then by unsigned reference.

    The order on the stack is the kernels', which is not a full sort: each new entry is only compared with the one below it."""
    def key(entry: tuple[np.float32, int]) -> tuple[np.float32, int]:
        return entry[0], entry[1] % (1 << 32)

    nearest, begin = entered[0], len(stack)
    for entry in entered[1:]:
        nearest, far = sorted((nearest, entry), key=key)
        stack.append(far)
        if len(stack) > begin + 1:
            stack[-2:] = sorted(stack[-2:], key=key, reverse=True)
        walk.push(len(stack))
    return nearest[1]


def bvh6(accel, ray: WalkRay) -> Walk:
    """Traverse a bvh6: the nearest child next, the others sorted on the stack. A leaf's reference is -64 * primitive - 1."""
    walk, tree = Walk(), accel._tree(accel.built)
    stack, current = [], 0
    while current is not None:
        if current < 0:
            walk.leaves += 1
            ray.test(walk, accel, -1 - current >> 6)
        else:
            children = tree.children[current]
            walk.node(current, 64, int((children != 0).sum()))
            # Entries sort by t, then by unsigned reference, where the kernel's reference of a leaf is -1 - primitive.
            entered = sorted((t, (r if r > 0 else -1 - (-1 - r >> 6)) % (1 << 32), r) for k in range(6)
                             if (r := int(children[k])) and (t := ray.enter(tree.lo[current, k], tree.hi[current, k])) < INF)
            if entered:
                for t, _, r in entered[:0:-1]:
                    stack.append((t, r))
                    walk.push(len(stack))
                current = entered[0][2]
                continue
        current = None
        while stack and current is None:
            t, r = stack.pop()
            walk.pops += 1
            if t <= ray.best[0]:
                current = r
    return walk


REWALK: dict[str, Callable[..., Walk]] = {
    "brute_force": brute_force,
    "bvh2": bvh2,
    "bvh4": wide,
    "bvh6": bvh6,
    "bvh8": wide,
    "bvh8c": wide,
}
