"""Decode untrusted pictures: PNG, JPEG and similar ones with Pillow, of few formats and after a check of the size; headers of HDR.

Source of HDR: G. Ward, "Radiance file formats" (filefmts)."""

import io
import re
import warnings
from collections.abc import Iterator
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


# --- Radiance HDR: what the header says; OpenImageIO decodes the pixels ------------------------------------------------

_HEADER = re.compile(rb"#\?(?:RADIANCE|RGBE)(.*?)\n\r?\n-Y\s+(\d{1,10})\s+\+X\s+(\d{1,10})\s*?\n", re.DOTALL)


def hdr_header(data: bytes, most: int) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the factor, (3,) float32, by which the pixels were multiplied, and their primaries: x and y of red, green, blue and white.

    The factor is the product of all lines EXPOSURE and COLORCORR. Raises InputError for a wrong header, and for more than `most` pixels."""
    header = _HEADER.match(data)
    if header is None:
        raise InputError("cannot be read as an image: it is no .hdr file whose header ends in a size such as -Y 512 +X 1024")
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
    check_size(int(header[3]), int(header[2]), most)
    return factor, (REC_709, *numbers("PRIMARIES", 8))[-1]
