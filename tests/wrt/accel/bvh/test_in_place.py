"""Refits in place of wide BVHs: arrays have the bits of a refit on the host."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import DEVICE, cpu_only  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.device import on_host
from wrt.kernels.wide.layout import EXIST_SHIFT, EXPONENT_BITS, FIRST_BYTES, MANTISSA_BITS, PLANES, WORD, first_reference
from wrt.kernels.wide.references import leaf_count, leaf_first
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

EXPONENT_BIAS, LARGEST_EXPONENT, LARGEST_BYTE = 127, 255, 255
EXPONENT_SHIFTS = EXPONENT_BITS * np.arange(3, dtype=np.uint32)
BALL, WIDE = icosphere(2), ("bvh4", "bvh8", "bvh8c")
SPHERES = np.float32([[0.0, 0.0, 3.0, 0.5], [2.0, 0.0, 0.0, 1.0]])
CASES = {
    "moved": lambda rng: BALL.vertices + 0.3 * rng.normal(size=BALL.vertices.shape),
    "flat": lambda rng: BALL.vertices * [1.0, 0.0, 1.0],
    "a point": lambda rng: 0.0 * BALL.vertices,
    "all scales": lambda rng: BALL.vertices * 10.0 ** rng.uniform(-45.0, 38.5, (len(BALL.vertices), 1)),
    "huge": lambda rng: 3e38 * np.sign(BALL.vertices),
    "tiny": lambda rng: 1e-44 * BALL.vertices,
    "far": lambda rng: BALL.vertices + [1e6, -3e4, 0.0],
    "nan": lambda rng: np.where(rng.random(BALL.vertices.shape) < 0.02, np.nan, BALL.vertices),
    "inf": lambda rng: np.where(rng.random(BALL.vertices.shape) < 0.02, -np.inf, BALL.vertices),
    "all nan": lambda rng: np.nan * BALL.vertices,
}


def decoded(origin: np.ndarray, step: np.ndarray, byte: np.ndarray) -> np.ndarray:
    """Decode planes origin + byte * step as kernels do: only the sum rounds. origin, step: (..., 1) float32; byte: (..., W)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return origin + byte.astype(np.float32) * step


def steps(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the biased exponent of the least power of two p with low + 255 p >= high; LARGEST_EXPONENT if no finite p suffices."""
    with np.errstate(invalid="ignore", over="ignore"):
        _, exponent = np.frexp((high.astype(np.float64) - low) / LARGEST_BYTE)
        biased = np.clip(np.where(high > low, exponent, -EXPONENT_BIAS) - 1 + EXPONENT_BIAS, 1, LARGEST_EXPONENT)
        for _ in range(3):  # frexp is one too small for a power of two, and the sum may round down
            short = ~(decoded(low, powers(biased), np.full_like(low, LARGEST_BYTE)) >= high)
            biased = np.minimum(biased + short, LARGEST_EXPONENT)
    return biased


def powers(biased: np.ndarray) -> np.ndarray:
    return (biased.astype(np.uint32) << MANTISSA_BITS).view(np.float32)


def compressed(lo: np.ndarray, hi: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Compress the boxes of N nodes' children. Return the start of each compressed node: all its floats before the references to children.

    lo, hi: (N, W, 3) float32; exists: (N, W) bool, whether a child exists. Result: (N, F) float32 with F = first_reference(W, True).
    Every compressed box contains the original box. Along an axis whose extent 8 bits cannot cover, the box is infinite.
    """
    n, width = exists.shape
    low = np.where(exists[..., None], lo, np.float32(np.inf)).min(axis=1)
    high = np.where(exists[..., None], hi, np.float32(-np.inf)).max(axis=1)
    low, high = np.where(low <= high, low, 0.0).astype(np.float32), np.where(low <= high, high, 0.0).astype(np.float32)
    biased = steps(low, high)
    coarse = (biased == LARGEST_EXPONENT) | ~np.isfinite(low) | ~np.isfinite(high)
    origin = np.where(coarse, np.float32(np.nan), low)
    step = powers(np.where(coarse, 1, biased))
    bytes_ = np.zeros((n, 3, 2, width), np.uint8)
    for end, planes in enumerate((lo, hi)):
        wanted = np.where((exists[..., None] & ~coarse[:, None, :]), planes, low[:, None, :]).transpose(0, 2, 1)
        bytes_[:, :, end] = nearest(np.where(coarse, 0.0, low).astype(np.float32)[..., None], step[..., None], wanted, end == 1)
    out = np.zeros((n, first_reference(width, True)), np.float32)
    out[:, :WORD] = origin
    exponents = np.where(coarse, 1, biased).astype(np.uint32)
    mask = (exists.astype(np.uint32) << np.arange(width, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
    out[:, WORD] = ((exponents << EXPONENT_SHIFTS).sum(axis=1, dtype=np.uint32) | mask << EXIST_SHIFT).view(np.float32)
    out[:, FIRST_BYTES:] = bytes_.reshape(n, len(PLANES) * width).view(np.float32)
    return out


def nearest(origin: np.ndarray, step: np.ndarray, planes: np.ndarray, upward: bool) -> np.ndarray:
    """Return, for each of `planes`, the byte whose decoded plane is the nearest not above it, or not below it if `upward`."""
    with np.errstate(over="ignore", invalid="ignore"):
        t = (planes.astype(np.float64) - origin) / step.astype(np.float64)
    byte = np.clip(np.where(np.isfinite(t), np.ceil(t) if upward else np.floor(t), 0.0), 0.0, LARGEST_BYTE)
    for _ in range(2):  # the decoded plane may round to the wrong side
        plane = decoded(origin, step, byte)
        byte += np.where(plane < planes, 1.0, 0.0) if upward else np.where(plane > planes, -1.0, 0.0)
        byte = np.clip(byte, 0.0, LARGEST_BYTE)
    return byte.astype(np.uint8)


def points_of(vertices: np.ndarray) -> Any:
    with np.errstate(over="ignore"):
        return wp.array(np.asarray(vertices, np.float32), dtype=wp.vec3, device=DEVICE)


def assert_refitted(accel: Any, vertices: np.ndarray) -> None:
    """Compare the arrays with boxes from a loop over all nodes, in NumPy, and with the records of a new structure."""
    host = accel._over(Geometry(np.asarray(vertices, np.float32), accel.geometry.faces, accel.geometry.spheres))
    built = accel.built
    tree, (low, high) = host._tree(built), host.geometry.bounds()
    lo, hi = np.full_like(tree.lo, np.inf), np.full_like(tree.hi, -np.inf)
    for node, lane in reversed([*np.ndindex(tree.children.shape)]):
        child = int(tree.children[node, lane])
        if child < 0:
            first, count = leaf_first.func(child), leaf_count.func(child)
            ids = tree.order[first:].reshape(-1)[:count]
            lo[node, lane], hi[node, lane] = low[ids].min(axis=0), high[ids].max(axis=0)
        elif child > 0:
            lo[node, lane], hi[node, lane] = lo[child].min(axis=0), hi[child].max(axis=0)
    nodes = host._arrays(replace(tree, lo=lo, hi=hi))["nodes"]
    if host.compressed:
        head = first_reference(host.width, True)
        host._nodes(replace(built, arrays={"nodes": nodes}))[:, :head] = compressed(lo, hi, tree.exists)
    for found, expected in ((accel.data.nodes, nodes), (accel.data.primitives, host._primitives(built))):
        np.testing.assert_array_equal(on_host(found).view(np.uint32), expected.view(np.uint32))


@pytest.mark.parametrize("name", WIDE)
def test_arrays_of_a_refit_in_place_have_the_bits_of_one_on_the_host(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    structures = [build(Geometry(BALL.vertices, BALL.faces, spheres), name, **options) for spheres, options in (
        (SPHERES[:0], {}), (SPHERES, {"max_leaf": 1}), (SPHERES, {"max_leaf": 40, "cost_traversal": 5.0}), (SPHERES, {"builder": "sbvh"}))]
    for accel in structures:
        accel.refit(points_of(BALL.vertices), in_place=True)
    monkeypatch.setattr("wrt.accel.bvh.in_place.vectors", lambda *_: None)  # a graph reads points unchecked, too
    monkeypatch.setattr("wrt.accel.bvh.wide_tree.SLOTS_PER_JOB", 64)
    data = [accel.data for accel in structures]
    for case in CASES.values():
        with np.errstate(over="ignore"):
            vertices = np.float32(case(rng))
        for accel in structures:
            accel.refit(points_of(vertices), in_place=True)
            assert_refitted(accel, vertices)
    assert all(accel.data is each for accel, each in zip(structures, data, strict=True))


@pytest.mark.parametrize("name", WIDE)
def test_small_trees(name: str) -> None:
    for count in (0, 1, 2, 9):
        mesh = Mesh(BALL.vertices, BALL.faces[:count])
        accel = build(mesh, name)
        accel.refit(points_of(2.0 * BALL.vertices), in_place=True)
        assert_refitted(accel, 2.0 * BALL.vertices)
    spheres = build(Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), SPHERES), name)
    spheres.refit(points_of(np.zeros((0, 3))), in_place=True)
    assert_refitted(spheres, np.zeros((0, 3)))


@cpu_only
def test_a_graph_of_the_cpu_captures_a_refit_in_place() -> None:
    accel, points = build(BALL, "bvh8"), points_of(BALL.vertices)
    with refused(None, "the first refit in place"), wp.ScopedCapture("cpu"):
        accel.refit(points, in_place=True)
    accel.refit(points, in_place=True)
    with refused(None, "cannot be captured in a graph"), wp.ScopedCapture("cpu"):
        accel.refit(wp.zeros(2 * len(points), dtype=wp.vec3, device="cpu")[::2], in_place=True)
    with wp.ScopedCapture("cpu") as capture:
        accel.refit(points, in_place=True)
    for case in ("moved", "nan"):
        points.assign(np.float32(vertices := CASES[case](np.random.default_rng(1))))
        wp.capture_launch(capture.graph)
        assert_refitted(accel, vertices)
