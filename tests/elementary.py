"""Measure the elementary functions of shading: `python -m tests.elementary` (half an hour) prints times per call and largest errors.

Functions of one argument are tested with all 2^32 floats; functions of two with random and special values. The reference is the C
library in float64, whose error is below 2^-27 ulp of float32; test_elementary.py checks the worst arguments with 60 decimal digits.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from math import factorial, log, pi, sqrt
from typing import Any

import numpy as np

from tests.kernel_tools import DEVICE, floats, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade.elementary import acos, atan2, exp, power, sin_cos
from wrt.kernels.structs import kernel

ONE = ("sin", "cos", "acos", "exp")
TWO = ("atan2", "power")


@wp.func
def ulps(found: float, exact: wp.float64) -> float:
    """Return |found - exact| in ulp of float32 at `exact`. Infinities count as 2^128; inf for a wrong sign of 0, or NaN on one side."""
    if wp.isnan(exact) or wp.isnan(found):
        return wp.where(wp.isnan(exact) == wp.isnan(found), 0.0, wp.inf)
    largest = wp.float64(wp.static(2.0**128))
    a = wp.clamp(wp.float64(found), -largest, largest)
    b = wp.clamp(exact, -largest, largest)
    if a == b and wp.copysign(1.0, found) != wp.where(wp.cast(exact, wp.int64) < wp.int64(0), -1.0, 1.0):
        return wp.inf
    exponent = wp.clamp(int((wp.cast(exact, wp.int64) >> wp.int64(52)) & wp.int64(2047)) - 1023, -126, 127)
    place = wp.cast(wp.int64(exponent - 23 + 1023) << wp.int64(52), wp.float64)
    return float(wp.abs(a - b) / place)


@wp.func
def error_of_one(which: int, x: float) -> float:
    d = wp.float64(x)
    if which < 2:
        sin, cos = sin_cos(x)
        if which == 0:
            return ulps(sin, wp.sin(d))
        return ulps(cos, wp.cos(d))
    if which == 2:
        if not wp.abs(x) <= 1.0:
            return ulps(acos(x), wp.float64(wp.nan))  # wp.acos clamps
        return ulps(acos(x), wp.acos(d))
    return ulps(exp(x), wp.exp(d))


@kernel
def sweep(first: wp.uint32, stride: wp.uint32, count: int, which: int, error: wp.array(dtype=float), at: wp.array(dtype=float)):
    """Write the largest error over the `count` floats of each thread, in ulp, and its argument. Their bits: first, first + stride ..."""
    i = wp.tid()
    worst = wp.float32(-1.0)
    for j in range(count):
        x = wp.cast(first + stride * (wp.uint32(i) * wp.uint32(count) + wp.uint32(j)), wp.float32)
        found = error_of_one(which, x)
        if found > worst:
            worst = found
            at[i] = x
    error[i] = worst


@kernel
def pairs(x: wp.array(dtype=float), y: wp.array(dtype=float), which: int, error: wp.array(dtype=float)):
    i = wp.tid()
    if which == 0:
        error[i] = ulps(atan2(x[i], y[i]), wp.atan2(wp.float64(x[i]), wp.float64(y[i])))
    else:
        error[i] = ulps(power(x[i], y[i]), wp.pow(wp.float64(x[i]), wp.float64(y[i])))


def worst_of_one(name: str, stride: int = 1, first: int = 0) -> tuple[float, float]:
    """Return the largest error in ulp, and its argument, over the floats whose bits are first, first + stride ..."""
    threads = 1 << 12
    count = (2**32 // stride) // threads
    error, at = zeros(threads), zeros(threads)
    launch(sweep, threads, first, stride, count, ONE.index(name), error, at)
    i = int(error.numpy().argmax())
    return float(error.numpy()[i]), float(at.numpy()[i])


def worst_of_two(name: str, x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    error = zeros(len(x))
    launch(pairs, len(x), floats(x), floats(y), TWO.index(name), error)
    i = int(error.numpy().argmax())
    return float(error.numpy()[i]), float(x[i]), float(y[i])


def special_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs (x, y) of zeros, infinities, NaN, the smallest and largest floats, integers, and neighbours of 1."""
    some = np.array([0.0, 2.0**-149, 2.0**-126, 2.0**-24, 0.5, 1.0 - 2.0**-24, 1.0, 1.0 + 2.0**-23, 1.5, 2.0, 3.0, 4.0, 127.0,
                     128.0, 149.0, 150.0, 2.0**23 - 0.5, 2.0**23 + 1.0, 2.0**24 - 1.0, 2.0**24, 2.0**24 + 2.0, 2.0**32,
                     2.0**128 - 2.0**104, np.inf, np.nan], dtype=np.float32)
    x, y = np.meshgrid(np.concatenate([some, -some]), np.concatenate([some, -some]))
    return x.ravel(), y.ravel()


def random_pairs(name: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return n pairs (x, y), a quarter of each kind: random bits; similar sizes (power: bases near 1); results over the whole
    range; arguments that shading has."""
    rng = np.random.default_rng(seed)
    m = n // 4
    any_x, any_y = rng.integers(0, 2**32, size=(2, m), dtype=np.uint32).view(np.float32)
    a, b = rng.uniform(0.0, 1.0, size=(2, m))
    sign = rng.choice([-1.0, 1.0], size=(4, m))
    if name == "power":
        near = 1.0 + sign[0] * 2.0 ** -(24.0 * a)
        base = 2.0 ** (sign[2] * 127.0 * a**3)
        with np.errstate(divide="ignore"):
            x = [any_x, near, base, a]
            y = [any_y, (150.0 * sign[1] * b) / np.log2(near), 151.0 * sign[3] * b / np.log2(base), np.exp(12.0 * b)]
    else:
        scale = 2.0 ** rng.uniform(-140.0, 127.0, size=m)
        x = [any_x, sign[0] * scale * a, sign[2] * 2.0 ** rng.uniform(-149.0, 127.0, m), 2.0 * a - 1.0]
        y = [any_y, sign[1] * scale * b, sign[3] * 2.0 ** rng.uniform(-149.0, 127.0, m), 2.0 * b - 1.0]
    with np.errstate(over="ignore", invalid="ignore"):
        return np.concatenate(x).astype(np.float32), np.concatenate(y).astype(np.float32)


def series(name: str) -> tuple[Callable[[float], float], float, float]:
    """Return the function that a polynomial of wrt.kernels.shade.elementary approximates (a power series without its first terms),
    and the ends of its interval."""

    def total(term: Callable[[int], float]) -> Callable[[float], float]:
        terms = [term(i) for i in range(60)]
        return lambda z: sum(each * z**i for i, each in enumerate(terms))

    of = {"sin": (lambda i: (-1.0) ** (i + 1) / factorial(2 * i + 3), 0.0, (pi / 4.0) ** 2),
          "cos": (lambda i: (-1.0) ** i / factorial(2 * i + 4), 0.0, (pi / 4.0) ** 2),
          "asin": (lambda i: factorial(2 * i + 2) / (4 ** (i + 1) * factorial(i + 1) ** 2 * (2 * i + 3)), 0.0, 0.25),
          "atan": (lambda i: (-1.0) ** (i + 1) / (2 * i + 3), 0.0, 0.25),
          "exp": (lambda i: 1.0 / factorial(i + 2), -log(2.0) / 2.0, log(2.0) / 2.0),
          "log": (lambda i: 2.0 / log(2.0) / (2 * i + 5), 0.0, ((sqrt(2.0) - 1.0) / (sqrt(2.0) + 1.0)) ** 2)}
    term, low, high = of[name]
    return total(term), low, high


def derived(name: str, n: int) -> np.ndarray:
    """Return the n coefficients of the polynomial, lowest power first, by interpolation at Chebyshev points.

    On intervals from 0, its factor vanishes there, and so does its error: the n points are those of n + 1, shifted, without 0."""
    function, low, high = series(name)
    if low == 0.0:
        cosines = np.cos(pi * (2.0 * np.arange(n + 1) + 1.0) / (2.0 * n + 2.0))
        points = high * (cosines - cosines[-1])[:-1] / (1.0 - cosines[-1])
    else:
        points = high * np.cos(pi * (2.0 * np.arange(n) + 1.0) / (2.0 * n))
    return np.linalg.solve(np.vander(points, n, increasing=True), [function(z) for z in points])


# --- time ------------------------------------------------------------------------------------------------------------


# Ranges of arguments in shading, for each function and its counterpart of the C library.
ANGLES, COSINES, DEPTHS = (-6.0, 6.0), (-1.0, 1.0), (-8.0, 0.0)


@wp.func
def own_sin_cos(x: float, y: float) -> float:
    sin, cos = sin_cos(x)
    return sin + cos


@wp.func
def library_sin_cos(x: float, y: float) -> float:
    return wp.sin(x) + wp.cos(x)


@wp.func
def own_acos(x: float, y: float) -> float:
    return acos(x)


@wp.func
def library_acos(x: float, y: float) -> float:
    return wp.acos(x)


@wp.func
def own_atan2(x: float, y: float) -> float:
    return atan2(x, y)


@wp.func
def library_atan2(x: float, y: float) -> float:
    return wp.atan2(x, y)


@wp.func
def own_exp(x: float, y: float) -> float:
    return exp(x)


@wp.func
def library_exp(x: float, y: float) -> float:
    return wp.exp(x)


@wp.func
def own_power(x: float, y: float) -> float:
    return power(wp.abs(x), 50.0 + y)


@wp.func
def library_power(x: float, y: float) -> float:
    return wp.pow(wp.abs(x), 50.0 + y)


CALLS = {"sin_cos": (own_sin_cos, library_sin_cos, ANGLES), "acos": (own_acos, library_acos, COSINES),
         "atan2": (own_atan2, library_atan2, COSINES), "exp": (own_exp, library_exp, DEPTHS),
         "power": (own_power, library_power, COSINES)}


def timed(call: Any) -> Any:
    @kernel
    def run(x: wp.array(dtype=float), y: wp.array(dtype=float), rounds: int, out: wp.array(dtype=float)):
        total = wp.float32(0.0)
        for _ in range(rounds):
            for i in range(x.shape[0]):
                total += call(x[i], y[i])
        out[wp.tid()] = total

    return run


def nanoseconds(name: str, runs: int = 9) -> tuple[float, float]:
    """Return the median processor time of a call in ns, of wrt's function and of the C library's, measured in turns."""
    own, library, (low, high) = CALLS[name]
    kernels = [timed(own), timed(library)]
    x, y = (floats(each) for each in np.random.default_rng(0).uniform(low, high, size=(2, 4096)))
    out, rounds = zeros(1), 200
    spent: list[list[float]] = [[], []]
    for _ in range(runs + 1):
        for each, into in zip(kernels, spent, strict=True):
            begin = time.thread_time()
            launch(each, 1, x, y, rounds, out)
            wp.synchronize_device(DEVICE)
            into.append((time.thread_time() - begin) / (rounds * 4096) * 1e9)
    ours, theirs = (statistics.median(each[1:]) for each in spent)
    return ours, theirs


def main() -> None:
    for name in CALLS:
        print("{}: {:.1f} ns per call, C library {:.1f} ns".format(name, *nanoseconds(name)), flush=True)
    for name in TWO:
        for pairs_of in (special_pairs(), random_pairs(name, 1 << 26, 0)):
            found = worst_of_two(name, *pairs_of)
            print("{}: {:.3f} ulp at {!r}, {!r} of {:,} pairs".format(name, *found, len(pairs_of[0])), flush=True)
    for name in ONE:
        print("{}: {:.3f} ulp at {!r}, of all floats".format(name, *worst_of_one(name)), flush=True)


if __name__ == "__main__":
    main()
