"""The result of a render: pixels, their variance, what the first hits were, and how to show and save it all."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.checks import as_names
from wrt.core.errors import InputError
from wrt.picture.image import (
    PathLike,
    as_half,
    check_writable,
    color_channels,
    encode_png,
    output_format,
    write_codes,
    write_exr,
    write_image,
)
from wrt.picture.tonemap import to_codes

# The letters of a layer's channels in an EXR file; a layer that is not named here has one channel, called as itself.
LETTERS = {"variance": "RGB", "depth": "Z", "normal": "XYZ", "albedo": "RGB"}


@dataclass(eq=False)
class Film:
    """What `render` gives back.

    pixels: (H, W, 3) float32, linear Rec. 709 radiance, the mean of the samples; row 0 is on top.
    variance: (H, W, 3) float32, estimated variance of that mean (its root is the standard error); inf where it is not known:
        one sample tells nothing of it.
    samples: (H, W) int32, samples taken of each pixel.
    aov: by name, of what one ray through the pixel's centre, and the middle of the lens, hits first (blended surfaces
        count, cut-out parts do not; no filter, no mean over samples):
        "depth" (H, W) float32: the distance from the camera to the hit along that ray, in scene units, not the distance
            along the camera's axis; inf on a miss;
        "normal" (H, W, 3) float32: of unit length, in world space, the one that shades (interpolated and bent by a normal
            map where the surface has such), on the side that the ray comes from; 0 on a miss;
        "albedo" (H, W, 3) float32: the material's, with its texture; 0 on a miss;
        "prim_id" (H, W) int32: index of the triangle (all objects in order, then the spheres); -1 on a miss;
        "material_id" (H, W) int32: index into `scene.materials`; -1 on a miss.
    stats: counts and seconds of the render. stats["seconds"] has the seconds of each stage by the clock: "compile" until the last
        kernel of the scene was there, and beside it "upload" and "build" (with kernels of the builder's own, which
        stats["accel"]["build_seconds"] does not count); then "aov" and "trace", with those before a resume.
        "lost_throughput_per_sample": what rays that were cut would have added in a room of radiance 1; "visibly_cut": the share
        of the pixels that lack 5 % or more of that radiance because of max_depth.
    metadata: what a file says about it (scene, spp, seed, seconds, version).
    exposure (stops) and tonemap (a name in wrt.picture.tonemap.TONEMAPS): how it wants to be shown.
    np.asarray(film), `from_dlpack(film)` of any library, film.numpy() and film.warp() are the pixels, not a copy of them.
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
            raise InputError(f"film: pixels and variance must be (H, W, 3) and samples (H, W), got {self.pixels.shape},"
                             f" {self.variance.shape} and {self.samples.shape}")
        for name, array in self.aov.items():
            if array.shape[:2] != size:
                raise InputError(f"film: aov {name!r} must be {size} like the pixels, got {array.shape[:2]}")

    def __repr__(self) -> str:
        height, width = self.samples.shape
        low, high = int(self.samples.min(initial=1 << 30)), int(self.samples.max(initial=0))
        parts = [f"{width}x{height}", f"{high} spp" if low == high else f"{low} to {high} spp"]
        parts += [f"mean radiance {float(np.mean(self.pixels)):.3g}"] if self.pixels.size else []
        parts += [f"aov: {', '.join(self.aov)}"] if self.aov else []
        return f"Film({', '.join(parts)})"

    @property
    def layers(self) -> dict[str, np.ndarray]:
        """Everything but the colours, by name: the AOVs, variance and samples."""
        return {**self.aov, "variance": self.variance, "samples": self.samples}

    def to_srgb8(self) -> np.ndarray:
        """As shown: exposed, tone-mapped, sRGB-encoded, (H, W, 3) uint8; NaN is black."""
        return to_codes(self.pixels, self.exposure, self.tonemap)

    def numpy(self) -> np.ndarray:
        """The pixels themselves, (H, W, 3) float32."""
        return self.pixels

    def warp(self) -> Any:
        """The pixels as a Warp array, (H, W) vec3, of the same memory."""
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
        """Write the picture, and other layers with it; returns the paths written.

        path: .png gets exposure and tone mapping, .exr and .hdr stay linear. bits: as in wrt.picture.image.write_image. aov:
        names in `layers`; None is all of them for EXR and none otherwise. EXR takes them as channels (depth.Z, ...,
        prim_id), with values as they are; next to a PNG or HDR picture each becomes a PNG to look at (AOV_VIEWS),
        `name.depth.png` beside `name.png`. Every file is written whole or not at all. Raises InputError before anything
        is written where a path or a name is wrong.
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
            write_codes(view_path, aov_to_srgb8(name, array), self.metadata)
        return [Path(path), *views]

    def _layer_names(self, aov: str | Iterable[str] | None, suffix: str) -> list[str]:
        if aov is None:
            return list(self.layers) if suffix == ".exr" else []
        names = list(dict.fromkeys(as_names(aov, "aov")))
        unknown = [name for name in names if name not in self.layers]
        if unknown:
            raise InputError(f"no AOV {unknown[0]!r}; there are {', '.join(self.layers)}")
        return names


def aov_path(path: PathLike, name: str) -> Path:
    """Where `save` puts a layer beside a PNG or HDR picture: out.png -> out.depth.png."""
    return Path(path).with_suffix(f".{name}.png")


def layer_channels(name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """A layer's EXR channels by name: depth.Z, normal.X ..., or `name` itself for one that has no letters."""
    if array.ndim == 3:
        return color_channels(name, array, LETTERS.get(name, "RGB"))
    return {f"{name}.{LETTERS[name]}" if name in LETTERS else name: array}


# --- layers to look at ------------------------------------------------------------------------------------------------


def _view_depth(depth: np.ndarray) -> np.ndarray:
    """Near is white, far dark grey, a miss black; linear between the nearest and the farthest hit."""
    hit = np.isfinite(depth)
    near, far = (float(depth[hit].min()), float(depth[hit].max())) if hit.any() else (0.0, 0.0)
    share = (np.where(hit, depth, far) - near) / (far - near) if far > near else np.zeros(depth.shape)
    return _grey(np.where(hit, 255.0 - 215.0 * share, 0.0))


def _view_normal(normal: np.ndarray) -> np.ndarray:
    """-1 to 1 as code 0 to 255, without sRGB encoding; a miss is black."""
    hit = np.abs(normal).sum(axis=-1, keepdims=True) > 0.0
    return np.rint(np.where(hit, np.clip(0.5 + 0.5 * normal, 0.0, 1.0), 0.0) * 255.0).astype(np.uint8)


def _view_id(ids: np.ndarray) -> np.ndarray:
    """A colour from a hash of each number, the same in every picture; a miss is black."""
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
    # The standard error, on the scale of the picture itself without exposure and tone mapping; unknown is white.
    "variance": lambda variance: to_codes(np.sqrt(np.maximum(variance, 0.0))),
    # 0 is black, the most there are is white.
    "samples": lambda samples: _grey(255.0 * samples / max(int(samples.max(initial=0)), 1)),
}


def aov_to_srgb8(name: str, array: np.ndarray) -> np.ndarray:
    """A layer as a picture to look at, (H, W, 3) uint8; raises InputError where AOV_VIEWS has no view of that name."""
    if name not in AOV_VIEWS:
        raise InputError(f"AOV {name!r} has no view; there are {', '.join(AOV_VIEWS)}")
    return AOV_VIEWS[name](array)
