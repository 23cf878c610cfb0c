"""Results of queries: hits, counters of their cost, and the arrays that receive both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.queries.hit_points import HitPoints, Source
from wrt.core.arrays import from_tensor, to_numpy, to_warp
from wrt.core.checks import shown
from wrt.core.device import empty_aligned
from wrt.core.errors import InputError
from wrt.core.html import html_table
from wrt.core.types import Array, ArrayT, Device, TensorT, WarpArray

HIT_TYPES = {"out.t": np.float32, "out.u": np.float32, "out.v": np.float32, "out.prim_id": np.int32}
ANY_HIT_TYPES = {"out": np.bool_}


@dataclass(frozen=True, eq=False)
class Counters:
    """Costs of each ray of a query. `counters.nodes`, `counters.primitives` and the other fields of `counts` are (N,) arrays.

    Attributes
    ----------
    counts : (N,) structured array
        Records of `kernels.traverse.counters.Counts`.
    first : (N + 1,) int64
        Rows first[i] .. first[i + 1] - 1 of `address` and `size` are the fetches of ray i; all 0 without `trace=True`.
    address, size : (M,) int64
        Address and size of each fetch in bytes. Addresses of primitives begin at kernels.traverse.counters.PRIMITIVE_SPACE.
    """

    counts: np.ndarray
    first: np.ndarray
    address: np.ndarray
    size: np.ndarray

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith("_") or name not in (self.counts.dtype.names or ()):
            raise AttributeError(name)
        return self.counts[name]

    def __repr__(self) -> str:
        means = ", ".join(f"{name} {self.counts[name].mean():.2f}" for name in self.counts.dtype.names or ())
        return f"Counters({len(self.counts)} rays; mean per ray: {means})" if len(self.counts) else "Counters(0 rays)"

    def _repr_html_(self) -> str:
        names = (self.counts.dtype.names or ()) if len(self.counts) else ()
        rows = [(name, float(self.counts[name].mean()), int(self.counts[name].max()), int(self.counts[name].sum(dtype=np.int64)))
                for name in names]
        return html_table(f"Counters of {len(self.counts)} rays", ("", "mean per ray", "largest", "sum"), rows)


@dataclass(frozen=True, eq=False)
class Hits(HitPoints[ArrayT]):
    """Hits of N rays. The arrays are NumPy's, or those of the rays' library: Warp, PyTorch or JAX.

    Attributes
    ----------
    t : (N,) float32
        Distance in units of the direction's length; inf on a miss.
    u, v : (N,) float32
        Barycentric coordinates: the point is (1 - u - v) v0 + u v1 + v v2. Both are 0 on a miss and on a sphere.
    prim_id : (N,) int32
        Index of the face, or number of faces plus index of the sphere; -1 on a miss.
    counters : Counters or None
        Costs of each ray, if the query had `counters=True` or `trace=True`.
    source : tuple or None
        Snapshot and rays from which points, normals and ids are computed. Pickled hits have none.
    """

    t: ArrayT
    u: ArrayT
    v: ArrayT
    prim_id: ArrayT
    counters: Counters | None = None
    source: Source | None = None

    def __reduce__(self) -> tuple[object, ...]:
        return Hits, (self.t, self.u, self.v, self.prim_id, self.counters)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Hits({len(self)} rays)"

    def _repr_html_(self) -> str:
        hits = self.numpy()
        t = hits.t[hits.prim_id >= 0]
        facts: dict[str, float] = {"rays": len(self), "hits": len(t), "misses": len(self) - len(t)}
        if len(t):
            facts |= {"nearest t": float(t.min()), "farthest t": float(t.max())}
        return html_table("Hits", (), facts.items()) + (self.counters._repr_html_() if self.counters else "")

    def numpy(self) -> Hits[npt.NDArray[Any]]:
        """Return the hits with NumPy arrays, which share the memory of hits on the CPU."""
        return self.each(to_numpy)

    def warp(self) -> Hits[WarpArray]:
        """Return the hits with Warp arrays, which share the memory of hits on the CPU."""
        return self.each(to_warp)

    def each(self, convert: Callable[[ArrayT], TensorT]) -> Hits[TensorT]:
        """Return the hits with t, u, v and prim_id passed through `convert`."""
        return Hits(convert(self.t), convert(self.u), convert(self.v), convert(self.prim_id), self.counters, self.source)


def answer_arrays(types: Mapping[str, type], out: list[Any] | None, n: int, device: Device | None,
                  shared: bool = False) -> list[Array]:
    """Return one array (n,) per entry of `types`: checked arrays of `out`, or new ones. device: None for NumPy arrays, else Warp.

    shared: begin a new array at a cache line, because JAX would copy any other array. Raises InputError that names the array by its
    key in `types`.
    """
    if out is None:
        empty = empty_aligned if shared else np.empty
        return [empty(n, dtype) if device is None else wp.empty(n, dtype=wp.dtype_from_numpy(dtype), device=device)
                for dtype in types.values()]
    out = [from_tensor(array, name, None) for name, array in zip(types, out, strict=True)]
    for (name, dtype), array in zip(types.items(), out, strict=True):
        if device is None:
            fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.flags.carray
        else:
            fits = (isinstance(array, wp.array) and array.dtype == wp.dtype_from_numpy(dtype) and array.device == device
                    and (array.is_contiguous or n == 0))
        if not (fits and array.shape == (n,)):
            kind, place = ("NumPy", "writeable and") if device is None else ("Warp", f"on {device} and")
            raise InputError(f"must be a {kind} array ({n},) of {np.dtype(dtype)}, {place} contiguous, got {shown(array)}",
                             argument=name)
    # The arrays are contiguous, so that they overlap exactly if their bounds do.
    for (name, one), (other, two) in combinations(zip(types, out, strict=True), 2) if len(out) > 1 else ():
        if np.may_share_memory(one, two) if device is None else abs((one.ptr or 0) - (two.ptr or 0)) < n * one.strides[0]:
            raise InputError(f"shares memory with {other}", argument=name)
    return out
