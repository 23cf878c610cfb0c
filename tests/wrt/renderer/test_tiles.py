"""Tiles cover every pixel once, and work_left has the missing samples after any interruption."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from wrt.renderer.tiles import Work, tiles, work_left


@given(st.integers(0, 9), st.integers(0, 9), st.integers(1, 40), st.integers(1, 40), st.integers(1, 50))
def test_tiles_cover_a_rectangle_once(x0: int, y0: int, width: int, height: int, step: int) -> None:
    times = np.zeros((60, 60), int)
    for x, y, w, h in tiles((x0, y0, x0 + width, y0 + height), step):
        assert 1 <= w <= step and 1 <= h <= step
        times[y : y + h, x : x + w] += 1
    assert (times[y0 : y0 + height, x0 : x0 + width] == 1).all() and times.sum() == width * height


@given(st.integers(1, 8), st.integers(1, 8), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_work_left_brings_every_pixel_to_the_goal_in_its_own_order(old: int, new: int, n: int, seed: int) -> None:
    crop = (3, 5, 24, 16)
    rng = np.random.default_rng(seed)
    samples = np.full((11, 21), 2)
    for x, y, w, h in tiles(crop, old):
        samples[y - 5 : y - 5 + h, x - 3 : x - 3 + w] += rng.integers(0, 6)
    expected = np.maximum(samples, 2 + n)
    for (x, y, w, h), first, count in work_left([Work(tile, 2, n) for tile in tiles(crop, new)], samples, crop):
        part = samples[y - 5 : y - 5 + h, x - 3 : x - 3 + w]
        assert (part == first).all() and count > 0  # each pixel continues with its first missing sample
        part += count
    assert np.array_equal(samples, expected)
