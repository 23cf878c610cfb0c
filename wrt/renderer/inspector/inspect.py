"""`wrt.inspect`: every ray of one pixel, as the renderer traces it."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
import warp as wp

from wrt.accel.structure import WrappedStructure
from wrt.core.checks import as_integer, as_tuple, shown, unknown
from wrt.core.device import on_host, start
from wrt.core.errors import InputError
from wrt.core.types import Device
from wrt.io.load import as_scene
from wrt.kernels.loops import record
from wrt.renderer.film import DeviceFilm, Work
from wrt.renderer.inspector.assemble import Assembler
from wrt.renderer.inspector.inspection import Inspection
from wrt.renderer.inspector.tree import Sample
from wrt.renderer.options import Options, PixelOptions
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SETTINGS, SettingChanges

# The options of `render` that choose a pixel's bits, or how they are computed.
OPTIONS = ("seed", "device", "threads", "accel", "accel_options", "triangle", "box", "instancing", "camera")


def inspect(scene: Scene | Mesh | str | os.PathLike[str], pixel: tuple[int, int], sample: int | None = None,
            **options: Unpack[PixelOptions]) -> Inspection:
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
    keywords: dict[str, Any] = {**options}
    scene = as_scene(scene).with_settings(**{name: keywords.pop(name) for name in SETTINGS if name in keywords})
    as_pixel(pixel, scene.settings.size)  # before kernels are compiled
    return Inspector(scene, **keywords).pixel(pixel, sample)


class Inspector:
    """A prepared scene whose pixels are inspected one after another. The arguments are those of `inspect`."""

    def __init__(self, scene: Scene | Mesh | str | os.PathLike[str], **options: Unpack[PixelOptions]) -> None:
        keywords: dict[str, Any] = {**options}
        changes = {name: keywords.pop(name) for name in SETTINGS if name in keywords}
        for name in keywords:
            if name not in OPTIONS:
                raise unknown(name, "argument of inspect", (*SETTINGS, *OPTIONS), argument=name)
        resolved = Options(**keywords)
        self.scene = as_scene(scene).with_settings(**changes)
        plan = plan_of(self.scene, resolved)
        self.camera, self.seed = plan.camera, resolved.seed
        self._recorder = Recorder(plan, start(resolved.device))
        self._assembler = Assembler(self.scene, self._recorder.prepared.arrays.world, plan.features)

    def aim(self, camera: CameraKind, **settings: Unpack[SettingChanges]) -> None:
        """Set the camera and settings of the next inspections. The parameters are those of Prepared.aimed."""
        self.scene, self.camera = self._recorder.aim(camera, **settings).scene, camera

    def pixel(self, pixel: tuple[int, int], sample: int | None = None) -> Inspection:
        """Return the rays of a pixel. pixel, sample: as for `inspect`. Raises InputError if there is no such pixel or sample."""
        settings = self.scene.settings
        x, y = as_pixel(pixel, settings.size)
        if sample is None:
            indices = range(settings.spp)
        else:
            index = as_integer(sample, "sample", 0, settings.spp - 1)
            indices = range(index, index + 1)
        samples = tuple(Sample(i, self._assembler.tree(self._recorder.sample(x, y, i))) for i in indices)
        return Inspection(self.scene, self.camera, (x, y), settings.size, self.seed, samples)


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


# The arrays of a Record in the order of Record.used, with the number of entries of the first attempt.
ARRAYS = {"rays": (record.TracedRay, 256), "ends": (record.PathEnd, 128),
          "lights": (record.AskedLight, 256), "paths": (record.NewPath, 256)}


class Recorder:
    """A scene whose render kernel runs over a structure that records its rays (wrt.kernels.loops.record). plan: the plan of the render."""

    def __init__(self, plan: Plan, device: Device) -> None:
        features = replace(plan.features, recording=True)
        self.prepared = prepare(replace(plan, structure=WrappedStructure(plan.structure, record), features=features), device)
        self.sizes = [size for _, size in ARRAYS.values()]

    def aim(self, camera: CameraKind, **settings: Unpack[SettingChanges]) -> Plan:
        """Set another camera and other settings, as Prepared.aimed does; return the plan with them."""
        self.prepared = self.prepared.aimed(camera, **settings)
        return self.prepared.plan

    def film(self, x: int, y: int) -> DeviceFilm:
        """Return an empty film of one pixel."""
        plan = self.prepared.plan
        return DeviceFilm(plan.scene.settings, (x, y, x + 1, y + 1), self.prepared.device, plan.options.seed)

    def sample(self, x: int, y: int, index: int) -> dict[str, np.ndarray]:
        """Trace one sample of a pixel; return a structured array for each array of Record, by name."""
        device = self.prepared.device
        while True:
            accel = self.prepared.plan.structure.struct()
            accel.accel = self.prepared.accel.data
            accel.record.used = wp.zeros(len(ARRAYS), dtype=wp.int32, device=device)
            for (name, (dtype, _)), size in zip(ARRAYS.items(), self.sizes, strict=True):
                setattr(accel.record, name, wp.zeros(size, dtype=dtype, device=device))
            self.prepared.launch(self.film(x, y), accel)(Work((x, y, 1, 1), index, 1))
            used = accel.record.used.numpy().tolist()
            if all(n <= size for n, size in zip(used, self.sizes, strict=True)):
                return {name: on_host(getattr(accel.record, name))[:n].copy() for name, n in zip(ARRAYS, used, strict=True)}
            self.sizes = [max(n, size) for n, size in zip(used, self.sizes, strict=True)]
