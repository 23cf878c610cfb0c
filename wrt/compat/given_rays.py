"""Rays as a caller of an adapter gives them: a kernel of kernels.placed_rays converts them for the structure, and they are traced.

A ray that is not finite, or has direction 0, hits nothing. The queries leave out the checks of `closest_hit` and `any_hit`, which
take longer than a ray.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import counter_of
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES
from wrt.accel.queries.batches import SMALL, Query, Tracer, Worker, trace_query, tracer
from wrt.accel.queries.raw_kernel import RawKernel
from wrt.accel.queries.raw_launches import raw_launch
from wrt.accel.queries.rays import Rays, constant
from wrt.accel.snapshot import Snapshot
from wrt.core.device import made_once
from wrt.core.threads import FreeList
from wrt.core.types import Kernel, WarpType
from wrt.core.warp_private import struct_record
from wrt.kernels.placed_rays import FAR

FAR_AWAY = np.float32(FAR)  # a constant of Warp would make NumPy compare objects one by one
Ends: TypeAlias = tuple[np.ndarray, np.ndarray]  # t_min and t_max of each ray, (N,) float32

class GivenRays(NamedTuple):
    """Valid rays: origins and directions (N, 3), t_max (N,), float32. A ray with t_max = -inf hits nothing."""

    origins: np.ndarray
    directions: np.ndarray
    t_max: np.ndarray

    @property
    def rays(self) -> Rays:
        """Rays of a query."""
        return self.between(None)

    def between(self, ends: Ends | None) -> Rays:
        """Return rays of a query with these ends; None: 0 and infinity."""
        if ends is None:
            return Rays(self.origins, self.directions, constant(0.0, len(self.t_max)), self.t_max)
        return Rays(self.origins, self.directions, ends[0], np.minimum(self.t_max, ends[1]))

    def of(self, rows: np.ndarray) -> "GivenRays":
        """Return some of the rays. rows: indices (M,)."""
        return GivenRays(*(array[rows] for array in self))


def closest_hits(accel: Accelerator, rays: GivenRays, threads: int) -> list[np.ndarray]:
    """Return t, u, v and prim_id of each ray's closest hit."""
    return _traced(accel, rays.rays, threads, HIT_TYPES)


def _traced(accel: Accelerator, rays: Rays, threads: int, types: Mapping[str, type]) -> list[np.ndarray]:
    out: list[Any] = [np.empty(len(rays.t_max), dtype) for dtype in types.values()]
    trace_query(accel.snapshot, Query(rays, out, threads))
    return out


def _empty(n: int) -> GivenRays:
    return GivenRays(np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32))


class RayFormat:
    """A form of rays, and the kernel that converts them.

    Parameters
    ----------
    kernel : Kernel
        Kernel of kernels.placed_rays. Arguments: `inputs`, `struct`, first.
    struct : WarpType
        Struct of the caller's arrays, and of those of GivenRays.
    columns : tuple of int
        Number of columns of each of the caller's arrays.
    dtype : type
        Type of these arrays.
    *inputs
        A value of the type of each argument before `struct`.
    refuse : Callable, optional
        Function of the caller's arrays that raises InputError. It is called if the kernel gives a ray the t_max FAR.
    """

    def __init__(self, kernel: Kernel, struct: WarpType, columns: tuple[int, ...], dtype: type, *inputs: object,
                 refuse: Callable[..., object] | None = None) -> None:
        self.kernel, self.struct, self.columns, self.dtype, self.inputs = kernel, struct, columns, dtype, inputs
        self._refuse = refuse
        self._convert = RawKernel(kernel, *inputs, struct())
        self._few_rays = FreeList(lambda: _FewRays(self, _empty(SMALL)))
        self._few_queries = made_once(lambda tracer: FreeList(lambda: _FewQueries(self, tracer)))

    def converted(self, arrays: tuple[np.ndarray, ...], threads: int, *inputs: object) -> GivenRays:
        """Convert the caller's arrays. inputs: records of the kernel's arguments before the struct."""
        n = len(arrays[0])
        if n <= SMALL:
            return self._few_rays.run(lambda few: few.converted(arrays, inputs))
        rays = _empty(n)
        self._convert.launch(n, *inputs, struct_record(self.struct, (*arrays, *rays)), threads=threads)
        self.check(arrays, rays.t_max)
        return rays

    def check(self, arrays: tuple[np.ndarray, ...], t_max: np.ndarray) -> None:
        """Raise the error of `refuse` if a converted ray has the t_max FAR."""
        if self._refuse is not None and np.count_nonzero(t_max == FAR_AWAY):
            self._refuse(*arrays)

    def closest_hits(self, accel: Accelerator, arrays: tuple[np.ndarray, ...], threads: int, *inputs: object) -> list[np.ndarray]:
        """Convert rays and return their hits as `closest_hits`."""
        if len(arrays[0]) <= SMALL and accel.device.is_cpu:
            return self._few(accel.snapshot, tracer(accel.snapshot.structure, False), arrays, inputs)
        return closest_hits(accel, self.converted(arrays, threads, *inputs), threads)

    def any_hits(self, accel: Accelerator, arrays: tuple[np.ndarray, ...], threads: int, *inputs: object,
                 ends: Ends | None = None) -> np.ndarray:
        """Convert rays and return whether each of them hits anything between its ends, (N,) bool."""
        if len(arrays[0]) <= SMALL and accel.device.is_cpu:
            return self._few(accel.snapshot, tracer(accel.snapshot.structure, True), arrays, inputs, ends)[0]
        return _traced(accel, self.converted(arrays, threads, *inputs).between(ends), threads, ANY_HIT_TYPES)[0]

    def few_counts(self, snapshot: Snapshot, arrays: tuple[np.ndarray, ...], *inputs: object) -> np.ndarray | None:
        """Convert at most SMALL rays and return HitLists.count for crossings, (N,) int32; None without all_hits.counter_of."""
        counter = counter_of(snapshot) if len(arrays[0]) <= SMALL else None
        return None if counter is None else self._few(snapshot, counter, arrays, inputs)[0]

    def _few(self, snapshot: Snapshot, tracer: Tracer, arrays: tuple[np.ndarray, ...], inputs: tuple[object, ...],
             ends: Ends | None = None) -> list[np.ndarray]:
        free: FreeList[_FewQueries] = self._few_queries(tracer)
        return free.run(lambda few: few.trace(snapshot, arrays, inputs, ends))


class _FewRays:
    """Buffers for SMALL rays, and a recorded launch that converts them: a tenth of the time of records for new arrays.

    One thread uses it at a time. rays: buffers of the converted rays.
    """

    def __init__(self, form: RayFormat, rays: GivenRays) -> None:
        self.form, self.rays = form, rays
        self.arrays: list[np.ndarray] = [np.empty((SMALL, columns), form.dtype) for columns in form.columns]
        self.inputs: list[object] = [None] * len(form.inputs)  # of the last launch
        self.launch = raw_launch(form.kernel, *form.inputs, form.struct(), 0)
        self.launch.set(len(self.inputs), struct_record(form.struct, (*self.arrays, *rays)))

    def converted(self, arrays: tuple[np.ndarray, ...], inputs: tuple[object, ...]) -> GivenRays:
        self.convert(arrays, inputs)
        return GivenRays(*(array[:len(arrays[0])].copy() for array in self.rays))

    def convert(self, arrays: tuple[np.ndarray, ...], inputs: tuple[object, ...]) -> None:
        """Write converted rays to the buffers."""
        n = len(arrays[0])
        for buffer, array in zip(self.arrays, arrays, strict=True):
            buffer[:n] = array
        for i, record in enumerate(inputs):
            if record is not self.inputs[i]:
                self.launch.set(i, record)
                self.inputs[i] = record
        self.launch.set_dim(n)
        self.launch.launch()
        self.form.check(arrays, self.rays.t_max[:n])


class _FewQueries:
    """Buffers for SMALL rays, and recorded launches that convert and trace them. One thread uses it at a time."""

    def __init__(self, form: RayFormat, tracer: Tracer) -> None:
        self.worker = Worker(tracer)
        origins, directions, _, t_max = self.worker.rays
        self.rays = _FewRays(form, GivenRays(origins, directions, t_max))

    def trace(self, snapshot: Snapshot, arrays: tuple[np.ndarray, ...], inputs: tuple[object, ...], ends: Ends | None) -> list[np.ndarray]:
        n = len(arrays[0])
        self.rays.convert(arrays, inputs)
        t_min, t_max = (array[:n] for array in self.worker.rays[2:4])
        t_min[:] = 0.0 if ends is None else ends[0]
        if ends is not None:
            np.minimum(t_max, ends[1], out=t_max)
        self.worker.launch(snapshot, self.worker.packed, 0, n)
        return [found[:n].copy() for found in self.worker.results]
