"""Shared code of the grid, octree, k-d tree and BSP tree: input of the builders, and checks of files."""

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.snapshot import Built
from wrt.accel.store import row_type
from wrt.core.device import start, upload
from wrt.core.errors import InputError
from wrt.core.types import WarpStruct
from wrt.kernels.build.triangle_cell import CellSource
from wrt.kernels.units.box import PAD_EXTENT
from wrt.kernels.warp_private import fields_of


def cell_source(geometry: Geometry, bounds: tuple[np.ndarray, np.ndarray]) -> WarpStruct:
    """Upload the triangles, and the padded boxes `bounds` of all primitives, as kernels.build.triangle_cell.CellSource."""
    cpu, source = start("cpu"), CellSource()
    source.vertices = upload(geometry.vertices, wp.vec3, cpu)
    source.faces = upload(geometry.faces, wp.vec3i, cpu)
    source.lo, source.hi = (upload(array, wp.vec3, cpu) for array in bounds)
    return source


def one_row(accel: Accelerator, built: Built) -> dict[str, np.ndarray]:
    """Return the arrays of `built`. Arrays of one row, as files have them, become the vectors and scalars of the structure's struct."""
    arrays = dict(built.arrays)
    for name, kind in fields_of(accel.structure.struct()).items():
        if name in arrays and not isinstance(kind, wp.array):
            arrays[name] = np.reshape(arrays[name], row_type(kind).shape)
    return arrays


def check_numbers(arrays: dict[str, np.ndarray]) -> None:
    """Raise InputError unless pad and extent are valid for kernels.traverse.cell_ray.cell_slack, and mailbox is 0 or 1."""
    if not (arrays["pad"] >= 0.0 and arrays["extent"] >= 0.0 and arrays["mailbox"] in (0, 1)):
        raise InputError("is damaged: pad, extent or mailbox is out of range")


def check_references(cells: np.ndarray, references: np.ndarray, n_primitives: int) -> None:
    """Raise InputError unless the records (first, count) of cells address references, and all references address primitives."""
    first, count = cells["first"].astype(np.int64), cells["count"].astype(np.int64)
    if ((first < 0) | (count < 0) | (first + count > len(references))).any():
        raise InputError("is damaged: a cell leads out of the references")
    if ((references < 0) | (references >= n_primitives)).any():
        raise InputError("is damaged: a reference leads out of the primitives")


def require_between(**options: tuple[float, float, float]) -> None:
    """Raise InputError for an option whose value is out of range. options: name=(value, low, high)."""
    for name, (value, low, high) in options.items():
        if not low <= value <= high:
            raise InputError(f"must be {low:.10g} to {high:.10g}, got {value}", argument=name)


def triangle_reach(geometry: Geometry, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an upper bound of the padding, and the largest extent, of triangles' boxes (for kernels.traverse.cell_ray.cell_slack)."""
    n = len(geometry.faces)
    if not n:
        return np.zeros((), np.float32), np.zeros((), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        extent = (hi[:n] - lo[:n]).max()
        # The pad of a box is at most this fraction of its extent and its coordinates (Geometry.bounds).
        pad = np.float32(PAD_EXTENT) * (extent + np.maximum(np.abs(lo[:n]), np.abs(hi[:n])).max())
    return np.asarray(pad), np.asarray(extent)
