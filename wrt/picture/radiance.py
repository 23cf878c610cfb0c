"""Radiance HDR files: what the header says, and the pixels that OpenImageIO cannot read.

Source: G. Ward, "Radiance file formats" (filefmts); resolu.c and color.c of Radiance.
"""

import re
from collections.abc import Callable

import numpy as np

from wrt.core.errors import InputError
from wrt.picture.decode import check_size
from wrt.picture.tonemap import REC_709

_HEADER = re.compile(rb"#\?(?:RADIANCE|RGBE)(.*?)\n\r?\n([+-])([XY])\s+(\d{1,10})\s+([+-])(?!\3)[XY]\s+(\d{1,10})\s*?\n", re.DOTALL)


def read_hdr(data: bytes, most: int, decode_runs: Callable[[], np.ndarray]) -> tuple[np.ndarray, tuple[float, ...]]:
    """Read linear pixels, (H, W, 3) float32 with row 0 on top, and their primaries: x and y of red, green, blue and white.

    Pixels are divided by the products of all lines EXPOSURE and COLORCORR. decode_runs returns pixels with run lengths by channel, in the
    file's order. Raises InputError for a wrong header, more than `most` pixels, too few of them, and what is not read."""
    header = _HEADER.match(data)
    if header is None:
        raise InputError("cannot be read as an image: it is no .hdr file: the header ends in a size, as in -Y 512 +X 1024")
    # Lines of the pictures that this picture was made of begin with a tab, and do not count.
    lines = [line.partition("=")[::2] for line in header[1].decode("latin-1").splitlines()]

    def numbers(name: str, count: int) -> np.ndarray:  # a row for each line of that name
        try:
            rows = [value.split() for key, value in lines if key == name]
            return np.array(rows, dtype=np.float64).reshape(len(rows), count)
        except ValueError:
            raise InputError(f"cannot be read as an image: each line {name} must hold {count} numbers") from None
    factor = (numbers("EXPOSURE", 1).prod(axis=0) * numbers("COLORCORR", 3).prod(axis=0)).astype(np.float32)
    kinds, good = {value.strip() for key, value in lines if key == "FORMAT"}, np.isfinite(factor) & (factor > 0.0)
    if kinds != {"32-bit_rle_rgbe"} or (numbers("GAMMA", 1) != 1.0).any() or not good.all():
        raise InputError("cannot be read as an image: it must have FORMAT=32-bit_rle_rgbe, GAMMA 1, and EXPOSURE and COLORCORR above 0")
    height, width, body = int(header[4]), int(header[6]), data[header.end():]
    check_size(width, height, most)
    may_run, coded = 8 <= width < 32768, bytes((2, 2, width >> 8 & 255, width & 255))  # begins a line with run lengths by channel
    runs = may_run and body[:2] == b"\2\2" and body[2:3] < b"\x80"
    if may_run and not runs and any(body[first : first + 4] == coded for first in range(0, 4 * width * height, 4 * width)):
        raise InputError("cannot be read as an image: it has lines with run lengths and lines without")
    pixels = (decode_runs() if runs else _decode(body, height * width)).reshape(height, width, 3) / factor
    by_columns = header[3] == b"X"
    pixels = pixels[:: -1 if (header[2] == b"-") == by_columns else 1, :: -1 if (header[5] == b"+") == by_columns else 1]
    return np.ascontiguousarray(pixels.swapaxes(0, 1) if by_columns else pixels), (REC_709, *numbers("PRIMARIES", 8))[-1]


def _decode(body: bytes, count: int) -> np.ndarray:
    """Decode pixels that have no run lengths, or the older ones, to (count, 3) float32.

    The colour 1, 1, 1 repeats the pixel before it; its last byte is the count, or the next 8 bits of it after another such colour."""
    pixels = np.frombuffer(body, np.uint8, len(body) // 4 * 4).reshape(-1, 4)
    repeats = (pixels[:, :3] == 1).all(axis=1)
    origin = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(pixels))))
    counts = np.where(repeats, pixels[:, 3].astype(np.int64) << np.clip(8 * (np.arange(len(pixels)) - origin - 1), 0, 24), 1)
    pixels = pixels[np.repeat(origin, np.diff(np.cumsum(counts).clip(max=count), prepend=0))]
    if len(pixels) < count or repeats[:1].any():
        raise InputError(f"cannot be read as an image: it has {len(pixels)} of {count} pixels, or begins with a repetition")
    return np.ldexp(pixels[:, :3].astype(np.float32), np.where(pixels[:, 3:] > 0, pixels[:, 3:] - np.int32(136), -300))
