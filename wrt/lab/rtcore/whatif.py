"""What-if studies of the RT core: one thing of the design is changed, the same rays are counted again, and the model says what for.

Every variant must find the same hits; a row tells how many rays differ (none may).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wrt.accel.answers import Counters
from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.core.html import Rows, html_table
from wrt.io.mesh_file import as_mesh
from wrt.kernels.study.bvh2_study import STACK_SIZE, Study
from wrt.lab.bench.rays import RAY_KINDS, RaySet, ray_sets
from wrt.lab.bench.report import check_plan, gathered, table
from wrt.lab.rtcore.meshes import bvhs, in_warps
from wrt.lab.rtcore.model import TERMS, Prediction, Work, predict, simt
from wrt.lab.rtcore.parameters import BASE, GPUS, SWEEPS, Core, Gpu
from wrt.lab.rtcore.warps import by_coherence, packed
from wrt.lab.rtcore.whatif_structures import base, resized, with_planes, with_traversal
from wrt.scene.mesh import Mesh

MANY_WARPS = replace(BASE, warps=32, warm=True)  # beside BASE: where latency is hidden and the L2 full, units and lines decide
ENTRIES = (STACK_SIZE, 8, 4, 2, 1, 0)
BITS = (16, 8, 6, 4)
COLUMNS = ("variant", "rays", "B/node", "nodes", "boxes", "triangles", "B/ray", "lines", "L1 missed", "SIMT",
           f"Grays/s, {BASE.warps} warps", "limit", f"Grays/s, {MANY_WARPS.warps} warps", "limit", "differ")
LEGEND = f"""\
nodes, boxes, triangles: a ray; B/ray: fetched, of nodes and triangles; lines: cache lines a ray that its warp asks for; L1 missed:
of those. SIMT: share of the lanes' time that rays use. Grays/s: of the model with {BASE.boxes:g} boxes and {BASE.triangles:g}
triangle a clock: with {BASE.warps} warps at a time in each RT core and an empty L2, and with {MANY_WARPS.warps} and an L2 that has
seen the same rays before; limit: the term that decides. A model's numbers, for comparing variants. differ: rays with another hit
than the first variant's; must be 0."""


@dataclass(frozen=True)
class Plan:
    """study: a name in STUDIES; mesh: a Mesh or a file; kinds of ray, rays of each, gpu: a name in GPUS; inside: the camera is in
    a room. Raises InputError."""

    study: str
    mesh: Mesh | str | Path
    kinds: Sequence[str] = ("primary", "diffuse")
    rays: int = 2**15
    gpu: str = "rtx2080ti"
    seed: int = 0
    inside: bool = False

    def __post_init__(self) -> None:
        check_plan(self, {"study": ([self.study], STUDIES), "kind of ray": (self.kinds, RAY_KINDS), "GPU": ([self.gpu], GPUS)},
                   rays=(1, 2**22))


@dataclass(frozen=True)
class Variant:
    """What rays find and what they cost: hits in the order of `rays`."""

    name: str
    rays: RaySet
    node_bytes: int
    prim_id: np.ndarray
    t: np.ndarray
    counters: Counters


@dataclass(frozen=True)
class Row:
    """One variant with one kind of ray; few, many: the model's predictions with BASE's warps and with MANY_WARPS."""

    variant: str
    kind: str
    node_bytes: int
    nodes: float
    boxes: float
    triangles: float
    bytes: float
    lines: float
    l1_missed: float
    simt: float
    few: Prediction
    many: Prediction
    differ: int

    def as_dict(self) -> dict[str, Any]:
        plain = {name: value for name, value in vars(self).items() if name not in ("few", "many")}
        return plain | {f"{name}_warps": {"rays_per_second": p.rays_per_second, "limit": p.bottleneck, "clocks": p.terms}
                        for name, p in (("few", self.few), ("many", self.many))}


def traced(name: str, accel: Accelerator, rays: RaySet, node_bytes: tuple[int, int] | None = None) -> Variant:
    """node_bytes: of a node, as it is in memory and as it would be."""
    hits = accel.closest_hit(rays.origins, rays.directions, t_max=rays.t_max, trace=True)
    counters = hits.counters
    assert counters is not None
    total = max(int(counters.counts["nodes"].sum(dtype=np.int64)), 1)
    size = int(counters.counts["node_bytes"].sum(dtype=np.int64)) // total
    if node_bytes is not None:
        counters, size = resized(counters, *node_bytes), node_bytes[1]
    return Variant(name, rays, size, hits.prim_id, hits.t, counters)


# --- the studies: each gives its variants, the one that the others are compared with first ----------------------------


def width(geometry: Geometry, rays: RaySet) -> Iterator[Variant]:
    """Node width, node format and kind of bounding volume: every BVH of the registry."""
    for name in bvhs():
        yield traced(name, build(geometry, name), rays)


def stack(geometry: Geometry, rays: RaySet) -> Iterator[Variant]:
    """Entries of the stack: all that it needs, or a few with restarts."""
    tree = base(geometry)
    for entries in ENTRIES:
        yield traced("full stack" if entries == STACK_SIZE else f"{entries} entries", with_traversal(tree, Study(entries)), rays)


def planes(geometry: Geometry, rays: RaySet) -> Iterator[Variant]:
    """Bits of a box plane: fp32, or few in the frame of the node, rounded outwards."""
    tree = base(geometry)
    first = traced("fp32", tree, rays)
    yield first
    for bits in BITS:
        accel, size = with_planes(tree, bits)
        yield traced(f"{bits} bits", accel, rays, (first.node_bytes, size))


def order(geometry: Geometry, rays: RaySet) -> Iterator[Variant]:
    """Nearer child first, and the early stop: on and off."""
    tree = base(geometry)
    for name, study in (("both", Study()), ("early stop alone", Study(ordered=False)), ("order alone", Study(early=False)),
                        ("neither", Study(ordered=False, early=False))):
        yield traced(name, with_traversal(tree, study), rays)


def sorting(geometry: Geometry, rays: RaySet) -> Iterator[Variant]:
    """Rays in the order of the picture, sorted by origin and direction, and shuffled."""
    tree = base(geometry)
    orders = {"as they come": np.arange(len(rays)), "sorted": by_coherence(rays.origins, rays.directions),
              "shuffled": np.random.default_rng(0).permutation(len(rays))}
    for name, which in orders.items():
        variant = traced(name, tree, rays.part(which))  # type: ignore[arg-type]
        back = np.argsort(which)
        yield replace(variant, prim_id=variant.prim_id[back], t=variant.t[back])


STUDIES: dict[str, Callable[[Geometry, RaySet], Iterator[Variant]]] = {
    "width": width, "stack": stack, "planes": planes, "order": order, "sorting": sorting}


def run(plan: Plan, tell: Callable[[Row], None] = lambda row: None) -> Rows[Row]:
    """All rows of a study; `tell` gets each when it is there. Raises InputError for a mesh that cannot be read."""
    return Rows(gathered(_rows(plan), tell), lambda rows: html_table(f"What if: {plan.study}", COLUMNS, map(cells, rows)))


def _rows(plan: Plan) -> Iterator[Row]:
    geometry, sets = rays_of(plan)
    for kind in dict.fromkeys(plan.kinds):
        first = None
        for variant in STUDIES[plan.study](geometry, sets[kind]):
            first = first or variant
            yield row_of(variant, first, kind, GPUS[plan.gpu])


def rays_of(plan: Plan) -> tuple[Geometry, dict[str, RaySet]]:
    geometry = Geometry.of(as_mesh(plan.mesh))
    tree = base(geometry)
    return geometry, in_warps(tree, ray_sets(tree, plan.rays, plan.seed, plan.inside))


def row_of(variant: Variant, first: Variant, kind: str, gpu: Gpu) -> Row:
    work = Work(variant.name, variant.counters, packed(len(variant.rays)))
    misses = work.misses(gpu, BASE)
    differ = (variant.prim_id != first.prim_id) | (variant.t != first.t)
    size = work.mean("node_bytes") + work.mean("primitive_bytes")
    busy = simt(variant.counters.counts, work.warp, variant.rays.origins, variant.rays.directions)["as they come"]
    return Row(variant.name, kind, variant.node_bytes, work.mean("nodes"), work.mean("boxes"), work.mean("primitives"), size,
               misses.accesses / len(work), misses.l1 / max(misses.accesses, 1), busy, predict(work, gpu),
               predict(work, gpu, MANY_WARPS), int(differ.sum()))


def cells(row: Row) -> tuple[str, ...]:
    return (row.variant, row.kind, f"{row.node_bytes}", f"{row.nodes:.1f}", f"{row.boxes:.1f}", f"{row.triangles:.1f}",
            f"{row.bytes:.0f}", f"{row.lines:.1f}", f"{row.l1_missed:.0%}", f"{row.simt:.0%}",
            f"{row.few.rays_per_second / 1e9:.2f}", row.few.bottleneck, f"{row.many.rays_per_second / 1e9:.2f}",
            row.many.bottleneck, f"{row.differ}")


def markdown(rows: Sequence[Row]) -> str:
    return f"{table(COLUMNS, [cells(row) for row in rows])}\n\n{LEGEND}"


# --- box rate against triangle rate: no new rays, only the model ------------------------------------------------------


@dataclass(frozen=True)
class Rate:
    """What the model says of one structure and kind of ray at these rates; doubled: how many times more rays a second with twice
    the triangle rate."""

    structure: str
    kind: str
    boxes: float
    triangles: float
    prediction: Prediction
    doubled: float

    def as_dict(self) -> dict[str, Any]:
        p = self.prediction
        return {"structure": self.structure, "kind": self.kind, "boxes": self.boxes, "triangles": self.triangles,
                "rays_per_second": p.rays_per_second, "limit": p.bottleneck, "clocks": p.terms, "doubled": self.doubled}


def rates(plan: Plan, tell: Callable[[str], None] = lambda line: None) -> Rows[Rate]:
    """Every box rate against every triangle rate for every BVH of the registry, with MANY_WARPS: where latency is hidden, rates
    matter most."""
    geometry, sets = rays_of(plan)
    out = []
    for name in bvhs():
        accel = build(geometry, name)
        for kind in dict.fromkeys(plan.kinds):
            tell(f"{name} {kind}")
            work = Work(name, traced(name, accel, sets[kind]).counters, packed(len(sets[kind])))
            for boxes in SWEEPS["boxes"]:
                for triangles in SWEEPS["triangles"]:
                    core: Core = replace(MANY_WARPS, boxes=boxes, triangles=triangles)
                    now, twice = (predict(work, GPUS[plan.gpu], replace(core, triangles=f * triangles)) for f in (1.0, 2.0))
                    out.append(Rate(name, kind, boxes, triangles, now, twice.rays_per_second / now.rays_per_second))
    return Rows(out, lambda rows: html_table("Box rate against triangle rate", RATE_COLUMNS, map(rate_cells, rows)))


RATE_COLUMNS = ("structure", "rays", "boxes a clock", "triangles a clock", "Grays/s", "limit", *TERMS, "twice the triangles")


def rate_cells(row: Rate) -> tuple[str, ...]:
    return (row.structure, row.kind, f"{row.boxes:g}", f"{row.triangles:g}", f"{row.prediction.rays_per_second / 1e9:.2f}",
            row.prediction.bottleneck, *(f"{row.prediction.terms[name]:.3g}" for name in TERMS), f"{row.doubled:.2f}x")


def rates_markdown(rows: Sequence[Rate]) -> str:
    lines = [rate_cells(row) for row in rows]
    return (f"{table(RATE_COLUMNS, lines)}\n\n{', '.join(TERMS)}: clocks a ray and RT core, with {MANY_WARPS.warps} warps at a time"
            " and an L2 that has seen the same rays before; twice the triangles: rays a second with twice that rate, over these.")
