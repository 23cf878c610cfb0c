"""Options of a render beyond the scene, and the progress that it reports."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from wrt.accel.scenes.instancing import INSTANCING
from wrt.accel.snapshot import check_units
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_choice, as_integer, as_names, as_one, as_path, as_tuple, did_you_mean, shown
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.threads import thread_count
from wrt.picture.film import Film
from wrt.scene.cameras import CameraKind
from wrt.scene.settings import SettingChanges

if TYPE_CHECKING:
    from distributed import Client

AOVS = ("depth", "normal", "albedo", "prim_id", "material_id")


@dataclass(frozen=True)
class Progress:
    """Progress of a render, which its callback receives. All numbers of a resumed render include the work before the resume.

    Parameters
    ----------
    done, total
        Number of samples done, and of all samples, summed over the pixels. Before the stage "trace": percent done, and 100.
    rays, seconds
        Number of rays traced so far, and seconds of tracing. Before the stage "trace": 0, and seconds since preparing began.
    stage
        "trace" while rays are traced. Before: "compile", once, if kernels are compiled for over half a second (otherwise the logger
        "wrt" reports that); "build", if building takes over a second.
    note
        Text about a problem that does not end the render, or "".
    picture
        Function that returns a Film of the samples so far, with pixels, variance and samples only. Running tiles may be incomplete.
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
        """Mean number of rays per second so far; 0 before tracing."""
        return self.rays / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def seconds_left(self) -> float:
        """Estimated seconds left, at the mean speed so far; inf before the first sample."""
        return self.seconds * (self.total - self.done) / self.done if self.done else float("inf")


@dataclass
class Options:
    """The options of `render` as one object, without the scene's settings. The docstring of `render` defines each option.

    Raises
    ------
    InputError
        If an option has the wrong type, is out of range or contradicts another.
    """

    seed: int = 0
    device: str = DEFAULT_DEVICE
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
    accel_options: dict[str, object] = field(default_factory=dict)
    checkpoint: str | os.PathLike[str] | None = None
    checkpoint_every: float = 60.0
    resume: bool = False
    devices: Sequence[str] | None = None
    executor: Executor | Client | None = None

    def __post_init__(self) -> None:
        for name in ("accel", "device", "triangle", "box", "instancing"):
            as_one(getattr(self, name), str, name)
        ACCELERATORS.check(self.accel, "accel")
        check_units(self.triangle, self.box)
        as_choice(self.instancing, INSTANCING, "instancing")
        self.aov = as_names(self.aov, "aov")
        no_aov = sorted(set(self.aov) - set(AOVS))
        if no_aov:
            raise InputError(f"no AOV {', '.join(no_aov)}",
                             argument="aov", hint=f"{did_you_mean(no_aov[0], AOVS)}there is {', '.join(AOVS)}")
        for name in ("time_limit", "target_error"):
            as_one(getattr(self, name), (int, float, np.number, type(None)), name)
        if self.time_limit is not None and not self.time_limit > 0.0:
            raise InputError(f"must be more than 0 seconds, got {self.time_limit}", argument="time_limit")
        if self.target_error is not None and not 0.0 < self.target_error < math.inf:
            raise InputError(f"must be more than 0 and finite, got {self.target_error}", argument="target_error")
        as_one(self.checkpoint_every, (int, float, np.number), "checkpoint_every")
        if not self.checkpoint_every > 0.0:
            raise InputError(f"must be more than 0 seconds, got {self.checkpoint_every}", argument="checkpoint_every")
        self.checkpoint = None if self.checkpoint is None else as_path(self.checkpoint, "checkpoint")
        if as_one(self.resume, bool, "resume") and self.checkpoint is None:
            raise InputError("needs a checkpoint", argument="resume", hint="name its file with `checkpoint`")
        self.tile_size = None if self.tile_size is None else as_integer(self.tile_size, "tile_size", 1, 1 << 15)
        self.pass_size = None if self.pass_size is None else as_integer(self.pass_size, "pass_size", 1, 1 << 24)
        self.seed = as_integer(self.seed, "seed", 0, 2**32 - 1)
        if self.crop is not None:
            self.crop = tuple(map(int, as_tuple(self.crop, (int, np.integer), "crop")))  # type: ignore[arg-type, assignment]
            if len(self.crop or ()) != 4:
                raise InputError(f"must be x0, y0, x1, y1 in pixels, got {shown(self.crop)}", argument="crop")
        if not (self.progress is None or callable(self.progress)):
            raise InputError(f"must be a function that takes a Progress, got {shown(self.progress)}", argument="progress")
        as_one(self.camera, (str, int, np.integer, CameraKind, type(None)), "camera")
        as_one(self.accel_options, dict, "accel_options")
        as_one(self.threads, (int, np.integer, type(None)), "threads")
        thread_count(self.threads)
        if self.devices is not None:
            self._check_devices()
        elif self.executor is None:
            start(self.device)
        elif not (isinstance(self.executor, Executor) or hasattr(self.executor, "get_executor")):  # an attribute of Dask's Client
            raise InputError("must be a concurrent.futures.Executor or a dask.distributed.Client,"
                             f" got {shown(self.executor)}", argument="executor")

    def _check_devices(self) -> None:
        self.devices = as_tuple(self.devices, str, "devices")
        if self.executor is not None:
            raise InputError("and executor exclude each other", argument="devices", hint="each worker of an executor uses `device`")
        kinds = {str(device.arch) if device.is_cuda else "cpu" for device in map(start, self.devices)}
        if len(kinds) != 1:
            raise InputError(f"must be one or more devices of one kind, since others round differently, got {shown(self.devices)}",
                             argument="devices")
        self.device = self.devices[0]


OPTIONS = tuple(each.name for each in fields(Options))


class PixelOptions(SettingChanges, total=False):
    """The keywords of `inspect`: the scene's settings, and those fields of Options that decide on a pixel or on its computation."""

    seed: int
    device: str
    accel: str
    threads: int | None
    camera: str | int | CameraKind | None
    triangle: str
    box: str
    instancing: str
    accel_options: dict[str, object]


class ProfileOptions(PixelOptions, total=False):
    """The keywords of `profile`."""

    crop: tuple[int, int, int, int] | None
    tile_size: int | None
    progress: Callable[[Progress], None] | None


class RenderOptions(ProfileOptions, total=False):
    """The keywords of `render`: the scene's settings, and the fields of Options."""

    aov: str | Sequence[str]
    time_limit: float | None
    target_error: float | None
    pass_size: int | None
    checkpoint: str | os.PathLike[str] | None
    checkpoint_every: float
    resume: bool
    devices: Sequence[str] | None
    executor: Executor | Client | None
