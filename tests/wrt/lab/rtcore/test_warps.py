"""Warps: efficiency by hand, and orders that are orders."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.lab.rtcore.warps import WARP, blocks, by_coherence, efficiency, longest_of, morton, packed


def test_efficiency_by_hand() -> None:
    equal = np.full(64, 7.0)
    assert efficiency(equal, packed(64)) == 1.0
    assert efficiency(equal[:40], packed(40)) == 40 / 64  # 24 lanes have no ray
    one_long = np.ones(32)
    one_long[5] = 9.0
    assert efficiency(one_long, packed(32)) == pytest.approx((31 + 9) / (32 * 9))
    assert longest_of(np.array([1.0, 5.0, 2.0]), np.array([0, 0, 2])).tolist() == [5.0, 0.0, 2.0]
    assert efficiency(np.zeros(5), packed(5)) == 1.0 and efficiency(np.zeros(0), packed(0)) == 1.0


def test_sorting_by_cost_is_best_and_packing_never_worse() -> None:
    rng = np.random.default_rng(1)
    cost = rng.geometric(0.05, 3200).astype(float)
    assert efficiency(np.sort(cost), packed(3200)) > efficiency(cost, packed(3200)) > 0.2
    loose = np.arange(3200) // 8  # 8 rays a warp
    assert efficiency(cost, packed(3200)) > efficiency(cost, loose)


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
