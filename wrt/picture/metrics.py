"""Error of a picture `a` against a reference `b`, (H, W, 3) linear Rec. 709 each: mean errors, FLIP, and a difference image."""

import math
from collections.abc import Mapping

import numpy as np

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.picture.heatmap import heatmap, top_of
from wrt.picture.tonemap import encode_srgb, tone_map

RELMSE_EPS = 0.01
PIXELS_PER_DEGREE = 3840 * math.pi / 180  # FLIP's default: a screen 3840 pixels wide, at a distance of its width
HIGHER_IS_BETTER = ("psnr",)


def compare(a: np.ndarray, b: np.ndarray, *, exposure: float = 0.0, tonemap: str = "none") -> dict[str, float]:
    """Compute error measures of a picture against a reference.

    Pixels with a NaN or an infinity in a or b are left out of every mean, and counted.

    Parameters
    ----------
    a, b
        Picture and reference, (H, W, 3) linear Rec. 709.
    exposure, tonemap
        Display settings for psnr and flip: stops, and a name of TONEMAPS.

    Returns
    -------
    dict of str to float
        From linear values of all pixels and channels: "mse"; "relmse", the mean of (a - b)^2 / (b^2 + 0.01) [1]_; "max_abs", the
        largest difference; "mean_ratio", mean(a) / mean(b). From displayed values: "psnr" of sRGB codes with peak 1, in dB (inf if
        equal); "flip", the mean of `flip_map`. These are NaN if no pixel is finite. Counts: "pixels"; "nonfinite_a" and "nonfinite_b",
        pixels with NaN or infinity; "nonfinite_differ", pixels with NaN or infinity in a or b at which a and b differ.

    Raises
    ------
    InputError
        If the sizes differ, or a picture has another shape.

    References
    ----------
    .. [1] Rousselle, Knaus, Zwicker, "Adaptive Sampling and Reconstruction using Greedy Error Minimization", 2011.
    """
    a, b = _pair(a, b)
    finite = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
    equal = ((a == b) | (np.isnan(a) & np.isnan(b))).all(axis=-1)
    result: dict[str, float] = {
        "pixels": int(finite.size), **{f"nonfinite_{name}": int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
                                       for name, image in (("a", a), ("b", b))},
        "nonfinite_differ": int(np.count_nonzero(~finite & ~equal))}
    if not finite.any():
        return result | dict.fromkeys(("mse", "relmse", "max_abs", "mean_ratio", "psnr", "flip"), math.nan)
    shown_mse, flip = _shown_errors(a, b, finite, exposure, tonemap)
    x, y = (image[finite].astype(np.float64) for image in (a, b))
    squared = (x - y) ** 2
    return result | {
        "mse": float(np.mean(squared)),
        "relmse": float(np.mean(squared / (y**2 + RELMSE_EPS))),
        "max_abs": float(np.abs(x - y).max()),
        "mean_ratio": _ratio(float(np.mean(x)), float(np.mean(y))),
        "psnr": -10.0 * math.log10(shown_mse) if shown_mse > 0.0 else math.inf,
        "flip": flip,
    }


def _shown_errors(a: np.ndarray, b: np.ndarray, finite: np.ndarray, exposure: float, tonemap: str) -> tuple[float, float]:
    """Return the mean squared error of sRGB codes and the mean of FLIP, both over finite pixels."""
    # Other pixels are black in both pictures, because FLIP filters over neighbours.
    a, b = (tone_map(np.where(finite[..., None], image, np.float32(0.0)), exposure, tonemap) for image in (a, b))
    flip = float(np.mean(flip_map(a, b)[finite], dtype=np.float64))
    a, b = (encode_srgb(image[finite].astype(np.float64)) for image in (a, b))
    return float(np.mean((a - b) ** 2)), flip


def failures(result: Mapping[str, float], limits: Mapping[str, float | None]) -> list[str]:
    """Return one sentence for each limit that a result of `compare` violates.

    Parameters
    ----------
    result
        Result of `compare`.
    limits
        Limits by name: a lower limit for psnr, upper limits for other measures; None for no limit. NaN violates every limit. With any
        limit, pixels that are NaN or infinite in a picture and at which the two differ are a failure, too.
    """
    active = {name: limit for name, limit in limits.items() if limit is not None}
    sentences = []
    for name, limit in active.items():
        value = result[name]
        if name in HIGHER_IS_BETTER and not value >= limit:
            sentences.append(f"{name} {value:.6g} is below {limit:g}")
        if name not in HIGHER_IS_BETTER and not value <= limit:
            sentences.append(f"{name} {value:.6g} is above {limit:g}")
    if active and result["nonfinite_differ"]:
        sentences.append(f"{result['nonfinite_differ']} pixels are NaN or infinite in one picture and differ in the other")
    return sentences


def _ratio(a: float, b: float) -> float:
    if b == 0.0:
        return 1.0 if a == 0.0 else math.copysign(math.inf, a)
    return a / b


def _pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(a, dtype=np.float32), np.asarray(b, dtype=np.float32)
    for image in (a, b):
        if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise InputError(f"a picture must be (H, W, 3), got {image.shape}")
    if a.shape != b.shape:
        sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in (a, b))
        raise InputError(f"the pictures have different sizes, {sizes}")
    return a, b


# --- FLIP -------------------------------------------------------------------------------------------------------------


def flip_map(a: np.ndarray, b: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """Compute LDR-FLIP, the difference seen when two pictures alternate on a screen, with OpenImageIO.

    Parameters
    ----------
    a, b
        (H, W, 3) display-linear in [0, 1] (`tone_map`, or a decoded PNG), finite, in any order.
    pixels_per_degree
        Pixels per degree of the visual angle.

    Returns
    -------
    (H, W) float32
        0 (no difference) to 1.

    References
    ----------
    Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom, Fairchild, "FLIP: A Difference Evaluator for Alternating Images", HPG 2020.
    """
    with needed_by("FLIP"):
        import OpenImageIO as oiio

    def buffer(image: np.ndarray) -> oiio.ImageBuf:
        out = oiio.ImageBuf(oiio.ImageSpec(image.shape[1], image.shape[0], 3, "float"))
        out.set_pixels(oiio.ROI(), np.ascontiguousarray(np.clip(image, 0.0, 1.0), dtype=np.float32))
        return out

    return np.asarray(oiio.ImageBufAlgo.FLIP_diff(buffer(b), buffer(a), hdr=0, ppd=pixels_per_degree).get_pixels())[..., 0]


# --- difference image -------------------------------------------------------------------------------------------------


def difference_image(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Draw the linear difference |a - b| of the channel that differs most as a heat map with its scale, (H, W, 3) uint8.

    Parameters
    ----------
    a, b
        Picture and reference, (H, W, 3) linear. Where they differ and are not both finite, the picture has the last colour.

    Returns
    -------
    (H, W, 3) uint8
        See `heatmap`: also larger than the pictures.

    Raises
    ------
    InputError
        If the sizes differ.
    """
    a, b = _pair(a, b)
    with np.errstate(invalid="ignore"):  # inf - inf
        difference = np.where((a == b) | (np.isnan(a) & np.isnan(b)), np.float32(0.0), np.abs(a - b)).max(axis=-1)
    top = top_of(difference[np.isfinite(difference)])
    return heatmap(np.nan_to_num(difference, nan=top, posinf=top), "difference |a - b|", top)
