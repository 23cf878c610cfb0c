"""Exposure, tone mapping and sRGB encoding: linear radiance to display codes. Other primaries to Rec. 709.

All colours are linear Rec. 709 until `encode_srgb`. "Display-linear" is the light that the display emits, in [0, 1].
"""

import contextlib
from collections.abc import Callable, Sequence

import numpy as np

from wrt.core.checks import as_choice
from wrt.core.errors import InputError

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # weights of linear Rec. 709
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x and y of red, green, blue and white
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])  # XYZ to the cones' responses
# Radiance that every curve shows as white; its square fits in a float32.
BRIGHTEST = 1e9
BRIGHT, BRIGHT_SHARE = 0.8, 0.95  # of auto_exposure


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Apply the sRGB transfer function (IEC 61966-2-1), [0, 1] to [0, 1], to an array of any shape; NaN stays NaN."""
    linear = np.asarray(linear)
    low = linear <= 0.0031308
    return np.where(low, linear * 12.92, 1.055 * np.power(np.where(low, 1.0, linear), 1.0 / 2.4) - 0.055)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """Invert `encode_srgb`, [0, 1] to [0, 1], for an array of any shape; NaN stays NaN."""
    encoded = np.asarray(encoded)
    low = encoded <= 0.04045
    return np.where(low, encoded / 12.92, np.power((np.where(low, 1.0, encoded) + 0.055) / 1.055, 2.4))


def to_rec_709(linear: np.ndarray, primaries: Sequence[float]) -> np.ndarray:
    """Convert linear colours (..., 3) from other primaries: x and y of red, green, blue and white. White stays white (Bradford).

    Raises InputError if the primaries span no colours. Source: SMPTE RP 177; ImfAcesFile.cpp of OpenEXR, which adapts in the same way."""
    def cones(space: Sequence[float]) -> np.ndarray:  # responses to red, green and blue in columns; those to white are 1
        xy = np.array(space, dtype=np.float64).reshape(4, 2)
        *colors, white = np.column_stack([xy, 1.0 - xy.sum(axis=1)]) @ BRADFORD.T
        return (columns := np.transpose(colors) / white[:, None]) * np.linalg.solve(columns, np.ones(3))
    if np.allclose(primaries, REC_709, rtol=0.0, atol=2e-4):
        return linear
    with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
        matrix = np.linalg.solve(cones(REC_709), cones(primaries))
        if np.abs(matrix).max() < 1e3:
            return linear @ matrix.T.astype(linear.dtype)
    raise InputError(f"cannot be read as an image: its primaries and white span no colours: {', '.join(f'{x:g}' for x in primaries)}")


def luminance(linear: np.ndarray) -> np.ndarray:
    """Return the relative luminance (...) of linear Rec. 709 colours (..., 3)."""
    return linear @ LUMINANCE.astype(linear.dtype)


# --- curves: from linear radiance (..., 3), finite and >= 0, to display-linear; `tone_map` clips the result to [0, 1] -

REINHARD_WHITE = 4.0  # two stops above 1


def reinhard(linear: np.ndarray) -> np.ndarray:
    """Apply Reinhard's extended operator to luminance: L (1 + L / W^2) / (1 + L); W = 4 is the lowest luminance that is white.

    Chromaticity stays the same, so that a channel of a bright saturated colour can still clip.
    Source: Reinhard, Stark, Shirley, Ferwerda, "Photographic Tone Reproduction for Digital Images" (2002), equation 4."""
    bright = luminance(linear)[..., None]
    return linear * ((1.0 + bright / REINHARD_WHITE**2) / (1.0 + bright))


# Matrices that act on columns of RGB. In: Rec. 709 to AP1 with the desaturation of the RRT; out: AP1 to Rec. 709, with the ODT's.
ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def aces(linear: np.ndarray) -> np.ndarray:
    """Apply Stephen Hill's fit of the ACES reference rendering and sRGB output transforms, without extra exposure.

    Source: S. Hill, ACES.hlsl in "Baking Lab" (M. Pettineo and D. Neubelt, 2016)."""
    v = linear @ ACES_IN.T.astype(linear.dtype)
    fitted = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return fitted @ ACES_OUT.T.astype(linear.dtype)


# Inset of the primaries. The published rows sum to 1 only within 2e-4; they are scaled to a sum of 1, so that grey stays exactly grey.
AGX_INSET = np.array([
    [0.842479062253094, 0.0784335999999992, 0.0792237451477643],
    [0.0423282422610123, 0.878468636469772, 0.0791661274605434],
    [0.0423756549057051, 0.0784336, 0.879142973793104],
])
AGX_INSET /= AGX_INSET.sum(axis=1, keepdims=True)
AGX_OUTSET = np.linalg.inv(AGX_INSET)
AGX_MIN_EV, AGX_MAX_EV = -10.0, 6.5  # stops below and above mid-grey, 0.18
AGX_PIVOT = (AGX_MIN_EV / (AGX_MIN_EV - AGX_MAX_EV), 0.5)
AGX_SLOPE, AGX_TOE_POWER, AGX_SHOULDER_POWER = 2.0, 3.0, 3.25


def _agx_half(reach: np.ndarray, x_span: float, y_span: float, power: float) -> np.ndarray:
    """Evaluate half of the sigmoid at the distance `reach` from the pivot. It goes from (0, 0), at slope AGX_SLOPE, to (x_span, y_span)."""
    scale = (((AGX_SLOPE * x_span / y_span) ** power - 1.0) * (AGX_SLOPE * x_span) ** -power) ** (-1.0 / power)
    term = AGX_SLOPE * reach / scale
    return scale * term / (1.0 + term**power) ** (1.0 / power)


def agx_contrast(x: np.ndarray) -> np.ndarray:
    """Apply AgX's default contrast: [0, 1] (log2 of exposure) to [0, 1] (display code); mid-grey is exactly 0.5.

    This is the sigmoid itself; the polynomials that are often fitted to it are off by up to 0.006 and miss 0 and 1."""
    x_pivot, y_pivot = AGX_PIVOT
    toe = y_pivot - _agx_half(np.maximum(x_pivot - x, 0.0), x_pivot, y_pivot, AGX_TOE_POWER)
    shoulder = y_pivot + _agx_half(np.maximum(x - x_pivot, 0.0), 1.0 - x_pivot, 1.0 - y_pivot, AGX_SHOULDER_POWER)
    return np.where(x < x_pivot, toe, shoulder)


def agx(linear: np.ndarray) -> np.ndarray:
    """Apply Troy Sobotka's AgX, base look: inset, log2 between -10 and +6.5 stops, sigmoid, outset, 2.2 power to linear.

    Sources: T. Sobotka, AgX-S2O3 (inset matrix, range, sigmoid), with the slope and powers of the NumPy version in the
    AgX repository; B. Wrensch, "Minimal AgX Implementation" (2023), for the outset, the inverse of the inset, and for
    the power of 2.2, which turns codes into light."""
    inset = linear @ AGX_INSET.T.astype(linear.dtype)
    stops = np.log2(np.maximum(inset / 0.18, 2.0**AGX_MIN_EV))
    x = np.clip((stops - AGX_MIN_EV) / (AGX_MAX_EV - AGX_MIN_EV), 0.0, 1.0)
    codes = agx_contrast(x) @ AGX_OUTSET.T.astype(linear.dtype)
    return np.clip(codes, 0.0, 1.0) ** 2.2


TONEMAPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": lambda linear: linear,  # clipped at 1
    "reinhard": reinhard,
    "aces": aces,
    "agx": agx,
}


def tone_map(pixels: np.ndarray, exposure: float = 0.0, tonemap: str = "none") -> np.ndarray:
    """Map linear radiance to display-linear light, (..., 3) float32 in [0, 1].

    pixels: (..., 3) linear; exposure: stops; tonemap: a name in TONEMAPS. Negative values, -inf and NaN become black; +inf becomes the
    brightest value of the curve. Raises InputError for an unknown name."""
    as_choice(tonemap, TONEMAPS, "tonemap")
    with np.errstate(over="ignore", invalid="ignore"):  # overflow gives +inf, inf * 0 gives NaN: both are replaced below
        exposed = np.asarray(pixels, dtype=np.float32) * np.float32(2.0**exposure)
    linear = np.clip(np.nan_to_num(exposed, nan=0.0, posinf=BRIGHTEST, neginf=0.0), 0.0, BRIGHTEST)
    return np.clip(TONEMAPS[tonemap](linear), 0.0, 1.0).astype(np.float32, copy=False)


def auto_exposure(pixels: np.ndarray) -> float:
    """Return the exposure in stops that shows BRIGHT_SHARE of the lit pixels at a luminance of BRIGHT or less; 0 without a lit pixel.

    pixels: (..., 3) linear. Black, NaN and infinite pixels do not count. The result is in [-60, 60]."""
    bright = luminance(np.asarray(pixels, np.float64))
    lit = bright[np.isfinite(bright) & (bright > 0.0)]
    return float(np.clip(np.log2(BRIGHT / np.quantile(lit, BRIGHT_SHARE)), -60.0, 60.0)) if lit.size else 0.0


def to_codes(pixels: np.ndarray, exposure: float = 0.0, tonemap: str = "none", bits: int = 8) -> np.ndarray:
    """Return the result of `tone_map`, sRGB-encoded and rounded to codes: (..., 3) uint8, or uint16 for bits=16."""
    scale = 2.0**bits - 1.0
    encoded = encode_srgb(tone_map(pixels, exposure, tonemap).astype(np.float64))
    return np.rint(encoded * scale).astype(np.uint8 if bits == 8 else np.uint16)
