"""A model of the RT core: it predicts clocks per ray, and rays a second, from the counted work of rays.

An RT core tests boxes and triangles at fixed rates, reads nodes and triangles through L1, L2 and DRAM, and holds a few warps at a time.
Each of these limits is a term, in clocks per ray. The terms overlap in time, so the largest term decides, as in a roofline model. NVIDIA
has not published Turing's rates. So results are ranges over assumptions; they serve to order variants and to find sensitivities."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.queries.answers import Counters
from wrt.core.types import ArrayLike
from wrt.lab.bench.report import Columns, Row, tabled, tables_page
from wrt.lab.rtcore.caches import LINE, Misses, Prefetches, first_level, second_level
from wrt.lab.rtcore.parameters import BASE, SWEEPS, Core, Gpu

WARP = 32
BLOCK = (8, 4)  # pixels of a warp: columns, rows
MORTON_BITS = 10  # bits of each coordinate in a Morton code
TERMS = ("box", "triangle", "L1", "L2", "DRAM", "latency")


@dataclass(frozen=True, eq=False)
class Work:
    """Rays in the order of warps and lanes. counters: Counters of closest_hit(trace=True); warp: (N,) int64, warp of each ray, from 0."""

    name: str
    counters: Counters
    warp: np.ndarray
    prefetches: Prefetches | None = None

    def __len__(self) -> int:
        return len(self.warp)

    def mean(self, name: str) -> float:
        """Return the mean of a counter over the rays."""
        return float(self.counters.counts[name].mean())

    @cached_property
    def _simulated(self) -> dict[Any, Any]:
        return {}

    def misses(self, gpu: Gpu, core: Core) -> Misses:
        """Simulate the caches of a GPU. Reuse the result of a call with equal caches, SMs, warps at a time and `warm`."""
        first_key = (gpu.sms, core.warps, gpu.l1)
        if first_key not in self._simulated:
            self._simulated[first_key] = first_level(self.warp, self.counters, *first_key, self.prefetches)
        key = (*first_key, gpu.l2, core.warm)
        if key not in self._simulated:
            self._simulated[key] = second_level(self._simulated[first_key], gpu.l2, core.warm)
        return self._simulated[key]


class Prediction(Row):
    """Result of `predict`: `rays_per_second` of the whole GPU, and `limit`, the name of the largest term (see TERMS).

    The dict `clocks` has the clocks of an RT core per ray for each term, `utilisation` these over the clocks of the largest term."""


def predict(work: Work, gpu: Gpu, core: Core = BASE) -> Prediction:
    """Return the clocks of an RT core per ray, term by term.
    The term "latency": a ray waits for each of its fetches and tests in turn, and a warp stays in the core until its longest ray ends. Each
    fetch takes the mean time of all fetches."""
    n, counts, misses = len(work), work.counters.counts, work.misses(gpu, core)
    fetches = np.diff(work.counters.first)
    l2_share, dram_share = misses.wait_l2 / max(misses.wanted, 1), misses.wait_dram / max(misses.wanted, 1)
    fetch = core.l1_latency + l2_share * core.l2_latency + dram_share * core.dram_latency
    wait = fetches * fetch + counts["box_operations"] * core.box_latency + counts["primitives"] * core.triangle_latency
    terms = {
        # In structures with planes or cells instead of boxes, the box unit tests these.
        "box": max(work.mean("boxes"), work.mean("box_operations")) / core.boxes,
        "triangle": work.mean("primitives") / core.triangles,
        "L1": misses.accesses / n / core.l1_lines,
        "L2": misses.l1 * LINE / n / core.l2_bytes,
        "DRAM": misses.l2 * LINE / n / (gpu.dram / gpu.clock / gpu.sms),
        "latency": float(longest_of(wait, work.warp).sum()) / core.warps / n,
    }
    limit = max(terms, key=lambda name: terms[name])
    return Prediction(work=work.name, gpu=gpu.name, clocks=terms, limit=limit, rays_per_second=gpu.sms * gpu.clock / terms[limit],
                      utilisation={name: value / terms[limit] for name, value in terms.items()})


def sweep(work: Work, gpu: Gpu, core: Core = BASE, names: tuple[str, ...] = ("boxes", "triangles")) -> list[Prediction]:
    """Return a prediction for each combination of assumed values: the fields `names` of Core take their values in SWEEPS."""
    out = []
    for values in product(*(SWEEPS[name] for name in names)):
        changes: dict[str, Any] = dict(zip(names, values, strict=True))
        out.append(predict(work, gpu, replace(core, **changes)))
    return out


def span(predictions: list[Prediction]) -> tuple[float, float]:
    """Return the lowest and highest rays_per_second."""
    rates = [each.rays_per_second for each in predictions]
    return min(rates), max(rates)


def sensitivity(work: Work, gpu: Gpu, core: Core = BASE) -> dict[str, float]:
    """Vary each field of SWEEPS alone; return field -> highest over lowest rays a second, the largest factor first."""
    factors = {}
    for name in SWEEPS:
        low, high = span(sweep(work, gpu, core, (name,)))
        factors[name] = high / low
    return dict(sorted(factors.items(), key=lambda item: -item[1]))


def blocks(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the warp and the lane of each pixel, (height * width,) each: warps are blocks of 8 x 4 pixels, row by row."""
    y, x = np.divmod(np.arange(width * height), width)
    across = -(-width // BLOCK[0])
    return y // BLOCK[1] * across + x // BLOCK[0], y % BLOCK[1] * BLOCK[0] + x % BLOCK[0]


def packed(n: int) -> np.ndarray:
    """Return the warp of each of n successive rays, (n,); all warps but the last are full."""
    return np.arange(n) // WARP


def efficiency(cost: np.ndarray, warp: np.ndarray) -> float:
    """Return the SIMT efficiency, 0 to 1; it is 1 if all costs are 0. cost, warp: (N,) of each ray.
    A warp occupies its 32 lanes for the cost of its costliest ray."""
    longest = longest_of(cost, warp)
    total = WARP * float(longest.sum())
    return float(cost.sum()) / total if total > 0.0 else 1.0


def longest_of(cost: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """Return the largest cost of a ray in each warp, (W,) float64. cost: (N,), not negative."""
    out = np.zeros(int(warp.max(initial=-1)) + 1)
    np.maximum.at(out, warp, cost)
    return out


def by_coherence(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return an order, (N,) int64, in which similar rays are neighbours.
    Sort by the octant of the direction, then along Morton curves through the origins and through the directions. Sources:
    Pharr et al. 1997, Garanzha and Loop 2010."""
    octant = (directions < 0.0) @ np.array([4, 2, 1])
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return np.lexsort((morton(unit), morton(origins), octant))


def morton(points: np.ndarray) -> np.ndarray:
    """Return the position of each point on a Morton curve through the points' box, (N,) int64."""
    if not len(points):
        return np.zeros(0, np.int64)
    lo, extent = points.min(axis=0), np.ptp(points, axis=0)
    cell = (points - lo) / np.where(extent > 0.0, extent, 1.0) * ((1 << MORTON_BITS) - 1)
    code = np.zeros(len(points), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (cell[:, axis].astype(np.int64) >> bit & 1) << (3 * bit + axis)
    return code


def simt(counts: np.ndarray, warp: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> dict[str, float]:
    """Return the SIMT efficiency for the warps `warp`, for the rays packed into full warps, and for rays sorted by coherence and packed.
    The cost of a ray is its number of box operations and triangle tests. counts: (N,) kernels.traverse.observer.Counts."""
    cost = counts["box_operations"].astype(np.float64) + counts["primitives"]
    order = by_coherence(origins, directions)
    return {"as they come": efficiency(cost, warp), "packed": efficiency(cost, packed(len(cost))),
            "sorted": efficiency(cost[order], packed(len(cost)))}


def trace_rays(accel: Accelerator, name: str, origins: np.ndarray, directions: np.ndarray, t_max: ArrayLike = np.inf) -> Work:
    """Trace closest hits of rays, count and record their work; 32 successive rays are a warp."""
    counters = accel.closest_hit(origins, directions, t_max=t_max, trace=True).counters
    assert counters is not None
    return Work(name, counters, packed(len(origins)))


RANGE = ("boxes", "triangles", "warps")  # fields of Core that vary in the reported range


def term(name: str) -> Callable[[Row], str]:
    return lambda row: f"{row.clocks[name]:.3g} ({row.utilisation[name]:.0%})"


MODEL_COLUMNS: Columns = {
    "rays": "{name}", "nodes/ray": "{nodes:.1f}", "boxes/ray": "{boxes:.1f}", "triangles/ray": "{triangles:.1f}",
    "lines/ray": "{lines:.1f}",
    **{name: term(name) for name in TERMS}, "limit": "{limit}", "Grays/s": lambda row: f"{row.rays_per_second / 1e9:.2f}",
    "range, Grays/s": lambda row: f"{row.low / 1e9:.2f} to {row.high / 1e9:.2f}",
    "moved most by": lambda row: ", ".join(f"{name} {factor:.2g}x" for name, factor in list(row.factors.items())[:2])}
SIMT_COLUMNS: Columns = {"rays": "{name}", **{name: f"{{simt_efficiency[{name}]:.0%}}" for name in ("as they come", "packed", "sorted")}}
LEGEND = f"""\
nodes, boxes, triangles: fetched or tested; lines: cache lines that the warps access. {", ".join(TERMS)}: clocks of an RT core per ray that
this part alone needs; in brackets its use while the slowest part (limit) is fully used. Grays/s: under the assumptions in
wrt/lab/rtcore/parameters.py (Turing: 4 boxes or 1 triangle a clock; 4 warps at a time, L2 empty at first). range: over {", ".join(RANGE)} =
{"; ".join(", ".join(f"{value:g}" for value in SWEEPS[name]) for name in RANGE)}. moved most by: the assumptions that change Grays/s most
if each varies alone, with the factor from lowest to highest. Nothing here is measured: NVIDIA has not published Turing's rates and node
format."""


def model_row(work: Work, gpu: Gpu, simt: dict[str, float], **facts: object) -> Row:
    """Return the row of a Work: the prediction under the assumptions gpu.core, and means over the rays.
    - low, high: lowest and highest rays a second as the fields RANGE of Core vary; factors: result of `sensitivity`.
    - simt: result of the function `simt`; facts: further fields of the row."""
    prediction = vars(predict(work, gpu, gpu.core))
    low, high = span(sweep(work, gpu, gpu.core, RANGE))
    return Row(**facts, **{name: value for name, value in prediction.items() if name != "work"}, name=work.name, rays=len(work),
               nodes=work.mean("nodes"), boxes=work.mean("boxes"), triangles=work.mean("primitives"),
               lines=work.misses(gpu, gpu.core).accesses / len(work), low=low, high=high, factors=sensitivity(work, gpu, gpu.core),
               simt_efficiency=simt)


def model_page(rows: Sequence[Row]) -> str:
    """Return the tables of the model and of SIMT efficiency as HTML."""
    gpu = rows[0].gpu if rows else "a GPU"
    return tables_page([tabled(MODEL_COLUMNS, rows, f"Model of {gpu}"), tabled(SIMT_COLUMNS, rows, "SIMT efficiency")])
