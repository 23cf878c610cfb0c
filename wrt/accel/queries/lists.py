"""Lists of the hits of rays: batches of rays fill lists in buffers that later batches reuse, and a kernel copies the lists one by one."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import warp as wp

from wrt.accel.queries.batches import Tracer, Worker, tracer
from wrt.accel.queries.raw_launches import raw_launch
from wrt.accel.queries.rays import filled
from wrt.accel.snapshot import Snapshot, Structure
from wrt.core.device import MOST_ROWS, launch_on, made_once, row_type, upload
from wrt.core.errors import InputError
from wrt.core.threads import FreeList
from wrt.core.types import Device, Kernel, KernelModule, WarpArray, WarpStruct
from wrt.core.warp_private import RawLaunch, array_record, record_of, struct_record
from wrt.kernels.hit_lists import FEW, HitLists, copy_hits, make_list_hit, make_list_hits_kernel
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit

ALL = (1 << 30) - 1
BATCH = 4096  # rays of a batch on the CPU, whose lists stay in a core's cache
BATCH_ON_GPU = 1 << 18  # rays of a batch on a GPU, whose lists take 32 MiB in the first traversal
HIT_KINDS = wp.float32, wp.float32, wp.float32, wp.int32  # of HitArrays
Mesh: TypeAlias = tuple[WarpArray | None, WarpArray | None, WarpArray | None]  # vertices, faces and first_face of HitLists


def begins(counts: np.ndarray) -> np.ndarray:
    """Return the first row of each of N adjacent lists, and the end of the last list, (N + 1,) int64."""
    out = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=out[1:])
    return out


def rows_of(hits: int) -> int:
    """Return `hits` as the size of an array. Raises InputError above 2^31 - 1, the largest size that kernels can index."""
    if hits > MOST_ROWS:
        raise InputError(f"{hits} hits do not fit into an array of at most 2^31 - 1", hint="query fewer rays at a time")
    return int(hits)


@made_once
def lister(structure: Structure) -> Tracer | None:
    """Return a tracer that lists all hits on the CPU, or None if the structure has no kernel that lists for many rays at a time."""
    listing = structure._replace(units=structure.units._replace(lists=True))
    stream: KernelModule = structure.accel.stream
    return tracer(listing, True) if stream and stream.make_stream(listing.units, True) else None


@made_once
def list_hits(structure: Structure, ordered: bool) -> Kernel:
    """Return the kernel that lists hits of one ray at a time. ordered: it visits near nodes first, so that a limit ends it early."""
    listing, instances = structure._replace(units=structure.units._replace(lists=True)), structure.units.instances
    accepts = make_list_hit(instances, structure.units.triangle == "watertight")
    return make_list_hits_kernel(structure.struct, listing.traversal(any_hit=not ordered, accepts=accepts), instances)


class HostLists:
    """Lists of a batch of rays on the CPU: buffers, and recorded launches that fill and copy the lists. One thread uses it at a time."""

    def __init__(self, structure: Structure) -> None:
        self.structure, self.tracer = structure, lister(structure)
        self.rays = [np.empty((BATCH, 3), np.float32), np.empty((BATCH, 3), np.float32), *np.empty((2, BATCH), np.float32)]
        self.index = np.arange(BATCH + 1, dtype=np.int32)
        self.room, self.first = FEW, FEW * self.index
        self.counts, to_face, self.begin = np.empty((3, BATCH), np.int32)
        self.roots = np.empty((3, BATCH), np.int32)
        self.rows, self.out = np.empty(FEW * BATCH, row_type(Hit)), [np.empty(FEW * BATCH, wp.dtype_to_numpy(kind)) for kind in HIT_KINDS]
        self.place = self.roots[0], np.empty(BATCH, np.float64), to_face, *self.roots[1:], np.empty(BATCH, np.float32)
        self.given, self.packed = struct_record(RayArrays, self.rays), struct_record(HitArrays, self.out)
        # The second lists are for rays with more hits than the first lists hold.
        self.lists, self.more = (struct_record(HitLists, [0, False, None, None, None, self.first, self.counts, self.rows, *self.place])
                                 for _ in range(2))
        self.kept: tuple[np.ndarray, ...] = ()  # arrays of the second lists; () if all hits are in the first lists
        self.copier = raw_launch(copy_hits, RayArrays(), HitLists(), None, HitArrays(), 0)
        self.copier.set(0, self.given)
        self.filler: RawLaunch | None = None
        self.worker: Worker | None = None

    def find(self, snapshot: Snapshot, rays: Sequence[np.ndarray], roots: np.ndarray | None, limit: int, mesh: Mesh,
             counting: bool) -> np.ndarray:
        """Fill the lists with at most `limit` hits of each ray. Return HitLists.count, (n,) int32, until the next call.

        roots: (1 or 3, n) int32, HitLists.root, exclude, mask; None without instances. mesh: with vertices and faces to list
        crossings only. counting: the caller needs only the numbers of hits, and no triangle is in several leaves.
        """
        n = len(rays[0])
        for buffer, array in zip(self.rays, rays, strict=True):
            buffer[:n] = array
        vertices, faces, first_face = mesh
        self.lists.limit, self.lists.crossings = limit, vertices is not None
        if vertices is not None and faces is not None:
            self.lists.vertices, self.lists.faces = record_of(vertices), record_of(faces)
        if roots is not None and first_face is not None:
            self.roots[:len(roots), :n], self.lists.first_face = roots, record_of(first_face)
        room = 0 if counting and self.tracer else FEW * BATCH // n
        if self.room != room:
            self.room = room
            np.multiply(self.index, room, out=self.first)
        counts, self.kept = self.counts[:n], ()
        counts[:] = 0
        if self.tracer and limit > FEW:  # no limit ends its walks
            self.worker = self.worker or Worker(self.tracer)
            self.worker.inputs[3] = None  # so that the changed record is copied
            self.worker.launch(snapshot, (self.given, self.lists), 0, n)
        else:
            self._fill(snapshot, self.lists, n)
        return counts if counting or counts.max() <= room else self._find_more(snapshot, limit, counts)

    def _find_more(self, snapshot: Snapshot, limit: int, counts: np.ndarray) -> np.ndarray:
        """Fill the second lists for the rays with more hits than the first lists hold, and return all counts."""
        many = counts > self.room
        first = begins(np.where(many, np.minimum(counts, 2 * limit), 0))
        self.kept = first.astype(np.int32), np.zeros(len(counts), np.int32), np.empty(rows_of(first[-1]), row_type(Hit))
        for name in ("limit", "crossings", "vertices", "faces", "first_face"):
            setattr(self.more, name, getattr(self.lists, name))
        self.more.first, self.more.count, self.more.rows = map(array_record, self.kept)
        counts[many] = 0
        self._fill(snapshot, self.more, len(counts))
        return np.where(many, self.kept[1], counts)

    def _fill(self, snapshot: Snapshot, lists: WarpStruct, n: int) -> None:
        if self.filler is None:
            self.filler = raw_launch(list_hits(self.structure, True), self.structure.struct(), RayArrays(), HitLists(), 0)
            self.filler.set(1, self.given)
        self.filler.set(0, record_of(snapshot.data))
        self.filler.set(2, lists)
        self.filler.set_dim(n)
        self.filler.launch()

    def copy(self, begin: np.ndarray, hits: Any) -> None:
        """Copy the list of ray i to `hits`, a record of HitArrays, from begin[i] on."""
        n = len(begin)
        self.begin[:n] = begin
        self.copier.set(2, array_record(self.begin))
        self.copier.set(3, hits)
        self.copier.set_dim(n)
        for lists in (self.lists, self.more) if self.kept else (self.lists,):
            self.copier.set(1, lists)
            self.copier.launch()

    def hits(self, counts: np.ndarray) -> list[np.ndarray]:
        """Return t, u, v and prim_id of all hits, one list after another. counts: (n,), lengths of the lists."""
        first = begins(counts)
        total, out, packed = rows_of(first[-1]), self.out, self.packed
        if total > len(out[0]):
            out = [np.empty(total, array.dtype) for array in out]
            packed = struct_record(HitArrays, out)
        self.copy(first[:-1], packed)
        return out if out is not self.out else [array[:total].copy() for array in out]

    def release(self) -> None:
        """Give the second lists' memory back."""
        self.kept = ()


@made_once
def host_lists(structure: Structure) -> FreeList[HostLists]:
    """Return the HostLists of a structure that no thread uses now."""
    return FreeList(lambda: HostLists(structure))


class GpuLists:
    """Lists of a batch of rays on a GPU, in new arrays. Methods as those of HostLists."""

    def __init__(self, device: Device, structure: Structure) -> None:
        self.device, self.structure = device, structure

    def find(self, snapshot: Snapshot, rays: Sequence[WarpArray], roots: np.ndarray | None, limit: int, mesh: Mesh,
             counting: bool) -> np.ndarray:
        n, room = len(rays[0]), 1 if counting else FEW
        self.rays = filled(RayArrays, rays)
        self.lists = [self._filled(snapshot, roots, room * np.arange(n + 1), limit, mesh, counting)]
        counts: np.ndarray = self.lists[0].count.numpy()
        if counting or counts.max() <= FEW:
            return counts
        many = counts > FEW
        self.lists[0].count = upload(np.where(many, 0, counts), wp.int32, self.device)
        self.lists.append(self._filled(snapshot, roots, begins(np.where(many, np.minimum(counts, 2 * limit), 0)), limit, mesh, False))
        return np.where(many, self.lists[1].count.numpy(), counts)

    def _filled(self, snapshot: Snapshot, roots: np.ndarray | None, first: np.ndarray, limit: int, mesh: Mesh,
                counting: bool) -> WarpStruct:
        """Traverse the structure and return the lists. The list of ray i has the rows first[i] .. first[i + 1] - 1."""
        n, lists = len(first) - 1, HitLists()
        lists.limit, lists.crossings = limit, mesh[0] is not None
        for name, array in zip(("vertices", "faces", "first_face"), mesh, strict=True):
            if array is not None:
                setattr(lists, name, array)
        lists.first, lists.count = upload(first, wp.int32, self.device), wp.zeros(n, dtype=wp.int32, device=self.device)
        lists.rows = wp.empty(rows_of(first[-1]), dtype=Hit, device=self.device)
        if roots is not None:
            for name, ids in zip(("root", "exclude", "mask"), roots, strict=False):
                setattr(lists, name, upload(ids, wp.int32, self.device))
            lists.scale, lists.to_face, lists.end = (wp.empty(n, dtype=kind, device=self.device)
                                                     for kind in (wp.float64, wp.int32, wp.float32))
        launch_on(self.device, list_hits(self.structure, not counting), n, snapshot.data, self.rays, lists, 0)
        return lists

    def copy(self, begin: np.ndarray, hits: WarpStruct) -> None:
        for lists in self.lists:
            launch_on(self.device, copy_hits, len(begin), self.rays, lists, upload(begin, wp.int32, self.device), hits, 0)

    def hits(self, counts: np.ndarray) -> list[WarpArray]:
        first = begins(counts)
        out = [wp.empty(rows_of(first[-1]), dtype=kind, device=self.device) for kind in HIT_KINDS]
        self.copy(first[:-1], filled(HitArrays, out))
        return out
