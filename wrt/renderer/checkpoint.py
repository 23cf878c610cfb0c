"""Checkpoints of long renders: the film in a file, which is replaced as a whole, so that it is never incomplete (wrt.core.files).

A checkpoint is a file with checksums (wrt.core.files). It contains the identity of its render (everything that can change a
pixel), the progress, and the film's arrays. A render can resume from any state between two tiles.
"""

import json
import math
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wrt.core import VERSION
from wrt.core.errors import InputError
from wrt.core.files import check_writable, read_checked, replacing, write_checked
from wrt.core.types import PathLike
from wrt.renderer.film import DeviceFilm
from wrt.renderer.options import OPTIONS
from wrt.renderer.plan import Plan
from wrt.scene.model import digest
from wrt.scene.settings import SETTINGS

MAGIC = b"wrt checkpoint 2\n"
# Options and settings that may change on resume; and `camera` and `device`, since the digest and the kind are compared instead.
NO_PIXEL = ("spp", "exposure", "tonemap", "auto_exposure", "threads", "aov", "time_limit", "target_error", "tile_size", "pass_size",
            "progress", "checkpoint", "checkpoint_every", "resume", "camera", "device", "executor")
HASHES = ("scene", "camera", "kernels")  # parts of the identity whose values tell a reader nothing


class Saved(NamedTuple):
    """Contents of a checkpoint file."""

    samples: tuple[int, int]  # Samples in one group (wrt.renderer.film): of the pixel with the fewest, and of that with the most.
    seconds: float  # Time of tracing.
    identity: dict[str, Any]  # See Checkpoint.
    body: memoryview  # The film's arrays, in the order of DeviceFilm.arrays.


def read(path: PathLike) -> Saved:
    """Read a checkpoint. Raises InputError if the file is missing, damaged, of another version, or no checkpoint."""
    try:
        with read_checked(path, MAGIC, "checkpoint") as (header, body):
            low, high = map(int, header["samples"])
            seconds = float(header["seconds"])
            if not (0 <= low <= high < 1 << 31 and 0.0 <= seconds < math.inf):  # counts of the film are int32
                raise ValueError("out of range")
            return Saved((low, high), seconds, dict(header["identity"]), body)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"is no checkpoint of this version ({type(error).__name__}: {error})", path=path) from error


class Checkpoint:
    """The checkpoint of one render. identity: JSON values that must be equal on resume.

    With `resume`, the constructor reads an existing file and refuses it if its identity differs. Without `resume`, it refuses any
    existing file. It also checks that the file can be written."""

    def __init__(self, path: Path, every: float, identity: dict[str, Any], *, resume: bool) -> None:
        self.path, self.every = path.absolute(), every
        self.identity = json.loads(json.dumps(identity, default=str))
        self.saved: Saved | None = None
        self.problem = ""  # why the newest samples are not saved
        self._last = time.monotonic()
        check_writable(path)
        if os.path.lexists(self.path):
            if not resume:
                raise InputError("exists already", path=path, hint="resume it (--resume, resume=True), or remove it first")
            self.saved = read(self.path)
            was, now = self.saved.identity, self.identity
            differ = [f"other {name}" if name in HASHES else f"{name} was {was.get(name)}, is {now.get(name)}"
                      for name in {**now, **was} if now.get(name) != was.get(name)]
            if differ:
                raise InputError(f"is a checkpoint of another render: {'; '.join(differ)}", path=path)

    def due(self) -> bool:
        """Return True once `every` seconds have passed since the last save."""
        return time.monotonic() - self._last >= self.every

    def save(self, film: DeviceFilm, seconds: float) -> None:
        """Write the film. If that fails, keep the old file and store the reason in `problem`: the render continues, and tries again."""
        samples = film.view(film.groups[0].samples)
        header = {"samples": [int(samples.min()), int(samples.max())], "seconds": seconds, "identity": self.identity}
        try:
            with replacing(self.path) as file:
                write_checked(file, MAGIC, header, (film.view(array) for _, array in film.arrays()))
            self.problem = ""
        except InputError as error:
            self.problem = f"the checkpoint is not saved: {error}"
        self._last = time.monotonic()

    def restore(self, film: DeviceFilm) -> None:
        """Copy the arrays of the file, if there is one, into an empty film."""
        if self.saved is None:
            return
        values, begin = np.frombuffer(self.saved.body, np.uint8), 0
        if len(values) != sum(film.view(array).nbytes for _, array in film.arrays()):
            raise InputError("is damaged: its arrays have the wrong size", path=self.path)
        for _, array in film.arrays():
            old = film.view(array)
            film.put(array, values[begin:begin + old.nbytes].view(old.dtype).reshape(old.shape))
            begin += old.nbytes
        self.saved = self.saved._replace(body=memoryview(b""))  # free the memory of the file's contents


def checkpoint_of(plan: Plan, path: PathLike, kind: str) -> Checkpoint:
    """Return the checkpoint at `path`. kind: kind of the device (prepare.kind_of). Raises InputError if it cannot be written or resumed."""
    options, settings = plan.options, plan.scene.settings
    identity = {name: getattr(settings, name) for name in SETTINGS if name not in NO_PIXEL}
    identity |= {name: getattr(options, name) for name in OPTIONS if name not in NO_PIXEL}
    identity |= {"crop": plan.crop, "groups of samples": plan.groups, "scene": digest(plan.scene),
                 "camera": digest(plan.camera), "device": kind, "version": VERSION, "kernels": plan.kernels_hash()}
    file = Checkpoint(Path(path), options.checkpoint_every, identity, resume=options.resume)
    samples = 0 if file.saved is None else file.saved.samples[1]
    if samples > max(1, settings.spp // plan.groups):
        raise InputError(f"must be {samples * plan.groups} or more, the samples per pixel in this checkpoint; got {settings.spp}",
                         argument="spp", path=file.path)
    return file
