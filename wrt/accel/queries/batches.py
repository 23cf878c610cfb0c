"""Kernel launches of a query, on CPU threads or a GPU. Some structures have a CPU kernel that traces many rays at a time."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES
from wrt.accel.queries.arguments import WorldIds
from wrt.accel.queries.raw_launches import SMALL, FewRows, RowKernel, raw_launch
from wrt.accel.queries.rays import Rays, arrays_on, constant, filled, rays_on
from wrt.accel.snapshot import Snapshot, Structure, any_hit_kernel, closest_hit_kernel, worlds_kernel
from wrt.core.arrays import to_warp
from wrt.core.device import empty_aligned, launch_on, made_once, memory_of, row_type
from wrt.core.threads import FreeList, run_all, thread_count
from wrt.core.types import Array, Device, KernelModule, WarpStruct, WarpType
from wrt.core.warp_private import array_record, captures_on_cpu, record_of, struct_record
from wrt.kernels.hit_lists import HitLists
from wrt.kernels.query import FilteredRays, HitArrays, RayArrays, WorldRays
from wrt.kernels.structs import Surfaces
from wrt.kernels.warp_private import fields_of
from wrt.kernels.wide.packets import ANY_REFUSED, REPORT_SIZE, Scratch

# Rays per launch, which lasts some milliseconds, so that its overhead is small and Ctrl-C acts soon. A query of at most FEWEST rays
# is one launch. Else each launch gets 1 / (SHARES threads) of the remaining rays, LEAST to MOST, so that all threads end together.
FEWEST, MOST, LEAST, SHARES = 8192, 131072, 4096, 2
RAYS_PER_LAUNCH = 16384  # For kernels that trace one ray at a time.
MOST_ON_GPU = 1 << 26  # Largest number of rays that are copied to a GPU at once: 3 GB with their hits.
BYTES_OF_RAY = 48  # A ray and its hit.
FITS_ANY_GPU = 1 << 20  # Up to this number of rays, the free memory of the GPU is not queried.
MOST_PACKED = (1 << 31) - 64  # rays: kernels index in int32, and their last block may exceed the range.
SIDE = 4  # pixels of a square of 16 rays, which are a packet (kernels.wide.layout.LANES) and share more nodes than 16 pixels of a row
LARGEST = 256  # rows and columns: the rays of larger pictures are so dense that the copies cost more than tiles save
BUFFERED = 16384  # Rays in a worker's buffers, and in a launch of tiles: 640 KB, which stay in the core's cache.


class Query(NamedTuple):
    """A call of closest_hit or any_hit.

    out: arrays for the results: t, u, v and prim_id, or one array of bool. threads: None for one per core. width: `tiled_width`.
    """

    rays: Rays
    out: Sequence[Array]
    threads: int | None
    worlds: WorldIds | None = None
    width: int = 0


class MadeRays(NamedTuple):
    """N rays that a kernel makes from rows of the caller, as in adapters for other libraries.

    kernel: computes origins and directions (N, 3) and t_max (N,) of valid rays from `given` and `inputs`; t_min is 0.
    """

    kernel: RowKernel
    given: Sequence[np.ndarray]
    inputs: Sequence[object] = ()

    def rays(self, threads: int) -> Rays:
        origins, directions, t_max = self.kernel.rows(len(self.given[0]), self.given, *self.inputs, threads=threads)
        return Rays(origins, directions, constant(0.0, len(t_max)), t_max)


def trace_made(snapshot: Snapshot, made: MadeRays, any_hit: bool, threads: int) -> list[np.ndarray]:
    """Return t, u, v and prim_id of the closest hits, or with `any_hit` whether each ray hits anything.

    It leaves out the checks of `closest_hit` and `any_hit`. The rays of a small query are made in the buffers of a worker.
    """
    n = len(made.given[0])
    if n <= SMALL and snapshot.device.is_cpu and has_stream(snapshot.structure):
        return tracer(snapshot.structure, any_hit).workers.run(lambda worker: worker.trace_made(snapshot, made, n))
    out = [np.empty(n, dtype) for dtype in (ANY_HIT_TYPES if any_hit else HIT_TYPES).values()]
    trace_query(snapshot, Query(made.rays(threads), out, threads))
    return out


def trace_query(snapshot: Snapshot, query: Query) -> None:
    """Trace the rays and write the results to query.out. Raises InputError for invalid rays, after some results are written."""
    any_hit, structure, worlds = len(query.out) == 1, snapshot.structure, query.worlds
    if snapshot.device.is_cuda or (worlds is not None and not has_stream(structure)):
        trace_one_by_one(snapshot, query)
    else:
        found = (tracer(structure, any_hit) if worlds is None else filter_tracer(structure.filtered, any_hit) if worlds.filtered
                 else world_tracer(structure, any_hit))
        (found.record if captures_on_cpu() else found.trace)(snapshot, query)


def parts(n: int, threads: int, block: int) -> list[tuple[int, int]]:
    """Divide n rays into ranges [first, end); `first` is a multiple of `block`. The last ranges are small, to balance the threads."""
    out, first = [], 0
    while first < n:
        size = MOST if threads == 1 else max(LEAST, min((n - first) // (SHARES * threads), MOST))
        end = min(first + -(-size // block) * block, n)
        out.append((first, end))
        first = end
    return out


class Tracer:
    """Tracer of queries on the CPU. It holds the kernel for a structure, and workers that later calls reuse.

    rays: RayArrays, or, only for a structure with a `stream`, WorldRays if each ray has its own world, or FilteredRays with its filter.
    """

    def __init__(self, structure: Structure, any_hit: bool, rays: WarpType = RayArrays) -> None:
        stream: KernelModule = structure.accel.stream
        # Kernel that traces many rays at a time, or None if the structure has no such kernel.
        self.rays = rays
        self.stream = stream and stream.make_stream(structure.units, any_hit, self.rays)
        self.kernel = self.stream or (any_hit_kernel if any_hit else closest_hit_kernel)(structure)
        self.block = stream.stream_block if self.stream else 1
        self.sizes = stream.stream_sizes if self.stream else ()
        self.kinds = [row_type(field.dtype).base for field in fields_of(self.rays).values()]
        self.types = {} if structure.units.lists else ANY_HIT_TYPES if any_hit else HIT_TYPES
        self.out = HitLists if structure.units.lists else None if any_hit else HitArrays
        self.inputs = structure.struct(), Surfaces(), self.rays(), self.out and self.out()
        self.workers = FreeList(lambda: Worker(self))

    def trace(self, snapshot: Snapshot, query: Query) -> None:
        """Trace on the CPU, as trace_query does. The rays are checked before tracing, or by a kernel that traces many rays at a time."""
        rays: Rays = query.rays
        inputs: Any = rays
        results: Any = query.out
        if not (type(rays.origins) is type(rays.t_min) is type(rays.t_max) is np.ndarray):
            rays = rays.on(wp.get_device("cpu"))
            results = [np.asarray(array) for array in results]
        if not self.stream:  # `self.stream` reports invalid rays itself
            rays = rays.checked()
        if rays is not inputs:
            inputs = [np.asarray(array) for array in rays]
        if query.worlds is not None:
            inputs = [*inputs, *(array.numpy() for array in query.worlds.columns)]
        n = len(inputs[0])
        if n <= SMALL:
            refused = self.workers.run(lambda worker: worker.trace(snapshot, inputs, results))
        else:
            refused = self._trace_many(snapshot, inputs, results, thread_count(query.threads), query.width)
        if refused:
            rays.checked()

    def record(self, snapshot: Snapshot, query: Query) -> None:
        """Record the trace in the graph that is captured on the CPU: one launch on one thread, with scratch memory of its own.

        The graph keeps all arrays alive."""
        out, n, worlds = query.out, len(query.out[0]), [] if query.worlds is None else query.worlds.columns
        given = filled(self.rays, [*arrays_on(snapshot.device, query.rays), *worlds])
        last = [new_scratch(self.sizes), 0, n] if self.stream else [0]
        launch_on(snapshot.device, self.kernel, min(n, 1) if self.stream else n, snapshot.data, snapshot.surfaces, given,
                  filled(HitArrays, out) if len(out) > 1 else out[0], *last, captured=True)

    def _trace_many(self, snapshot: Snapshot, inputs: Sequence[np.ndarray], results: Sequence[np.ndarray], threads: int,
                    width: int) -> bool:
        """Trace in several launches, in place where that is possible. Return whether a ray was refused."""
        n = len(inputs[0])
        in_place = n <= MOST_PACKED and all(map(readable, inputs, self.kinds))
        width = width if n <= MOST_PACKED and self.stream else 0
        packed = pack(self.rays, inputs, results) if in_place and not width else None
        if packed and self.stream:
            ranges = parts(n, threads, self.block) if n > FEWEST else [(0, n)]
        else:
            part = RAYS_PER_LAUNCH if packed else FEWEST
            if width:
                part = BUFFERED // (SIDE * width) * SIDE * width
            ranges = [(first, min(first + part, n)) for first in range(0, n, part)]
        refused: list[bool] = []

        def job(first: int, end: int) -> None:
            worker = self.workers.take()
            if packed:
                refused.append(worker.launch(snapshot, packed, first, end))
            else:
                refused.append(worker.trace(snapshot, [array[first:end] for array in inputs], [array[first:end] for array in results],
                                            width))
            self.workers.give(worker)

        run_all([partial(job, *each) for each in ranges], threads)
        return any(refused)


tracer, world_tracer, filter_tracer = (made_once(partial(Tracer, rays=rays)) for rays in (RayArrays, WorldRays, FilteredRays))


@made_once
def has_stream(structure: Structure) -> bool:
    """Return whether the structure has a CPU kernel that traces many rays at a time."""
    return tracer(structure, False).stream is not None


def new_scratch(sizes: tuple[int, ...]) -> WarpStruct:
    """Return kernels.wide.packets.Scratch with arrays of these sizes. They begin at cache lines, so that no vector crosses a line."""
    out: WarpStruct = Scratch()
    for (name, kind), size in zip(fields_of(Scratch).items(), sizes, strict=False):
        setattr(out, name, wp.array(empty_aligned(size, wp.dtype_to_numpy(kind.dtype)), kind.dtype, device="cpu", copy=False))
    return out


class Worker:
    """A recorded launch, its scratch memory, and buffers for rays and results that a kernel cannot use in place.

    One thread uses it at a time.
    """

    def __init__(self, tracer: Tracer) -> None:
        self.block, self.scratch = tracer.block, new_scratch(tracer.sizes)
        self.report = self.scratch.report.numpy() if tracer.stream else np.zeros(REPORT_SIZE, np.int32)
        own = [self.scratch, 0] if tracer.stream else []
        self.threads = 1
        self.command = raw_launch(tracer.kernel, *tracer.inputs, *own, 0)
        self.inputs: list[object] = [None] * (len(own) + 5)  # of the last launch
        self.own = [record_of(self.scratch)] if tracer.stream else []
        if not tracer.types:  # the caller has buffers
            return
        self.rays = [np.empty((BUFFERED, 3), np.float32), np.empty((BUFFERED, 3), np.float32), *np.empty((2, BUFFERED), np.float32)]
        self.results = [np.empty(BUFFERED, dtype) for dtype in tracer.types.values()]
        self.rays += [np.empty(BUFFERED, kind) for kind in tracer.kinds[4:]]
        self.packed = pack(tracer.rays, self.rays, self.results)
        self.makers: dict[RowKernel, FewRows] = {}  # which write into self.rays

    def trace(self, snapshot: Snapshot, rays: Sequence[np.ndarray], results: Sequence[np.ndarray], width: int = 0) -> bool:
        """Trace at most BUFFERED rays by means of the buffers, in tiles if `width` is not 0. Return whether a ray was refused.

        Values beyond float32 become infinite.
        """
        n = len(rays[0])
        for target, source in zip(self.rays, rays, strict=True):
            if source.dtype != target.dtype:
                with np.errstate(over="ignore"):
                    source = source.astype(target.dtype)  # of stride 0, one number for all rays becomes an array
            if width and source.strides[0]:
                copy_to_tiles(target[:n], np.ascontiguousarray(source), width)
            else:
                target[:n] = source
        refused = self.launch(snapshot, self.packed, 0, n)
        for result, found in zip(results, self.results, strict=True):
            if width:
                copy_from_tiles(result, found[:n], width)
            else:
                result[:] = found[:n]
        return refused

    def trace_made(self, snapshot: Snapshot, made: MadeRays, n: int) -> list[np.ndarray]:
        """Trace n rays, at most SMALL, and return the results."""
        origins, directions, t_min, t_max, *_ = self.rays
        maker = self.makers.get(made.kernel)
        if maker is None:
            maker = self.makers[made.kernel] = FewRows(made.kernel, (origins, directions, t_max))
        maker.compute(n, made.given, made.inputs)
        t_min[:n] = 0.0
        self.launch(snapshot, self.packed, 0, n)
        return [found[:n].copy() for found in self.results]

    def launch(self, snapshot: Snapshot, packed: tuple[Any, Any], first: int, end: int) -> bool:
        """Trace the rays [first, end) of `packed`, from `pack`. Return whether one of them was refused, because it is invalid."""
        inputs = [record_of(snapshot.data), record_of(snapshot.surfaces), *packed, *self.own, first, end]
        for i, last in enumerate(self.inputs):  # a kernel that traces one ray at a time has no argument `end`
            if inputs[i] is not last:
                self.command.set(i, inputs[i])
                self.inputs[i] = inputs[i]
        threads = end - first if self.block == 1 else 1
        if threads != self.threads:
            self.command.set_dim(threads)
            self.threads = threads
        self.command.launch()
        return bool(self.report[ANY_REFUSED])


def readable(array: np.ndarray, kind: np.dtype) -> bool:
    """Return whether a kernel can read the array in place as one of `kind`."""
    return array.dtype == kind and array.flags.aligned and (array.flags.c_contiguous or array.strides == (0,))


def pack(kind: WarpType, rays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> tuple[Any, Any]:
    """Make kernel records of rays (`kind`) and results (HitArrays or an array of bool). The caller must keep the arrays."""
    return struct_record(kind, rays), struct_record(HitArrays, results) if len(results) > 1 else array_record(results[0])


def rays_on_gpu(n: int, device: Device) -> int:
    """Return the number of rays to copy to a GPU at once: they fill at most half of its free memory."""
    return MOST_ON_GPU if n <= FITS_ANY_GPU else max(FEWEST, min(MOST_ON_GPU, int(memory_of(device) / 2.0 / BYTES_OF_RAY)))


def trace_one_by_one(snapshot: Snapshot, query: Query) -> None:
    """Trace as trace_query does, a ray per thread: on a GPU, rays in NumPy arrays in parts; each ray in its own world in one launch."""
    device, structure, rays, out = snapshot.device, snapshot.structure, query.rays, query.out
    if query.worlds is not None:
        structure = structure.filtered if query.worlds.filtered else structure
        kernel, more = worlds_kernel(structure, len(out) == 1), [query.worlds.arrays]
    else:
        kernel, more = (closest_hit_kernel if len(out) > 1 else any_hit_kernel)(structure), []
    n = len(out[0])
    part = n if rays.as_warp or more else rays_on_gpu(n, device)
    for first in range(0, n, max(part, 1)):
        some = slice(first, min(first + part, n))
        own, targets = (rays, out) if part >= n else (Rays(*(array[some] for array in rays)), [array[some] for array in out])
        there = [to_warp(array) if device.is_cpu or isinstance(array, wp.array)
                 else wp.empty(len(array), dtype=wp.dtype_from_numpy(array.dtype), device=device) for array in targets]
        launch_on(device, kernel, len(targets[0]), snapshot.data, snapshot.surfaces, rays_on(device, own), *more,
                  filled(HitArrays, there) if len(out) > 1 else there[0], None, threads=thread_count(query.threads), step=RAYS_PER_LAUNCH,
                  captured=True)
        for array, result in zip(targets, there, strict=True):
            if not isinstance(array, wp.array) and device.is_cuda:
                array[:] = result.numpy()


def tiled_width(shape: tuple[int, ...]) -> int:
    """Return the width of small pictures of rays, (..., rows, columns), that consist of whole tiles. Return 0 for all other shapes."""
    return shape[-1] if len(shape) > 1 and all(n % SIDE == 0 and n <= LARGEST for n in shape[-2:]) else 0


def copy_to_tiles(tiles: np.ndarray, rows: np.ndarray, width: int) -> None:
    """Copy contiguous pixels from rows of pictures to tiles: both (N, ...) of one dtype, and N a multiple of SIDE * width."""
    _pieces(tiles, -1, width // SIDE, SIDE)[...] = _pieces(rows, -1, SIDE, width // SIDE).swapaxes(1, 2)


def copy_from_tiles(rows: np.ndarray, tiles: np.ndarray, width: int) -> None:
    """Copy pixels from tiles back to rows of pictures. Arguments: see `copy_to_tiles`."""
    _pieces(rows, -1, SIDE, width // SIDE)[...] = _pieces(tiles, -1, width // SIDE, SIDE).swapaxes(1, 2)


def _pieces(pixels: np.ndarray, *shape: int) -> np.ndarray:
    """View pixels (N, ...) as pieces of SIDE pixels, which NumPy copies as one item each."""
    return pixels.reshape(-1).view(f"V{SIDE * pixels[:1].nbytes}").reshape(shape)
