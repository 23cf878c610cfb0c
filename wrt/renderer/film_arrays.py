"""The film on the device: a pixel's samples as one sequence, or as several independent ones that tell the picture's error."""

from __future__ import annotations

import math
from copy import copy
from typing import Any

import numpy as np
import warp as wp

from wrt.core.device import upload
from wrt.kernels import structs
from wrt.renderer.features import filter_icdf
from wrt.scene.settings import Settings

# Independent sequences a pixel where the error is asked for. Over a picture, four tell the error as well as eight do (what they
# miss is averaged over the pixels), and long sequences are better than many: eight have up to 1.4 times the error of four.
GROUPS = 4
# A pixel: of one film, with the picture that becomes of it and is written; of each further group; of AOVs.
BYTES_OF_FILM, BYTES_OF_GROUP, BYTES_OF_AOVS = 132, 20, 36
OF_A_GROUP = {"mean": wp.vec3, "samples": wp.int32, "lost": wp.float32}
# Of the brightness around: a difference that people see in a detail of some pixels (in a large patch, less than half of it).
VISIBLE = 0.05
SHARED = {"m2": wp.vec3, "rays": wp.int64, "cut_depth": wp.int32, "cut_throughput": wp.int32, "not_finite": wp.int32}
OF_AOVS = {"depth": wp.float32, "normal": wp.vec3, "albedo": wp.vec3, "prim_id": wp.int32, "material_id": wp.int32}


class DeviceFilm:
    """Arrays of one entry a pixel of the crop for the render kernel to fill: one struct for each group of samples, with its seed.

    The samples of one group are one scrambled sequence. Its points avoid each other, so that their mean is better than
    their spread lets on, and by how much they do not tell. The means of several groups with scrambles of their own are
    independent and equally good: the variance among them, over their number, is an unbiased estimate of the variance of
    their mean (Owen 1997, "Monte Carlo Variance of Scrambled Net Quadrature", section 1).
    """

    def __init__(self, settings: Settings, crop: tuple[int, int, int, int], device: Any, seed: int, groups: int = 1) -> None:
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
            film = structs.Film()
            film.width, film.height = settings.size
            film.x, film.y, film.columns = x0, y0, x1 - x0
            for name, array in {**shared, **own}.items():
                setattr(film, name, array)
            self.groups.append(film)
        self._read: dict[int, np.ndarray] | None = None  # what a snapshot has copied, by address

    def snapshot(self) -> DeviceFilm:
        """The same film to be read: of a GPU's arrays each is copied once, when it is first asked for."""
        out = copy(self)
        out._read = {}
        return out

    def arrays(self) -> list[tuple[str, Any]]:
        """Everything that samples change, by name: the shared arrays, then those of each group."""
        own = [(f"{name} of group {i}", getattr(film, name)) for i, film in enumerate(self.groups) for name in OF_A_GROUP]
        return [(name, getattr(self.groups[0], name)) for name in SHARED] + own

    def put(self, array: Any, values: np.ndarray) -> None:
        """Write values, (H, W) or (H, W, 3), into a device array."""
        array.assign(values.reshape(array.shape[0], *values.shape[2:]))

    @property
    def rays(self) -> int:
        """Rays so far, over the whole picture."""
        return int(self.groups[0].rays.numpy().sum())

    def view(self, array: Any) -> np.ndarray:
        """A device array of one entry a pixel as (H, W) or (H, W, 3); on the CPU without a copy."""
        pixels = None if self._read is None else self._read.get(array.ptr)
        if pixels is None:
            pixels = array.numpy()
            if self._read is not None:
                self._read[array.ptr] = pixels
        return pixels.reshape(*self.shape, *pixels.shape[1:])

    def picture(self, array: Any) -> np.ndarray:
        """A copy of `view`."""
        return self.view(array).copy()

    def count(self, name: str) -> int:
        """The sum over the pixels of a shared count."""
        return int(self.picture(getattr(self.groups[0], name)).sum(dtype=np.int64))

    def lost(self) -> float:
        """Throughput that was cut, summed over all samples."""
        return sum(float(self.picture(film.lost).sum(dtype=np.float64)) for film in self.groups)

    def visibly_cut(self, most_by_throughput: float) -> float:
        """The share of the pixels that are visibly darker for rays that were cut by depth: those rays would have added VISIBLE or
        more to the pixel in a room of radiance 1.

        The room stands for what the picture shows on average, which the eye adapts to. most_by_throughput: what one ray that was
        cut by its throughput is worth at most; `lost` holds both, so that what is left of it is a lower bound.
        """
        film = self.groups[0]
        lost = sum((self.view(group.lost) for group in self.groups[1:]), self.view(film.lost))
        by_depth = np.where(self.view(film.cut_depth) > 0, lost - most_by_throughput * self.view(film.cut_throughput), 0.0)
        return float((by_depth > VISIBLE * self.samples()).mean())

    def samples(self) -> np.ndarray:
        """(H, W) int32, over all groups; a pixel's groups have equally many."""
        return sum((self.picture(film.samples) for film in self.groups[1:]), self.picture(self.groups[0].samples))

    def pixels_and_variance(self) -> tuple[np.ndarray, np.ndarray]:
        """The mean of the samples and the estimated variance of that mean, both (H, W, 3) float32.

        The variance is inf where nothing tells it: of fewer than two samples, or groups.
        """
        if len(self.groups) == 1:
            film = self.groups[0]
            n = self.picture(film.samples)[..., None].astype(np.float32)
            m2 = np.where(n < 2.0, np.float32(np.inf), self.picture(film.m2))
            with np.errstate(invalid="ignore"):  # of a checkpoint by a stranger, m2 can be anything
                return self.picture(film.mean), m2 / np.maximum(n * (n - 1.0), 1.0)
        mean, variance = self._over_groups()
        with np.errstate(over="ignore"):
            return mean.astype(np.float32), variance.astype(np.float32)

    def error(self) -> float:
        """Estimated root mean square error over pixels and channels, from the spread of the groups; needs two or more.

        inf where a pixel has no samples.
        """
        return math.sqrt(float(self.snapshot()._over_groups()[1].mean()))

    def _over_groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the groups' means and its estimated variance, (H, W, 3) float64, one group in memory at a time; the
        variance is inf where there are no samples."""
        n = len(self.groups)
        with np.errstate(over="ignore", invalid="ignore"):
            mean = sum(self.picture(film.mean) / np.float64(n) for film in self.groups)
            variance = sum((self.picture(film.mean) - mean) ** 2 for film in self.groups) / (n * (n - 1.0))
        return np.asarray(mean), np.where(self.samples()[..., None] > 0, variance, np.inf)


class AovFilm:
    """Arrays for the AOV kernel to fill, of one entry a pixel of the crop."""

    def __init__(self, settings: Settings, crop: tuple[int, int, int, int], device: Any) -> None:
        x0, y0, x1, y1 = crop
        self.shape = y1 - y0, x1 - x0
        self.struct = structs.AovFilm()
        self.struct.width, self.struct.height = settings.size
        self.struct.x, self.struct.y, self.struct.columns = x0, y0, x1 - x0
        for name, dtype in OF_AOVS.items():
            setattr(self.struct, name, wp.zeros(self.shape[0] * self.shape[1], dtype=dtype, device=device))

    def view(self, name: str) -> np.ndarray:
        """One AOV, (H, W) or (H, W, 3); on the CPU without a copy."""
        array = getattr(self.struct, name).numpy()
        return array.reshape(*self.shape, *array.shape[1:])

    def picture(self, name: str) -> np.ndarray:
        """A copy of `view`."""
        return self.view(name).copy()
