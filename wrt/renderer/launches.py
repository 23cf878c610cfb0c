"""The launches that render a picture: one ray at a time (wrt.kernels.loops.one_ray), on CUDA and if a CPU counts rays; else in waves.

The waves of a CPU (wrt.kernels.loops.wave) need kernels, working memory for each thread, and launches that are recorded once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.queries.batches import new_scratch
from wrt.accel.queries.raw_launches import Launches
from wrt.accel.snapshot import Structure
from wrt.core.device import launch_on, made_once, records, start, upload
from wrt.core.threads import FreeList
from wrt.core.types import Device, Kernel, WarpArray, WarpStruct, WarpType
from wrt.kernels.launches import Launch
from wrt.kernels.loops import state, wave, wave_shade
from wrt.kernels.loops.one_ray import Tile, add_samples
from wrt.kernels.loops.state import BLOCK
from wrt.kernels.query import HitArrays, RenderRays, make_render_rays_kernel
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import make_cutout
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample
from wrt.kernels.wide.stream import BatchTraversal
from wrt.renderer.film import AovFilm, DeviceFilm, Work

THREADS_OF_SM = 2048  # resident threads of NVIDIA's largest multiprocessors
ROUNDS = 4  # threads in one launch for each resident thread
# Largest number of samples in a wave. With 4,096 to 32,768, renders are 0.92 to 1.06 times as fast as with 16,384, depending on the scene.
CAPACITY = 16384
MAX_SLOTS = 1 << 18  # Largest number of stack entries, and of shadow rays, of all samples of a wave together.
ALL = 1 << 30  # Block size of a kernel whose only thread traces all rays.
CAMERA_FEATURES = ("camera", "lens", "blades", "filter", "independent")
CUTOUT_FEATURES = ("instances", "textures", "checkerboards", "cutout")


class SceneRecords(NamedTuple):
    """The device structs of a scene: acceleration structure, surfaces, lighting, and camera."""

    accel: WarpStruct
    surfaces: WarpStruct
    lighting: WarpStruct
    camera: WarpStruct

def film_launch(device: Device, kernel: Kernel, scene: SceneRecords, limits: list[WarpStruct], film: DeviceFilm,
                always_by_pixels: bool) -> Callable[[Work], int]:
    """Return a function that adds the samples of a Work to the film by threads that trace one ray at a time, and returns their number.

    A thread renders all samples of a pixel or, if the pixels are too few to occupy a GPU, one sample. limits: a struct Limits for each
    group of the film."""
    most_threads = 0 if always_by_pixels else device.sm_count * THREADS_OF_SM * ROUNDS
    samples = wp.empty(0, dtype=Sample, device=device)

    def trace(work: Work) -> int:
        nonlocal samples
        pixels, end = work.rectangle[2] * work.rectangle[3], work.first + work.n
        by_samples = work.n > 1 and pixels * ROUNDS <= most_threads
        step = min(most_threads // pixels, work.n) if by_samples else work.n
        if by_samples and len(samples) < pixels * step:
            samples = wp.empty(pixels * step, dtype=Sample, device=device)
        for first in range(work.first, end, step):
            tile = tile_of(work._replace(first=first, n=min(step, end - first)))
            tile.threads = tile.n_samples if by_samples else 1
            tile.samples = samples
            for limit, group in zip(limits, film.groups, strict=True):
                launch_on(device, kernel, pixels * tile.threads, *scene, limit, group, tile)
                if tile.threads > 1:
                    launch_on(device, add_samples, pixels, group, tile)
        return work.total

    return trace


def aov_launch(device: Device, kernel: Kernel, scene: SceneRecords, film: AovFilm) -> Callable[[Work], int]:
    """Return a function that writes the AOVs of a Work's rectangle to the film, and returns the number of pixels."""

    def trace(work: Work) -> int:
        launch_on(device, kernel, work.rectangle[2] * work.rectangle[3], scene.accel, scene.surfaces, scene.camera, film.struct,
                  tile_of(work))
        return work.total

    return trace


def tile_of(work: Work) -> WarpStruct:
    tile = Tile()
    tile.x, tile.y, tile.width, _ = work.rectangle
    tile.first_sample, tile.n_samples, tile.threads = work.first, work.n, 1
    return tile


# --- waves ------------------------------------------------------------------------------------------------------------


def keep_only(features: Features, names: tuple[str, ...]) -> Features:
    """Reset every feature outside `names`. Scenes that differ only in reset features then share a kernel."""
    return Features(**{name: getattr(features, name) for name in names})


begin_kernel = made_once(wave.make_begin_kernel)
shade_kernels = made_once(wave_shade.make_shade_kernels)
shadow_kernel = made_once(wave.make_shadow_kernel)
aov_kernel = made_once(wave.make_aov_kernel)
begin_aov_kernel = made_once(wave.make_begin_aov_kernel)


@made_once
def queue_kernel(structure: Structure, features: Features, any_hit: bool) -> tuple[Kernel, int]:
    """Return the kernel that traces a queue of rays, and its rays per thread: ALL with a stream kernel (wrt.accel.base), else 1.

    The kernel always handles spheres, so that scenes with and without spheres share it."""
    structure = structure._replace(units=structure.units._replace(spheres=True))
    accepts = make_cutout(features)
    stream = structure.accel.stream
    kernel = stream and stream.make_stream(structure.units, any_hit, RenderRays, accepts)
    if kernel is not None:
        return kernel, ALL
    return make_render_rays_kernel(structure.struct, structure.traversal(any_hit=any_hit, accepts=accepts), any_hit), 1


@dataclass(frozen=True)
class WaveKernels:
    """The kernels of a picture. None: the picture does not need this kernel."""

    shade: Kernel  # shade_wave (kernels/loops/wave_shade.py).
    prepare: Kernel | None  # prepare_block (wave_shade.py).
    closest_hit: Kernel
    any_hit: Kernel | None  # For shadow rays in scenes without transparent shadows.
    shadow: Kernel | None  # shadow_wave (wave.py), in scenes with transparent shadows.
    begin: Kernel  # begin_wave (wave.py).
    loop: Kernel  # trace_wave (wave.py).
    begin_aov: Kernel | None  # begin_aov (wave.py).
    aov: Kernel | None  # aov_wave (wave.py).
    block: int  # Rays per thread of the traversals: ALL or 1.

    def all(self) -> list[Kernel]:
        """Return the kernels, the slowest to compile first."""
        return [kernel for kernel in vars(self).values() if isinstance(kernel, wp.Kernel)]


def wave_kernels(features: Features, structure: Structure, aov: bool) -> WaveKernels:
    """Return the kernels of a picture. aov: include the AOV kernels."""
    default = Features()
    surfaces = replace(features, camera=default.camera, lens=False, blades=False, filter=False, stack_size=default.stack_size)
    cutout, camera = keep_only(features, CUTOUT_FEATURES), import_module(features.camera)
    transparent = features.transparent_shadows
    closest_hit, block = queue_kernel(structure, cutout, False)
    shade, prepare = shade_kernels(surfaces)
    return WaveKernels(
        shade=shade,
        prepare=prepare,
        closest_hit=closest_hit,
        any_hit=queue_kernel(structure, cutout, True)[0] if features.direct_light and not transparent else None,
        shadow=shadow_kernel(surfaces) if transparent else None,
        begin=begin_kernel(keep_only(features, CAMERA_FEATURES), camera),
        loop=wave.make_loop_kernel(transparent),
        begin_aov=begin_aov_kernel(camera) if aov else None,
        aov=aov_kernel(surfaces) if aov else None,
        block=block,
    )


@dataclass(frozen=True)
class Waves:
    """The wave kernels of a scene, and the working memory (Buffers) of the threads."""

    kernels: WaveKernels
    lights: int  # Number of lights; a sampled background counts as a light.
    buffers: FreeList[Buffers]

    def launch(self, scene: SceneRecords, limits: list[WarpStruct], film: DeviceFilm | AovFilm) -> Callable[[Work], int]:
        """Return a function that renders the samples of a Work, adds them to the film, and returns their number.

        Several threads may call this function at once. limits: a struct Limits for each group of the film."""
        recorded: dict[int, Picture | Aovs] = {}

        def trace(work: Work) -> int:
            buffers = self.buffers.take()
            if id(buffers) not in recorded:
                recorded[id(buffers)] = (Aovs(self, buffers, scene, film) if isinstance(film, AovFilm)
                                         else Picture(self, buffers, scene, limits, film))
            recorded[id(buffers)].trace(work)
            self.buffers.give(buffers)
            return work.total

        return trace


def capacity(features: Features, lights: int) -> int:
    """Return the largest number of samples in a wave. lights: number of shadow rays per hit."""
    return max(min(CAPACITY, MAX_SLOTS // max(lights, features.stack_size)), 64)


class Buffers:
    """The working memory of one thread: the arrays of a wave (kernels/loops/state.py)."""

    def __init__(self, features: Features, lights: int) -> None:
        self.capacity = n = capacity(features, lights)
        self.task, self.order = records(state.Task, 1), np.zeros(n, np.int32)  # The wave's arrays share this memory.
        w, cpu = state.Wave(), start("cpu")
        self.wave = w
        w.capacity = n
        w.task, w.progress = upload(self.task, state.Task, cpu), wp.zeros(1, dtype=state.Progress, device="cpu")
        w.pixels.order = upload(self.order, wp.int32, cpu)
        w.pixels.key, w.pixels.film_index = empty(n, wp.uint32), empty(n + LANES, wp.int32)
        w.samples.film_point, w.samples.lens_point = empty(n + LANES, wp.vec2), empty(n + LANES, wp.vec2)
        w.samples.total, w.samples.pending, w.samples.traced_rays = empty(n, Sample), empty(n, wp.int32), empty(n, wp.int32)
        w.samples.paths = empty(n * features.stack_size, state.Path)
        w.queue.sample, w.queue.rays, w.queue.hits = empty(n, wp.int32), empty_rays(n), empty_hits(n)
        w.outcomes.hit_rays, w.outcomes.missed_rays, w.outcomes.resumed_samples = (empty(n, wp.int32) for _ in range(3))
        self.allocate_shadows(features.transparent_shadows, lights)
        w.rows = empty(state.ROWS * BLOCK, wp.float32)
        self.scratch = new_scratch(BatchTraversal.stream_sizes)

    def allocate_shadows(self, transparent: bool, lights: int) -> None:
        """Allocate the receivers (hits that wait for direct light) and their shadow rays."""
        w, n, slots = self.wave, self.capacity, self.capacity * lights
        w.receivers.sample, w.receivers.pending_light = empty(n, wp.int32), empty(n, PendingLight)
        w.receivers.shadow = empty(slots, wp.int32)
        w.shadows.value, w.shadow_queue.rays = empty(slots, wp.vec3), empty_rays(slots)
        w.shadow_queue.count = wp.zeros(max(lights, 1), dtype=wp.int32, device="cpu")
        if transparent:
            w.receivers.scatter, w.shadows.walk = empty(n, Scatter), empty(slots, ShadowWalk)
            w.shadow_queue.slot, w.shadow_queue.hits = empty(slots, wp.int32), empty_hits(slots)
        else:
            w.shadow_queue.occluded = empty(slots, wp.bool)

    def for_each_wave(self, work: Work, launch: Callable[[], None]) -> None:
        """Split `work` into waves. For each wave, set its pixels and samples (Task, Pixels.order) and call `launch`."""
        task, (x, y, width, height) = self.task[0], work.rectangle
        task["x"], task["y"], task["width"] = x, y, width
        order, most = block_order(width, height), min(work.n, self.capacity)
        for first in range(work.first, work.first + work.n, most):
            samples = min(most, work.first + work.n - first)
            count = self.capacity // samples
            task["first_sample"], task["samples"] = first, samples
            for begin in range(0, len(order), count):
                pixels = order[begin : begin + count]
                self.order[: len(pixels)], task["pixels"] = pixels, len(pixels)
                launch()


class Picture:
    """The kernel launches that render a picture with one thread's buffers. They are recorded once: only the buffers' contents change."""

    def __init__(self, waves: Waves, buffers: Buffers, scene: SceneRecords, limits: list[WarpStruct], film: DeviceFilm) -> None:
        kernels, w = waves.kernels, buffers.wave
        self.buffers, self.launches, self.groups = buffers, Launches(), []
        recorded = self.launches.recorded

        def trace(kernel: Kernel, rays: object, out: object) -> WarpStruct:
            return recorded(traversal(kernels, kernel, buffers, scene.accel, scene.surfaces, rays, out), kernels.block)

        block = recorded(command(kernels.prepare, w, scene.surfaces, scene.lighting, 0, 0), ALL) if kernels.prepare else Launch()
        launches = {
            "closest_hit": trace(kernels.closest_hit, w.queue.rays, w.queue.hits),
            "shade": recorded(command(kernels.shade, w, scene.surfaces, scene.lighting, limits[0], block, 0, 0), ALL),
        }
        if kernels.shadow:
            launches["shadow_closest_hit"] = trace(kernels.closest_hit, w.shadow_queue.rays, w.shadow_queue.hits)
            launches["advance_shadow"] = recorded(command(kernels.shadow, w, scene.surfaces, 0))
        if kernels.any_hit:
            launches["shadow_any_hit"] = trace(kernels.any_hit, w.shadow_queue.rays, w.shadow_queue.occluded)
        for group_limits, group in zip(limits, film.groups, strict=True):
            launches["begin"] = recorded(command(kernels.begin, w, scene.camera, group_limits, group, 0, 0), ALL)
            of_group = wave.WaveLaunches()
            for name, launch in launches.items():
                setattr(of_group, name, launch)
            self.groups.append(command(kernels.loop, w, of_group, waves.lights, group))

    def trace(self, work: Work) -> None:
        """Trace all samples of `work`."""
        for group in self.groups:
            self.buffers.for_each_wave(work, group.launch)


class Aovs:
    """The kernel launches that write AOVs with one thread's buffers."""

    def __init__(self, waves: Waves, buffers: Buffers, scene: SceneRecords, film: AovFilm) -> None:
        kernels, w = waves.kernels, buffers.wave
        self.buffers, self.block = buffers, kernels.block
        self.begin = command(kernels.begin_aov, w, scene.camera, film.struct)
        self.aov = command(kernels.aov, w, scene.surfaces, film.struct)
        self.closest_hit = traversal(kernels, kernels.closest_hit, buffers, scene.accel, scene.surfaces, w.queue.rays, w.queue.hits)

    def trace(self, work: Work) -> None:
        """Trace the AOVs of the rectangle of `work`."""
        self.buffers.for_each_wave(work, self._trace_wave)

    def _trace_wave(self) -> None:
        pixels = int(self.buffers.task[0]["pixels"])
        self.begin.launch()
        self.closest_hit.set_dim(-(-pixels // self.block))
        self.closest_hit.set_param_by_name("end", pixels)
        self.closest_hit.launch()
        self.aov.launch()


def command(kernel: Kernel | None, *inputs: object) -> wp.Launch:
    """Record the launch of a kernel with one thread, without running it."""
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)


def traversal(kernels: WaveKernels, kernel: Kernel, buffers: Buffers, *inputs: object) -> wp.Launch:
    """Record the launch of a kernel that traces a queue. The last two kernel arguments, the range first .. end, are set before each run."""
    return command(kernel, *inputs, *([buffers.scratch] if kernels.block > 1 else []), 0, 0)


def empty(n: int, dtype: WarpType) -> WarpArray:
    return wp.empty(n, dtype=dtype, device="cpu")


def empty_rays(n: int) -> WarpStruct:
    out = RenderRays()
    out.origin, out.direction, out.exclude = empty(n, wp.vec3), empty(n, wp.vec3), empty(n, wp.int32)
    out.t_min, out.t_max = wp.zeros(n, dtype=wp.float32, device="cpu"), empty(n, wp.float32)
    return out


def empty_hits(n: int) -> WarpStruct:
    out = HitArrays()
    out.t, out.u, out.v, out.prim_id = (empty(n, dtype) for dtype in (wp.float32, wp.float32, wp.float32, wp.int32))
    return out


@lru_cache(maxsize=64)
def block_order(width: int, height: int) -> np.ndarray:
    """Return the indices y * width + x of a rectangle's pixels (int32), by squares of 4x4 and 2x2: neighbours are traced together."""
    y, x = np.mgrid[:height, :width]
    within = (x & 1) | (y & 1) << 1 | (x & 2) << 1 | (y & 2) << 2
    return np.lexsort((within.ravel(), x.ravel() // 4, y.ravel() // 4)).astype(np.int32)
