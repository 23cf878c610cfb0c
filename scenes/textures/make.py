"""Make the images beside this file from formulas: `python scenes/textures/make.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from PIL import Image

FOLDER = Path(__file__).resolve().parent
SIDE = 256


def main() -> None:
    save("leaf.png", leaf())
    save("fade.png", fade())
    save("print.png", printed())
    save("bumps_normal.png", normals(bumps()))
    save("glow.png", glow())
    save("wear.png", wear())
    sky("sky.hdr")


def grid(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """x to the right and y down, each (side, side) from 0 to 1 at the middles of the pixels."""
    middle = (np.arange(side) + 0.5) / side
    return np.meshgrid(middle, middle, indexing="xy")


def covered(distance: np.ndarray) -> np.ndarray:
    """How much of each pixel is inside, from the signed distance to the outline in units of the picture's width."""
    return np.clip(0.5 - distance * SIDE, 0.0, 1.0)


def codes(*channels: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(np.stack(np.broadcast_arrays(*channels), axis=-1), 0.0, 1.0) * 255.0).astype(np.uint8)


def save(name: str, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(FOLDER / name, optimize=True)


def leaf() -> np.ndarray:
    """A leaf with toothed edges and a stalk; alpha is the outline. For alpha masks."""
    x, y = grid()
    along = np.clip((0.86 - y) / 0.78, 0.0, 1.0)  # from the stalk to the tip
    half = 0.36 * np.sin(np.pi * along**0.8) ** 0.9 * (1.0 - 0.10 * np.abs(np.sin(9.0 * np.pi * along)))
    inside = np.maximum(covered(np.abs(x - 0.5) - half) * (np.abs(y - 0.47) < 0.39),
                        covered(np.abs(x - 0.5) - 0.012) * (y > 0.5) * (y < 0.98))
    side = np.abs(x - 0.5)
    veins = np.exp(-((np.mod(along - 0.9 * side, 0.13) - 0.065) / 0.012) ** 2) * (side < half)
    veins = np.maximum(veins, np.exp(-(side / 0.008) ** 2))
    shade = 0.75 + 0.25 * np.cos(6.0 * side) + 0.15 * veins
    return codes(0.30 * shade + 0.15 * veins, 0.56 * shade + 0.12 * veins, 0.16 * shade, inside)


def fade() -> np.ndarray:
    """A white disc whose alpha falls from 1 in the middle to 0 at its edge. For blending."""
    x, y = grid()
    radius = 2.0 * np.hypot(x - 0.5, y - 0.5)
    alpha = np.clip(1.0 - radius, 0.0, 1.0)
    return codes(np.ones_like(x), np.ones_like(x), np.ones_like(x), alpha * alpha * (3.0 - 2.0 * alpha))


def printed() -> np.ndarray:
    """A picture that shows which way up it is: an F on a coloured ramp in a frame."""
    x, y = grid()
    red, green, blue = 0.25 + 0.65 * x, 0.30 + 0.25 * y, 0.80 - 0.55 * x
    strokes = np.zeros_like(x, dtype=bool)
    for left, right, top, low in ((0.30, 0.40, 0.18, 0.82), (0.30, 0.72, 0.18, 0.28), (0.30, 0.60, 0.45, 0.55)):
        strokes |= (x > left) & (x < right) & (y > top) & (y < low)
    frame = np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.46
    ink = np.where(strokes, 0.97, np.where(frame, 0.12, np.nan))
    return codes(*(np.where(np.isnan(ink), channel, ink) for channel in (red, green, blue)))


def bumps() -> np.ndarray:
    """Heights in units of the picture's width: round studs in rows, every second one a dent; seamless."""
    x, y = grid()
    u, v = np.mod(4.0 * x, 1.0) - 0.5, np.mod(4.0 * y, 1.0) - 0.5
    sign = np.where((np.floor(4.0 * x) + np.floor(4.0 * y)) % 2.0 == 0.0, 1.0, -1.0)
    return sign * np.sqrt(np.clip(0.36**2 - u * u - v * v, 0.0, None)) * 0.12


def normals(height: np.ndarray) -> np.ndarray:
    """A tangent-space normal map as glTF wants it: +x to the right, +y up in the picture."""
    slope_x = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * (SIDE / 2.0)
    slope_y = -(np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) * (SIDE / 2.0)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(height)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return codes(*(0.5 + 0.5 * normal[..., axis] for axis in range(3)))


def glow() -> np.ndarray:
    """Lit windows of a house front, some dark. For emission."""
    x, y = grid()
    column, row = np.floor(6.0 * x), np.floor(8.0 * y)
    u, v = 6.0 * x - column, 8.0 * y - row
    pane = (np.abs(u - 0.5) < 0.32) & (np.abs(v - 0.5) < 0.34) & (np.abs(u - 0.5) > 0.03)
    lit = np.mod(3.0 * column + 5.0 * row + column * row, 4.0) != 1.0
    warm = 0.55 + 0.45 * np.mod(0.37 * column + 0.61 * row, 1.0)
    on = pane & lit
    return codes(on * 1.0, on * (0.55 + 0.4 * warm), on * (0.25 + 0.6 * warm * warm))


def wear() -> np.ndarray:
    """Roughness in green and metallic in blue: polished metal bands in rough paint. For metallic-roughness."""
    x, y = grid()
    band = covered(0.12 - np.abs(np.mod(6.0 * x + 2.0 * y, 1.0) - 0.5) * 0.5)
    return codes(np.ones_like(x), 0.75 - 0.60 * band, band)


def sky(name: str, width: int = 256, height: int = 128) -> None:
    """An equirectangular sky: blue above, haze at the horizon, brown ground, and a sun of 3 degrees to the left."""
    angle = (np.arange(height) + 0.5) / height * np.pi
    turn = ((np.arange(width) + 0.5) / width - 0.5) * 2.0 * np.pi
    polar, azimuth = np.meshgrid(angle, turn, indexing="ij")
    direction = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)], axis=-1)
    up = direction[..., 1:2]
    zenith, haze, ground = np.array([0.16, 0.33, 0.85]), np.array([0.95, 0.92, 0.85]), np.array([0.20, 0.16, 0.12])
    pixels = haze + (zenith - haze) * np.clip(up, 0.0, 1.0) ** 0.45
    pixels = np.where(up < 0.0, ground + (haze - ground) * np.exp(18.0 * np.minimum(up, 0.0)), pixels)
    sun = np.array([-0.62, 0.55, 0.30])
    cosine = direction @ (sun / np.linalg.norm(sun))
    pixels += np.array([1.0, 0.85, 0.6]) * (np.exp((cosine[..., None] - 1.0) * 60.0) * 0.6)
    pixels[cosine > np.cos(np.radians(3.0))] = (330.0, 300.0, 250.0)
    picture = oiio.ImageBuf(np.ascontiguousarray(pixels, dtype=np.float32))
    if not picture.write(str(FOLDER / name)):
        raise SystemExit(picture.geterror())


if __name__ == "__main__":
    main()
