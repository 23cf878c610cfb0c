"""Heat maps: a colour for the value of each pixel, with a colour scale."""

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.packages import needed_by
from wrt.picture.tonemap import encode_srgb

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

INK, PALE = (30, 30, 30), (110, 110, 110)
BAR, MARGIN, TITLE = 18, 14, 30  # pixels: width of the scale, margin, height of the title
LEAST = 480  # pixels: narrower pictures are enlarged by a whole factor
BRIGHTEST = 99.0  # percentile of the values at which the last colour begins


@cache
def colors() -> np.ndarray:
    """Return the colour scale (256, 3) uint8: black, blue, red, yellow, near white, in even steps of OKLCh lightness."""
    t = np.linspace(0.0, 1.0, 256)
    lightness = 0.10 + 0.87 * t
    hue = np.radians(270.0 + 195.0 * t)
    chroma = 0.19 * np.sin(np.pi * t**0.9) ** 0.8
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    lms = np.stack([lightness + 0.3963377774 * a + 0.2158037573 * b, lightness - 0.1055613458 * a - 0.0638541728 * b,
                    lightness - 0.0894841775 * a - 1.2914855480 * b]) ** 3
    matrix = np.array([[4.0767416621, -3.3077115913, 0.2309699292], [-1.2684380046, 2.6097574011, -0.3413193965],
                       [-0.0041960863, -0.7034186147, 1.7076147010]])
    return np.rint(255.0 * encode_srgb(np.clip(matrix @ lms, 0.0, 1.0)).T).astype(np.uint8)


def top_of(values: np.ndarray) -> float:
    """Return the end of the colour scale: a round number that 99 % of the values do not exceed; 1 if all values are 0."""
    most = float(np.percentile(values, BRIGHTEST) or values.max()) if values.size else 0.0
    if most <= 0.0:
        return 1.0
    step = step_of(most)
    return step * math.ceil(most / step - 1e-9)


def step_of(top: float) -> float:
    """Return the distance of the marks of a scale from 0 to `top`: 1, 2 or 5 times a power of ten. 4 to 10 distances reach `top`."""
    power = 10.0 ** math.floor(math.log10(top / 4.0))
    return next(power * factor for factor in (5.0, 2.0, 1.0) if top / (power * factor) >= 4.0 - 1e-9)


def colored(values: np.ndarray, top: float) -> np.ndarray:
    """Return colours, (h, w, 3) uint8, of values (h, w) >= 0; `top` and larger values get the last colour."""
    return colors()[np.rint(np.clip(np.nan_to_num(values / top, posinf=1.0), 0.0, 1.0) * 255.0).astype(np.uint8)]


def heatmap(values: np.ndarray, title: str, top: float | None = None) -> np.ndarray:
    """Draw values (h, w) >= 0, row 0 on top, as (H, W, 3) uint8 with a title and a colour scale.

    top: end of the scale; larger values have its colour; None: `top_of(values)`. The mean and the largest value follow the title."""
    with needed_by("a heat map"):
        from PIL import Image, ImageDraw

    scale = max(1, -(-LEAST // values.shape[1]))
    height, width = values.shape[0] * scale, values.shape[1] * scale
    top = top_of(values) if top is None else top
    bar_height = max(height, 120)
    image = Image.new("RGB", (MARGIN * 3 + width + BAR + 64, TITLE + bar_height + MARGIN), "white")
    image.paste(Image.fromarray(colored(values, top).repeat(scale, axis=0).repeat(scale, axis=1)), (MARGIN, TITLE))
    left = 2 * MARGIN + width
    ramp = colors()[np.rint(np.linspace(255.0, 0.0, bar_height)).astype(np.uint8)]
    image.paste(Image.fromarray(np.repeat(ramp[:, None], BAR, axis=1)), (left, TITLE))
    canvas = ImageDraw.Draw(image)
    largest = float(values.max(initial=0.0))
    canvas.text((MARGIN, TITLE // 2), f"{title}; mean {short(float(values.mean()))}, largest {short(largest)}", fill=INK,
                font=font(13), anchor="lm")
    step = step_of(top)
    for i in range(round(top / step) + 1):
        y = TITLE + (bar_height - 1) * (1.0 - i * step / top)
        canvas.line((left + BAR, y, left + BAR + 4, y), fill=PALE)
        more = " +" if i == round(top / step) and largest > top else ""
        canvas.text((left + BAR + 7, y), short(i * step) + more, fill=INK, font=font(12), anchor="lm")
    return np.asarray(image)


def short(value: float) -> str:
    """Format a value with three digits (four from 1000 on); in k (thousands) from ten thousand on, in M (millions) from ten million on."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if value >= 10.0 * factor:
            return f"{value / factor:.3g}{letter}"
    return f"{value:.4g}" if value >= 1000.0 else f"{value:.3g}"


@cache
def font(size: int) -> "FreeTypeFont | ImageFont":
    from PIL.ImageFont import load_default

    return load_default(size)
