"""Checkpoints of long renders: the film in a file, which is replaced as a whole, so that it is never incomplete (wrt.core.files).

A checkpoint is a file with checksums (wrt.core.checked_file). It contains the identity of its render (everything that can change a
pixel), the progress, and the film's arrays with the number of samples of each pixel. A render can resume from any state between two
tiles. If two renders write the same checkpoint, the file has the film of the render that wrote last.
"""

import json
import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.checked_file import read_checked, write_checked
from wrt.core.errors import InputError
from wrt.core.files import check_writable, replacing
from wrt.core.version import VERSION
from wrt.renderer.film_arrays import DeviceFilm
from wrt.renderer.options import OPTIONS
from wrt.renderer.plan import Plan
from wrt.scene.digest import digest
from wrt.scene.settings import SETTINGS

MAGIC = b"wrt checkpoint 2\n"
# Options and settings that may change on resume; and `camera` and `device`, since the digest and the kind are compared instead.
NO_PIXEL = ("spp", "exposure", "tonemap", "auto_exposure", "threads", "aov", "time_limit", "target_error", "tile_size", "pass_size",
            "progress", "checkpoint", "checkpoint_every", "resume", "camera", "device", "devices", "executor")
# Messages for differing hashes. For other parts of the identity, the message shows both values.
DIFFERENT = {"scene": "the scene differs", "camera": "the camera differs", "kernels": "the kernels have another version"}


@dataclass(frozen=True)
class Saved:
    """Contents of a checkpoint file. Groups of samples: see wrt.renderer.film_arrays."""

    samples: tuple[int, int]  # Samples in one group: of the pixel with the fewest, and of the pixel with the most.
    seconds: float  # Time of tracing.
    identity: dict[str, Any]  # See Checkpoint.
    body: memoryview  # The film's arrays, in the order of DeviceFilm.arrays.


def read(path: str | os.PathLike[str]) -> Saved:
    """Read a checkpoint. Raises InputError if the file is missing, damaged, of another version, or no checkpoint."""
    try:
        with read_checked(path, MAGIC, "checkpoint") as (header, body):
            low, high = map(int, header["samples"])
            if not 0 <= low <= high < 1 << 31:  # counts of the film are int32
                raise ValueError("samples out of range")
            seconds = float(header["seconds"])
            if not 0.0 <= seconds < math.inf:
                raise ValueError(f"{seconds} seconds")
            return Saved((low, high), seconds, dict(header["identity"]), body)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"is no checkpoint of this version ({type(error).__name__}: {error})", path=path) from error


class Checkpoint:
    """The checkpoint of one render. identity: JSON values that must be equal on resume. groups: number of the film's groups of samples.

    With `resume`, the constructor reads an existing file and refuses it if its identity differs. Without `resume`, it refuses any
    existing file. It also checks that the file can be written."""

    def __init__(self, path: Path, every: float, identity: dict[str, Any], *, groups: int, resume: bool) -> None:
        self.path, self.every, self.groups = path.absolute(), every, groups
        self.identity = json.loads(json.dumps(identity, default=str))
        self.saved: Saved | None = None
        self.problem = ""
        check_writable(path)
        if os.path.lexists(self.path):
            if not resume:
                raise InputError("exists already", path=path, hint="resume it (--resume, resume=True), or remove it first")
            self.saved = self._checked(read(self.path))
        self._last = 0.0

    def _checked(self, saved: Saved) -> Saved:
        differ = [name for name in {**self.identity, **saved.identity} if self.identity.get(name) != saved.identity.get(name)]
        if differ != ["kernels"]:
            differ = [name for name in differ if name != "kernels"]  # other settings may compile other kernels
        reported = [DIFFERENT.get(name, f"{name} was {saved.identity.get(name)}, is {self.identity.get(name)}") for name in differ]
        if reported:
            raise InputError(f"is a checkpoint of another render: {'; '.join(reported)}", path=self.path)
        return saved

    def facts(self) -> dict[str, object]:
        """Return the checkpoint's entries of Film.stats."""
        resumed = None if self.saved is None else {"samples": self.saved.samples[0] * self.groups, "seconds": self.saved.seconds}
        return {"checkpoint": None if self.problem else str(self.path), "resumed": resumed}

    # --- writing ------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Start the clock for `due`. Raises InputError if another render has written the file since the constructor looked for it."""
        if self.saved is None and os.path.lexists(self.path):
            raise InputError("exists: another render wrote it meanwhile", path=self.path)
        self._last = time.monotonic()

    def due(self) -> bool:
        """Return True once `every` seconds have passed since the last save."""
        return time.monotonic() - self._last >= self.every

    def save(self, film: DeviceFilm, seconds: float) -> None:
        """Write the film. If writing fails, keep the old file and store the reason in `problem`, so that the render can continue."""
        samples = film.view(film.groups[0].samples)
        header = {"samples": [int(samples.min()), int(samples.max())], "seconds": seconds, "identity": self.identity}
        try:
            with replacing(self.path) as file:
                write_checked(file, MAGIC, header, (film.view(array) for _, array in film.arrays()))
            self.problem = ""
        except (InputError, MemoryError) as error:
            self.problem = f"the checkpoint is not saved: {error}"
        self._last = time.monotonic()

    # --- reading ------------------------------------------------------------------------------------------------------

    def restore(self, film: DeviceFilm) -> None:
        """Copy the arrays of the file into an empty film. Raises InputError if the arrays are invalid."""
        assert self.saved is not None
        if len(self.saved.body) != sum(film.view(array).nbytes for _, array in film.arrays()):
            raise InputError("is damaged: its arrays have the wrong size", path=self.path)
        begin = 0
        for name, array in film.arrays():
            old = film.view(array)
            values = np.frombuffer(self.saved.body[begin:begin + old.nbytes], old.dtype).reshape(old.shape)
            if name.startswith("mean") and not np.isfinite(values).all():  # a kernel never stores such values
                raise InputError("is damaged: its pixels are not finite", path=self.path)
            film.put(array, values)
            begin += old.nbytes
        samples = [film.view(group.samples) for group in film.groups]
        if any((each != samples[0]).any() for each in samples) or (samples[0].min(), samples[0].max()) != self.saved.samples:
            raise InputError("is damaged: its numbers of samples disagree", path=self.path)
        self.saved = replace(self.saved, body=memoryview(b""))  # free the memory of the file's contents


def checkpoint_of(plan: Plan, kind: str) -> Checkpoint | None:
    """Return the checkpoint that the plan's options ask for, or None. kind: kind of the device (wrt.renderer.prepare.kind_of).

    Raises InputError if the checkpoint cannot be written or resumed."""
    options, settings = plan.options, plan.scene.settings
    if options.checkpoint is None:
        return None
    identity = {name: getattr(settings, name) for name in SETTINGS if name not in NO_PIXEL}
    identity |= {name: getattr(options, name) for name in OPTIONS if name not in NO_PIXEL}
    identity |= {"crop": plan.crop, "groups of samples": plan.groups, "scene": digest(plan.scene),
                 "camera": digest(plan.camera), "device": kind, "version": VERSION, "kernels": plan.kernels_hash()}
    file = Checkpoint(Path(options.checkpoint), options.checkpoint_every, identity, groups=plan.groups, resume=options.resume)
    samples = 0 if file.saved is None else file.saved.samples[1]
    if samples > max(1, settings.spp // plan.groups):
        raise InputError(f"must be {samples * plan.groups} or more, the samples per pixel in this checkpoint; got {settings.spp}",
                         argument="spp", path=file.path)
    return file
