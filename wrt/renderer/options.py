"""What a render is asked for beyond the scene, and what it reports while it runs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from wrt.accel.scenes.instancing import INSTANCING
from wrt.accel.structure import check_units
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_choice, as_integer, as_names, as_one, as_path, as_tuple, did_you_mean, shown
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.picture.film import Film
from wrt.scene.cameras import CameraKind

AOVS = ("depth", "normal", "albedo", "prim_id", "material_id")


@dataclass(frozen=True)
class Progress:
    """How far a render is: samples done and to do (summed over pixels), rays so far, seconds of tracing.

    Of a resumed render, what was done before counts in all four. stage: "trace"; or before anything is traced, where that takes
    longer than wrt.renderer.prepare.PREPARING_REPORTED: "compile", once, or "build", with done of total steps of a structure that
    is slow to build.
    note: what goes wrong meanwhile; "" is nothing. picture: makes a Film of what there is (pixels, variance, samples), while
    it is traced; tiles that run are half done in it.
    """

    done: int
    total: int
    rays: int
    seconds: float
    stage: str = "trace"
    note: str = ""
    picture: Callable[[], Film] | None = field(default=None, compare=False, repr=False)

    @property
    def rays_per_second(self) -> float:
        """The mean so far; 0 before anything is traced."""
        return self.rays / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def seconds_left(self) -> float:
        """At the mean speed so far; inf before anything is done."""
        return self.seconds * (self.total - self.done) / self.done if self.done else float("inf")


@dataclass
class Options:
    """How to render, beyond what the scene says. tile_size, pass_size: pixels a side and samples at once (None: chosen); never
    change a pixel. crop: x0, y0, x1, y1 in pixels. time_limit in seconds of tracing; the first sample of each pixel is always
    taken. instancing: which meshes that several objects share are kept once (wrt.accel.scenes.instancing).

    devices: several of this machine, of one kind ("cuda:0", "cuda:1"), that share the tiles, in place of `device`. executor: a
    concurrent.futures.Executor or a dask.distributed.Client whose workers trace the tiles on their `device` (docs/cluster.md);
    neither changes a pixel.

    target_error: stop when the estimated error of the picture is no larger: the root mean square, over its pixels and
    channels, of the standard error in linear radiance. It is noise alone: what max_depth and min_throughput cut off is not
    in it. A pixel's samples are then split over GROUPS independent sequences (wrt.renderer.film_arrays), and spp is the most to
    take (rounded down to a multiple of GROUPS; one a group at least). The estimate is looked at when a group has 1, 2, 4, 8 ...
    samples: only then is its sequence as even as it can be.

    checkpoint: a file that the work so far is written to every `checkpoint_every` seconds, and when a render ends early or is
    done; it stays. A file that is there already is refused, unless `resume` says to go on with it: the picture is then that of
    an uninterrupted render, bit for bit. Where there is none, `resume` begins anew (wrt.renderer.checkpoint)."""

    seed: int = 0
    device: str = "cpu"
    accel: str = "bvh"
    threads: int | None = None
    camera: str | int | CameraKind | None = None
    crop: tuple[int, int, int, int] | None = None
    aov: Sequence[str] = ()
    time_limit: float | None = None
    target_error: float | None = None
    tile_size: int | None = None
    pass_size: int | None = None
    progress: Callable[[Progress], None] | None = None
    triangle: str = "watertight"
    box: str = "conservative"
    instancing: str = "auto"
    accel_options: dict[str, Any] = field(default_factory=dict)
    checkpoint: str | os.PathLike[str] | None = None
    checkpoint_every: float = 60.0
    resume: bool = False
    devices: Sequence[str] | None = None
    executor: Any = None

    def __post_init__(self) -> None:
        for name in ("accel", "device", "triangle", "box", "instancing"):
            as_one(getattr(self, name), str, name)
        ACCELERATORS.check(self.accel)
        check_units(self.triangle, self.box)
        as_choice(self.instancing, INSTANCING, "instancing")
        self.aov = as_names(self.aov, "aov")
        no_aov = sorted(set(self.aov) - set(AOVS))
        if no_aov:
            raise InputError(f"no AOV {', '.join(no_aov)}; {did_you_mean(no_aov[0], AOVS)}there is {', '.join(AOVS)}")
        for name in ("time_limit", "target_error"):
            as_one(getattr(self, name), (int, float, np.number, type(None)), name)
        if self.time_limit is not None and not self.time_limit > 0.0:
            raise InputError(f"time_limit must be more than 0 seconds, got {self.time_limit}")
        if self.target_error is not None and not 0.0 < self.target_error < math.inf:
            raise InputError(f"target_error must be more than 0 and finite, got {self.target_error}")
        as_one(self.checkpoint_every, (int, float, np.number), "checkpoint_every")
        if not self.checkpoint_every > 0.0:
            raise InputError(f"checkpoint_every must be more than 0 seconds, got {self.checkpoint_every}")
        self.checkpoint = None if self.checkpoint is None else as_path(self.checkpoint, "checkpoint")
        if as_one(self.resume, bool, "resume") and self.checkpoint is None:
            raise InputError("resume needs a checkpoint to go on with")
        self.tile_size = None if self.tile_size is None else as_integer(self.tile_size, "tile_size", 1, 1 << 15)
        self.pass_size = None if self.pass_size is None else as_integer(self.pass_size, "pass_size", 1, 1 << 24)
        self.seed = as_integer(self.seed, "seed", 0, 2**32 - 1)
        if self.crop is not None and len(as_tuple(self.crop, (int, np.integer), "crop")) != 4:
            raise InputError(f"crop must be x0, y0, x1, y1 in pixels, got {self.crop!r}")
        if not (self.progress is None or callable(self.progress)):
            raise InputError(f"progress must be a function of a Progress, got {shown(self.progress)}")
        as_one(self.camera, (str, int, np.integer, CameraKind, type(None)), "camera")
        as_one(self.accel_options, dict, "accel_options")
        as_one(self.threads, (int, np.integer, type(None)), "threads")
        thread_count(self.threads)
        if self.devices is not None:
            self._check_devices()
        elif self.executor is None:
            start(self.device)
        elif not (isinstance(self.executor, Executor) or hasattr(self.executor, "get_executor")):  # as Dask's Client has
            raise InputError("executor must be a concurrent.futures.Executor or a dask.distributed.Client,"
                             f" got {shown(self.executor)}")

    def _check_devices(self) -> None:
        self.devices = as_tuple(self.devices, str, "devices")
        if self.executor is not None:
            raise InputError("devices are of this machine; an executor's workers have one `device` each: give one or the other")
        kinds = {str(device.arch) if device.is_cuda else "cpu" for device in map(start, self.devices)}
        if len(kinds) != 1:
            raise InputError(f"devices must be one or more of the same kind, whose pixels are the same, got {shown(self.devices)}")
        self.device = self.devices[0]


OPTIONS = tuple(each.name for each in fields(Options))
