"""Film, the result of a render: pixels, variance and AOVs; their display and their files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.checks import as_names, require_known
from wrt.core.errors import InputError
from wrt.core.types import PathLike, WarpArray
from wrt.picture.image import as_half, check_writable, color_channels, encode_png, output_format, write_codes, write_exr, write_image
from wrt.picture.tonemap import to_codes

# Letters of the channels of a layer in an EXR file. Any other layer has one channel of its own name, or R, G and B.
LETTERS = {"variance": "RGB", "depth": "Z", "normal": "XYZ", "albedo": "RGB"}


@dataclass(eq=False)
class Film:
    """The result of `render`. A film keeps the arrays that it is given.

    The results of `np.asarray(film)`, of any library's `from_dlpack(film)`, of `numpy()` and of `warp()` share the memory of the pixels.

    Parameters
    ----------
    pixels
        (H, W, 3) float32, linear Rec. 709 radiance, the mean of the samples; row 0 is on top.
    variance
        (H, W, 3) float32, estimated variance of `pixels`: its square root is the standard error. inf for fewer than two samples.
    samples
        (H, W) int32, number of samples of each pixel.
    aov
        Layers by name, (H, W) or (H, W, 3) each. Each value comes from the first hit of one ray, through the centres of the pixel
        and of the lens. It is neither filtered nor averaged. The ray hits surfaces of alpha mode "blend", but not what "mask" cuts out.

        - "depth", float32: distance from the camera along the ray, in scene units (not along the camera's axis); inf on a miss.
        - "normal", float32: unit shading normal in world space, on the side of the camera; 0 on a miss.
        - "albedo", float32: albedo of the material, with its texture; 0 on a miss.
        - "prim_id", int32: index of the triangle or sphere: first the triangles of all objects in order, then the spheres; -1 on a miss.
        - "material_id", int32: index into `scene.materials`; -1 on a miss.
    stats
        Counts and times. `stats["seconds"]` has the wall-clock seconds of each stage, also of the runs before a resume: "compile" (runs
        beside "upload" and "build"), "aov" and "trace". "lost_throughput_per_sample" is the radiance that cut rays would have added in
        surroundings of radiance 1; "lost_by_depth" is the part by `max_depth`. "visibly_cut" is the share of pixels that lose 0.05 or more
        by `max_depth`, "needed_depth" an estimate of a depth that is enough, "clamped_share" the share of the light that `clamp` took.
    metadata
        Entries that `save` writes into files: scene, spp, seed, seconds, version ...
    exposure, tonemap
        Display settings in stops and by name, as in Settings.

    Raises
    ------
    InputError
        If the shapes of the arrays differ.
    """

    pixels: np.ndarray
    variance: np.ndarray
    samples: np.ndarray
    aov: dict[str, np.ndarray] = field(default_factory=dict)
    stats: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    exposure: float = 0.0
    tonemap: str = "none"

    def __post_init__(self) -> None:
        size = self.pixels.shape[:2]
        if self.pixels.shape != (*size, 3) or self.variance.shape != (*size, 3) or self.samples.shape != size:
            raise InputError(f"pixels and variance must be (H, W, 3) and samples (H, W), got {self.pixels.shape},"
                             f" {self.variance.shape} and {self.samples.shape}", argument="pixels", place="film")
        for name, array in self.aov.items():
            if array.shape[:2] != size:
                raise InputError(f"{name!r} must be {size} like the pixels, got {array.shape[:2]}", argument="aov", place="film")

    def __repr__(self) -> str:
        height, width = self.samples.shape
        low, high = int(self.samples.min(initial=1 << 30)), int(self.samples.max(initial=0))
        parts = [f"{width}x{height}", f"{high} spp" if low == high else f"{low} to {high} spp"]
        parts += [f"mean radiance {float(np.mean(self.pixels)):.3g}"] if self.pixels.size else []
        parts += [f"aov: {', '.join(self.aov)}"] if self.aov else []
        return f"Film({', '.join(parts)})"

    @property
    def layers(self) -> dict[str, np.ndarray]:
        """All layers except the pixels, by name: the AOVs, "variance" and "samples"."""
        return {**self.aov, "variance": self.variance, "samples": self.samples}

    def to_srgb8(self) -> np.ndarray:
        """Return the displayed picture, (H, W, 3) uint8: exposed, tone-mapped, sRGB-encoded; NaN is black."""
        return to_codes(self.pixels, self.exposure, self.tonemap)

    def numpy(self) -> np.ndarray:
        """Return the pixels, (H, W, 3) float32, without a copy."""
        return self.pixels

    def warp(self) -> WarpArray:
        """Return the pixels as a Warp array, (H, W) vec3, without a copy."""
        import warp as wp

        from wrt.core.arrays import to_warp

        return to_warp(self.pixels, wp.vec3)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.pixels, dtype=dtype, copy=copy)

    def __dlpack__(self, **options: Any) -> Any:
        return self.pixels.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self.pixels.__dlpack_device__()

    def _repr_png_(self) -> bytes:
        return encode_png(self.to_srgb8(), self.metadata)

    def save(self, path: PathLike, *, bits: int | None = None, aov: str | Iterable[str] | None = None) -> list[Path]:
        """Write the picture and layers to files. Each file is written completely or not at all.

        Parameters
        ----------
        path
            Path of the picture. A .png, .jpg or .webp file is exposed and tone-mapped; .exr and .hdr files are linear.
        bits
            Bits of a channel: 8 or 16 for PNG (default 8), 32 or 16 for EXR (default 32).
        aov
            Names of `layers`. An EXR file has all layers by default, as channels with their values (depth.Z ... prim_id). Beside a PNG
            or HDR file, each named layer becomes a PNG file to look at, such as `name.depth.png`; the default is none.

        Returns
        -------
        list of Path
            The files written.

        Raises
        ------
        InputError
            If a path or a name is wrong (nothing is written then), or if the system refuses to write.
        """
        suffix, bits = output_format(path, bits)
        names = self._layer_names(aov, suffix)
        if suffix == ".exr":
            colors = as_half(path, self.pixels) if bits == 16 else self.pixels
            channels = color_channels("", colors)
            for name in names:
                channels |= layer_channels(name, self.layers[name])
            write_exr(path, channels, self.metadata)
            return [Path(path)]
        views = {aov_path(path, name): self.layers[name] for name in names}
        for view_path in (path, *views):
            check_writable(view_path)
        write_image(path, self.pixels, bits=bits, exposure=self.exposure, tonemap=self.tonemap, metadata=self.metadata)
        for name, (view_path, array) in zip(names, views.items(), strict=True):
            write_codes(view_path, aov_to_srgb8(name, array), self.metadata | (depth_range(array) if name == "depth" else {}))
        return [Path(path), *views]

    def _layer_names(self, aov: str | Iterable[str] | None, suffix: str) -> list[str]:
        if aov is None:
            return list(self.layers) if suffix == ".exr" else []
        names = list(dict.fromkeys(as_names(aov, "aov")))
        for name in names:
            require_known(name, self.layers, "AOV", "aov")
        return names


def aov_path(path: PathLike, name: str) -> Path:
    """Return the file of a layer beside a PNG or HDR picture: out.png -> out.depth.png."""
    return Path(path).with_suffix(f".{name}.png")


def layer_channels(name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """Return the EXR channels of a layer by name: depth.Z, normal.X ... Layers not in LETTERS: `name`, or name.R, name.G, name.B."""
    if array.ndim == 3:
        return color_channels(name, array, LETTERS.get(name, "RGB"))
    return {f"{name}.{LETTERS[name]}" if name in LETTERS else name: array}


# --- layers to look at ------------------------------------------------------------------------------------------------


def depth_range(depth: np.ndarray) -> dict[str, float]:
    """Return the depths, in scene units, that `_view_depth` shows as white and as the darkest grey; empty without a hit."""
    hit = depth[np.isfinite(depth)]
    return {"white": float(hit.min()), "darkest": float(hit.max())} if hit.size else {}


def _view_depth(depth: np.ndarray) -> np.ndarray:
    """Return depth as grey, linear from the nearest hit (white) to the farthest (dark grey); a miss is black."""
    hit = np.isfinite(depth)
    near, far = (float(depth[hit].min()), float(depth[hit].max())) if hit.any() else (0.0, 0.0)
    share = (np.where(hit, depth, far) - near) / (far - near) if far > near else np.zeros(depth.shape)
    return _grey(np.where(hit, 255.0 - 215.0 * share, 0.0))


def _view_normal(normal: np.ndarray) -> np.ndarray:
    """Return a colour for each normal: components from -1 to 1 become codes 0 to 255, without sRGB encoding; a miss is black."""
    hit = np.abs(normal).sum(axis=-1, keepdims=True) > 0.0
    return np.rint(np.where(hit, np.clip(0.5 + 0.5 * normal, 0.0, 1.0), 0.0) * 255.0).astype(np.uint8)


def _view_id(ids: np.ndarray) -> np.ndarray:
    """Return a colour for each id, from a hash: an id has the same colour in every picture; a miss is black."""
    value = (ids.astype(np.int64) + 1).astype(np.uint32)  # then the finaliser of MurmurHash3, modulo 2^32
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    colors = np.stack([64 + (value >> np.uint32(shift)) % np.uint32(192) for shift in (0, 8, 16)], axis=-1)
    return np.where(ids[..., None] >= 0, colors, 0).astype(np.uint8)


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(np.rint(values).astype(np.uint8)[..., None], 3, axis=-1)


AOV_VIEWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "depth": _view_depth,
    "normal": _view_normal,
    "albedo": to_codes,
    "prim_id": _view_id,
    "material_id": _view_id,
    # The standard error in the scale of the picture, without exposure and tone mapping; inf is white.
    "variance": lambda variance: to_codes(np.sqrt(np.maximum(variance, 0.0))),
    # From 0 (black) to the largest count (white).
    "samples": lambda samples: _grey(255.0 * samples / max(int(samples.max(initial=0)), 1)),
}


def aov_to_srgb8(name: str, array: np.ndarray) -> np.ndarray:
    """Return a layer as a picture to look at, (H, W, 3) uint8. Raises InputError if AOV_VIEWS has no view of that name."""
    require_known(name, AOV_VIEWS, "view of the AOV", "aov")
    return AOV_VIEWS[name](array)
