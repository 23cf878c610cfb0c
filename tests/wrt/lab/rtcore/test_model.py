"""The throughput model: every term by hand on made-up work, its limits, and the published numbers that it starts from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from wrt.accel.queries.answers import Counters
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE, Counts
from wrt.lab.rtcore.caches import LINE, Cache
from wrt.lab.rtcore.model import (
    TERMS,
    WARP,
    Work,
    blocks,
    by_coherence,
    efficiency,
    longest_of,
    morton,
    packed,
    predict,
    sensitivity,
    simt,
    span,
    sweep,
    trace_rays,
)
from wrt.lab.rtcore.parameters import GPUS, SWEEPS, Core, Gpu
from wrt.scene.shapes import icosphere

SMALL = Gpu("small", 2, 1e9, 64e9, Cache(64 * LINE, 4), Cache(256 * LINE, 4))  # DRAM: 32 bytes a clock and SM


def made(nodes: np.ndarray, triangles: np.ndarray, apart: int = LINE) -> Work:
    """Rays that fetch so many nodes and triangles each, the same for all, every one in a line of its own."""
    counts = np.zeros(len(nodes), Counts.numpy_dtype())
    counts["nodes"], counts["boxes"], counts["box_operations"], counts["primitives"] = nodes, 2 * nodes, nodes, triangles
    address = [np.concatenate([np.arange(n), int(PRIMITIVE_SPACE) // apart + np.arange(t)]) * apart
               for n, t in zip(nodes, triangles, strict=True)]
    first = np.concatenate([[0], np.cumsum(nodes + triangles)])
    address = np.concatenate(address)
    return Work("made", Counters(counts, first, address, np.full(len(address), 32)), packed(len(nodes)))


def test_every_term_by_hand() -> None:
    """Four full warps of equal rays, two for each SM: 10 nodes, 3 triangles; each SM asks for each line twice, and misses once."""
    work = made(np.full(128, 10), np.full(128, 3))
    core = Core(boxes=4.0, triangles=0.5, warps=1, box_latency=5.0, triangle_latency=7.0, l1_latency=11.0, l2_latency=100.0,
                dram_latency=200.0, l1_lines=2.0, l2_bytes=16.0)
    accesses, l1, l2 = 4 * 13, 2 * 13, 13
    assert vars(work.misses(SMALL, core)) == {"accesses": accesses, "l1": l1, "l2": l2, "compulsory": 13,
                                              "wanted": 32 * accesses, "wait_l2": 32 * l1, "wait_dram": 32 * l2}
    fetch = 11.0 + 100.0 * l1 / accesses + 200.0 * l2 / accesses
    wait = 13 * fetch + 10 * 5.0 + 3 * 7.0
    expected = {"box": 20 / 4.0, "triangle": 3 / 0.5, "L1": accesses / 128 / 2.0, "L2": l1 * LINE / 128 / 16.0,
                "DRAM": l2 * LINE / 128 / 32.0, "latency": 4 * wait / 1 / 128}
    found = predict(work, SMALL, core)
    assert found.clocks == pytest.approx(expected) and tuple(found.clocks) == TERMS
    assert found.limit == "latency" and found.rays_per_second == pytest.approx(2 * 1e9 / expected["latency"])
    assert found.utilisation["latency"] == 1.0 and found.utilisation["box"] == pytest.approx(5.0 / expected["latency"])
    assert predict(work, SMALL, replace(core, warps=10**6)).limit == "triangle"
    assert predict(work, SMALL, replace(core, warm=True)).clocks["DRAM"] == 0.0


def test_a_warp_holds_its_place_until_its_longest_ray_ends() -> None:
    nodes = np.full(64, 2)
    nodes[7] = 40
    core = Core(l2_latency=0.0, dram_latency=0.0)
    even = predict(made(np.full(64, 2), np.zeros(64, int)), SMALL, core).clocks["latency"]
    odd = predict(made(nodes, np.zeros(64, int)), SMALL, core).clocks["latency"]
    assert odd == pytest.approx(even * (2 + 40) / (2 + 2))


def test_rates_and_ranges() -> None:
    work = made(np.full(64, 10), np.full(64, 3))
    base = replace(Core(), warps=10**4)
    by_rate = [predict(work, SMALL, replace(base, boxes=rate)).clocks["box"] for rate in SWEEPS["boxes"]]
    assert by_rate == pytest.approx([20.0, 10.0, 5.0, 2.5])
    all_of_them = sweep(work, SMALL, base)
    assert len(all_of_them) == len(SWEEPS["boxes"]) * len(SWEEPS["triangles"])
    low, high = span(all_of_them)
    assert low == pytest.approx(2e9 / 20.0) and high >= predict(work, SMALL, base).rays_per_second
    factors = sensitivity(work, SMALL, base)
    assert list(factors) == sorted(factors, key=lambda name: -factors[name]) and set(factors) == set(SWEEPS)
    assert all(factor >= 1.0 for factor in factors.values()) and factors["warps"] > 1.0


def test_a_structure_on_a_gpu() -> None:
    """The work of real rays; planes take the box unit; sorting shuffled rays makes warps more alike."""
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 64), np.linspace(-1.2, 1.2, 64))
    origins = np.stack([x.ravel(), y.ravel(), np.full(4096, 3.0)], axis=1)[rng.permutation(4096)]
    directions = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    work = trace_rays(build(icosphere(5), "bvh2"), "shuffled", origins, directions)
    found = simt(work.counters.counts, work.warp, origins, directions)
    assert 0.0 < found["as they come"] == found["packed"] < found["sorted"] <= 1.0
    assert len(work) == 32 * (int(work.warp[-1]) + 1)
    prediction = predict(work, GPUS["rtx2080ti"])
    assert 0.1e9 < prediction.rays_per_second < 100e9
    assert prediction.clocks["box"] == pytest.approx(work.mean("boxes") / 4.0)
    planes = trace_rays(build(icosphere(3), "kdtree"), "planes", origins, directions)
    assert predict(planes, GPUS["rtx2080ti"]).clocks["box"] == pytest.approx(planes.mean("box_operations") / 4.0) != 0.0


def test_published_numbers() -> None:
    """The claim of 10 Grays/s is 10.5 clocks a ray and core."""
    gpu = GPUS["rtx2080ti"]
    assert gpu.sms * gpu.clock / 10e9 == pytest.approx(10.5, abs=0.01)
    assert gpu.l2.size == 5632 * 1024 and gpu.l1.size == 96 * 1024


def test_efficiency_by_hand() -> None:
    equal = np.full(64, 7.0)
    assert efficiency(equal, packed(64)) == 1.0
    assert efficiency(equal[:40], packed(40)) == 40 / 64  # 24 lanes have no ray
    one_long = np.ones(32)
    one_long[5] = 9.0
    assert efficiency(one_long, packed(32)) == pytest.approx((31 + 9) / (32 * 9))
    assert longest_of(np.array([1.0, 5.0, 2.0]), np.array([0, 0, 2])).tolist() == [5.0, 0.0, 2.0]
    assert efficiency(np.zeros(5), packed(5)) == 1.0 and efficiency(np.zeros(0), packed(0)) == 1.0


def test_blocks_are_of_eight_by_four_pixels() -> None:
    warp, lane = blocks(20, 9)
    assert len(np.unique(warp * WARP + lane)) == 180 and (lane < WARP).all()
    for w in np.unique(warp):
        y, x = np.divmod(np.flatnonzero(warp == w), 20)
        assert np.ptp(y // 4) == 0 and np.ptp(x // 8) == 0
    assert warp.reshape(9, 20)[8, 19] == warp.max() == 8


def test_sorting_puts_like_rays_beside_each_other() -> None:
    """Two bundles of rays, shuffled together, come apart; the order has every ray once."""
    rng = np.random.default_rng(2)
    which = rng.integers(0, 2, 500)
    origins = np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])[which] + 0.1 * rng.random((500, 3))
    directions = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]])[which] + 0.1 * rng.random((500, 3))
    order = by_coherence(origins, directions)
    assert sorted(order.tolist()) == list(range(500))
    assert np.count_nonzero(np.diff(which[order])) == 1


def test_morton_codes_are_interleaved_bits() -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    assert (np.diff(morton(corners)) > 0).all() and morton(corners)[0] == 0 and morton(corners)[7] == (1 << 30) - 1
    assert morton(np.zeros((3, 3))).tolist() == [0, 0, 0] and len(morton(np.zeros((0, 3)))) == 0
