"""`wrt.inspect`: every ray of one pixel, as the renderer traces it."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Unpack

import numpy as np
import warp as wp

from wrt.accel.snapshot import WrappedStructure
from wrt.core.checks import as_integer, as_tuple, shown
from wrt.core.device import on_host, start
from wrt.core.errors import InputError
from wrt.io.load import as_scene
from wrt.kernels.loops import record
from wrt.renderer.film import DeviceFilm, Work
from wrt.renderer.inspector.assemble import Assembler
from wrt.renderer.inspector.tree import Inspection, Sample
from wrt.renderer.options import OF_A_PIXEL, Options, RenderOptions, split
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges


def inspect(scene: Scene | Mesh | str | os.PathLike[str], pixel: tuple[int, int], sample: int | None = None,
            **options: Unpack[RenderOptions]) -> Inspection:
    """Trace one pixel as `render` does, and return all of its rays.

    The kernel that renders also records. So the sum over the tree is the pixel of `render` with the same options, bit for bit.

    Parameters
    ----------
    scene
        As for `render`.
    pixel
        x and y in pixels from the top left.
    sample
        Index of the only sample to trace. None: all samples of the pixel.
    **options
        The scene's settings, such as spp, and seed, device, threads, accel, accel_options, triangle, box, instancing and camera, as for
        `render`.

    Returns
    -------
    Inspection
        The tree of rays of each sample.

    Raises
    ------
    InputError
        If the scene cannot be rendered, an option is unknown or wrong, or there is no such pixel or sample.

    Examples
    --------
    >>> tree = wrt.inspect("scenes/whitted.toml", (320, 180), sample=0)
    >>> print(tree)
    >>> tree.save("rays.svg")
    """
    changes, others = split(options, "inspect", OF_A_PIXEL)
    scene = as_scene(scene).with_settings(**changes)
    as_pixel(pixel, scene.settings.size)  # before kernels are compiled
    return Inspector(scene, **others).pixel(pixel, sample)


# The arrays of a Record in the order of Record.used, with the number of entries of the first attempt.
ARRAYS = {"rays": (record.TracedRay, 256), "ends": (record.PathEnd, 128), "lights": (record.AskedLight, 256)}


class Inspector:
    """A prepared scene whose pixels are inspected one after another. The arguments are those of `inspect`.

    Its render kernel runs over a structure that records the rays (wrt.kernels.loops.record)."""

    def __init__(self, scene: Scene | Mesh | str | os.PathLike[str], **options: Unpack[RenderOptions]) -> None:
        changes, others = split(options, "inspect", OF_A_PIXEL)
        resolved = Options(**others)
        self.scene = as_scene(scene).with_settings(**changes)
        plan = plan_of(self.scene, resolved)
        self.camera, self.seed = plan.camera, resolved.seed
        features = replace(plan.features, recording=True)
        recording = replace(plan, structure=WrappedStructure(plan.structure, record), features=features)
        self._prepared = prepare(recording, start(resolved.device))
        self._assembler = Assembler(self.scene, self._prepared.arrays.world, plan.features)
        self._sizes = [size for _, size in ARRAYS.values()]

    def aim(self, camera: CameraKind, **settings: Unpack[SettingChanges]) -> None:
        """Set the camera and settings of the next inspections. The parameters are those of Prepared.aimed."""
        self._prepared = self._prepared.aimed(camera, **settings)
        self.scene, self.camera = self._prepared.plan.scene, camera

    def pixel(self, pixel: tuple[int, int], sample: int | None = None) -> Inspection:
        """Return the rays of a pixel. pixel, sample: as for `inspect`. Raises InputError if there is no such pixel or sample."""
        settings = self.scene.settings
        x, y = as_pixel(pixel, settings.size)
        indices = range(settings.spp) if sample is None else [as_integer(sample, "sample", 0, settings.spp - 1)]
        samples = tuple(Sample(i, self._assembler.tree(self._records(x, y, i))) for i in indices)
        return Inspection(self.scene, self.camera, (x, y), settings.size, self.seed, samples)

    def _records(self, x: int, y: int, index: int) -> dict[str, np.ndarray]:
        """Trace one sample of a pixel; return a structured array for each array of Record, by name."""
        plan, device = self._prepared.plan, self._prepared.device
        while True:
            accel = plan.structure.struct()
            accel.accel = self._prepared.accel.data
            accel.record.used = wp.zeros(len(ARRAYS), dtype=wp.int32, device=device)
            for (name, (dtype, _)), size in zip(ARRAYS.items(), self._sizes, strict=True):
                setattr(accel.record, name, wp.zeros(size, dtype=dtype, device=device))
            film = DeviceFilm(plan.scene.settings, (x, y, x + 1, y + 1), device, plan.options.seed)
            self._prepared.launch(film, accel)(Work((x, y, 1, 1), index, 1))
            used = accel.record.used.numpy().tolist()
            if all(n <= size for n, size in zip(used, self._sizes, strict=True)):
                return {name: on_host(getattr(accel.record, name))[:n].copy() for name, n in zip(ARRAYS, used, strict=True)}
            self._sizes = [max(n, size) for n, size in zip(used, self._sizes, strict=True)]


def as_pixel(pixel: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
    """Return x and y of a pixel. Raises InputError if it is outside the picture of this size."""
    numbers = as_tuple(pixel, (int, np.integer), "pixel")
    if len(numbers) != 2:
        raise InputError(f"must be x, y from the top left, got {shown(pixel)}", argument="pixel")
    (x, y), (width, height) = (as_integer(each, "pixel", -2**31, 2**31) for each in numbers), size
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"must be within the picture of {width}x{height}, x 0 to {width - 1} and y 0 to {height - 1}, got {x},{y}",
                         argument="pixel")
    return x, y
