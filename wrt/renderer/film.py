"""The film on the device, and the tiles of a picture. With a target error, a pixel's samples form groups, which estimate the error."""

import math
from collections.abc import Iterator
from copy import copy
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.core.device import upload
from wrt.core.types import Device, WarpArray
from wrt.kernels.shade import film as device_film
from wrt.scene.settings import MAX_DEPTH, Settings

Rectangle = tuple[int, int, int, int]  # x, y, width, height
# Number of groups with a target error; each is an independent sequence. Eight groups estimate a picture's error no better than four. They
# have up to 1.4 times the error of four, because longer sequences converge faster.
GROUPS = 4
# Bytes per pixel: a film with one group and the picture written from it; each further group; AOVs.
BYTES_OF_FILM, BYTES_OF_GROUP, BYTES_OF_AOVS = 136, 20, 36
OF_A_GROUP = {"mean": wp.vec3, "samples": wp.int32, "lost": wp.float32}
FEW = 0.003  # Share of the pixels that is too small to be noticed if they are too dark: 26x26 pixels of 640x360. Fewer look like noise.
VISIBLE = 0.05  # Smallest difference, as a share of the surrounding brightness, that people see in a detail of a few pixels.
SHARED = {"m2": wp.vec3, "rays": wp.int64, "cut_depth": wp.int32, "cut_throughput": wp.int32, "not_finite": wp.int32,
          "clamped": wp.float32}
OF_AOVS = {"depth": wp.float32, "normal": wp.vec3, "albedo": wp.vec3, "prim_id": wp.int32, "material_id": wp.int32}


class Work(NamedTuple):
    """Work for a tracer: the samples `first` to `first + n - 1` of each pixel of a rectangle."""

    rectangle: Rectangle
    first: int
    n: int

    @property
    def total(self) -> int:
        """Number of samples, summed over the pixels."""
        return self.rectangle[2] * self.rectangle[3] * self.n


def tiles(crop: tuple[int, int, int, int], step: int) -> Iterator[Rectangle]:
    """Yield the tiles that cover `crop` (x0, y0, x1, y1), row by row: squares of side `step`, cut at the right and bottom edges."""
    x0, y0, x1, y1 = crop
    for y in range(y0, y1, step):
        for x in range(x0, x1, step):
            yield x, y, min(step, x1 - x), min(step, y1 - y)


def corners(rectangle: Rectangle) -> tuple[int, int, int, int]:
    """Return x0, y0, x1, y1 of a rectangle x, y, width, height."""
    x, y, width, height = rectangle
    return x, y, x + width, y + height


@cache
def filter_icdf(name: str, size: int = 4097) -> np.ndarray:
    """Return the inverse cumulative distribution of a pixel filter along x or y, (size,) float32, in pixels from the centre.

    gaussian: standard deviation 0.5, cut at 1.5 pixels; blackman-harris: the four-term window, 3 pixels wide (Harris 1978). Kernels
    interpolate linearly, which widens the tails: with 4097 entries the standard deviation is off by 2e-4, with 257 by 8e-3."""
    x = np.linspace(-1.5, 1.5, 20001)
    if name == "gaussian":
        density = np.exp(-2.0 * x * x) - np.exp(-2.0 * 1.5 * 1.5)
    elif name == "blackman-harris":
        phase = 2.0 * np.pi * (x / 3.0 + 0.5)
        density = 0.35875 - 0.48829 * np.cos(phase) + 0.14128 * np.cos(2 * phase) - 0.01168 * np.cos(3 * phase)
    else:
        return np.zeros(2, np.float32)
    cdf = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return np.interp(np.linspace(0.0, 1.0, size), cdf / cdf[-1], x).astype(np.float32)


class DeviceFilm:
    """The film of the render kernel: arrays with one entry for each pixel of the crop, and a struct Film and a seed for each group.

    The samples of a group form one scrambled sequence. Its points are evenly spread, so that the variance of the samples overestimates
    the error of their mean. Groups with different scrambles have independent means. The variance of these means, divided by the number
    of groups, estimates the variance of the pixel without bias (Owen 1997, "Monte Carlo Variance of Scrambled Net Quadrature")."""

    def __init__(self, settings: Settings, crop: tuple[int, int, int, int], device: Device, seed: int, groups: int = 1) -> None:
        self.crop, self.seed = crop, seed
        self.seeds = [seed] if groups == 1 else [int(s) for s in np.random.SeedSequence(seed).generate_state(groups)]
        x0, y0, x1, y1 = crop
        self.shape = y1 - y0, x1 - x0
        n = self.shape[0] * self.shape[1]
        shared = {name: wp.zeros(n, dtype=dtype, device=device) for name, dtype in SHARED.items()}
        shared["filter_icdf"] = upload(filter_icdf(settings.filter), wp.float32, device)
        self.groups = []
        for _ in self.seeds:
            own = {name: wp.zeros(n, dtype=dtype, device=device) for name, dtype in OF_A_GROUP.items()}
            film = device_film.Film()
            film.width, film.height = settings.size
            film.x, film.y, film.columns = x0, y0, x1 - x0
            film.clamp = settings.clamp
            for name, array in {**shared, **own}.items():
                setattr(film, name, array)
            self.groups.append(film)
        self._read: dict[int, np.ndarray] | None = None  # in a snapshot: host copies of arrays, by device address

    def snapshot(self) -> "DeviceFilm":
        """Return a read-only copy of this object. The copy fetches each array from a GPU only once, at its first use."""
        out = copy(self)
        out._read = {}
        return out

    def arrays(self) -> list[tuple[str, WarpArray]]:
        """Return name and array for all arrays that samples change: the arrays that the groups share, then the arrays of each group."""
        own = [(f"{name} of group {i}", getattr(film, name)) for i, film in enumerate(self.groups) for name in OF_A_GROUP]
        return [(name, getattr(self.groups[0], name)) for name in SHARED] + own

    def put(self, array: WarpArray, values: np.ndarray) -> None:
        """Write values, (H, W) or (H, W, 3), to a device array."""
        array.assign(values.reshape(array.shape[0], *values.shape[2:]))

    def view(self, array: WarpArray) -> np.ndarray:
        """Return a device array with one entry for each pixel as (H, W) or (H, W, 3). On the CPU, this makes no copy."""
        pixels = None if self._read is None else self._read.get(array.ptr)
        if pixels is None:
            pixels = array.numpy()
            if self._read is not None:
                self._read[array.ptr] = pixels
        return pixels.reshape(*self.shape, *pixels.shape[1:])

    def picture(self, array: WarpArray) -> np.ndarray:
        """Return a copy of `view`."""
        return self.view(array).copy()

    def count(self, name: str) -> int:
        """Return the sum over all pixels of an array of counts. name: its key in SHARED, such as "rays"."""
        return int(self.view(getattr(self.groups[0], name)).sum(dtype=np.int64))

    def lost_throughput(self) -> float:
        """Return the sum of the throughputs of all cut rays, over all samples and pixels."""
        return sum(float(self.picture(film.lost).sum(dtype=np.float64)) for film in self.groups)

    def clamped_share(self) -> float:
        """Return the share of the samples' radiance that Settings.clamp took away."""
        clamped = float(self.view(self.groups[0].clamped).sum(dtype=np.float64))
        left = sum(float((self.view(film.mean).mean(axis=2, dtype=np.float64) * self.view(film.samples)).sum()) for film in self.groups)
        return clamped / (left + clamped) if clamped > 0.0 else 0.0

    def lost_by_depth(self, most_by_throughput: float) -> np.ndarray:
        """Return lower bounds of what rays cut by max_depth would have added to the pixels in surroundings of radiance 1, (H, W) float64.

        most_by_throughput: upper bound of the throughput of one ray cut by min_throughput, which `lost` contains, too."""
        film = self.groups[0]
        lost = sum((self.view(group.lost) for group in self.groups[1:]), self.view(film.lost))
        by_depth = np.where(self.view(film.cut_depth) > 0, lost - most_by_throughput * self.view(film.cut_throughput), 0.0)
        return np.asarray(np.maximum(by_depth, 0.0) / np.maximum(self.samples(), 1))

    def samples(self) -> np.ndarray:
        """Return the number of samples of each pixel, summed over the groups, (H, W) int32."""
        return sum((self.picture(film.samples) for film in self.groups[1:]), self.picture(self.groups[0].samples))

    def pixels_and_variance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of the samples and the estimated variance of that mean, (H, W, 3) float32 each.

        With one group, the variance is inf in a pixel with fewer than two samples. With several groups, it is inf without samples."""
        if len(self.groups) == 1:
            film = self.groups[0]
            n = self.picture(film.samples)[..., None].astype(np.float32)
            m2 = np.where(n < 2.0, np.float32(np.inf), self.picture(film.m2))
            with np.errstate(invalid="ignore"):  # m2 of a manipulated checkpoint can have any value
                return self.picture(film.mean), m2 / np.maximum(n * (n - 1.0), 1.0)
        mean, variance = self._over_groups()
        with np.errstate(over="ignore"):
            return mean.astype(np.float32), variance.astype(np.float32)

    def error(self) -> float:
        """Return the estimated root mean square error over pixels and channels. Needs several groups; inf if a pixel has no samples."""
        return math.sqrt(float(self.snapshot()._over_groups()[1].mean()))

    def _over_groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of the groups' means and its estimated variance (inf without samples), (H, W, 3) float64 each."""
        n = len(self.groups)
        with np.errstate(over="ignore", invalid="ignore"):
            mean = sum(self.picture(film.mean) / np.float64(n) for film in self.groups)
            variance = sum((self.picture(film.mean) - mean) ** 2 for film in self.groups) / (n * (n - 1.0))
        return np.asarray(mean), np.where(self.samples()[..., None] > 0, variance, np.inf)


def needed_depth(lost: np.ndarray, max_depth: int) -> int:
    """Estimate the least max_depth that leaves at most FEW of the pixels with a loss over VISIBLE.

    lost: result of DeviceFilm.lost_by_depth for a picture of `max_depth` bounces. The estimate assumes that each further bounce reduces
    a pixel's loss by the same factor as the mean bounce so far: lost ** (1 / (max_depth + 1)). The result is at most MAX_DEPTH."""
    factor = float(np.quantile(lost, 1.0 - FEW, method="higher")) ** (1.0 / (max_depth + 1))
    if factor >= VISIBLE ** (1.0 / (MAX_DEPTH + 1)):
        return MAX_DEPTH
    return max(max_depth, math.ceil(math.log(VISIBLE, factor) - 1.0 - 1e-9)) if factor > 0.0 else max_depth


class AovFilm:
    """The film of the AOV kernel: arrays with one entry for each pixel of the crop."""

    def __init__(self, settings: Settings, crop: tuple[int, int, int, int], device: Device) -> None:
        x0, y0, x1, y1 = crop
        self.shape = y1 - y0, x1 - x0
        self.struct = device_film.AovFilm()
        self.struct.width, self.struct.height = settings.size
        self.struct.x, self.struct.y, self.struct.columns = x0, y0, x1 - x0
        for name, dtype in OF_AOVS.items():
            setattr(self.struct, name, wp.zeros(self.shape[0] * self.shape[1], dtype=dtype, device=device))

    def view(self, name: str) -> np.ndarray:
        """Return one AOV, (H, W) or (H, W, 3). On the CPU, this makes no copy."""
        array = getattr(self.struct, name).numpy()
        return array.reshape(*self.shape, *array.shape[1:])

    def picture(self, name: str) -> np.ndarray:
        """Return a copy of `view`."""
        return self.view(name).copy()
