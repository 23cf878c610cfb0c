"""Answers of a structure: hits, what they cost, and the arrays that take them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.hit_points import HitPoints
from wrt.core.arrays import taken, to_numpy, to_warp
from wrt.core.checks import shown
from wrt.core.device import empty_aligned
from wrt.core.errors import InputError
from wrt.core.html import html_table

HIT_TYPES = {"out.t": np.float32, "out.u": np.float32, "out.v": np.float32, "out.prim_id": np.int32}
ANY_HIT_TYPES = {"out": np.bool_}


@dataclass(frozen=True, eq=False)
class Counters:
    """What each ray cost, (N,) each, as in kernels.traverse.counters.Counts; trace: the fetches of all rays one after another,
    those of ray i from first[i] to first[i + 1]: address (int64, bytes; primitives from PRIMITIVE_SPACE on) and size (int64,
    bytes)."""

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
        return f"Counters({len(self.counts)} rays; a ray: {means})" if len(self.counts) else "Counters(0 rays)"

    def _repr_html_(self) -> str:
        names = (self.counts.dtype.names or ()) if len(self.counts) else ()
        rows = [(name, float(self.counts[name].mean()), int(self.counts[name].max()), int(self.counts[name].sum(dtype=np.int64)))
                for name in names]
        return html_table(f"Counters of {len(self.counts)} rays", ("", "a ray", "largest", "sum"), rows)


@dataclass(frozen=True, eq=False)
class Hits(HitPoints):
    """t: (N,) float32, in units of |direction|, inf on a miss; prim_id: (N,) int32, -1 on a miss; u, v: (N,) float32:
    the point is (1 - u - v) v0 + u v1 + v v2 (0 on a miss and on spheres). NumPy arrays; Warp's, torch's or JAX's if the rays were.
    counters: what each ray cost, where that was asked for. source: what the points, normals and ids are computed from."""

    t: Any
    u: Any
    v: Any
    prim_id: Any
    counters: Counters | None = None
    source: Any = None

    def __reduce__(self) -> Any:
        """In a file or in another process they know their rays no more."""
        return Hits, (self.t, self.u, self.v, self.prim_id, self.counters)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Hits({len(self)} rays)"

    def _repr_html_(self) -> str:
        hits = self.numpy()
        t = hits.t[hits.prim_id >= 0]
        facts: dict[str, Any] = {"rays": len(self), "hits": len(t), "misses": len(self) - len(t)}
        if len(t):
            facts |= {"nearest t": float(t.min()), "farthest t": float(t.max())}
        return html_table("Hits", (), facts.items()) + (self.counters._repr_html_() if self.counters else "")

    def numpy(self) -> Hits:
        """The same with NumPy arrays; of hits on the CPU they share the memory."""
        return self.each(to_numpy)

    def warp(self) -> Hits:
        """The same with Warp arrays; of hits on the CPU they share the memory."""
        return self.each(to_warp)

    def each(self, convert: Callable[[Any], Any]) -> Hits:
        """The same with each of the four arrays converted."""
        return replace(self, **{name: convert(getattr(self, name)) for name in ("t", "u", "v", "prim_id")})


def room_for(types: dict[str, Any], given: list[Any] | None, n: int, device: Any, shared: bool = False) -> list[Any]:
    """Where n answers go: an array of each type, of Warp on a device, or of NumPy (None); those that are given, if there are some.
    shared: with another library: JAX would copy what does not begin with a cache line. Raises InputError that calls one by its
    name in `types` where it does not fit."""
    if given is None:
        empty = empty_aligned if shared else np.empty
        return [empty(n, dtype) if device is None else wp.empty(n, dtype=wp.dtype_from_numpy(dtype), device=device)
                for dtype in types.values()]
    given = [taken(array, name, None) for name, array in zip(types, given, strict=True)]
    for (name, dtype), array in zip(types.items(), given, strict=True):
        if device is None:
            fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.flags.carray
        else:
            fits = (isinstance(array, wp.array) and array.dtype == wp.dtype_from_numpy(dtype) and array.device == device
                    and (array.is_contiguous or n == 0))
        if not (fits and array.shape == (n,)):
            kind, place = ("NumPy", "writeable and") if device is None else ("Warp", f"on {device},")
            raise InputError(f"must be a {kind} array ({n},) of {np.dtype(dtype)}, {place} without gaps, got {shown(array)}",
                             argument=name)
    # Without gaps: the bounds of two arrays say all. Numbers of a Warp array are as large as those of the others.
    for (name, one), (other, two) in combinations(zip(types, given, strict=True), 2) if len(given) > 1 else ():
        if np.may_share_memory(one, two) if device is None else abs((one.ptr or 0) - (two.ptr or 0)) < n * one.strides[0]:
            raise InputError(f"shares memory with {other}", argument=name)
    return given
