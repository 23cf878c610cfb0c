"""Decode untrusted pictures: PNG, JPEG and similar ones with Pillow, of few formats and after a check of the size, and Radiance HDR.

Source of HDR: G. Ward, "Radiance file formats" (filefmts); resolu.c and color.c of Radiance."""

import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.picture.tonemap import REC_709

# Other formats of Pillow, such as EPS, run programs.
FORMATS = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "GIF")
MAX_SIDE = 32768  # pixels
MAX_PIXELS = 1 << 27  # 16384x8192


def check_size(width: int, height: int, most: int = MAX_PIXELS) -> None:
    """Raise InputError if a picture has more than MAX_SIDE pixels on a side or more than `most` pixels."""
    if max(width, height) > MAX_SIDE or width * height > most:
        raise InputError(f"cannot be read as an image: it is {width}x{height}",
                         hint=f"at most {MAX_SIDE} pixels a side and {most} in all are read")


def decode_rgba8(data: bytes, formats: tuple[str, ...] = FORMATS) -> np.ndarray:
    """Decode a picture to (H, W, 4) uint8 codes, row 0 on top. Alpha is 255 in a picture without alpha.

    16-bit channels keep their high byte; colour profiles are ignored. Raises InputError for a broken, truncated or too large picture."""
    with _opened(data, formats) as picture:
        bits, key = data[24] if picture.format == "PNG" else 8, picture.info.get("transparency")
        if bits == 16 and "A" not in picture.mode:  # Pillow would clip grey to 255, and cut the transparent colour to 8 bits
            codes = decode_png16(data)
            alpha = np.full(codes.shape[:2], 255) if key is None else 255 * (codes != np.array(key)).any(axis=2)
            return np.dstack([codes >> 8, alpha]).astype(np.uint8)
        if picture.mode == "L" and isinstance(key, int):  # Pillow widens grey of 2 and 4 bits, but not the transparent one
            picture.info["transparency"] = key % 2**bits * (255 // (2**bits - 1))
        return np.array(picture.convert("RGBA"))


def decode_png16(data: bytes) -> np.ndarray:
    """Decode a PNG with 16 bits a channel to (H, W, 3) uint16 codes without alpha. Raises InputError as decode_rgba8 does.

    Pillow keeps one byte of each channel of a colour picture: the high one, or the low one if the byte order is declared as swapped.
    Grey with alpha has four bytes a pixel, read here as RGBA. (OpenImageIO keeps all bytes, but its libpng writes errors to stderr.)"""
    with _opened(data, ("PNG",)) as picture:
        order = picture.tile[0][3] if picture.tile else ""
        if picture.mode.startswith("I"):
            return np.repeat(np.asarray(picture).astype(np.uint16)[..., None], 3, axis=2)
        if order == "LA;16B":
            picture.tile = [(*tile[:3], "RGBA") for tile in picture.tile]
            high, low = (np.repeat(np.asarray(picture)[..., i:i + 1], 3, axis=2) for i in (0, 1))
        else:
            high = np.asarray(picture)[..., :3]
            with _opened(data, ("PNG",)) as other:
                other.tile = [(*tile[:3], str(tile[3]).replace(";16B", ";16L")) for tile in other.tile]
                low = np.asarray(other)[..., :3]
        codes = high.astype(np.uint16)
        codes <<= 8
        codes |= low
        return codes


@contextmanager
def _opened(data: bytes, formats: tuple[str, ...]) -> Iterator[Any]:
    """Yield a Pillow image, which decodes its pixels on first use."""
    with needed_by("a picture in a file"):
        from PIL import Image, UnidentifiedImageError

    Image.init()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of sizes above half its own limit, and of metadata
            with Image.open(io.BytesIO(data), formats=[name for name in formats if name in Image.OPEN]) as picture:
                check_size(*picture.size)
                yield picture
    except (InputError, MemoryError):
        raise
    except UnidentifiedImageError:
        raise InputError(f"cannot be read as an image: it is none of {', '.join(formats)}") from None
    except Exception as error:  # decoders raise nearly anything on a broken file
        raise InputError(f"cannot be read as an image: {' '.join(str(error).split()) or type(error).__name__}") from error


# --- Radiance HDR: what the header says, and the pixels that OpenImageIO cannot read ----------------------------------

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
    pixels = (decode_runs() if runs else _decode_flat(body, height * width)).reshape(height, width, 3) / factor
    by_columns = header[3] == b"X"
    pixels = pixels[:: -1 if (header[2] == b"-") == by_columns else 1, :: -1 if (header[5] == b"+") == by_columns else 1]
    return np.ascontiguousarray(pixels.swapaxes(0, 1) if by_columns else pixels), (REC_709, *numbers("PRIMARIES", 8))[-1]


def _decode_flat(body: bytes, count: int) -> np.ndarray:
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
