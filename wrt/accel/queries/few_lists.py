"""Lists of all hits of a few rays: buffers and launches that later calls reuse. Records for new arrays take longer than a ray."""

from functools import cached_property
from typing import TypeAlias

import numpy as np

from wrt.accel.queries.answers import HIT_TYPES
from wrt.accel.queries.batches import SMALL, Tracer, Worker
from wrt.accel.queries.raw_kernel import HostMemory, RawKernel
from wrt.accel.queries.raw_launches import raw_launch
from wrt.accel.queries.rays import Rays
from wrt.accel.snapshot import Snapshot
from wrt.core.types import WarpArray
from wrt.core.warp_private import RawLaunch, array_record, record_of, struct_record
from wrt.kernels.hit_lists import FEW, HitLists
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit

MOST = SMALL  # rays
Mesh: TypeAlias = tuple[WarpArray | None, WarpArray | None, WarpArray | None]  # vertices, faces and first_face of HitLists


def begins(counts: np.ndarray) -> np.ndarray:
    """Return the first row of each of N adjacent lists, and the end of the last list, (N + 1,) int64."""
    out = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=out[1:])
    return out


class FewLists:
    """Lists of FEW hits for each of MOST rays, or longer ones for fewer rays. One thread uses it at a time.

    Parameters
    ----------
    fill, copy : RawKernel
        Kernels of kernels.hit_lists: one that fills the lists for one ray at a time, and copy_hits.
    tracer : Tracer, optional
        See batches.lister. It is faster than `fill`, but no limit ends its walks.
    """

    def __init__(self, fill: RawKernel, copy: RawKernel, tracer: Tracer | None) -> None:
        self.kernel, self.tracer = fill, tracer
        self.rays = [np.empty((MOST, 3), np.float32), np.empty((MOST, 3), np.float32), *np.empty((2, MOST), np.float32)]
        self.indices = np.arange(MOST + 1, dtype=np.int32)
        self.first, self.capacity = FEW * self.indices, FEW
        self.counts, self.begin, self.root, to_face = np.empty((4, MOST), np.int32)
        self.walk = [np.empty(MOST, np.float64), to_face, np.empty(MOST, np.float32)]  # scale, to_face and end of HitLists
        self.rows = HostMemory().empty(FEW * MOST, Hit)
        self.out = [np.empty(FEW * MOST, dtype) for dtype in HIT_TYPES.values()]
        self.lists = struct_record(HitLists, [0, False, None, None, None, self.first, self.counts, self.rows, self.root, *self.walk])
        self.given = struct_record(RayArrays, self.rays)
        self.copy = raw_launch(copy.kernel, *copy.inputs, 0)
        for i, record in enumerate((self.given, self.lists, array_record(self.begin), struct_record(HitArrays, self.out))):
            self.copy.set(i, record)

    @cached_property
    def fill(self) -> RawLaunch:
        """Launch of the kernel for one ray at a time, compiled when it is needed."""
        launch = raw_launch(self.kernel.kernel, *self.kernel.inputs, 0)
        launch.set(1, self.given)
        return launch

    @cached_property
    def worker(self) -> Worker | None:
        """Worker of the tracer, whose kernel is compiled when it is needed."""
        return Worker(self.tracer) if self.tracer else None

    def find(self, snapshot: Snapshot, rays: Rays, roots: np.ndarray | None, limit: int, mesh: Mesh) -> np.ndarray | None:
        """Fill the lists. Return HitLists.count of the rays, (N,) int32, until the next call; None if a list is too short.

        roots: (N,) int32, HitLists.root; None without instances. mesh: with vertices and faces to list crossings only.
        """
        n = len(rays.t_min)
        for buffer, array in zip(self.rays, rays, strict=True):
            buffer[:n] = array
        self.counts[:n] = 0
        if self.capacity != (capacity := FEW * MOST // max(n, 1)):
            self.capacity = capacity
            np.multiply(self.indices, capacity, out=self.first)
        vertices, faces, first_face = mesh
        self.lists.limit, self.lists.crossings = limit, vertices is not None
        if vertices is not None and faces is not None:
            self.lists.vertices, self.lists.faces = record_of(vertices), record_of(faces)
        if roots is not None and first_face is not None:
            self.root[:n], self.lists.first_face = roots, record_of(first_face)
        if limit > FEW and self.worker:
            self.worker.inputs[3] = None  # so that the changed record is copied
            self.worker.launch(snapshot, (self.given, self.lists), 0, n)
        else:
            self.fill.set(0, record_of(snapshot.data))
            self.fill.set(2, self.lists)
            self.fill.set_dim(n)
            self.fill.launch()
        counts = self.counts[:n]
        return counts if counts.max(initial=0) <= capacity else None

    def hits_of(self, counts: np.ndarray) -> list[np.ndarray]:
        """Return the first row of each ray's hits, (N + 1,) int64, and t, u, v and prim_id of the hits. counts: from `find`."""
        n, first = len(counts), begins(counts)
        self.begin[:n] = first[:-1]
        self.copy.set_dim(n)
        self.copy.launch()
        return [first, *(array[:first[-1]].copy() for array in self.out)]
