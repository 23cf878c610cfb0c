"""`wrt.profile`: record every ray of a picture, with its counters and the addresses of its fetches."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

import numpy as np
import warp as wp

from wrt.accel.queries.observed import copied
from wrt.accel.snapshot import WrappedStructure
from wrt.core.device import memory_of, on_host, start, upload
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.tables import html_table
from wrt.core.threads import run_all
from wrt.core.types import PathLike
from wrt.io.load import as_scene
from wrt.kernels.shade.paths import BRANCHES, COATED, REFLECTED
from wrt.kernels.study import ray_log
from wrt.kernels.traverse.observer import SIZE_RANGE, Counts, Recorder
from wrt.kernels.warp_private import fields_of
from wrt.lab.rtcore.caches import distinct_lines
from wrt.renderer.film import DeviceFilm, Rectangle, Work
from wrt.renderer.options import OF_A_PROFILE, Options, Progress, RenderOptions, split
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene

if TYPE_CHECKING:
    from PIL import Image

T = TypeVar("T")
COUNTERS = tuple(fields_of(Counts))
KINDS = ("primary", "reflection", "refraction", "straight", "shadow")
PICTURES = (*COUNTERS, "lines", *(f"probes_{kind}" for kind in KINDS))
TITLES = {
    "probes": "ray probes", "nodes": "nodes fetched", "boxes": "box tests", "box_operations": "operations of the box unit",
    "primitives": "triangle tests", "leaves": "leaves entered", "pushes": "stack pushes", "pops": "stack pops",
    "stack": "most entries on the stack", "node_bytes": "bytes of nodes", "primitive_bytes": "bytes of triangles",
    "lines": "distinct cache lines of a ray", **{f"probes_{kind}": f"{kind} rays" for kind in KINDS},
}
TILE_SIZE = 64
BYTES_OF_RAY = 200  # memory for a ray, with all arrays derived from it
TRACE_LIMIT = 4_000_000  # largest number of recorded fetches, about


@dataclass(frozen=True, eq=False)
class Rays:
    """Every ray of a picture, arrays (N,): sorted by tile, then by pixel, then in the order of tracing.

    - rays: kernels.study.ray_log.LoggedRay; counts: kernels.traverse.observer.Counts; lines: number of distinct cache lines.
    - pixel: row * width + column; kind: index in KINDS. A clear coat's reflection is a "reflection",
      too. A "straight" ray continues through a blended surface without refraction.
    - depth: bounces before the ray; a shadow ray has the depth of the ray whose hit it starts from.
    - trace_rows: indices of the rays whose fetches were recorded; trace_first: index of each such ray's first fetch, and the end.
    - address, size: of each recorded fetch, in bytes (wrt.accel.queries.answers.Counters)."""

    rays: np.ndarray
    counts: np.ndarray
    pixel: np.ndarray
    kind: np.ndarray
    depth: np.ndarray
    lines: np.ndarray
    trace_rows: np.ndarray
    trace_first: np.ndarray
    address: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass(frozen=True, eq=False)
class Profile:
    """Result of `profile`. size: width, height; pixels: the picture (H, W, 3); accel: the structure; seconds: time of each stage."""

    scene: str
    size: tuple[int, int]
    spp: int
    pixels: np.ndarray
    rays: Rays
    accel: Any
    seconds: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Profile({self.scene!r}, {self.size[0]}x{self.size[1]}, {self.spp} spp, {len(self.rays)} rays)"

    def _repr_html_(self) -> str:
        rows = self.by_depth()
        return html_table(repr(self), tuple(rows[0]) if rows else (), [tuple(row.values()) for row in rows])

    @cached_property
    def maps(self) -> dict[str, np.ndarray]:
        """Maps by name (PICTURES), (H, W) float64 each, row 0 on top.
        A pixel of a counter's map is the sum over all rays of a sample, averaged over samples (`stack`: the largest value). A pixel of
        `probes_KIND` is the number of rays of that kind per sample."""
        rays, n = self.rays, self.size[0] * self.size[1]
        sums = {name: np.bincount(rays.pixel, rays.counts[name], n) / self.spp for name in COUNTERS}
        sums["stack"] = np.zeros(n)
        np.maximum.at(sums["stack"], rays.pixel, rays.counts["stack"])
        sums["lines"] = np.bincount(rays.pixel, rays.lines, n) / self.spp
        for i, kind in enumerate(KINDS):
            sums[f"probes_{kind}"] = np.bincount(rays.pixel, rays.kind == i, n) / self.spp
        return {name: value.reshape(self.size[1], self.size[0]) for name, value in sums.items()}

    def heatmap(self, name: str) -> Image.Image:
        """Return a map of `maps` as a PIL image with a colour scale. Raise InputError for an unknown name."""
        with needed_by("a heat map"):
            from PIL import Image

        from wrt.picture.heatmap import heatmap

        if name not in PICTURES:
            raise InputError(f"no map {name!r}", hint=f"there is {', '.join(PICTURES)}")
        return Image.fromarray(heatmap(self.maps[name], TITLES[name] + ("" if name == "stack" else " a sample")))

    def by_depth(self) -> list[dict[str, object]]:
        """Return a row for each depth and kind of ray: depth, kind, hits, and the sum of each counter (`stack`: the largest value)."""
        rays, rows = self.rays, []
        for depth in np.unique(rays.depth):
            for i, kind in enumerate(KINDS):
                chosen = (rays.depth == depth) & (rays.kind == i)
                if chosen.any():
                    counts = rays.counts[chosen]
                    sums = {name: int(counts[name].sum(dtype=np.int64)) for name in COUNTERS}
                    sums |= {"stack": int(counts["stack"].max()), "lines": int(rays.lines[chosen].sum(dtype=np.int64))}
                    rows.append({"depth": int(depth), "kind": kind, "hits": int(rays.rays["hit"][chosen].sum()), **sums})
        return rows


def profile(scene: Scene | Mesh | PathLike, **options: Unpack[RenderOptions]) -> Profile:
    """Render a scene and record the cost of each ray.

    The rays are exactly those of `wrt.render` with the same arguments. The addresses of their fetches are recorded for evenly spaced
    tiles, about four million fetches at most.

    Parameters
    ----------
    scene : Scene, Mesh or path
        As for `wrt.render`.
    **options
        Settings of `wrt.render`, and its options in `wrt.renderer.options.OF_A_PROFILE`. The default of `spp` is the value of a Scene or
        a TOML file, else 1. `progress` counts the samples of three passes over the picture.

    Returns
    -------
    Profile

    Raises
    ------
    InputError
        An unknown argument, a scene that cannot be rendered, or more rays than fit into memory.
    """
    settings, others = split(options, "profile", OF_A_PROFILE)
    if not isinstance(scene, Scene | Mesh) and os.fspath(scene).endswith(".toml"):
        scene = as_scene(scene)
    if settings.get("spp") is None and not isinstance(scene, Scene):
        settings["spp"] = 1
    return Profiler(as_scene(scene).with_settings(**settings), Options(**{"tile_size": TILE_SIZE, **others})).measure()


@dataclass
class _Tile:
    """A tile. used: number of rays of each pixel; fetches: number of fetches. Later passes add rays, counts, lines and perhaps trace."""

    rectangle: Rectangle
    used: np.ndarray
    fetches: int
    rays: Any = None
    counts: Any = None
    lines: Any = None
    trace: np.ndarray | None = None


class Profiler:
    """Render with a structure that counts its steps and logs its rays. Each tile takes three passes: count the rays of each pixel, record
    the rays with their counters, record their fetches."""

    def __init__(self, scene: Scene, options: Options) -> None:
        self.device, plan = start(options.device), plan_of(scene, options)
        plan.require_memory(self.device)
        counting = plan.structure._replace(units=plan.structure.units._replace(observer="sum"))
        self.plan = replace(plan, structure=WrappedStructure(counting, ray_log), features=replace(plan.features, counting=True))
        self.prepared = prepare(self.plan, self.device)

    def measure(self) -> Profile:
        self.begin, self.done, self.rays, self.lock = time.perf_counter(), 0, 0, threading.Lock()
        settings, (x0, y0, x1, y1) = self.plan.scene.settings, self.plan.crop
        # One film for each pass; all three get the same samples.
        self.films = [DeviceFilm(settings, self.plan.crop, self.device, self.plan.options.seed) for _ in range(3)]
        tiles: list[_Tile] = []
        self._each(lambda rectangle: tiles.append(self._count(rectangle)), self.prepared.tiles(1))
        tiles.sort(key=lambda tile: tile.rectangle[1::-1])
        total = sum(int(tile.used.sum(dtype=np.int64)) for tile in tiles)
        if total * BYTES_OF_RAY > 0.5 * memory_of(self.device):
            raise InputError(f"a profile of {total / 1e6:.0f} million rays needs {total * BYTES_OF_RAY / 2**30:.0f} GiB, more than half"
                             " of the memory; use a smaller size, fewer samples or a crop")
        step = max(1, -(-sum(tile.fetches for tile in tiles) // TRACE_LIMIT))
        self._each(self._record, [(tile, i % step == step // 2) for i, tile in enumerate(tiles)])
        seconds = {**self.prepared.seconds, "trace": time.perf_counter() - self.begin}
        return Profile(self.plan.scene.name, (x1 - x0, y1 - y0), settings.spp, self.films[0].pixels_and_variance()[0], self._gather(tiles),
                       self.prepared.accel, seconds)

    def _each(self, work: Callable[[T], None], items: Iterable[T]) -> None:
        """Call `work` with each item, on all threads."""
        run_all([partial(work, item) for item in items], 1 if self.device.is_cuda else self.prepared.threads)

    def _trace(self, rectangle: Rectangle, film: int, used: np.ndarray | None = None,
               first_fetch: np.ndarray | None = None) -> tuple[Recorder, ray_log.RayLog]:
        """Trace all samples of a tile. used: number of rays of each pixel, to count and log each ray; None: sum over the rays of a pixel.
        first_fetch: index of each ray's first fetch, and the end; None: record no fetches."""
        recorder, log = Recorder(), ray_log.RayLog()
        zeros = partial(wp.zeros, device=self.device)
        pixels = rectangle[2] * rectangle[3]
        n = pixels if used is None else int(used.sum(dtype=np.int64))
        recorder.counts, log.used = zeros(n, dtype=Counts), zeros(pixels, dtype=wp.int32)
        if used is not None:
            log.first, log.rays = upload(np.cumsum(used, dtype=np.int64) - used, wp.int64, self.device), zeros(n, dtype=ray_log.LoggedRay)
        if first_fetch is not None:
            recorder.first = upload(first_fetch, wp.int64, self.device)
            recorder.fetches = zeros(int(first_fetch[-1]), dtype=wp.int64)
        data = copied(self.prepared.accel.data)  # each tile has its own recorder
        data.recorder = recorder
        accel = self.plan.structure.struct()
        accel.accel, accel.log = data, log
        self.prepared.launch(self.films[film], accel)(Work(rectangle, 0, self.plan.scene.settings.spp))
        return recorder, log

    def _count(self, rectangle: Rectangle) -> _Tile:
        recorder, log = self._trace(rectangle, 0)
        used = log.used.numpy().copy()
        self._report(rectangle, 1, int(used.sum(dtype=np.int64)))
        return _Tile(rectangle, used, int(fetches_of(on_host(recorder.counts)).sum()))

    def _record(self, job: tuple[_Tile, bool]) -> None:
        tile, keep = job
        recorder, log = self._trace(tile.rectangle, 1, tile.used)
        tile.rays, tile.counts = log.rays.numpy().copy(), recorder.counts.numpy().copy()
        first = np.concatenate([[0], np.cumsum(fetches_of(tile.counts))])
        trace = self._trace(tile.rectangle, 2, tile.used, first)[0].fetches.numpy()
        tile.lines = distinct_lines(first, trace // int(SIZE_RANGE), trace % int(SIZE_RANGE))
        tile.trace = trace.copy() if keep else None
        self._report(tile.rectangle, 2, len(tile.rays))

    def _report(self, rectangle: Rectangle, runs: int, rays: int) -> None:
        """Report to `progress` that a tile has finished `runs` more passes. rays: number of rays of one pass."""
        progress, spp = self.plan.options.progress, self.plan.scene.settings.spp
        if progress is not None:
            with self.lock:
                self.done += runs * rectangle[2] * rectangle[3] * spp
                self.rays += runs * rays
                progress(Progress(self.done, 3 * self.plan.area * spp, self.rays, time.perf_counter() - self.begin))

    def _gather(self, tiles: list[_Tile]) -> Rays:
        rays = np.concatenate([tile.rays for tile in tiles])
        counts = np.concatenate([tile.counts for tile in tiles])
        x0, y0, x1, y1 = self.plan.crop
        index = np.arange((y1 - y0) * (x1 - x0)).reshape(y1 - y0, x1 - x0)
        pixel = np.concatenate([np.repeat(index[y - y0:y - y0 + height, x - x0:x - x0 + width].ravel(), tile.used)
                                for tile in tiles for x, y, width, height in [tile.rectangle]])
        label = rays["label"]
        path = np.maximum.accumulate(np.where(label > 0, np.arange(len(rays)), 0))  # for a shadow ray, the last path ray before it
        shadow = KINDS.index("shadow")
        branch = (label - 1) % int(BRANCHES)
        kind = np.where(label > 0, np.where(branch == COATED, REFLECTED, branch), shadow).astype(np.int8)
        depth = (label[path] - 1) // int(BRANCHES)
        trace = [tile.trace for tile in tiles if tile.trace is not None]
        kept = np.concatenate([np.full(len(tile.rays), tile.trace is not None) for tile in tiles])
        length = fetches_of(counts[kept])
        fetches = np.concatenate(trace) if trace else np.zeros(0, np.int64)
        return Rays(rays, counts, pixel, kind, depth, np.concatenate([tile.lines for tile in tiles]), np.flatnonzero(kept),
                    np.concatenate([[0], np.cumsum(length)]), fetches // int(SIZE_RANGE), fetches % int(SIZE_RANGE))


def fetches_of(counts: np.ndarray) -> np.ndarray:
    """Return the number of fetches of each ray, (N,) int64. counts: (N,) kernels.traverse.observer.Counts."""
    return counts["nodes"].astype(np.int64) + counts["primitives"]
