"""Options of a render beyond the scene, and the progress that it reports."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from wrt.accel.scenes.instancing import INSTANCING
from wrt.accel.snapshot import check_units
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_choice, as_integer, as_names, as_one, as_path, as_tuple, require_known, shown, unknown
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.threads import thread_count
from wrt.picture.film import Film
from wrt.scene.cameras import CameraKind
from wrt.scene.settings import SETTINGS, SettingChanges

if TYPE_CHECKING:
    from distributed import Client

AOVS = ("depth", "normal", "albedo", "prim_id", "material_id")
WHOLE = {"seed": (0, 2**32 - 1), "tile_size": (1, 1 << 15), "pass_size": (1, 1 << 24)}  # options with their lowest and highest value


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
    executor: Client | None = None

    def __post_init__(self) -> None:
        for name in ("accel", "device", "triangle", "box", "instancing"):
            as_one(getattr(self, name), str, name)
        ACCELERATORS.check(self.accel, "accel")
        check_units(self.triangle, self.box)
        as_choice(self.instancing, INSTANCING, "instancing")
        self.aov = as_names(self.aov, "aov")
        for name in self.aov:
            require_known(name, AOVS, "AOV", "aov")
        for name in ("time_limit", "target_error", "checkpoint_every"):  # None is valid where it is the default
            value = as_one(getattr(self, name), (int, float, np.number, type(getattr(Options, name))), name)
            if value is not None and not 0.0 < float(value):
                raise InputError(f"must be more than 0, got {value}", argument=name)
        for name, (low, high) in WHOLE.items():
            if getattr(self, name) is not None or getattr(Options, name) is not None:
                setattr(self, name, as_integer(getattr(self, name), name, low, high))
        self.checkpoint = None if self.checkpoint is None else as_path(self.checkpoint, "checkpoint")
        if as_one(self.resume, bool, "resume") and self.checkpoint is None:
            raise InputError("needs a checkpoint", argument="resume", hint="name its file with `checkpoint`")
        if self.crop is not None:
            self.crop = tuple(map(int, as_tuple(self.crop, (int, np.integer), "crop")))  # type: ignore[arg-type, assignment]
            if len(self.crop or ()) != 4:
                raise InputError(f"must be x0, y0, x1, y1 in pixels, got {shown(self.crop)}", argument="crop")
        if not (self.progress is None or callable(self.progress)):
            raise InputError(f"must be a function that takes a Progress, got {shown(self.progress)}", argument="progress")
        as_one(self.camera, (str, int, np.integer, CameraKind, type(None)), "camera")
        as_one(self.accel_options, dict, "accel_options")
        thread_count(self.threads)
        if self.executor is None:
            start(self.device)
        elif not hasattr(self.executor, "get_executor"):  # an attribute of Dask's Client
            raise InputError(f"must be a dask.distributed.Client, got {shown(self.executor)}", argument="executor")


OPTIONS = tuple(each.name for each in fields(Options))


class RenderOptions(SettingChanges, total=False):
    """The keywords of `render`: the scene's settings, and the fields of Options. `inspect` and `profile` take some of them."""

    seed: int
    device: str
    accel: str
    threads: int | None
    camera: str | int | CameraKind | None
    crop: tuple[int, int, int, int] | None
    aov: str | Sequence[str]
    time_limit: float | None
    target_error: float | None
    tile_size: int | None
    pass_size: int | None
    progress: Callable[[Progress], None] | None
    triangle: str
    box: str
    instancing: str
    accel_options: dict[str, object]
    checkpoint: str | os.PathLike[str] | None
    checkpoint_every: float
    resume: bool
    executor: Client | None


# The options that decide on a pixel or on its computation, which `inspect` takes, and those of `profile`.
OF_A_PIXEL = ("seed", "device", "threads", "accel", "accel_options", "triangle", "box", "instancing", "camera")
OF_A_PROFILE = (*OF_A_PIXEL, "crop", "tile_size", "progress")


def split(keywords: RenderOptions, function: str, taken: tuple[str, ...] = OPTIONS) -> tuple[SettingChanges, dict[str, Any]]:
    """Return the settings and the options among the keywords of `function`. Raises InputError for an option that is not in `taken`."""
    for name in keywords:
        if name not in (*SETTINGS, *taken):
            raise unknown(name, f"argument of {function}", (*SETTINGS, *taken), argument=name)
    settings = {name: value for name, value in keywords.items() if name in SETTINGS}
    options = {name: value for name, value in keywords.items() if name not in settings}
    return cast(SettingChanges, settings), options
