"""Results of queries: hits, counters of their cost, and the arrays that receive both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.queries.arguments import Shape, in_shape
from wrt.accel.queries.hit_points import HitPoints, Source
from wrt.core.arrays import check_no_gradients, from_tensor, given_like, is_tensor, to_numpy, to_warp
from wrt.core.checks import shown
from wrt.core.device import empty_aligned
from wrt.core.errors import InputError
from wrt.core.tables import html_table
from wrt.core.types import Array, ArrayT, Device, TensorT, WarpArray

HIT_TYPES = {f"out.{name}": np.dtype(np.int32 if name == "prim_id" else np.float32) for name in ("t", "u", "v", "prim_id")}
ANY_HIT_TYPES = {"out": np.dtype(np.bool_)}


@dataclass(frozen=True, eq=False)
class Counters:
    """Costs of each ray of a query. `counters.nodes`, `counters.primitives` and the other fields of `counts` have the rays' shape.

    Attributes
    ----------
    counts : (...) structured array
        Records of `kernels.traverse.observer.Counts`.
    first : (N + 1,) int64
        Rows first[i] .. first[i + 1] - 1 of `address` and `size` are the fetches of ray i of N, in C order; all 0 without `trace=True`.
    address, size : (M,) int64
        Address and size of each fetch in bytes. Addresses of primitives begin at kernels.traverse.observer.PRIMITIVE_SPACE.
    """

    counts: np.ndarray
    first: np.ndarray
    address: np.ndarray
    size: np.ndarray

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith("_") or name not in (self.counts.dtype.names or ()):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
        return self.counts[name]

    def __repr__(self) -> str:
        means = ", ".join(f"{name} {self.counts[name].mean():.2f}" for name in self.counts.dtype.names or () if self.counts.size)
        return f"Counters({self.counts.size} rays; mean per ray: {means})" if self.counts.size else "Counters(0 rays)"

    def _repr_html_(self) -> str:
        names = (self.counts.dtype.names or ()) if self.counts.size else ()
        rows = [(name, float(self.counts[name].mean()), int(self.counts[name].max()), int(self.counts[name].sum(dtype=np.int64)))
                for name in names]
        return html_table(f"Counters of {self.counts.size} rays", ("", "mean per ray", "largest", "sum"), rows)


@dataclass(frozen=True, eq=False)
class Hits(HitPoints[ArrayT]):
    """Hits of rays, in arrays of the rays' shape (...). The arrays are NumPy's, or those of the rays' library: Warp, PyTorch or JAX.

    `hits[mask]`, `hits[10:20]` and `hits[i, j]` are the hits of some rays, in copied arrays, as NumPy indexes `t`.

    Attributes
    ----------
    t : (...) float32
        Distance in units of the direction's length; inf on a miss.
    u, v : (...) float32
        Barycentric coordinates: the point is (1 - u - v) v0 + u v1 + v v2. Both are 0 on a miss and on a sphere.
    prim_id : (...) int32
        Index of the face, or number of faces plus index of the sphere; -1 on a miss. It counts on over all meshes of a scene: `face` is
        the index within the mesh of `object`.
    counters : Counters or None
        Costs of each ray, if the query had `counters=True` or `trace=True`; not in `hits[...]`.
    source : tuple or None
        Snapshot and rays from which points, normals and ids are computed. Pickled hits have none; those of `first_hits` have only ids.
    """

    t: ArrayT
    u: ArrayT
    v: ArrayT
    prim_id: ArrayT
    counters: Counters | None = None
    source: Source | None = None

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Hits({' x '.join(map(str, self.shape)) or 1} rays)"

    def __getitem__(self, index: object) -> Hits[ArrayT]:
        """Return the hits of some rays. index: mask, slice, integers, or a tuple of these. Raises InputError under a recording tape."""
        if isinstance(index, str):
            raise TypeError(f"hits[...] selects rays; write hits.{index} in place of hits[{index!r}]")
        check_no_gradients("hits[...]", t=self.t)
        keys = tuple(to_numpy(key) if is_tensor(key) or isinstance(key, wp.array) else key
                     for key in (index if isinstance(index, tuple) else (index,)))
        rays = np.asarray(np.arange(int(np.prod(self.shape))).reshape(self.shape)[keys])
        some: Hits[ArrayT] = self.each(lambda array: given_like(self.prim_id, to_numpy(array).reshape(-1)[rays]))
        if self.source is None:
            return replace(some, counters=None)
        snapshot, own, worlds = self.source
        flat = rays.reshape(-1)
        return replace(some, counters=None, source=(snapshot, own and own.of(flat), worlds and worlds.of(flat)))

    def _repr_html_(self) -> str:
        hits = self.numpy()
        t = hits.t[hits.prim_id >= 0]
        facts: dict[str, float] = {"rays": hits.t.size, "hits": len(t), "misses": hits.t.size - len(t)}
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

    def in_shape(self, shape: tuple[int, ...]) -> Hits[ArrayT]:
        """Return the hits in another shape, in views of the same arrays. The number of hits stays the same."""
        costs = self.counters and replace(self.counters, counts=self.counters.counts.reshape(shape))

        def view(array: Any) -> ArrayT:
            shaped: ArrayT = in_shape(array if isinstance(array, wp.array) else array.reshape(-1), shape)
            return shaped

        return replace(self.each(view), counters=costs)


def arrays_of(out: object) -> list[Any]:
    """Return the arrays of the argument `out` of closest_hit in the order of HIT_TYPES. Raises InputError unless it is Hits."""
    if not isinstance(out, Hits):
        raise InputError(f"must be Hits, got {shown(out)}", argument="out", hint="the Hits of an earlier call")
    return [out.t, out.u, out.v, out.prim_id]


def answer_arrays(types: Mapping[str, np.dtype], out: Sequence[Any] | None, shape: Shape, device: Device | None,
                  shared: bool = False) -> Sequence[Array]:
    """Return one array (N,) per entry of `types`: arrays of `out`, which have the rays' shape, or new ones. device: None for NumPy.

    shared: begin a new array at a cache line, because JAX would copy any other array. Raises InputError that names the array by its
    key in `types`.
    """
    n = shape[0] if len(shape) == 1 else int(np.prod(shape))
    if out is None:
        if device is not None:
            return [wp.empty(n, dtype=wp.dtype_from_numpy(dtype), device=device) for dtype in types.values()]
        return [empty_aligned(n, dtype) if shared else np.empty(n, dtype) for dtype in types.values()]
    arrays = []
    for (name, dtype), array in zip(types.items(), out, strict=True):
        if type(array) is not np.ndarray:
            array = from_tensor(array, name, None)
        if device is None:
            fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.flags.carray and array.shape == shape
        else:
            fits = (isinstance(array, wp.array) and array.dtype == wp.dtype_from_numpy(dtype) and array.device == device
                    and (array.is_contiguous or n == 0) and array.shape == (shape or (1,)))
        if not fits:
            kind, place = ("NumPy", "writeable and") if device is None else ("Warp", f"on {device} and")
            raise InputError(f"must be a {kind} array {shape} of {dtype}, {place} contiguous, got {shown(array)}", argument=name)
        arrays.append(array if array.ndim == 1 else in_shape(array, (n,)) if device is not None else array.reshape(-1))
    if device is None and all(array.base is None for array in arrays) and len({*map(id, arrays)}) == len(arrays):
        return arrays  # the usual call
    # The arrays are contiguous, so that they overlap exactly if their bounds do.
    for (name, one), (other, two) in combinations(zip(types, arrays, strict=True), 2):
        if np.may_share_memory(one, two) if device is None else abs((one.ptr or 0) - (two.ptr or 0)) < n * one.strides[0]:
            raise InputError(f"shares memory with {other}", argument=name)
    return arrays
