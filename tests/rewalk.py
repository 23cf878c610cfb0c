"""What a ray costs, told by plain Python: each structure is walked again, ray by ray, and its counters must come out exactly.

REWALK[name](structure, ray) gives the `Walk` of one ray. What the triangle unit says is taken from testing every primitive
(`rays`), so that a walk knows nothing of the code that it checks but the layout of the structure's arrays. A new structure
adds its walk here.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from tests.kernels.every_hit import HitList, make_all_hits_kernel
from wrt.core.device import load_kernel, upload
from wrt.kernels.query import RayArrays
from wrt.kernels.traverse.kdtree import HELD_GRAZING, HELD_RELATIVE
from wrt.kernels.units.bounding_sphere import SMALLEST, SPHERE_PAD
from wrt.kernels.units.box import FAR_PAD
from wrt.kernels.units.kdop import RAY_PAD
from wrt.kernels.wide.lanes import LANE_PAD

INF = np.float32(np.inf)
REACH = np.float32(2.0**-19)
PRIMITIVES = 1 << 40
PRIMITIVE_BYTES = 40


@dataclass
class Walk:
    """The counters of one ray, and what it fetched: (address, bytes)."""

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
    """One ray; hits: what the triangle unit says of each primitive on it, prim_id -> t; best: (t, prim_id) so far."""

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
        """Record `index` of the primitives is tested."""
        walk.primitives += 1
        walk.trace.append((PRIMITIVES + index * PRIMITIVE_BYTES, PRIMITIVE_BYTES))
        prim_id = int(prim_ids(accel)[index])
        if prim_id in self.hits:
            self.best = min(self.best, (self.hits[prim_id], prim_id))

    def enter(self, lo: np.ndarray, hi: np.ndarray) -> np.float32:
        """Where the ray enters a box before its best hit, by conservative slabs in float32; inf if it does not."""
        backwards = self.inv_dir < 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            near = (np.where(backwards, hi, lo) - self.origin) * self.inv_dir
            far = (np.where(backwards, lo, hi) - self.origin) * self.inv_dir
        enter = np.fmax.reduce(near, initial=self.t_min)
        leave = np.minimum(np.float32(np.fmin.reduce(far, initial=INF) * np.float32(FAR_PAD)), self.best[0])
        return enter if enter <= leave else INF


def prim_ids(accel) -> np.ndarray:
    """The prim_id of every record; a wide structure keeps one number of so many records as a row."""
    primitives = accel.data.primitives.numpy()
    if primitives.dtype.names:
        return primitives["prim_id"]
    return primitives.reshape(-1, PRIMITIVE_BYTES // 4, accel.width)[:, -1].copy().view(np.int32).reshape(-1)


def rays(geometry, origins, directions, t_min=0.0, t_max=np.inf, capacity=256) -> list[WalkRay]:
    """The rays with all their hits, found by testing every primitive with the default unit."""
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
    return binary(accel, ray, lambda node, k: ray.enter(node[f"lo_{k}"], node[f"hi_{k}"]))


def binary(accel, ray: WalkRay, enter: Callable[[np.void, int], np.float32]) -> Walk:
    """enter(node, k): where the ray enters child k before its best hit, or inf."""
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
            near = sorted((t, k) for k in (0, 1) if (t := enter(node, k)) < INF)
            if not near:
                break
            if len(near) == 2:
                t, k = near[1]
                stack.append((t, int(node[f"first_{k}"]), int(node[f"count_{k}"])))
                walk.push(len(stack))
            k = near[0][1]
            first, count = int(node[f"first_{k}"]), int(node[f"count_{k}"])
    return walk


def bvh2_sphere(accel, ray: WalkRay) -> Walk:
    d = ray.direction.astype(np.float64)
    length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    unit, inv_length = (d / length).astype(np.float32), np.float32(1.0 / length)

    def enter(node: np.void, k: int) -> np.float32:
        sphere = node[f"sphere_{k}"]
        f = ray.origin - sphere[:3]
        size = abs(f[0]) + abs(f[1]) + abs(f[2]) + sphere[3]
        middle = -(f[0] * unit[0] + f[1] * unit[1] + f[2] * unit[2])
        f = f + middle * unit
        radius = sphere[3] + (np.float32(SPHERE_PAD) * size + np.float32(SMALLEST))
        square = radius * radius - (f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
        if sphere[3] < 0.0 or square < 0.0:
            return INF
        half = np.sqrt(square)
        t = max((middle - half) * inv_length, ray.t_min)
        return t if t <= min((middle + half) * inv_length, ray.best[0]) else INF

    return binary(accel, ray, enter)


def bvh2_kdop(accel, ray: WalkRay) -> Walk:
    def project(v: np.ndarray) -> np.ndarray:
        return np.array([v[0] + v[1] + v[2], v[1] - v[0] + v[2], v[0] - v[1] + v[2], v[0] + v[1] - v[2]])

    from_middle = ray.origin - np.array(accel.data.middle, np.float32)
    origin, pad = project(from_middle), np.float32(RAY_PAD) * (abs(from_middle[0]) + abs(from_middle[1]) + abs(from_middle[2]))
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / project(ray.direction)

    def line(lo: np.ndarray, hi: np.ndarray, from_: np.ndarray, inv: np.ndarray, pad: np.float32) -> tuple[np.float32, np.float32]:
        with np.errstate(invalid="ignore"):
            ends = ((lo - from_) - pad) * inv, ((hi - from_) + pad) * inv
        near, far = np.where(inv < 0.0, ends[::-1], ends)
        return np.fmax.reduce(near, initial=-INF), np.fmin.reduce(far, initial=INF)

    def enter(node: np.void, k: int) -> np.float32:
        near, far = line(node[f"lo_{k}"], node[f"hi_{k}"], ray.origin, ray.inv_dir, np.float32(0.0))
        askew = line(node[f"cut_lo_{k}"], node[f"cut_hi_{k}"], origin, inverse, pad)
        passes_by = max(near, askew[0]) > min(far * np.float32(FAR_PAD), askew[1])
        return INF if passes_by else ray.enter(node[f"lo_{k}"], node[f"hi_{k}"])

    return binary(accel, ray, enter)


def widened(t: np.float32) -> tuple[np.float32, np.float32]:
    """t less and t plus the rounding of what it is compared with."""
    ends = t * np.float32(2.0 - float(FAR_PAD)), t * np.float32(FAR_PAD)
    return np.minimum(*ends), np.maximum(*ends)


def kdtree(accel, ray: WalkRay) -> Walk:
    walk, nodes, stack = Walk(boxes=1, box_operations=1), accel.data.nodes.numpy(), []
    lo, hi = np.array(accel.data.lo, np.float32), np.array(accel.data.hi, np.float32)
    if ray.enter(lo, hi) == INF:
        return walk
    finite = np.abs(ray.inv_dir[np.isfinite(ray.inv_dir)])
    box = np.float32(1.01) / np.abs(ray.direction).max()
    held = np.float32(accel.data.reach) * min(np.float32(HELD_GRAZING) * finite.max(), box)
    backwards = ray.inv_dir < 0.0
    enter = np.fmax.reduce((np.where(backwards, hi, lo) - ray.origin) * ray.inv_dir)
    leave = np.fmin.reduce((np.where(backwards, lo, hi) - ray.origin) * ray.inv_dir)
    t_enter = max(widened(enter)[0] - held, ray.t_min * np.float32(2.0 - HELD_RELATIVE) - held)
    t_exit = min(widened(leave)[1] + held, ray.best[0] * np.float32(HELD_RELATIVE) + held)
    index = 0
    while True:
        split, word = nodes[index]
        walk.node(index, nodes.itemsize, 0)
        axis, first = int(word) & 3, int(word) >> 2
        if axis != 3:
            with np.errstate(invalid="ignore"):
                far_enter, near_exit = widened((split - ray.origin[axis]) * ray.inv_dir[axis])
            near, far = (first + 1, first) if backwards[axis] else (first, first + 1)
            if t_enter > near_exit:
                index, t_enter = far, np.fmax(t_enter, far_enter)
                continue
            if not t_exit < far_enter:
                stack.append((far, np.fmax(t_enter, far_enter), t_exit))
                walk.push(len(stack))
            index, t_exit = near, np.fmin(t_exit, near_exit)
            continue
        walk.box_operations -= 1  # a leaf has no plane
        walk.leaves += 1
        for i in range(first, first + int(split)):
            ray.test(walk, accel, i)
        while True:
            if not stack:
                return walk
            walk.pops += 1
            index, t_enter, t_exit = stack.pop()
            t_exit = min(t_exit, ray.best[0] * np.float32(HELD_RELATIVE) + held)
            if t_enter <= t_exit:
                break


def grid(accel, ray: WalkRay) -> Walk:
    """From plane to plane, with the distances to all planes taken beforehand."""
    walk, layout = Walk(), accel.data
    n, mailbox, seen = tuple(layout.n), int(accel.data.mailbox), [0] * 8
    cells, references = accel.data.cells.numpy(), accel.data.references.numpy()
    slack = cell_slack(accel, ray)
    lo, hi, size = (np.array(v, np.float32) for v in (layout.lo, layout.hi, layout.size))
    with np.errstate(invalid="ignore", over="ignore"):
        slabs = []
        for a in range(3):
            planes = (lo[a] + np.arange(n[a], dtype=np.float32) * size[a]).astype(np.float32)
            t = (np.append(planes, hi[a]) - ray.origin[a]) * ray.inv_dir[a]
            t = t if ray.inv_dir[a] > 0.0 else t[::-1]
            slabs.append((t[:-1], t[1:]))
        t_in = max(max(s[0][0] for s in slabs), earlier(ray.t_min) - slack)
        if not t_in <= later(min(s[1][-1] for s in slabs)):
            return walk
        at = [int(np.argmax(later(s[1]) >= t_in)) for s in slabs]
        while t_in <= later(ray.best[0]) + slack:
            leave = [slabs[a][1][at[a]] for a in range(3)]
            axis = int(np.argmin(leave))
            t_in = leave[axis]
            beside = [[at[a]] if a == axis else [b for b in range(at[a], n[a]) if slabs[a][0][b] <= later(t_in) or b == at[a]]
                      for a in range(3)]
            side, other = (axis + 1) % 3, (axis + 2) % 3
            for q in beside[other]:
                for p in beside[side]:
                    cell = {axis: at[axis], side: p, other: q}
                    x, y, z = (cell[a] if ray.inv_dir[a] > 0.0 else n[a] - 1 - cell[a] for a in range(3))
                    index = x + n[0] * (y + n[1] * z)
                    walk.node(index, cells.itemsize, 0)
                    first, count = int(cells[index]["first"]), int(cells[index]["count"])
                    walk.leaves += count > 0
                    for primitive in references[first : first + count].tolist():
                        if mailbox and seen[primitive % 8] == primitive + 1:
                            continue
                        seen[primitive % 8] = primitive + 1
                        ray.test(walk, accel, primitive)
            at[axis] += 1
            if at[axis] == n[axis]:
                break
    return walk


def octree(accel, ray: WalkRay) -> Walk:
    """Down from the root by recursion; the planes of a cell are handed down as numbers of the finest cells."""
    walk, data = Walk(boxes=1, box_operations=1), accel.data
    mailbox, nodes, references, seen, entries = int(data.mailbox) > 0, data.nodes.numpy(), data.references.numpy(), [0] * 8, [0]
    slack, n = cell_slack(accel, ray), 1 << int(data.levels)
    begin = earlier(ray.t_min) - slack
    lo, hi = np.array(data.lo, np.float32), np.array(data.hi, np.float32)
    backwards = ray.inv_dir < 0.0

    def planes(at: np.ndarray) -> np.ndarray:
        return np.minimum(lo + at.astype(np.float32) * np.float32(data.size), hi)

    def enter(low: np.ndarray, size: int) -> np.float32:
        """Where the ray enters a cell; inf where it passes by, or after its best hit."""
        ends = planes(low), planes(low + size)
        with np.errstate(invalid="ignore", over="ignore"):
            near, far = ((np.where(backwards, a, b) - ray.origin) * ray.inv_dir for a, b in (ends[::-1], ends))
        t = np.fmax.reduce(near, initial=begin)
        return t if t <= later(np.fmin.reduce(far)) and t <= later(ray.best[0]) + slack else INF

    def visit(index: int, low: np.ndarray, size: int) -> None:
        walk.node(index, nodes.itemsize, 0)
        first, count = int(nodes[index]["first"]), int(nodes[index]["count"])
        if count >= 0:
            walk.leaves += 1
            walk.box_operations -= 1  # a leaf has no planes
            for primitive in references[first : first + count].tolist():
                if not mailbox or seen[primitive % 8] != primitive + 1:
                    seen[primitive % 8] = primitive + 1
                    ray.test(walk, accel, primitive)
            return
        octants = [k for k in range(8) if -count >> k & 1]
        walk.boxes += len(octants)
        half = size // 2
        corners = [low + half * (k >> np.arange(3) & 1) for k in octants]
        # In the order of the ray: by halves, the z axis first to tell.
        met = [(int(((corner > low) != backwards) @ [1, 2, 4]), first + i, corner)
               for i, corner in enumerate(corners) if enter(corner, half) < INF]
        met.sort(key=lambda child: child[0])
        if len(met) > 1:
            entries[0] += 1
            walk.push(entries[0])
        for i, (_, child, corner) in enumerate(met):
            walk.pops += i > 0
            entries[0] -= i > 0 and i == len(met) - 1
            if i == 0 or enter(corner, half) < INF:
                visit(child, corner, half)

    if enter(np.zeros(3, np.int64), n) < INF:
        visit(0, np.zeros(3, np.int64), n)
    return walk


def later(t: np.ndarray) -> np.ndarray:
    return np.maximum(t * np.float32(FAR_PAD), t * np.float32(2.0 - FAR_PAD))


def earlier(t: np.ndarray) -> np.ndarray:
    return np.minimum(t * np.float32(FAR_PAD), t * np.float32(2.0 - FAR_PAD))


def cell_slack(accel, ray: WalkRay) -> np.float32:
    """How far a hit may be told to lie from the cells that list it."""
    inverse = np.abs(ray.inv_dir)
    two, pad, extent = (np.float32(x) for x in (2.0, accel.data.pad, accel.data.extent))
    return min(two * pad * inverse[inverse < INF].max(), two * extent * inverse.min())


def wide(accel, ray: WalkRay) -> Walk:
    """A child's reference is 0 for none, an inner node, or ~(64 * begin + primitives - 1); begin counts rows, or primitives."""
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
    """As WalkRay.enter, with far planes by widened reciprocals, and no box beyond float32."""
    backwards = ray.inv_dir < 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        near = (np.where(backwards, hi, lo) - ray.origin) * ray.inv_dir
        far = (np.where(backwards, lo, hi) - ray.origin) * (ray.inv_dir * np.float32(LANE_PAD))
    enter = np.fmax.reduce(near, initial=ray.t_min)
    return enter if enter <= np.fmin.reduce(far, initial=min(ray.best[0], np.finfo(np.float32).max)) else INF


def visit_order(walk: Walk, stack: list[tuple[np.float32, int]], entered: list[tuple[np.float32, int]]) -> int:
    """Push all but the nearest, never one above a farther one that is above the rest; at equal t by the reference, unsigned."""
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


def bsp_reach(accel, ray: WalkRay) -> tuple[np.float32, ...]:
    """t_0, t_1, how far the walk goes on behind the best hit, and the planes' thickness for each unit of t; in float32."""
    lo, hi = (np.array(getattr(accel.data, name), np.float32) for name in ("lo", "hi"))
    grow = REACH * np.maximum(np.abs(lo - ray.origin), np.abs(hi - ray.origin)).max() + np.float32(2.0**-120)
    backwards = ray.inv_dir < 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        near = (np.where(backwards, hi + grow, lo - grow) - ray.origin) * ray.inv_dir
        far = (np.where(backwards, lo - grow, hi + grow) - ray.origin) * ray.inv_dir
    size = np.abs(ray.direction)
    beyond = min(grow / size[size > 0.0].min(), (np.float32(accel.data.extent) + np.float32(2.0) * grow) / size.max())
    return (np.maximum(np.fmax.reduce(near), ray.t_min - beyond), np.minimum(np.fmin.reduce(far), ray.t_max + beyond), beyond,
            REACH * size.max())


def bsp(accel, ray: WalkRay) -> Walk:
    walk, nodes = Walk(), accel.data.nodes.numpy()
    t_0, t_1, beyond, drift = bsp_reach(accel, ray)
    stack = [(t_0, t_1, int(accel.data.first), int(accel.data.count))] if t_0 <= t_1 else []
    first_visit = True
    while stack:
        t_0, t_1, first, count = stack.pop()
        if not first_visit:
            walk.pops += 1
            if t_0 > ray.best[0] + beyond:
                continue
            t_1 = min(t_1, ray.best[0] + beyond)
        first_visit = False
        while count < 0:
            node = nodes[first]
            walk.node(first, nodes.itemsize, 0)
            axis, n = int(node["axis"]), node["normal"]
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                if axis < 3:
                    height, inv = -node["offset"] - ray.origin[axis], ray.inv_dir[axis]
                else:
                    o, d = ray.origin, ray.direction
                    height = -(n[0] * o[0] + n[1] * o[1] + n[2] * o[2] + node["offset"])
                    inv = np.float32(1.0) / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
                thick = node["tolerance"] + drift * max(-t_0, t_1)
                near, far = ("1", "0") if inv < 0.0 else ("0", "1")
                near_end, far_begin = ((height - thick) * inv, (height + thick) * inv) if inv < 0.0 else (
                    (height + thick) * inv, (height - thick) * inv)
            visits = []
            if node["count_" + near] != 0 and not t_0 > near_end:
                visits.append((t_0, near_end if near_end < t_1 else t_1, int(node["first_" + near]), int(node["count_" + near])))
            if node["count_" + far] != 0 and not far_begin > t_1:
                visits.append((far_begin if far_begin > t_0 else t_0, t_1, int(node["first_" + far]), int(node["count_" + far])))
            if not visits:
                break
            if len(visits) == 2:
                stack.append(visits[1])
                walk.push(len(stack))
            t_0, t_1, first, count = visits[0]
        if count > 0:
            walk.leaves += 1
            for i in range(first, first + count):
                ray.test(walk, accel, i)
    return walk


REWALK: dict[str, Callable[..., Walk]] = {
    "brute_force": brute_force,
    "bvh2": bvh2,
    "bvh2_sphere": bvh2_sphere,
    "bvh2_kdop": bvh2_kdop,
    "bvh4": wide,
    "bvh8": wide,
    "bvh8c": wide,
    "kdtree": kdtree,
    "bsp": bsp,
    "grid": grid,
    "octree": octree,
}
