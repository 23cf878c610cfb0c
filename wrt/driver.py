"""The driver: tiles over threads, passes over samples, into a film."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, fields
from functools import cache, partial
from typing import Any

import numpy as np
import warp as wp

import wrt
from wrt.accel import ACCELERATORS, Structure, build, tells_progress
from wrt.accel.base import check_units
from wrt.arguments import as_integer, as_names, as_one, as_tuple, shown, unknown
from wrt.device import load_kernel, memory_size, start, thread_count
from wrt.device_film import BYTES_OF_FILM, BYTES_OF_GROUP, GROUPS, DeviceFilm
from wrt.device_scene import camera_struct, upload_scene
from wrt.errors import InputError
from wrt.features import Features, features_of
from wrt.film import Film
from wrt.interrupt import held_interrupts
from wrt.kernels import render as kernels
from wrt.kernels import structs
from wrt.kernels.traverse import Units
from wrt.mesh import Mesh
from wrt.scene import SETTINGS, Camera, Scene
from wrt.scene_file import as_scene

AOVS = ("depth", "normal", "albedo", "prim_id", "material_id")
TILE_SIZE = 32
BYTES_OF_AOVS, BYTES_OF_RESULT = 36, 80  # a pixel; of the result: measured, with writing it to a file
MAX_PASS = 64  # samples a pixel in one pass: what Ctrl-C and a time limit have to wait for
PREPARING_TOLD = 1.0  # seconds of compiling and building before `progress` is told of it
MAX_SPP = 1 << 16  # where a target error asks for more than anybody said


@dataclass(frozen=True)
class Progress:
    """How far a render is: samples done and to do (summed over pixels), rays so far, seconds of tracing.

    stage: "trace"; or before anything is traced, where that takes longer than PREPARING_TOLD: "compile", once, or "build", with
    done of total steps of a structure that is slow to build.
    """

    done: int
    total: int
    rays: int
    seconds: float
    stage: str = "trace"

    @property
    def rays_per_second(self) -> float:
        return self.rays / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def seconds_left(self) -> float:
        return self.seconds * (self.total - self.done) / self.done if self.done else float("inf")


@dataclass
class Options:
    """How to render, beyond what the scene says. tile_size, pass_size: pixels a side and samples at once; never change a
    pixel. crop: x0, y0, x1, y1 in pixels. time_limit in seconds of tracing; the first sample of each pixel is always taken.

    target_error: stop when the estimated error of the picture is no larger: the root mean square, over its pixels and
    channels, of the standard error in linear radiance. It is noise alone: what max_depth and min_throughput cut off is not
    in it. A pixel's samples are then split over GROUPS independent sequences (wrt.device_film), and spp is the most to take
    (rounded down to a multiple of GROUPS; one a group at least). The estimate is looked at when a group has 1, 2, 4, 8 ...
    samples: only then is its sequence as even as it can be."""

    seed: int = 0
    device: str = "cpu"
    accel: str = "bvh"
    threads: int | None = None
    camera: str | int | Camera | None = None
    crop: tuple[int, int, int, int] | None = None
    aov: Sequence[str] = ()
    time_limit: float | None = None
    target_error: float | None = None
    tile_size: int = TILE_SIZE
    pass_size: int | None = None
    progress: Callable[[Progress], None] | None = None
    triangle: str = "watertight"
    box: str = "conservative"
    accel_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("accel", "device", "triangle", "box"):
            as_one(getattr(self, name), str, name)
        if self.accel not in ACCELERATORS:
            raise InputError(f"no structure {self.accel!r}; there is {', '.join(ACCELERATORS)}")
        check_units(self.triangle, self.box)
        self.aov = as_names(self.aov, "aov")
        no_aov = sorted(set(self.aov) - set(AOVS))
        if no_aov:
            raise InputError(f"no AOV {', '.join(no_aov)}; there is {', '.join(AOVS)}")
        for name in ("time_limit", "target_error"):
            as_one(getattr(self, name), (int, float, np.number, type(None)), name)
        if self.time_limit is not None and not self.time_limit > 0.0:
            raise InputError(f"time_limit must be more than 0 seconds, got {self.time_limit}")
        if self.target_error is not None and not 0.0 < self.target_error < math.inf:
            raise InputError(f"target_error must be more than 0 and finite, got {self.target_error}")
        self.tile_size = as_integer(self.tile_size, "tile_size", 1, 1 << 15)
        self.pass_size = None if self.pass_size is None else as_integer(self.pass_size, "pass_size", 1, 1 << 24)
        self.seed = as_integer(self.seed, "seed", 0, 2**32 - 1)
        if self.crop is not None and len(as_tuple(self.crop, (int, np.integer), "crop")) != 4:
            raise InputError(f"crop must be x0, y0, x1, y1 in pixels, got {self.crop!r}")
        if not (self.progress is None or callable(self.progress)):
            raise InputError(f"progress must be a function of a Progress, got {shown(self.progress)}")
        as_one(self.camera, (str, int, np.integer, Camera, type(None)), "camera")
        as_one(self.accel_options, dict, "accel_options")
        as_one(self.threads, (int, np.integer, type(None)), "threads")
        thread_count(self.threads)
        start(self.device)


OPTIONS = tuple(each.name for each in fields(Options))


def render(scene: Scene | Mesh | str | os.PathLike[str], *, spp: int | None = None,
           size: tuple[int, int] | str | None = None, settings: dict[str, Any] | None = None, **options: Any) -> Film:
    """Render a scene; returns a Film (linear pixels, variance, AOVs, stats), whose docstring defines each AOV.

    scene: a Scene; the path of a scene or mesh file, or a Mesh, is loaded as `load_scene` does. size: width and height, or
    "640x360". spp, size and all other fields of Settings (max_depth, filter, tonemap ...), here or in `settings`, override
    the scene's own; the other `options` are the fields of Options: seed, device, accel, threads, camera, crop, aov,
    time_limit, target_error, progress ...
    With target_error the scene's own spp is no limit, but MAX_SPP is, unless spp is given.
    The same arguments give the same pixels, bit for bit, for any threads, tile_size and pass_size. Interrupted by Ctrl-C, it
    returns what it has, with stats["interrupted"] set. Raises InputError for anything that cannot be rendered.
    """
    if options.get("target_error") is not None and spp is None:
        spp = MAX_SPP
    changes = {**(settings or {}), **{name: options.pop(name) for name in SETTINGS if name in options}}
    changes |= {name: value for name, value in (("spp", spp), ("size", size)) if value is not None}
    for name in options:
        if name not in OPTIONS:
            raise InputError(unknown(name, "argument of render", (*SETTINGS, *OPTIONS)))
    rendering = Options(**options)
    return Renderer(as_scene(scene).with_settings(**changes), rendering).run()


@cache
def render_kernel(features: Features, structure: Structure) -> Any:
    return kernels.make_render_kernel(features, structure)


@cache
def aov_kernel(features: Features, structure: Structure) -> Any:
    return kernels.make_aov_kernel(features, structure)


class Renderer:
    """One scene made ready to render: kernel and structure. `run` takes the samples, and can do so again with another seed."""

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options
        self.seconds: dict[str, float] = {}
        self.threads = thread_count(options.threads)
        self.interrupts: list[int] = []
        self.fraction_built = 0.0
        self.device = start(options.device)
        self.camera = options.camera if isinstance(options.camera, Camera) else scene.camera(options.camera)
        self.features = features_of(scene, self.camera)
        self.groups = 1 if options.target_error is None else GROUPS
        self.crop = self._crop()
        self._check_memory()
        units = Units(options.triangle, options.box, self.features.spheres)
        structure = self._structure(Structure(ACCELERATORS[options.accel], units))
        self.kernels = [render_kernel(self.features, structure)]
        if options.aov:
            self.kernels.append(aov_kernel(self.features, structure))
        self._prepare()
        self.device_camera = camera_struct(self.camera, scene.settings.size)

    def _structure(self, structure: Any) -> Any:
        """What the kernels are made for; one that profiles puts a log before it."""
        return structure

    def _crop(self) -> tuple[int, int, int, int]:
        width, height = self.scene.settings.size
        x0, y0, x1, y1 = (0, 0, width, height) if self.options.crop is None else self.options.crop
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise InputError(f"crop {x0},{y0},{x1},{y1} is not within the picture of {width}x{height}")
        return x0, y0, x1, y1

    def _check_memory(self) -> None:
        """Better told now than by the system after an hour, which ends whoever takes too much."""
        width, height = self.scene.settings.size
        x0, y0, x1, y1 = self.crop
        film = BYTES_OF_FILM + BYTES_OF_GROUP * (self.groups - 1) + (BYTES_OF_AOVS if self.options.aov else 0)
        needed, there = width * height * film + (x1 - x0) * (y1 - y0) * BYTES_OF_RESULT, memory_size(self.device)
        if needed > there:
            raise InputError(f"a picture of {width}x{height} takes {needed / 2**30:.1f} GiB of memory;"
                             f" {self.options.device} has {there / 2**30:.1f}")

    def _prepare(self) -> None:
        """Compile, which takes longest, and build the structure meanwhile. Neither Ctrl-C nor an error waits for the
        compiler, and no wait is long: Python may hear of Ctrl-C only between two of them."""
        pool = ThreadPoolExecutor(2)
        compiling = pool.submit(self._compile)
        jobs: set[Future[None]] = {compiling, pool.submit(self._build)}
        begin, tell, told = time.perf_counter(), self.options.progress, ("", 0.0)
        try:
            while jobs:
                finished, jobs = wait(jobs, timeout=0.1, return_when=FIRST_EXCEPTION)
                seconds = time.perf_counter() - begin
                state = ("build", self.fraction_built) if self.fraction_built > 0.0 else ("compile", 0.0)
                if tell is not None and jobs and seconds >= PREPARING_TOLD and state != told and (
                        state[0] == "build" or compiling in jobs):
                    tell(Progress(int(100.0 * state[1]), 100, 0, seconds, stage=state[0]))
                    told = state
                for job in finished:
                    job.result()
        finally:
            pool.shutdown(wait=False)

    def _compile(self) -> None:
        begin = time.perf_counter()
        for kernel in self.kernels:
            load_kernel(kernel, self.device)
        self.seconds["compile"] = time.perf_counter() - begin

    def _build(self) -> None:
        begin = time.perf_counter()
        self.device_scene = upload_scene(self.scene, self.device)
        self.seconds["upload"] = time.perf_counter() - begin
        options = {"triangle": self.options.triangle, "box": self.options.box, **self.options.accel_options}
        if tells_progress(self.options.accel):
            options = {"progress": partial(setattr, self, "fraction_built"), **options}
        self.accel = build(self.device_scene.world.geometry, self.options.accel, self.options.device, self.threads, **options)
        self.seconds["build"] = self.accel.stats.build_seconds

    def run(self, *, seed: int | None = None, spp: int | None = None) -> Film:
        """Take all samples (or as many as time allows, or as the target error needs) and return the film.

        seed, spp: in place of the options' and the scene's.
        """
        self.seed = self.options.seed if seed is None else seed
        self.spp = max(1, (spp or self.scene.settings.spp) // self.groups)  # a group
        self.film = DeviceFilm(self.scene.settings, self.crop, self.device, self.seed, self.groups)
        self.expected_spp, self.timed_out, interrupted = self.spp, False, False
        aov: dict[str, np.ndarray] = {}
        begin = time.perf_counter()
        with held_interrupts() as self.interrupts:
            try:
                if self.options.aov:
                    aov = self._aovs()
                    self.seconds["aov"] = time.perf_counter() - begin
                begin = time.perf_counter()
                for first, count in self._passes(begin):
                    self._run_pass(first, count, begin)
            except KeyboardInterrupt:  # from _each_tile, or from a progress callback that wants the end
                interrupted = True
            self.seconds["trace"] = time.perf_counter() - begin
            return self._result(aov, interrupted or bool(self.interrupts))

    def _passes(self, begin: float) -> Iterator[tuple[int, int]]:
        """First sample and number of samples (of each group) of each pass: 1, 1, 2, 4 ..., so that a first picture comes soon.

        A time limit counts from `begin`: a pass takes no more samples than are likely to be done by then, but for the
        first of each pixel, which is always taken.
        """
        spp, limit = self.spp, self.options.time_limit
        first, count = 0, self.options.pass_size or 1
        while first < spp and not self._precise_enough(first):
            count = min(count, spp - first)
            if self.options.target_error is not None:
                count = min(count, (1 << first.bit_length()) - first)  # no farther than to the next power of 2
            if first > 0 and limit is not None:
                elapsed = time.perf_counter() - begin
                if elapsed >= limit:
                    self.timed_out = True
                    return
                count = max(1, min(count, int(min((limit - elapsed) / elapsed * first, spp))))
            yield first, count
            first += count
            count = self.options.pass_size or min(first, MAX_PASS // self.groups)

    def _precise_enough(self, taken: int) -> bool:
        """Whether the target error is reached after so many samples of each group; looked at when they are a power of 2."""
        target = self.options.target_error
        if target is None or taken == 0 or taken & (taken - 1):
            return False
        error = self.film.error()
        if error > target:  # at worst the variance falls as 1 / n
            steps = math.ceil(min(2.0 * math.log2(error / target), 24.0))
            self.expected_spp = min(self.spp, taken << steps)
        return error <= target

    def _tiles(self) -> Iterator[tuple[int, int, int, int]]:
        x0, y0, x1, y1 = self.crop
        step = max(x1 - x0, y1 - y0) if self.device.is_cuda else self.options.tile_size
        for y in range(y0, y1, step):
            for x in range(x0, x1, step):
                yield x, y, min(step, x1 - x), min(step, y1 - y)

    def _launch(self, kernel: Any, arguments: list[Any], rectangle: tuple[int, int, int, int], samples: tuple[int, int],
                rest: Sequence[Any] = ()) -> None:
        tile = structs.Tile()
        tile.x, tile.y, tile.width = rectangle[:3]
        tile.first_sample, tile.n_samples = samples
        wp.launch(kernel, dim=rectangle[2] * rectangle[3], inputs=[*arguments, tile, *rest], device=self.device)

    def _run_pass(self, first: int, count: int, begin: float) -> None:
        world = [self.accel.data, self.device_scene.surfaces, self.device_scene.lighting, self.device_camera]
        groups = [[*world, self._limits(seed), film] for seed, film in zip(self.film.seeds, self.film.groups, strict=True)]
        area = (self.crop[2] - self.crop[0]) * (self.crop[3] - self.crop[1])

        def trace(rectangle: tuple[int, int, int, int]) -> int:
            for arguments in groups:
                self._launch(self.kernels[0], arguments, rectangle, (first, count))
            return rectangle[2] * rectangle[3]

        self._each_tile(trace, lambda done: self._report(first * area + done * count, area, begin))

    def _limits(self, seed: int) -> Any:
        limits = structs.Limits()
        limits.max_depth, limits.min_throughput = self.scene.settings.max_depth, self.scene.settings.min_throughput
        limits.seed = seed
        return limits

    def _each_tile(self, trace: Callable[[tuple[int, int, int, int]], int], report: Callable[[int], None]) -> None:
        """Trace every tile on all threads; `report` gets the number of pixels done, now and then. KeyboardInterrupt where
        Ctrl-C came: tiles that run come to their end, so that a pixel is never half done."""
        if self.interrupts:
            raise KeyboardInterrupt
        if self.device.is_cuda:
            done = sum(trace(tile) for tile in self._tiles())
            wp.synchronize_device(self.device)
            report(done)
            return
        with ThreadPoolExecutor(self.threads) as pool:
            pending: set[Future[int]] = {pool.submit(trace, tile) for tile in self._tiles()}
            done = 0
            try:
                while pending:
                    finished, pending = wait(pending, timeout=0.1)
                    done += sum(future.result() for future in finished)
                    report(done)
                    if self.interrupts and pending:
                        raise KeyboardInterrupt
            except BaseException:
                for future in pending:
                    future.cancel()
                raise

    def _report(self, done: int, area: int, begin: float) -> None:
        if self.options.progress is None:
            return
        total = area * self.expected_spp * self.groups
        self.options.progress(Progress(done * self.groups, total, self.film.rays, time.perf_counter() - begin))

    def _aovs(self) -> dict[str, np.ndarray]:
        width, height = self.scene.settings.size
        film = structs.AovFilm()
        shapes = {"depth": wp.float32, "normal": wp.vec3, "albedo": wp.vec3, "prim_id": wp.int32, "material_id": wp.int32}
        for name, dtype in shapes.items():
            setattr(film, name, wp.zeros(width * height, dtype=dtype, device=self.device))
        arguments = [self.accel.data, self.device_scene.surfaces, self.device_camera, film]

        def trace(rectangle: tuple[int, int, int, int]) -> int:
            self._launch(self.kernels[1], arguments, rectangle, (0, 1), [width, height])
            return rectangle[2] * rectangle[3]

        self._each_tile(trace, lambda done: None)
        return {name: self.film.picture(getattr(film, name)) for name in self.options.aov}

    def _result(self, aov: dict[str, np.ndarray], interrupted: bool) -> Film:
        film, samples = self.film, self.film.samples()
        pixels, variance = film.pixels_and_variance()
        total = max(int(samples.sum()), 1)
        rays = film.count("rays")
        stats: dict[str, Any] = {
            "seconds": dict(self.seconds), "rays": rays, "rays_per_sample": rays / total,
            "rays_per_second": rays / self.seconds["trace"] if self.seconds["trace"] > 0.0 else 0.0,
            "cut_by_depth": film.count("cut_depth"), "cut_by_throughput": film.count("cut_throughput"),
            "lost_throughput_per_sample": film.lost() / total,
            "not_finite": film.count("not_finite"), "samples": int(samples.sum()),
            "triangles": len(self.accel.geometry.faces), "spheres": len(self.accel.geometry.spheres),
            "accel": {"name": self.options.accel, **asdict(self.accel.stats)}, "interrupted": interrupted,
            "signal": int(self.interrupts[0]) if self.interrupts else None, "timed_out": self.timed_out and not interrupted,
        }
        if self.options.target_error is not None:
            error = film.error()
            stats |= {"estimated_error": error, "target_error": self.options.target_error,
                      "target_reached": error <= self.options.target_error and int(samples.min()) > 0}
        settings = self.scene.settings
        metadata = {
            "scene": plain_text(self.scene.name), "camera": plain_text(self.camera.name), "spp": int(samples.max()),
            "seed": self.seed, "seconds": round(self.seconds["trace"], 3), "version": wrt.__version__,
            "max_depth": settings.max_depth, "filter": settings.filter, "accel": self.options.accel,
            "device": self.options.device,
        }
        return Film(pixels=pixels, variance=variance, samples=samples, aov=aov, stats=stats,
                    metadata=metadata, exposure=settings.exposure, tonemap=settings.tonemap)


def plain_text(name: str) -> str:
    """A name that a file can hold: names out of glTF files and of the system may have lone surrogates, which become "?"."""
    return name.encode("utf-8", "replace").decode()
