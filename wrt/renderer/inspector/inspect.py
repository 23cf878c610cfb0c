"""`wrt.inspect`: every ray of one pixel, as the renderer traces it."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
import warp as wp

from wrt.accel.snapshot import WrappedStructure
from wrt.core.checks import as_integer, as_tuple, shown
from wrt.core.device import on_host, start
from wrt.core.errors import InputError
from wrt.core.files import write_bytes
from wrt.core.types import JsonObject, PathLike
from wrt.io.load import as_scene
from wrt.kernels.loops import record
from wrt.renderer.film import DeviceFilm, Work
from wrt.renderer.inspector.assemble import Assembler
from wrt.renderer.inspector.tree import Sample, as_table, color, ray_lines
from wrt.renderer.options import OF_A_PIXEL, Options, RenderOptions, split
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 4  # samples that are printed


@dataclass(frozen=True, eq=False)
class Inspection:
    """The rays of a pixel. `print` shows them as a tree; `radiance` is the sum over the tree.

    Parameters
    ----------
    scene, camera
        The inspected scene, with the settings of the inspection, and the camera of the picture.
    pixel, size
        x and y from the top left; width and height of the picture.
    seed
        Seed of the samples.
    samples
        The inspected samples: all samples of the pixel, or one.
    """

    scene: Scene = field(repr=False)
    camera: CameraKind = field(repr=False)
    pixel: tuple[int, int]
    size: tuple[int, int]
    seed: int
    samples: tuple[Sample, ...] = field(repr=False)

    @property
    def radiance(self) -> np.ndarray:
        """The mean of the samples, (3,) float32: the bits of the pixel that `render` returns if all samples are inspected.

        The film keeps a running mean in float32, mean += (sample - mean) / n. A sample that is not finite is black, and a sample over
        the setting `clamp` is scaled down."""
        mean, limit = np.zeros(3, np.float32), np.float32(self.scene.settings.clamp)
        with np.errstate(over="ignore", invalid="ignore"):
            for n, sample in enumerate(self.samples, 1):
                radiance = sample.radiance
                radiance = radiance if np.isfinite(radiance.sum()) else np.zeros(3, np.float32)
                if 0.0 < limit < radiance.max():
                    radiance = (limit / radiance.max()) * radiance
                mean = mean + (radiance - mean) / np.float32(n)
        return mean

    def __str__(self) -> str:
        """Return the trees of the first MOST samples, one line for each ray and each light, below a line with the pixel's radiance."""
        (x, y), (width, height), samples = self.pixel, self.size, self.samples
        of = f"sample {samples[0].index}" if len(samples) == 1 else f"the mean of {len(samples)} samples"
        lines = [f"pixel {x},{y} of {width}x{height}, {self.scene.name or 'scene'}: radiance {color(self.radiance)}, {of}"]
        for sample in samples[:MOST]:
            if len(samples) > 1:
                lines.append(f"sample {sample.index}: radiance {color(sample.radiance)}")
            lines += ["the camera has no ray here"] if sample.root is None else ray_lines(sample.root, "", "")
        if len(samples) > MOST:
            lines.append(f"and {len(samples) - MOST} more samples")
        return "\n".join(lines)

    def to_dict(self) -> JsonObject:
        """Return the samples as a JSON object: the fields of Inspection, Sample, Ray and Light, with rays as a flat list.

        A ray has "parent", the index of the ray at whose hit it begins (None for the camera ray), in place of "children".
        Infinity and NaN stay numbers, which JSON lacks: `python -m wrt inspect --json` writes null."""
        head = {"scene": self.scene.name, "camera": self.camera.name, "pixel": list(self.pixel), "size": list(self.size), "seed": self.seed}
        samples = [{"index": each.index, "radiance": each.radiance.tolist(), "rays": as_table(each.rays)} for each in self.samples]
        return head | {"radiance": self.radiance.tolist(), "samples": samples}

    def figure(self, sample: int | None = None) -> Figure:
        """Draw the rays of one sample with matplotlib, in the plane that holds most of them, with the outlines of the shapes there.

        sample: index of the sample; None: the first. Raises InputError if matplotlib is missing, the sample was not inspected, or it has
        no ray."""
        from wrt.renderer.inspector.drawing import figure  # without the drawing, an inspection imports less

        known = {each.index: each for each in self.samples}
        chosen = self.samples[0] if sample is None else known.get(sample)
        if chosen is None or chosen.root is None:
            raise InputError(f"must be an inspected sample with a ray ({min(known)} to {max(known)}), got {sample}", argument="sample")
        return figure(self.scene, self.camera, self.pixel, chosen)

    def save(self, path: PathLike, sample: int | None = None) -> None:
        """Write `figure(sample)` to a file: .png, .svg or .pdf. Raises InputError as `figure`, and if the file cannot be written."""
        from wrt.renderer.inspector.drawing import require_drawable

        target, file = require_drawable(path), io.BytesIO()
        self.figure(sample).savefig(file, format=target.suffix.lower()[1:])
        write_bytes(target, file.getvalue())


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
