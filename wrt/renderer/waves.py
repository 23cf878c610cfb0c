"""Pictures on the CPU by waves of samples (wrt.kernels.loops.wave): which kernels, what they work in, and the waves of a tile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.queries.batches import new_scratch
from wrt.accel.queries.raw_launches import Launches
from wrt.core.device import made_once, records, upload
from wrt.kernels.launches import Launch
from wrt.kernels.loops import state, wave, wave_begin, wave_rows, wave_shade
from wrt.kernels.loops.state import BLOCK
from wrt.kernels.query import HitArrays, RenderRays, make_render_rays_kernel
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import make_cutout
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample
from wrt.kernels.wide.batch import BatchTraversal
from wrt.renderer.film_arrays import AovFilm, DeviceFilm
from wrt.renderer.tiles import Work

# Samples of a wave: 4,096 to 32,768 are 0.92 to 1.06 times as fast, by the scene. Fewer where each has room for many paths or asks
# many lights: ROOM is for all of them together.
CAPACITY, ROOM = 16384, 1 << 18
ALL = 1 << 30  # rays of a kernel whose only thread takes them all
OF_CAMERA = ("camera", "lens", "blades", "filter", "independent")
OF_CUTOUT = ("instances", "textures", "checkerboards", "cutout")


class SceneRecords(NamedTuple):
    """The device's records of a scene: of its structure, surfaces and lighting, and of the camera."""

    accel: Any
    surfaces: Any
    lighting: Any
    camera: Any


def some(features: Features, names: tuple[str, ...]) -> Features:
    """Only those switches, so that scenes that differ in others share a kernel."""
    return Features(**{name: getattr(features, name) for name in names})


begin_kernel = made_once(wave_begin.make_begin_kernel)
shade_kernels = made_once(wave_shade.make_shade_kernels)
shadow_kernel = made_once(wave.make_shadow_kernel)
aov_kernel = made_once(wave.make_aov_kernel)
begin_aov_kernel = made_once(wave_begin.make_begin_aov_kernel)


@made_once
def queue_kernel(structure: Any, features: Features, any_hit: bool) -> tuple[Any, int]:
    """The structure's kernel for many rays at a time, where it has one, or for one ray after another; and the rays of one of its
    threads. Spheres are always provided for, so that scenes with and without them share it."""
    structure = structure._replace(units=structure.units._replace(spheres=True))
    accepts = make_cutout(features)
    stream = structure.accel.stream
    kernel = stream and stream.make_stream(structure.units, any_hit, RenderRays, accepts)
    if kernel is not None:
        return kernel, ALL
    return make_render_rays_kernel(structure.struct, structure.traversal(any_hit=any_hit, accepts=accepts), any_hit), 1


@dataclass(frozen=True)
class WaveKernels:
    """Those that a picture is made by; None: not needed. block: of queue_kernel."""

    shade: Any
    prepare: Any
    closest_hit: Any
    any_hit: Any
    shadow: Any
    begin: Any
    loop: Any
    begin_aov: Any
    aov: Any
    block: int

    def all(self) -> list[Any]:
        """What takes longest to compile comes first."""
        return [kernel for kernel in vars(self).values() if isinstance(kernel, wp.Kernel)]


def wave_kernels(features: Features, structure: Any, aov: bool) -> WaveKernels:
    """aov: whether AOVs are asked for."""
    default = Features()
    surfaces = replace(features, camera=default.camera, lens=False, blades=False, filter=False, stack_size=default.stack_size)
    cutout, camera = some(features, OF_CUTOUT), import_module(features.camera)
    transparent = features.transparent_shadows
    closest_hit, block = queue_kernel(structure, cutout, False)
    shade, prepare = shade_kernels(surfaces)
    return WaveKernels(
        shade=shade,
        prepare=prepare,
        closest_hit=closest_hit,
        any_hit=queue_kernel(structure, cutout, True)[0] if features.direct_light and not transparent else None,
        shadow=shadow_kernel(surfaces) if transparent else None,
        begin=begin_kernel(some(features, OF_CAMERA), camera),
        loop=wave.make_loop_kernel(transparent),
        begin_aov=begin_aov_kernel(camera) if aov else None,
        aov=aov_kernel(surfaces) if aov else None,
        block=block,
    )


@dataclass(frozen=True)
class Waves:
    """The kernels of a scene, and what their threads work in. features: those that size it; lights: the background among them;
    free: what no thread uses at the moment."""

    kernels: WaveKernels
    features: Features
    lights: int
    free: list[Buffers] = field(default_factory=list)

    def launch(self, scene: SceneRecords, limits: list[Any], film: DeviceFilm | AovFilm) -> Callable[[Work], int]:
        """A function that takes some work's samples into the film, and gives their number; several threads may call it. limits:
        those of each group of the film."""
        recorded: dict[int, Picture | Aovs] = {}

        def trace(work: Work) -> int:
            try:
                buffers = self.free.pop()
            except IndexError:
                buffers = Buffers(self.features, self.lights)
            if id(buffers) not in recorded:
                recorded[id(buffers)] = (Aovs(self, buffers, scene, film) if isinstance(film, AovFilm)
                                         else Picture(self, buffers, scene, limits, film))
            recorded[id(buffers)].take(work)
            self.free.append(buffers)  # not after an error
            return work.total

        return trace


def capacity(features: Features, lights: int) -> int:
    """Samples of a wave."""
    return max(min(CAPACITY, ROOM // max(lights, features.stack_size)), 64)


class Buffers:
    """What one thread works in. task, order: views of the wave's."""

    def __init__(self, features: Features, lights: int) -> None:
        self.capacity = n = capacity(features, lights)
        self.task, self.order = records(state.Task, 1), np.zeros(n, np.int32)
        w = self.wave = state.Wave()
        w.capacity = n
        w.task, w.progress = upload(self.task, state.Task, "cpu"), wp.zeros(1, dtype=state.Progress, device="cpu")
        w.pixels.order = upload(self.order, wp.int32, "cpu")
        w.pixels.key, w.pixels.film_index = room(n, wp.uint32), room(n + LANES, wp.int32)
        w.samples.film_point, w.samples.lens_point = room(n + LANES, wp.vec2), room(n + LANES, wp.vec2)
        w.samples.total, w.samples.pending, w.samples.traced_rays = room(n, Sample), room(n, wp.int32), room(n, wp.int32)
        w.samples.paths = room(n * features.stack_size, state.Path)
        w.queue.sample, w.queue.rays, w.queue.hits = room(n, wp.int32), queue(n), hit_arrays(n)
        w.outcomes.hit_rays, w.outcomes.missed_rays, w.outcomes.resumed_samples = (room(n, wp.int32) for _ in range(3))
        self.allocate_shadows(features.transparent_shadows, lights)
        w.block.rows = room(wave_rows.ROWS * BLOCK, wp.float32)
        self.scratch = new_scratch(BatchTraversal.stream_sizes)

    def allocate_shadows(self, transparent: bool, lights: int) -> None:
        """Allocate what asking lights takes."""
        w, n, slots = self.wave, self.capacity, self.capacity * lights
        w.receivers.sample, w.receivers.pending_light = room(n, wp.int32), room(n, PendingLight)
        w.receivers.shadow = room(slots, wp.int32)
        w.shadows.value, w.shadow_queue.rays = room(slots, wp.vec3), queue(slots)
        w.shadow_queue.count = wp.zeros(max(lights, 1), dtype=wp.int32, device="cpu")
        if transparent:
            w.receivers.scatter, w.shadows.walk = room(n, Scatter), room(slots, ShadowWalk)
            w.shadow_queue.slot, w.shadow_queue.hits = room(slots, wp.int32), hit_arrays(slots)
        else:
            w.shadow_queue.occluded = room(slots, wp.bool)

    def take(self, work: Work, each: Callable[[], None]) -> None:
        """Call `each` for every wave of some work, with its task in place."""
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
                each()


class Picture:
    """The launches of a picture in some buffers, packed once: all that changes from wave to wave is in the buffers."""

    def __init__(self, waves: Waves, buffers: Buffers, scene: SceneRecords, limits: list[Any], film: DeviceFilm) -> None:
        kernels, w = waves.kernels, buffers.wave
        self.buffers, self.kept, self.groups = buffers, Launches(), []
        recorded = self.kept.recorded

        def trace(kernel: Any, rays: Any, out: Any) -> Any:
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

    def take(self, work: Work) -> None:
        """All samples of some work."""
        for group in self.groups:
            self.buffers.take(work, group.launch)


class Aovs:
    """As Picture, of AOVs."""

    def __init__(self, waves: Waves, buffers: Buffers, scene: SceneRecords, film: AovFilm) -> None:
        kernels, w = waves.kernels, buffers.wave
        self.buffers, self.block = buffers, kernels.block
        self.begin = command(kernels.begin_aov, w, scene.camera, film.struct)
        self.aov = command(kernels.aov, w, scene.surfaces, film.struct)
        self.closest_hit = traversal(kernels, kernels.closest_hit, buffers, scene.accel, scene.surfaces, w.queue.rays, w.queue.hits)

    def take(self, work: Work) -> None:
        self.buffers.take(work, self.trace)

    def trace(self) -> None:
        pixels = int(self.buffers.task[0]["pixels"])
        self.begin.launch()
        self.closest_hit.set_dim(-(-pixels // self.block))
        self.closest_hit.set_param_by_name("end", pixels)
        self.closest_hit.launch()
        self.aov.launch()


def command(kernel: Any, *inputs: Any) -> Any:
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)


def traversal(kernels: WaveKernels, kernel: Any, buffers: Buffers, *inputs: Any) -> Any:
    """A launch whose last two arguments are the range of a queue's rays: first, end."""
    return command(kernel, *inputs, *([buffers.scratch] if kernels.block > 1 else []), 0, 0)


def room(n: int, dtype: Any) -> Any:
    return wp.empty(n, dtype=dtype, device="cpu")


def queue(n: int) -> Any:
    out = RenderRays()
    out.origin, out.direction, out.exclude = room(n, wp.vec3), room(n, wp.vec3), room(n, wp.int32)
    out.t_min, out.t_max = wp.zeros(n, dtype=wp.float32, device="cpu"), room(n, wp.float32)
    return out


def hit_arrays(n: int) -> Any:
    out = HitArrays()
    out.t, out.u, out.v, out.prim_id = (room(n, dtype) for dtype in (wp.float32, wp.float32, wp.float32, wp.int32))
    return out


@lru_cache(maxsize=64)
def block_order(width: int, height: int) -> np.ndarray:
    """The pixels of a rectangle (row by row: y * width + x), int32, in squares of 4x4, 2x2 within: neighbours go the same way."""
    y, x = np.mgrid[:height, :width]
    within = (x & 1) | (y & 1) << 1 | (x & 2) << 1 | (y & 2) << 2
    return np.lexsort((within.ravel(), x.ravel() // 4, y.ravel() // 4)).astype(np.int32)
