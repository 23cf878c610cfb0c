"""The model of the RT core: from what rays cost to clocks, and from clocks to rays a second.

An RT core tests boxes and triangles at fixed rates, gets nodes and triangles through an L1, an L2 and DRAM, and holds some warps
at a time. Each of these is a term in clocks a ray; they overlap, so that the largest decides (a roofline). Turing's rates were
never published: what comes out is a range over assumptions, for orderings and sensitivities, never a fact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from wrt.accel.answers import Counters
from wrt.accel.base import Accelerator
from wrt.core.errors import InputError
from wrt.core.html import html_table
from wrt.lab.rtcore.caches import LINE, Level1, Misses, Warps, first_level, second_level
from wrt.lab.rtcore.parameters import BASE, SWEEPS, Core, Gpu
from wrt.lab.rtcore.warps import by_coherence, efficiency, longest_of, packed

TERMS = ("box", "triangle", "L1", "L2", "DRAM", "latency")


@dataclass(frozen=True, eq=False)
class Work:
    """Rays in the order of warps and lanes, and what each costs. counters: as Accelerator.closest_hit(trace=True) gives them;
    warp: (N,) int64, the warp of each ray, 0 to W - 1, ascending."""

    name: str
    counters: Counters
    warp: np.ndarray

    def __post_init__(self) -> None:
        if not len(self.warp):
            raise InputError(f"{self.name}: there are no rays to tell anything of")

    def __len__(self) -> int:
        return len(self.warp)

    def mean(self, name: str) -> float:
        """Of a counter, a ray."""
        return float(self.counters.counts[name].mean())

    @cached_property
    def _simulated(self) -> dict[Any, Any]:
        return {}

    def misses(self, gpu: Gpu, core: Core) -> Misses:
        """What misses in the caches of that GPU."""
        key = (gpu.sms, gpu.l1, gpu.l2, core.warps, core.warm)
        if key not in self._simulated:
            self._simulated[key] = second_level(self._first_level(gpu, core), gpu.l2, core.warm)
        return self._simulated[key]

    def _first_level(self, gpu: Gpu, core: Core) -> Level1:
        key = (gpu.sms, gpu.l1, core.warps)
        if key not in self._simulated:
            c = self.counters
            self._simulated[key] = first_level(Warps(self.warp, c.first, c.address, c.size), gpu.sms, core.warps, gpu.l1)
        return self._simulated[key]


@dataclass(frozen=True)
class Prediction:
    """terms: clocks a ray and RT core that each part needs, by TERMS; gpu, core: what they were reckoned for."""

    work: str
    gpu: Gpu
    core: Core
    terms: dict[str, float]

    def _repr_html_(self) -> str:
        busy = self.utilisation
        rows = [(name, value, f"{busy[name]:.0%}") for name, value in self.terms.items()]
        title = f"{self.work} on {self.gpu.name}: {self.rays_per_second / 1e9:.3g} Gray/s, bound by {self.bottleneck}"
        return html_table(title, ("part", "clocks a ray", "busy"), rows)

    @property
    def clocks(self) -> float:
        return max(self.terms.values())

    @property
    def bottleneck(self) -> str:
        return max(self.terms, key=lambda name: self.terms[name])

    @property
    def utilisation(self) -> dict[str, float]:
        """How busy each part is while the busiest is at its limit, 0 to 1."""
        return {name: value / self.clocks for name, value in self.terms.items()}

    @property
    def rays_per_second(self) -> float:
        return self.gpu.sms * self.gpu.clock / self.clocks


def predict(work: Work, gpu: Gpu, core: Core = BASE) -> Prediction:
    """The clocks that a ray takes of an RT core: at least what each unit needs for its tests, what each level of memory needs
    for its lines, and what a ray waits for, over the rays that wait together.

    A ray waits, one after another, for each node or triangle (as long as a lane's mean fetch takes) and each test. A warp holds
    its place until its longest ray ends.
    """
    n, counts, misses = len(work), work.counters.counts, work.misses(gpu, core)
    fetches = np.diff(work.counters.first)
    l2_share, dram_share = misses.wait_l2 / max(misses.wanted, 1), misses.wait_dram / max(misses.wanted, 1)
    fetch = core.l1_latency + l2_share * core.l2_latency + dram_share * core.dram_latency
    wait = fetches * fetch + counts["box_operations"] * core.box_latency + counts["primitives"] * core.triangle_latency
    terms = {
        "box": boxes_of(work) / core.boxes,
        "triangle": work.mean("primitives") / core.triangles,
        "L1": misses.accesses / n / core.l1_lines,
        "L2": misses.l1 * LINE / n / core.l2_bytes,
        "DRAM": misses.l2 * LINE / n / (gpu.dram / gpu.clock / gpu.sms),
        "latency": float(longest_of(wait, work.warp).sum()) / core.warps / n,
    }
    return Prediction(work.name, gpu, core, terms)


def boxes_of(work: Work) -> float:
    """Box tests a ray; where a structure has planes or cells and no boxes, their tests take the box unit instead."""
    return max(work.mean("boxes"), work.mean("box_operations"))


def sweep(work: Work, gpu: Gpu, core: Core = BASE, names: tuple[str, ...] = ("boxes", "triangles")) -> list[Prediction]:
    """Predictions over all combinations of what is swept of these fields of Core."""
    return [predict(work, gpu, each) for each in variants(core, names)]


def variants(core: Core, names: tuple[str, ...]) -> Iterator[Core]:
    for values in product(*(SWEEPS[name] for name in names)):
        changes: dict[str, Any] = dict(zip(names, values, strict=True))
        yield replace(core, **changes)


def span(predictions: list[Prediction]) -> tuple[float, float]:
    """The least and the most rays a second of several predictions."""
    rates = [each.rays_per_second for each in predictions]
    return min(rates), max(rates)


def sensitivity(work: Work, gpu: Gpu, core: Core = BASE) -> dict[str, float]:
    """By which factor rays a second move where one assumption alone is swept, the largest first."""
    factors = {}
    for name in SWEEPS:
        low, high = span(sweep(work, gpu, core, (name,)))
        factors[name] = high / low
    return dict(sorted(factors.items(), key=lambda item: -item[1]))


def simt(counts: np.ndarray, warp: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> dict[str, float]:
    """SIMT efficiency, a ray costing its box operations and triangle tests: of the warps as they are, of the same rays packed
    without gaps, and packed after sorting them by coherence. counts: as kernels.traverse.counters.Counts, one row a ray."""
    cost = counts["box_operations"].astype(np.float64) + counts["primitives"]
    order = by_coherence(origins, directions)
    return {"as they come": efficiency(cost, warp), "packed": efficiency(cost, packed(len(cost))),
            "sorted": efficiency(cost[order], packed(len(cost)))}


def trace_rays(accel: Accelerator, name: str, origins: np.ndarray, directions: np.ndarray, warp: np.ndarray | None = None,
               t_max: Any = np.inf) -> Work:
    """Closest hits of rays that stand in the order of lanes, counted and recorded. warp: by default 32 after 32."""
    counters = accel.closest_hit(origins, directions, t_max=t_max, trace=True).counters
    assert counters is not None
    return Work(name, counters, packed(len(origins)) if warp is None else warp)
