"""`python -m wrt whatif`: change one part of the RT core's design, trace the same rays again, and apply the model.

Every variant must find the same hits; the column `differ` counts the rays whose hit differs (must be 0)."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.bvh.binary import Bvh2
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Counters
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import Built
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.kernels.study.bvh2_study import LEVELS, STACK_SIZE, Study, child_0_first
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Groups, Row, mesh_name
from wrt.lab.bench.report import run as run
from wrt.lab.rtcore import WhatIf as Plan
from wrt.lab.rtcore.meshes import bvhs, in_warps
from wrt.lab.rtcore.model import Work, by_coherence, packed, predict, simt
from wrt.lab.rtcore.parameters import BASE, GPUS, Gpu

FRAME_BYTES = 16  # of a node's frame: corner (12), and an exponent of the step for each axis
REFERENCE_BYTES = 16  # of the children's references in a binary node, as in Bvh2Node


@cache
def studied(study: Study) -> type[Bvh2]:
    """Return a Bvh2 class that traverses with the kernels of `study` (kernels.study.bvh2_study)."""
    return type("Bvh2Study", (Bvh2,), {"kernels": study, "__doc__": Bvh2.__doc__})


def with_traversal(accel: OneMesh, study: Study) -> OneMesh:
    """Return the tree with the traversal of a study. Raise InputError if the tree is too deep for a restart trail."""
    if study.entries < STACK_SIZE and accel.stats.depth > LEVELS:
        raise InputError(f"the tree is {accel.stats.depth} levels deep; a restart trail has bits for {LEVELS} levels")
    return studied(study).restore(accel.built, accel.geometry)


def quantised(lo: np.ndarray, hi: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Round boxes outwards to planes of `bits` bits in the frame of their node; return the boxes and the bytes of a node.

    lo, hi: (N, C, 3) float32, the boxes of C children; empty boxes (lo = inf) stay empty. A frame is the node's lowest corner and, for each
    axis, a power of two as the step (Ylitie, Karras and Laine 2017, section 3.1). No box shrinks: if float32 rounding would cut off a part
    of a box, the plane moves one step farther."""
    empty = ~(lo <= hi).all(axis=2, keepdims=True)
    low = np.where(empty, np.inf, lo).min(axis=1, keepdims=True)
    high = np.where(empty, -np.inf, hi).max(axis=1, keepdims=True)
    origin = np.where(np.isfinite(low), low, 0.0).astype(np.float32)
    extent = np.where(np.isfinite(high - low), high.astype(np.float64) - low, 0.0)
    # Leave one step free, for planes that move one step farther.
    step = np.exp2(np.ceil(np.log2(np.maximum(extent / ((1 << bits) - 2), 2.0**-100)))).astype(np.float32)

    def plane(code: np.ndarray) -> np.ndarray:
        return origin + code.astype(np.float32) * step

    with np.errstate(invalid="ignore"):
        below = np.clip(np.floor((lo.astype(np.float64) - origin) / step), 0, (1 << bits) - 1)
        above = np.clip(np.ceil((hi.astype(np.float64) - origin) / step), 0, (1 << bits) - 1)
        below -= (plane(below) > lo) & (below > 0)
        above += (plane(above) < hi) & (above < (1 << bits) - 1)
    out_lo, out_hi = np.where(empty, lo, plane(below)), np.where(empty, hi, plane(above))
    size = -(-lo.shape[1] * 6 * bits // 8) + FRAME_BYTES + REFERENCE_BYTES
    return out_lo.astype(np.float32), out_hi.astype(np.float32), size


def with_planes(accel: OneMesh, bits: int) -> tuple[OneMesh, int]:
    """Return the tree with box planes of `bits` bits, and the bytes of a node."""
    nodes = accel.built.arrays["nodes"].copy()
    lo, hi = (np.stack([nodes[f"{end}_{side}"] for side in (0, 1)], axis=1) for end in ("lo", "hi"))
    lo, hi, size = quantised(lo, hi, bits)
    for side in (0, 1):
        nodes[f"lo_{side}"], nodes[f"hi_{side}"] = lo[:, side], hi[:, side]
    built: Built = replace(accel.built, arrays={**accel.built.arrays, "nodes": nodes})
    return Bvh2.restore(built, accel.geometry), size


def resized(counters: Counters, before: int, after: int) -> Counters:
    """Return the counters as if a node had `after` bytes instead of `before` bytes."""
    node = counters.address < int(PRIMITIVE_SPACE)
    counts: Any = counters.counts.copy()
    counts["node_bytes"] = counts["nodes"] * after
    return Counters(counts, counters.first, np.where(node, counters.address // before * after, counters.address),
                    np.where(node, after, counters.size))


MANY_WARPS = replace(BASE, warps=32, warm=True)  # hides latency and fills the L2, so that test units and cache lines decide
ENTRIES = (STACK_SIZE, 8, 4, 2, 1, 0)
BITS = (16, 8, 6, 4)
TITLE = "What if"
COLUMNS: Columns = {
    "variant": "{variant}", "rays": "{kind}", "B/node": "{node_bytes}", "nodes/ray": "{nodes:.1f}", "boxes/ray": "{boxes:.1f}",
    "triangles/ray": "{triangles:.1f}", "B/ray": "{bytes:.0f}", "lines/ray": "{lines:.1f}", "L1 misses": "{l1_missed:.0%}",
    "SIMT efficiency": "{simt:.0%}", f"Grays/s, {BASE.warps} warps": lambda row: f"{row.few_warps.rays_per_second / 1e9:.2f}",
    f"limit, {BASE.warps} warps": "{few_warps.limit}",
    f"Grays/s, {MANY_WARPS.warps} warps": lambda row: f"{row.many_warps.rays_per_second / 1e9:.2f}",
    f"limit, {MANY_WARPS.warps} warps": "{many_warps.limit}", "differ": "{differ}"}
LEGEND = f"""\
B/ray: bytes of nodes and triangles that a ray fetches. lines/ray: cache lines that its warp accesses. L1 misses: share of the lines that
miss the L1. SIMT efficiency: share of the lanes' time that rays use. Grays/s: predicted with {BASE.boxes:g} boxes and
{BASE.triangles:g} triangle a clock, for {BASE.warps} warps at a time in each RT core and an L2 that is empty at first, and for
{MANY_WARPS.warps} warps and an L2 that has seen the same rays. limit: the largest term of the model. Predictions serve to compare
variants. differ: rays whose hit is not that of the first variant; must be 0."""


@dataclass(frozen=True)
class Variant:
    """A variant of the design. node_bytes: size of a node; prim_id, t: hits in an order common to all variants; counters: of `rays`."""

    name: str
    rays: RaySet
    node_bytes: int
    prim_id: np.ndarray
    t: np.ndarray
    counters: Counters


def traced(name: str, accel: OneMesh, rays: RaySet, node_bytes: tuple[int, int] | None = None) -> Variant:
    """Trace closest hits and return the Variant. node_bytes: bytes of a node in memory, and the bytes to count instead."""
    hits = accel.closest_hit(rays.origins, rays.directions, t_max=rays.t_max, trace=True)
    counters = hits.counters
    assert counters is not None
    total = max(int(counters.counts["nodes"].sum(dtype=np.int64)), 1)
    size = int(counters.counts["node_bytes"].sum(dtype=np.int64)) // total
    if node_bytes is not None:
        counters, size = resized(counters, *node_bytes), node_bytes[1]
    return Variant(name, rays, size, hits.prim_id, hits.t, counters)


def width(tree: Bvh2, rays: RaySet) -> Iterator[Variant]:
    """Yield variants of the nodes' width, format and bounding volume: every BVH of the registry."""
    return (traced(name, build(tree.geometry, name), rays) for name in bvhs())


def stack(tree: Bvh2, rays: RaySet) -> Iterator[Variant]:
    """Yield variants of the stack: a full one, and short ones with restarts."""
    for entries in ENTRIES:
        yield traced("full stack" if entries == STACK_SIZE else f"{entries} entries", with_traversal(tree, Study(entries)), rays)


def planes(tree: Bvh2, rays: RaySet) -> Iterator[Variant]:
    """Yield variants of the box planes: float32, and few bits in the frame of the node, rounded outwards."""
    first = traced("fp32", tree, rays)
    yield first
    for bits in BITS:
        accel, size = with_planes(tree, bits)
        yield traced(f"{bits} bits", accel, rays, (first.node_bytes, size))


def order(tree: Bvh2, rays: RaySet) -> Iterator[Variant]:
    """Yield variants of the traversal: with and without visiting the nearer child first, with and without early stop."""
    for name, study in (("both", Study()), ("early stop alone", Study(choose=child_0_first)), ("order alone", Study(early=False)),
                        ("neither", Study(choose=child_0_first, early=False))):
        yield traced(name, with_traversal(tree, study), rays)


def sorting(tree: Bvh2, rays: RaySet) -> Iterator[Variant]:
    """Yield variants of the order of the rays: as in the picture, sorted by origin and direction, and shuffled."""
    orders = {"as they come": np.arange(len(rays)), "sorted": by_coherence(rays.origins, rays.directions),
              "shuffled": np.random.default_rng(0).permutation(len(rays))}
    for name, which in orders.items():
        variant, back = traced(name, tree, rays.part(which)), np.argsort(which)
        yield replace(variant, prim_id=variant.prim_id[back], t=variant.t[back])


STUDIES: dict[str, Callable[[Bvh2, RaySet], Iterator[Variant]]] = {
    "width": width, "stack": stack, "planes": planes, "order": order, "sorting": sorting}


def groups(plan: Plan) -> Groups:
    return (partial(kind_rows, plan, kind) for kind in dict.fromkeys(plan.kinds))


def kind_rows(plan: Plan, kind: str) -> list[Row]:
    tree = Bvh2(Geometry.of(as_mesh(plan.mesh)))
    rays = in_warps(tree, ray_sets(tree, plan.rays, plan.seed, plan.inside))[kind]
    first: Variant | None = None
    out: list[Row] = []
    for variant in STUDIES[plan.study](tree, rays):
        first = first or variant
        out.append(row_of(variant, first, kind, GPUS[plan.gpu]))
    return out


def row_of(variant: Variant, first: Variant, kind: str, gpu: Gpu) -> Row:
    work = Work(variant.name, variant.counters, packed(len(variant.rays)))
    misses = work.misses(gpu, BASE)
    differ = (variant.prim_id != first.prim_id) | (variant.t != first.t)
    busy = simt(variant.counters.counts, work.warp, variant.rays.origins, variant.rays.directions)["as they come"]
    return Row(variant=variant.name, kind=kind, node_bytes=variant.node_bytes, nodes=work.mean("nodes"), boxes=work.mean("boxes"),
               triangles=work.mean("primitives"), bytes=work.mean("node_bytes") + work.mean("primitive_bytes"),
               lines=misses.accesses / len(work), l1_missed=misses.l1 / max(misses.accesses, 1), simt=busy,
               differ=int(differ.sum()), few_warps=predict(work, gpu), many_warps=predict(work, gpu, MANY_WARPS))


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {"study": plan.study, "mesh": mesh_name(plan.mesh)}
