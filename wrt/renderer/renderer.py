"""The driver: tiles over threads, passes over samples, into a film."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import wrt
from wrt.accel import ACCELERATORS, Structure, build, tells_progress
from wrt.core.address_space import told_limit
from wrt.core.checks import unknown
from wrt.core.device import free_memory, load_kernel, made_once, start, thread_count
from wrt.core.errors import InputError
from wrt.core.interrupts import held_interrupts
from wrt.core.memory import SMALL, gib
from wrt.core.seconds import Span, counted_once, loads_since
from wrt.io.load import as_scene
from wrt.kernels import structs
from wrt.kernels.shade import render as kernels
from wrt.kernels.traverse.common import Units
from wrt.picture.film import Film
from wrt.renderer.checkpoint import Checkpoint
from wrt.renderer.features import Features, features_of
from wrt.renderer.film_arrays import BYTES_OF_FILM, BYTES_OF_GROUP, GROUPS, AovFilm, DeviceFilm
from wrt.renderer.memory_estimate import bytes_of_scene
from wrt.renderer.options import AOVS as AOVS
from wrt.renderer.options import OPTIONS, Options, Progress
from wrt.renderer.tiles import Rectangle, Work, corners, tiles, work_left
from wrt.renderer.upload import camera_kind, camera_struct, upload_scene
from wrt.scene.cameras import CameraKind
from wrt.scene.digest import camera_digest, scene_digest
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SETTINGS

BYTES_OF_AOVS, BYTES_OF_RESULT = 36, 80  # a pixel; of the result: measured, with writing it to a file
TILE_SIZE = 32
MAX_PASS = 64  # samples a pixel in one pass: what Ctrl-C and a time limit have to wait for
PREPARING = "wrt prepares"  # what the threads that compile and build are called
PREPARING_TOLD = 1.0  # seconds of compiling and building before `progress` is told of it
MAX_SPP = 1 << 16  # where a target error asks for more than anybody said
AIMED = ("size", "spp", "max_depth", "min_throughput", "exposure", "tonemap")  # settings that no kernel is compiled from
# What may change between a checkpoint and going on with it; and the camera and the device, which are compared by what they are.
NO_PIXEL = ("spp", "exposure", "tonemap", "threads", "aov", "time_limit", "target_error", "tile_size", "pass_size", "progress",
            "checkpoint", "checkpoint_every", "resume", "camera", "device", "devices", "executor")


def render(scene: Scene | Mesh | str | os.PathLike[str], *, spp: int | None = None,
           size: tuple[int, int] | str | None = None, settings: dict[str, Any] | None = None, **options: Any) -> Film:
    """Render a scene; returns a Film (linear pixels, variance, AOVs, stats), whose docstring defines each AOV.

    scene: a Scene; the path of a scene or mesh file, or a Mesh, is loaded as `load_scene` does. size: width and height, or
    "640x360". spp, size and all other fields of Settings (max_depth, filter, tonemap ...), here or in `settings`, override
    the scene's own; the other `options` are the fields of Options: seed, device, accel, threads, camera, crop, aov,
    time_limit, target_error, progress ...
    With target_error the scene's own spp is no limit, but MAX_SPP is, unless spp is given.
    The same arguments give the same pixels, bit for bit, for any threads, tile_size and pass_size. Interrupted by Ctrl-C, it
    returns what it has, with stats["interrupted"] set. checkpoint, checkpoint_every, resume: a render that survives the end of
    its process (Options). Raises InputError for anything that cannot be rendered.
    """
    if options.get("target_error") is not None and spp is None:
        spp = MAX_SPP
    changes = {**(settings or {}), **{name: options.pop(name) for name in SETTINGS if name in options}}
    changes |= {name: value for name, value in (("spp", spp), ("size", size)) if value is not None}
    for name in options:
        if name not in OPTIONS:
            raise InputError(unknown(name, "argument of render", (*SETTINGS, *OPTIONS)))
    rendering = Options(**options)
    return renderer_of(as_scene(scene).with_settings(**changes), rendering).run()


def renderer_of(scene: Scene, options: Options) -> Renderer:
    """Of the kind that the options ask for."""
    if options.executor is None and options.devices is None:
        return Renderer(scene, options)
    from wrt.renderer.distributed.renderer import SpreadRenderer

    return SpreadRenderer(scene, options)


@made_once
def render_kernel(features: Features, structure: Structure) -> Any:
    return kernels.make_render_kernel(features, structure, camera_kind(features.camera))


@made_once
def aov_kernel(features: Features, structure: Structure) -> Any:
    return kernels.make_aov_kernel(features, structure, camera_kind(features.camera))


def kernel_hash(kernel: Any, device: str) -> str:
    """Of the kernel's whole code, the same in every process."""
    return str(kernel.module.get_module_hash(1 if device == "cpu" else None).hex())


class Renderer:
    """One scene made ready to render: kernel and structure. `run` takes the samples, and can do so again with another seed."""

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options
        self.seconds: dict[str, float] = {}
        self.spans: dict[str, list[Span]] = {}  # when things were done that others may have been done beside
        self.threads = thread_count(options.threads)
        self.interrupts: list[int] = []
        self.fraction_built = 0.0
        self.device = self._film_device()
        self.camera = options.camera if isinstance(options.camera, CameraKind) else scene.camera(options.camera)
        self.features = features_of(scene, self.camera, options.instancing)
        self.deepest = scene.settings.max_depth
        self.groups = 1 if options.target_error is None else GROUPS
        self.crop = self._crop()
        self._check_memory()
        units = Units(options.triangle, options.box, self.features.spheres, instances=self.features.instances)
        structure = self._structure(Structure(ACCELERATORS[options.accel], units))
        self.kernels = [render_kernel(self.features, structure)]
        if options.aov:
            self.kernels.append(aov_kernel(self.features, structure))
        self.checkpoint = None if options.checkpoint is None else self._checkpoint()
        self._prepare()
        self.device_camera = camera_struct(self.camera, scene.settings.size)

    def _structure(self, structure: Any) -> Any:
        """What the kernels are made for; one that profiles puts a log before it."""
        return structure

    def _film_device(self) -> Any:
        if self.options.executor is not None or self.options.devices is not None:  # SpreadRenderer takes them
            raise InputError("an executor or several devices are for wrt.render; this runs on one device")
        return start(self.options.device)

    def kind(self) -> str:
        """Of the device: pictures of two of the same kind have the same bits."""
        return f"cuda, sm_{self.device.arch}" if self.device.is_cuda else "cpu"

    def _crop(self) -> tuple[int, int, int, int]:
        width, height = self.scene.settings.size
        x0, y0, x1, y1 = (0, 0, width, height) if self.options.crop is None else self.options.crop
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise InputError(f"crop {x0},{y0},{x1},{y1} is not within the picture of {width}x{height}")
        return x0, y0, x1, y1

    def _check_memory(self) -> None:
        """Better told now than by the system after an hour, which ends whoever takes too much."""
        x0, y0, x1, y1 = self.crop
        pixel = BYTES_OF_FILM + BYTES_OF_GROUP * (self.groups - 1) + (BYTES_OF_AOVS if self.options.aov else 0)
        film = (x1 - x0) * (y1 - y0) * (pixel + BYTES_OF_RESULT)
        scene = bytes_of_scene(self.scene, ACCELERATORS[self.options.accel], self.options.instancing)
        there = free_memory(self.device)
        if film + scene > max(there, SMALL):
            raise InputError(f"a picture of {x1 - x0}x{y1 - y0} takes {gib(film)} of memory, its scene {gib(scene)};"
                             f" {self.device} has {gib(there)} free (WRT_MEMORY can say otherwise){told_limit()}")

    def _checkpoint(self) -> Checkpoint:
        """The file to save to, which says what must be the same to go on with it. Errors of it are told before the work."""
        options, settings = self.options, self.scene.settings
        identity = {name: getattr(settings, name) for name in SETTINGS if name not in NO_PIXEL}
        identity |= {name: getattr(options, name) for name in OPTIONS if name not in NO_PIXEL}
        identity |= {
            "crop": self.crop, "groups of samples": self.groups, "scene": scene_digest(self.scene),
            "camera": camera_digest(self.camera), "device": self.kind(),
            "version": wrt.__version__, "kernels": self.kernels_hash(),
        }
        area = (self.crop[2] - self.crop[0]) * (self.crop[3] - self.crop[1])
        file = Checkpoint(Path(options.checkpoint or ""), options.checkpoint_every, identity, area=area, groups=self.groups,
                          resume=options.resume)
        taken = 0 if file.saved is None else file.saved.samples[1]
        if taken > max(1, settings.spp // self.groups):
            raise InputError(f"holds {taken * self.groups} samples a pixel already; spp is {settings.spp}", file.path)
        return file

    def kernels_hash(self) -> str:
        return kernel_hash(self.kernels[0], self.options.device)

    def _prepare(self) -> None:
        """Compile, which takes longest, and build the structure meanwhile. Neither Ctrl-C nor an error waits for the
        compiler, and no wait is long: Python may hear of Ctrl-C only between two of them."""
        begin, tell, told = time.perf_counter(), self.options.progress, ("", 0.0)
        pool = ThreadPoolExecutor(2, thread_name_prefix=PREPARING)
        compiling = pool.submit(self._compile)
        jobs: set[Future[None]] = {compiling, pool.submit(self._build)}
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
        self.seconds |= counted_once({"compile": loads_since(begin), **self.spans})

    def _compile(self) -> None:
        for kernel in self.kernels:
            load_kernel(kernel, self.device)

    def _build(self) -> None:
        begin = time.perf_counter()
        self.device_scene = upload_scene(self.scene, self.device, self.options.instancing)
        uploaded = time.perf_counter()
        options = {"triangle": self.options.triangle, "box": self.options.box, **self.options.accel_options}
        if tells_progress(self.options.accel):
            options = {"progress": partial(setattr, self, "fraction_built"), **options}
        self.accel = build(self.device_scene.world.geometry, self.options.accel, self.options.device, self.threads, **options)
        self.spans = {"upload": [(begin, uploaded)], "build": [(uploaded, time.perf_counter())]}

    def aim(self, camera: CameraKind, **settings: Any) -> None:
        """Another camera and other settings (of AIMED) for the next `run`, with the same kernel and structure.

        Raises InputError for what the kernel was not made for: another kind of camera, a lens where there
        was a pinhole, more bounces.
        """
        scene = self.scene.with_settings(**settings)
        lacks = [name for name, needed, there in (
            (f"a camera of the kind {camera.kind}", camera.device != self.features.camera, False),
            *((f"a camera's {name}", needed, getattr(self.features, name)) for name, needed in camera.switches().items()),
            ("so many bounces", scene.settings.max_depth > self.deepest, False),
            ("other settings than " + ", ".join(AIMED), bool(settings.keys() - AIMED), False),
            ("a checkpoint", self.checkpoint is not None, False)) if needed and not there]
        if lacks:
            raise InputError(f"this renderer was not made for {lacks[0]}")
        self.scene, self.camera = scene, camera
        self.crop = self._crop()
        self._check_memory()
        self.device_camera = camera_struct(camera, scene.settings.size)

    def run(self, *, seed: int | None = None, spp: int | None = None) -> Film:
        """Take all samples (or as many as time allows, or as the target error needs) and return the film.

        seed, spp: in place of the options' and the scene's; not with a checkpoint.
        """
        if self.checkpoint is not None and (seed is not None or spp is not None):
            raise InputError("a render with a checkpoint has the seed and spp that it was made with")
        self.seed = self.options.seed if seed is None else seed
        self.spp = max(1, (spp or self.scene.settings.spp) // self.groups)  # a group
        self.film = DeviceFilm(self.scene.settings, self.crop, self.device, self.seed, self.groups)
        self.expected_spp, self.timed_out, interrupted = self.spp, False, False
        self.seconds_before, self.fewest, self.most = 0.0, 0, 0
        self._restore()
        aov: dict[str, np.ndarray] = {}
        begin = self.begin = time.perf_counter()
        with held_interrupts() as self.interrupts, self.checkpoint.held() if self.checkpoint else nullcontext():
            try:
                if self.options.aov:
                    aov = self._aovs()
                    self.seconds["aov"] = time.perf_counter() - begin
                begin = self.begin = time.perf_counter()
                for first, count in self._passes():
                    self._run_pass(first, count)
            except KeyboardInterrupt:  # from _each_tile, or from a progress callback that wants the end
                interrupted = True
            self.seconds["trace"] = self.seconds_before + time.perf_counter() - begin
            if self.checkpoint is not None:
                self.checkpoint.save(self.film, self.seconds["trace"])
                if self.checkpoint.problem:
                    warnings.warn(self.checkpoint.problem, RuntimeWarning, stacklevel=3)
            return self._result(aov, interrupted or bool(self.interrupts))

    def _restore(self) -> None:
        """Go on where the checkpoint ends, if there is one."""
        if self.checkpoint is not None and self.checkpoint.saved is not None:
            self.checkpoint.restore(self.film)
            self.fewest, self.most = self.checkpoint.saved.samples
            self.seconds_before = self.checkpoint.saved.seconds

    def _passes(self) -> Iterator[tuple[int, int]]:
        """First sample and number of samples (of each group) of each pass: 1, 1, 2, 4 ..., so that a first picture comes soon.

        A time limit counts from self.begin: a pass takes no more samples than are likely to be done by then, but for the
        first of each pixel, which is always taken; nor, where a launch is the whole picture, more than until the next
        checkpoint. A render that was saved within a pass begins with the pixels that are behind.
        """
        spp, limit = self.spp, self.options.time_limit or math.inf
        every = self.checkpoint.every if self.checkpoint is not None and self.device.is_cuda else math.inf
        first = known = self.fewest  # the speed is that of the samples since `known`, when `since`
        since = self.begin
        count = self.options.pass_size or min(max(first, 1), MAX_PASS // self.groups)
        while first < spp and (first < self.most or not self._precise_enough(first)):
            count = min(count, (self.most if first < self.most else spp) - first)
            if self.options.target_error is not None:
                count = min(count, (1 << first.bit_length()) - first)  # no farther than to the next power of 2
            if first > 0 and min(limit, every) < math.inf:
                now = time.perf_counter()
                left = limit - (now - self.begin)
                if left <= 0.0:
                    self.timed_out = True
                    return
                likely = min(left, every) / (now - since) * (first - known) if first > known else 1.0
                count = max(1, min(count, int(min(likely, spp))))
            yield first, count
            first += count
            if first == self.most:
                known, since = first, time.perf_counter()
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

    def _tiles(self) -> Iterator[Rectangle]:
        x0, y0, x1, y1 = self.crop
        return tiles(self.crop, max(x1 - x0, y1 - y0) if self.device.is_cuda else self.options.tile_size or TILE_SIZE)

    def _launch(self, kernel: Any, arguments: list[Any], work: Work) -> None:
        tile = structs.Tile()
        tile.x, tile.y, tile.width, height = work.rectangle
        tile.first_sample, tile.n_samples = work.first, work.n
        wp.launch(kernel, dim=tile.width * height, inputs=[*arguments, tile], device=self.device)

    def _run_pass(self, first: int, count: int) -> None:
        """Bring every pixel from `first` to `first + count` samples a group, where it is not there already."""
        area = (self.crop[2] - self.crop[0]) * (self.crop[3] - self.crop[1])
        work, before = [Work(tile, first, count) for tile in self._tiles()], first * area
        if first < self.most:  # of a resumed render
            samples = self.film.view(self.film.groups[0].samples)
            work, before = work_left(work, samples, self.crop), int(samples.sum(dtype=np.int64))
        self._trace(work, lambda done: self._report(before + done, area))

    def _trace(self, work: list[Work], report: Callable[[int], None]) -> None:
        """Take those samples into the film."""
        groups = self._arguments(self.film)

        def trace(job: Work) -> int:
            for arguments in groups:
                self._launch(self.kernels[0], arguments, job)
            return job.total

        self._each_tile(work, trace, report)

    def _arguments(self, film: DeviceFilm) -> list[list[Any]]:
        """Of the render kernel, for each group of the film."""
        world = [self.accel.data, self.device_scene.surfaces, self.device_scene.lighting, self.device_camera]
        return [[*world, self._limits(seed), group] for seed, group in zip(film.seeds, film.groups, strict=True)]

    def _limits(self, seed: int) -> Any:
        limits = structs.Limits()
        limits.max_depth, limits.min_throughput = self.scene.settings.max_depth, self.scene.settings.min_throughput
        limits.seed = seed
        return limits

    def _each_tile(self, work: list[Work], trace: Callable[[Work], int], report: Callable[[int], None]) -> None:
        """Trace every tile on all threads; `report` gets the sum of what `trace` gives, now and then. KeyboardInterrupt where
        Ctrl-C came: tiles that run come to their end, so that a pixel is never half done. So they do for a checkpoint."""
        if self.interrupts:
            raise KeyboardInterrupt
        if self.device.is_cuda:
            done = sum(trace(job) for job in work)
            wp.synchronize_device(self.device)
            report(done)
            self._save_if_due()
            return
        with ThreadPoolExecutor(self.threads) as pool:
            pending = {pool.submit(trace, job): job for job in work}
            done = 0
            try:
                while pending:
                    finished, _ = wait(pending, timeout=0.1)
                    if self.checkpoint is not None and self.checkpoint.due():
                        waiting = [future for future in pending if future.cancel()]
                        finished = pending.keys() - set(waiting)
                        done += sum(future.result() for future in finished)
                        self._save_if_due()
                        pending = {pool.submit(trace, pending[future]): pending[future] for future in waiting}
                    else:
                        done += sum(future.result() for future in finished)
                        pending = {future: job for future, job in pending.items() if future not in finished}
                    report(done)
                    if self.interrupts and pending:
                        raise KeyboardInterrupt
            except BaseException:
                for future in pending:
                    future.cancel()
                raise

    def _save_if_due(self) -> None:
        if self.checkpoint is not None and self.checkpoint.due():
            self.checkpoint.save(self.film, self._seconds())

    def _seconds(self) -> float:
        """Of tracing, those before the last resume too."""
        return self.seconds_before + time.perf_counter() - self.begin

    def _most_cut_by_throughput(self) -> float:
        """What a ray that is cut by its throughput is worth at most: in glass, light is denser."""
        glass = [m.ior for m in self.scene.materials if m.kind == "glass" or m.transmission > 0.0]
        return self.scene.settings.min_throughput * max(glass, default=1.0) ** 2

    def _report(self, done: int, area: int) -> None:
        if self.options.progress is None:
            return
        total = area * self.expected_spp * self.groups
        note = "" if self.checkpoint is None else self.checkpoint.problem
        rays, seconds = self.film.rays, self._seconds()
        self.options.progress(Progress(done * self.groups, total, rays, seconds, note=note, picture=self._picture))

    def _picture(self) -> Film:
        """What there is so far."""
        settings = self.scene.settings
        return Film(*self.film.pixels_and_variance(), self.film.samples(), exposure=settings.exposure, tonemap=settings.tonemap)

    def _aovs(self) -> dict[str, np.ndarray]:
        film = AovFilm(self.scene.settings, self.crop, self.device)
        arguments = [self.accel.data, self.device_scene.surfaces, self.device_camera, film.struct]

        def trace(job: Work) -> int:
            self._launch(self.kernels[1], arguments, job)
            return job.total

        self._each_tile([Work(tile, 0, 1) for tile in self._tiles()], trace, lambda done: None)
        return {name: film.picture(name) for name in self.options.aov}

    # --- for tiles that are traced elsewhere (wrt.renderer.distributed.renderer) ---

    def facts(self) -> dict[str, Any]:
        """What is told of the scene and its structure: counts, and seconds of making them ready."""
        return {"triangles": self.accel.geometry.n_triangles, "stored_triangles": len(self.device_scene.world.faces),
                "spheres": len(self.accel.geometry.spheres),
                "accel": {"name": self.options.accel, **asdict(self.accel.stats)}}

    def ready(self) -> dict[str, Any]:
        """What a worker tells when it has made the scene ready."""
        return {"facts": self.facts(), "seconds": self.seconds}

    def trace_tile(self, work: Work, seed: int, state: list[np.ndarray] | None) -> list[np.ndarray]:
        """The arrays of a film of that rectangle (DeviceFilm.arrays) with those samples added to `state` (None: zeros).

        It changes nothing here, so that it can be called in several threads, and again."""
        film = DeviceFilm(self.scene.settings, corners(work.rectangle), self.device, seed, self.groups)
        for (_, array), values in zip(film.arrays(), state or (), strict=False):
            film.put(array, values)
        for arguments in self._arguments(film):
            self._launch(self.kernels[0], arguments, work)
        return [film.picture(array) for _, array in film.arrays()]

    def aov_tile(self, rectangle: Rectangle) -> list[np.ndarray]:
        """The AOVs that were asked for, in their order, of a rectangle."""
        film = AovFilm(self.scene.settings, corners(rectangle), self.device)
        arguments = [self.accel.data, self.device_scene.surfaces, self.device_camera, film.struct]
        self._launch(self.kernels[1], arguments, Work(rectangle, 0, 1))
        return [film.picture(name) for name in self.options.aov]

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
            "visibly_cut": film.visibly_cut(self._most_cut_by_throughput()) if self.features.reflection else 0.0,
            "not_finite": film.count("not_finite"), "samples": int(samples.sum()),
            **self.facts(), "interrupted": interrupted,
            "signal": int(self.interrupts[0]) if self.interrupts else None, "timed_out": self.timed_out and not interrupted,
        }
        if self.options.target_error is not None:
            error = film.error()
            stats |= {"estimated_error": error, "target_error": self.options.target_error,
                      "target_reached": error <= self.options.target_error and int(samples.min()) > 0}
        if self.checkpoint is not None:
            saved = self.checkpoint.saved
            stats |= {"checkpoint": None if self.checkpoint.problem else str(self.checkpoint.path), "resumed": None if saved is None
                      else {"samples": saved.samples[0] * self.groups, "seconds": saved.seconds}}
        settings = self.scene.settings
        metadata = {
            "scene": plain_text(self.scene.name), "camera": plain_text(self.camera.name), "spp": int(samples.max()),
            "seed": self.seed, "seconds": round(self.seconds["trace"], 3), "version": wrt.__version__,
            "max_depth": settings.max_depth, "filter": settings.filter, "accel": self.options.accel,
            "device": ",".join(self.options.devices or [self.options.device]),
        }
        return Film(pixels=pixels, variance=variance, samples=samples, aov=aov, stats=stats,
                    metadata=metadata, exposure=settings.exposure, tonemap=settings.tonemap)


def plain_text(name: str) -> str:
    """A name that a file can hold: names out of glTF files and of the system may have lone surrogates, which become "?"."""
    return name.encode("utf-8", "replace").decode()
