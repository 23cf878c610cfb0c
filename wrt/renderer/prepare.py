"""Preparation of a scene for one device: kernels compiled, arrays uploaded, acceleration structure built."""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, wait
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Unpack

import numpy as np

from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.scenes.build import build
from wrt.core.compiling import WATCH
from wrt.core.device import load_kernel, start
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.threads import FreeList, Pool, run_all, thread_count
from wrt.core.types import Device, Kernel, WarpStruct
from wrt.core.warp_private import short_name
from wrt.renderer.film import OF_AOVS, AovFilm, DeviceFilm, Rectangle, Work, corners, tiles
from wrt.renderer.launches import CAPACITY, Buffers, SceneRecords, Waves, aov_launch, film_launch
from wrt.renderer.options import Options, Progress
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.upload import DeviceScene, camera_struct, upload_scene
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges
from wrt.scene.shapes import icosphere

TILE_SIZE = 32  # Smallest side of a tile on the CPU, in pixels.
TILES_EACH = 8  # Tiles of a pass for each thread, or more.
PREPARING = "wrt prepares"  # Name of the threads that compile and build.
PREPARING_REPORTED = 1.0  # Seconds after which building is reported.


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene that is ready to render on one device.

    - kernels: Plan.kernels, compiled. camera: the device's struct Camera. waves: None unless Plan.by_waves.
    - seconds: time of the stages "upload" and "build", and of "compile", which runs in parallel until the last kernel is loaded.
    """

    plan: Plan
    device: Device
    threads: int
    kernels: list[Kernel]
    arrays: DeviceScene
    accel: Accelerator
    camera: WarpStruct
    waves: Waves | None
    seconds: dict[str, float]

    def aimed(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Unpack[SettingChanges]) -> "Prepared":
        """Return this scene with another camera and other settings; Plan.aimed says which.

        angles_of: width and height whose ratio is the camera's aspect ratio. None: the picture's own width and height."""
        plan = self.plan.aimed(camera, **settings)
        plan.require_memory(self.device)
        return replace(self, plan=plan, camera=camera_struct(camera, angles_of or plan.scene.settings.size))

    def facts(self) -> dict[str, object]:
        """Return entries of Film.stats: the counts of triangles and spheres, and the structure's statistics."""
        return {"triangles": self.accel.geometry.n_triangles, "stored_triangles": len(self.arrays.world.faces),
                "spheres": len(self.accel.geometry.spheres),
                "accel": {"name": self.plan.accel, **asdict(self.accel.stats)}}

    def tiles(self, samples: int) -> Iterator[Rectangle]:
        """Yield the tiles of a pass with `samples` samples per pixel.

        On CUDA, one tile is the whole crop. On the CPU, a tile fills about two waves, or less if each thread would get too few tiles."""
        x0, y0, x1, y1 = self.plan.crop
        side = TILE_SIZE
        if self.device.is_cuda:
            side = max(x1 - x0, y1 - y0)
        elif self.waves is not None:
            pixels = min(2 * CAPACITY / samples, self.plan.area / (TILES_EACH * self.threads))
            side = 1 << int(0.5 * math.log2(max(pixels, TILE_SIZE**2)))
        return tiles(self.plan.crop, side if self.device.is_cuda else self.plan.options.tile_size or side)

    def launch(self, film: DeviceFilm | AovFilm, accel: WarpStruct | None = None) -> Callable[[Work], int]:
        """Return a function that traces the samples of a Work, adds them to the film, and returns their number.

        accel: device struct to use in place of self.accel.data."""
        accel = self.accel.data if accel is None else accel
        scene = SceneRecords(accel, self.arrays.surfaces, self.arrays.lighting, self.camera)
        limits = [] if isinstance(film, AovFilm) else [self.plan.limits(seed) for seed in film.seeds]
        if self.waves is not None:
            return self.waves.launch(scene, limits, film)
        if isinstance(film, AovFilm):
            return aov_launch(self.device, self.kernels[1], scene, film)
        by_pixels = self.device.is_cpu or bool(self.plan.structure.units.observer)
        return film_launch(self.device, self.kernels[0], scene, limits, film, by_pixels)

    # --- called by workers (wrt.renderer.workers) ---

    def ready(self) -> dict[str, object]:
        return {"facts": self.facts(), "seconds": self.seconds}

    def trace_tile(self, work: Work, seed: int, state: list[np.ndarray] | None) -> list[np.ndarray]:
        """Return `state`, the arrays of DeviceFilm.arrays for the rectangle (None: zeros), with the samples of `work` added.

        This method has no side effects, so that several threads can call it, and a failed call can be repeated."""
        film = DeviceFilm(self.plan.scene.settings, corners(work.rectangle), self.device, seed, self.plan.groups)
        for (_, array), values in zip(film.arrays(), state or (), strict=False):
            film.put(array, values)
        self.launch(film)(work)
        return [film.picture(array) for _, array in film.arrays()]

    def aov_tile(self, work: Work) -> list[np.ndarray]:
        """Return the AOVs of the rectangle of `work`, in the order of Options.aov."""
        film = AovFilm(self.plan.scene.settings, corners(work.rectangle), self.device)
        self.launch(film)(work)
        return [film.picture(name) for name in self.plan.options.aov]


def kind_of(device: Device) -> str:
    """Return the kind of a device as text. Devices of one kind render the same bits."""
    return f"cuda, sm_{device.arch}" if device.is_cuda else "cpu"


def prepare(plan: Plan, device: Device) -> Prepared:
    """Compile kernels, upload arrays, and build the structure. Raises InputError if the scene cannot be rendered."""
    work = _Preparation(plan, device)
    work.run()
    lights = work.arrays.lighting.count + plan.features.extra_lights
    waves = Waves(plan.wave_kernels, lights, FreeList(partial(Buffers, plan.features, lights))) if plan.by_waves else None
    camera = camera_struct(plan.camera, plan.scene.settings.size)
    return Prepared(plan, device, work.threads, work.kernels, work.arrays, work.accel, camera, waves, work.seconds)


class _Preparation:
    """Threads that prepare a scene: one thread uploads and builds, while the other threads compile."""

    arrays: DeviceScene
    accel: Accelerator

    def __init__(self, plan: Plan, device: Device) -> None:
        self.plan, self.device, self.kernels = plan, device, plan.kernels
        self.threads = thread_count(plan.options.threads)
        self.begin, self.seconds = time.perf_counter(), {"compile": 0.0}
        self.fraction_built, self.reported = 0.0, ("", 0)

    def run(self) -> None:
        """Build and compile. Ctrl-C, which Python handles between short waits, and an error end it without waiting for the compiler."""
        progress = self.plan.options.progress
        pool = Pool(1 + min(self.threads, len(self.kernels)), PREPARING)
        jobs: list[Callable[[], None]] = [self.build, *(partial(self.compile, kernel) for kernel in self.kernels)]
        pending = {pool.submit(job) for job in jobs}
        with nullcontext() if progress is None else WATCH.reported_by_caller():
            try:
                while pending:
                    finished, pending = wait(pending, timeout=0.1, return_when=FIRST_EXCEPTION)
                    for job in finished:
                        job.result()
                    if pending and progress is not None:
                        self._report(progress, time.perf_counter() - self.begin)
            finally:
                pool.shutdown(wait=False, cancel_futures=True)

    def _report(self, progress: Callable[[Progress], None], seconds: float) -> None:
        """Call `progress` if the stage or its percentage has changed, and the stage takes long."""
        stage, done = ("build", int(100.0 * self.fraction_built)) if self.fraction_built > 0.0 else ("compile", 0)
        if (stage, done) != self.reported and (seconds >= PREPARING_REPORTED if stage == "build" else WATCH.is_slow()):
            self.reported = stage, done
            progress(Progress(done, 100, 0, seconds, stage=stage))

    def compile(self, kernel: Kernel) -> None:
        load_kernel(kernel, self.device)
        self.seconds["compile"] = time.perf_counter() - self.begin

    def build(self) -> None:
        options = self.plan.options
        begin = time.perf_counter()
        self.arrays = upload_scene(self.plan.scene, self.device, self.plan.meshes)
        uploaded = time.perf_counter()
        chosen: dict[str, Any] = {"triangle": options.triangle, "box": options.box, **options.accel_options}
        self.accel = build(self.arrays.world.geometry, self.plan.accel, options.device, self.threads,
                           progress=partial(setattr, self, "fraction_built"), **chosen)
        self.fraction_built = 0.0  # what takes long from now on is compiling
        self.seconds |= {"upload": uploaded - begin, "build": time.perf_counter() - uploaded}


# --- ahead of time, for containers and the workers of a cluster -----------------------------------------------------------


def compile_queries(accel: str, device: str = DEFAULT_DEVICE) -> list[str]:
    """Compile the kernels that build and query an acceleration structure; return their names. Raises InputError for an unknown name."""
    structure = build(icosphere(2), accel, device)
    rays = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    structure.closest_hit(*rays)
    structure.any_hit(*rays)
    return ["closest_hit", "any_hit"]


def compile_picture(scene: Scene, accel: str, device: str = DEFAULT_DEVICE, threads: int = 1) -> list[str]:
    """Compile the kernels that render a scene with all AOVs; return their names. Raises InputError if the scene cannot be rendered."""
    target = start(device)
    kernels = plan_of(scene, Options(accel=accel, device=device, aov=tuple(OF_AOVS))).kernels
    run_all([partial(load_kernel, kernel, target) for kernel in kernels], threads)
    return [short_name(kernel) for kernel in kernels]
