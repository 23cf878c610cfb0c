"""Uniform grid: cells of one size, each with a list of the primitives that overlap it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.bvh.builders import half_areas
from wrt.accel.cells.common import check_references, shapes_of
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.accel.structures import require_between
from wrt.core.device import launch, on_host, records, start, upload
from wrt.core.errors import InputError
from wrt.core.types import WarpArray, WarpStruct
from wrt.kernels.build import grid as build_grid
from wrt.kernels.traverse import grid as kernels
from wrt.kernels.units.box import PAD_EXTENT

MAX_CELLS = 1 << 25
MAX_AXIS = 2048
PRIMITIVES_PER_LAUNCH = 16384


@dataclass(frozen=True)
class GridOptions:
    """Options of the grid. Raises InputError for values out of range.

    density: cells per primitive, 1e-3 to 1e3; there are at most MAX_CELLS. mailbox: avoid testing a ray against the same primitive in
    several cells.
    """

    density: float = 2.0
    mailbox: bool = True

    def __post_init__(self) -> None:
        require_between(density=(self.density, 1e-3, 1e3))


class Grid(OneMesh):
    """A uniform grid. Options: GridOptions.

    Every cell that overlaps a sphere's box lists the sphere. The option `box` has no effect.
    """

    name = "grid"
    kernels = kernels
    options = GridOptions

    def _build(self, options: GridOptions) -> Built:
        lo, hi = self.geometry.bounds()
        layout = resolution(lo, hi, options.density)
        cells, references = list_references(self.geometry, (lo, hi), layout, self.threads)
        pad, extent = triangle_reach(self.geometry, lo, hi)
        return Built({"lo": np.array(layout.lo), "hi": np.array(layout.hi), "size": np.array(layout.size),
                      "n": np.array(layout.n), "pad": pad, "extent": extent, "mailbox": np.array(options.mailbox, np.int32),
                      "cells": cells, "references": references},
                     np.arange(len(lo), dtype=np.int32), len(cells), int((cells["count"] > 0).sum()), 1,
                     sah_cost(layout, len(cells) + len(references)))

    def _check(self, built: Built) -> None:
        arrays = built.arrays
        if not (arrays["pad"] >= 0.0 and arrays["extent"] >= 0.0 and arrays["mailbox"] in (0, 1)):
            raise InputError("is damaged: pad, extent or mailbox is out of range")
        lo, hi, size, n = (arrays[name] for name in ("lo", "hi", "size", "n"))
        with np.errstate(over="ignore", invalid="ignore"):
            last = lo + (n - 1).astype(np.float32) * size
        empty = (lo == np.inf).all() and (hi == -np.inf).all()
        if not ((n >= 1) & (n <= MAX_AXIS) & (size >= 0.0) & ((last <= hi) | empty)).all():
            raise InputError("is damaged: its planes are not in order")
        if len(arrays["cells"]) != np.prod(n.astype(np.int64)):
            raise InputError("is damaged: the number of cells differs from its layout")
        check_references(arrays["cells"], arrays["references"], len(built.order))


def resolution(lo: np.ndarray, hi: np.ndarray, density: float) -> WarpStruct:
    """Choose the GridLayout over boxes lo, hi (N, 3): nearly cubic cells, about `density` per primitive (Cleary and Wyvill 1988)."""
    layout = kernels.GridLayout()
    low, high = lo.min(axis=0, initial=np.inf), hi.max(axis=0, initial=-np.inf)
    extent = high.astype(np.float64) - low.astype(np.float64)
    n = np.ones(3, np.int64)
    if len(lo) and np.isfinite(extent).all():
        # `finest` keeps cells so large that the rounding of their planes does not matter.
        finest = np.maximum(np.abs(low), np.abs(high)).astype(np.float64) * PAD_EXTENT
        with np.errstate(divide="ignore", invalid="ignore"):
            most = np.clip(np.where(extent > 0.0, extent / finest, 1.0), 1, MAX_AXIS)
        n = cells_along(extent, most, min(density * len(lo), MAX_CELLS))
    layout.lo, layout.hi, layout.n = wp.vec3(*low), wp.vec3(*high), wp.vec3i(*n.tolist())
    size = np.zeros(3, np.float32)
    size[n > 1] = (extent[n > 1] / n[n > 1]).astype(np.float32)
    layout.size = wp.vec3(*size)
    return layout


def cells_along(extent: np.ndarray, most: np.ndarray, wanted: float) -> np.ndarray:
    """Return the number of cells along each axis, (3,): proportional to `extent`, 1 to `most`, with a product of about `wanted`."""
    def along(log_scale: float) -> np.ndarray:
        return np.clip(extent * 2.0**log_scale, 1.0, most)

    low, high = -1000.0, 1000.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if along(middle).prod() < wanted:
            low = middle
        else:
            high = middle
    n = np.floor(along(low) + 1e-9).astype(np.int64)
    return np.maximum(n, 1)


def list_references(geometry: Geometry, bounds: tuple[np.ndarray, np.ndarray], layout: WarpStruct,
                    threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Return GridCell records, and the prim_ids of all cells one after another, (R,) int32."""
    cpu = start("cpu")
    shapes = shapes_of(geometry, bounds)
    n = len(geometry)
    count = wp.zeros(n, dtype=wp.int32, device=cpu)

    def run(begin: WarpArray, cells: WarpArray) -> None:
        launch(build_grid.list_cells, n, shapes, layout, None, begin, count, cells, threads=threads, step=PRIMITIVES_PER_LAUNCH)

    run(wp.zeros(0, dtype=wp.int64, device=cpu), wp.zeros(0, dtype=wp.int32, device=cpu))
    begin = np.zeros(n + 1, np.int64)
    np.cumsum(count.numpy(), out=begin[1:])
    total = int(begin[-1])
    if total >= 1 << 31:
        raise InputError(f"density leads to {total} references to primitives, more than 2^31 - 1", argument="density",
                         hint="choose a lower density")
    device_begin = upload(begin, wp.int64, cpu)
    cell_of = wp.zeros(total, dtype=wp.int32, device=cpu)
    if total:
        run(device_begin, cell_of)
    cells = upload(records(kernels.GridCell, int(np.prod(layout.n))), kernels.GridCell, cpu)
    references = wp.zeros(total, dtype=wp.int32, device=cpu)
    launch(build_grid.sort_by_cell, 1, device_begin, cell_of, cells, references)
    return on_host(cells), references.numpy()


def triangle_reach(geometry: Geometry, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an upper bound of the padding, and the largest extent, of triangles' boxes (for kernels.traverse.grid.cell_slack)."""
    n = len(geometry.faces)
    if not n:
        return np.zeros((), np.float32), np.zeros((), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        extent = (hi[:n] - lo[:n]).max()
        # The pad of a box is at most this fraction of its extent and its coordinates (Geometry.bounds).
        pad = np.float32(PAD_EXTENT) * (extent + np.maximum(np.abs(lo[:n]), np.abs(hi[:n])).max())
    return np.asarray(pad), np.asarray(extent)


def sah_cost(layout: WarpStruct, total: int) -> float:
    """Return the expected number of cells plus primitives that a random line visits. total: all cells plus all references."""
    extent = np.array(layout.hi, np.float64) - np.array(layout.lo, np.float64)
    whole, cell = (float(half_areas(np.zeros(3), e)) for e in (extent, extent / np.array(layout.n, np.float64)))
    return total * cell / whole if whole > 0.0 else float(total)
