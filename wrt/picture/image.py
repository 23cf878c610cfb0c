"""Image files: PNG (8 and 16 bit), JPEG, WebP, OpenEXR and Radiance HDR. Each file is written completely or not at all.

Row 0 is on top. Colours in memory are linear Rec. 709; PNG, JPEG and WebP files hold sRGB codes. OpenImageIO reads and writes EXR and
HDR; Pillow reads the rest (wrt.picture.decode), and writes JPEG and WebP. PNG is encoded here: Pillow writes no 16-bit RGB, and
OpenImageIO's PNG writer damages text outside ASCII and reports success on a full disk.
"""

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core import files
from wrt.core.errors import InputError, at, warn
from wrt.core.files import read_file, replacing
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.picture.decode import FORMATS as FORMATS_READ
from wrt.picture.decode import check_size, decode_png16, decode_rgba8, read_hdr
from wrt.picture.tonemap import REC_709, decode_srgb, to_codes, to_rec_709

Metadata = Mapping[str, object]

# Bits per channel in which a format is written; the first is the default.
FORMATS: dict[str, tuple[int, ...]] = {".png": (8, 16), ".exr": (32, 16), ".hdr": (32,), ".jpg": (8,), ".jpeg": (8,), ".webp": (8,)}
# Options of Pillow for files with losses: nearly invisible ones.
LOSSY: dict[str, dict[str, Any]] = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"quality": 95}}
MOST_LOSSY = {"JPEG": 65535, "WEBP": 16383}  # pixels of a side
DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga")  # read as sRGB codes
LINEAR_SUFFIXES = (".exr", ".hdr")
METADATA_PREFIX = "wrt:"  # begins the names of text entries
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MAGIC = {".exr": (b"\x76\x2f\x31\x01",), ".hdr": (b"#?RADIANCE", b"#?RGBE")}
MAX_LINEAR_PIXELS = 1 << 28  # an environment of 24576x10922, or 16384x16384
HALF_MAX = 65504.0
EXACT_IN_FLOAT = 1 << 24  # float32 represents all integers up to this one


# --- before and around writing ----------------------------------------------------------------------------------------


def output_format(path: PathLike, bits: int | None = None) -> tuple[str, int]:
    """Return the suffix and the bits per channel for `path`. Raises InputError if wrt does not write that format."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"cannot write {suffix or 'a file without a suffix'}", path=path, hint=f"use {', '.join(FORMATS)}")
    if bits is not None and bits not in FORMATS[suffix]:
        raise InputError(f"{suffix} is written with {' or '.join(map(str, FORMATS[suffix]))} bits, not {bits}", argument="bits", path=path)
    return suffix, bits or FORMATS[suffix][0]


def check_writable(path: PathLike, bits: int | None = None) -> None:
    """Raise InputError before any work if an image cannot be written to `path`."""
    output_format(path, bits)
    files.check_writable(path)


# --- writing ----------------------------------------------------------------------------------------------------------


def write_image(path: PathLike, pixels: np.ndarray, *, bits: int | None = None, exposure: float = 0.0,
                tonemap: str = "none", metadata: Metadata | None = None) -> None:
    """Write one picture in the format of the suffix.

    - pixels: (H, W, 3) linear. bits: per channel, of FORMATS (default 8 for PNG, 32 for EXR and HDR; 16 in EXR is half).
    - exposure, tonemap: for PNG, JPEG and WebP alone; metadata: text entries, written as `wrt:key`; HDR has none.

    EXR keeps NaN and infinite values. In PNG, JPEG and WebP, NaN and -inf are black, +inf is white. HDR has 0 for NaN and negative
    values, and its largest value for +inf. A SceneWarning counts replaced pixels. Raises InputError if the file cannot be written; an
    existing file then stays unchanged."""
    pixels = np.asarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise InputError(f"must be (H, W, 3), got {pixels.shape}", argument="pixels", path=path)
    suffix, bits = output_format(path, bits)
    if suffix not in LINEAR_SUFFIXES:
        _warn_replaced(path, ~np.isfinite(pixels), "NaN or infinite, written as black or white")
        write_codes(path, to_codes(pixels, exposure, tonemap, bits), metadata)
    elif suffix == ".exr":
        write_exr(path, color_channels("", as_half(path, pixels) if bits == 16 else pixels), metadata)
    else:
        _write_hdr(path, pixels)


def write_codes(path: PathLike, codes: np.ndarray, metadata: Metadata | None = None) -> None:
    """Write display codes, (H, W, 3) uint8 or (PNG alone) uint16, in the format of the suffix. Raises InputError as write_image does."""
    kind = {".webp": "WEBP", ".png": "PNG"}.get(Path(path).suffix.lower(), "JPEG")
    with at(path=path):
        data = encode_png(codes, metadata) if kind == "PNG" else _encode_lossy(codes, kind, metadata or {})
    files.write_bytes(path, data)


def _encode_lossy(codes: np.ndarray, kind: str, metadata: Metadata) -> bytes:
    """Encode (H, W, 3) uint8 sRGB codes as a JPEG or WebP file, with the metadata in EXIF's ImageDescription (tag 0x010E)."""
    with needed_by("a JPEG or WebP picture"):
        from PIL import Image

    if max(codes.shape) > MOST_LOSSY[kind]:
        raise InputError(f"a side of a {kind} picture has at most {MOST_LOSSY[kind]} pixels, not {max(codes.shape)}", hint="write a .png")
    out, exif = io.BytesIO(), Image.Exif()
    exif[0x010E] = "; ".join(f"{METADATA_PREFIX}{key}={value}" for key, value in metadata.items()).encode("ascii", "replace").decode()
    Image.fromarray(codes).save(out, kind, exif=exif, **LOSSY[kind])
    return out.getvalue()


def write_exr(path: PathLike, channels: Mapping[str, np.ndarray], metadata: Metadata | None = None) -> None:
    """Write named channels to one OpenEXR part, ZIP-compressed.

    channels: (H, W) each, all of one size; float16 is stored as half, other types as float. Integers are exact up to 2^24; a SceneWarning
    reports larger integers. (OpenEXR has integer channels, but OpenImageIO's Python binding rounds them beside float channels.)
    Raises InputError as write_image does."""
    oiio = _oiio()
    arrays = list(channels.values())
    height, width = arrays[0].shape
    types = ["half" if array.dtype == np.float16 else "float" for array in arrays]
    # OpenImageIO reads the types of the channels only if they differ, and the type of the whole otherwise.
    spec = oiio.ImageSpec(width, height, len(arrays), types[0])
    spec.channelnames = tuple(channels)
    spec.channelformats = tuple(oiio.TypeDesc(name) for name in types)
    spec.attribute("compression", "zip")
    for key, value in (metadata or {}).items():
        spec.attribute(METADATA_PREFIX + key, _utf8(value).decode())
    for name, array in channels.items():
        if array.dtype.kind in "iu" and array.size and int(array.max()) > EXACT_IN_FLOAT:
            warn(f"{os.fspath(path)}: {name} goes up to {array.max()} and is rounded: its channel is exact to {EXACT_IN_FLOAT}")
    _write_oiio(path, spec, np.stack(arrays, axis=-1, dtype=np.float32, casting="unsafe"))


def _oiio() -> Any:
    with needed_by("an EXR or HDR picture"):
        import OpenImageIO

    return OpenImageIO


def _write_oiio(path: PathLike, spec: Any, pixels: np.ndarray) -> None:
    """Write (H, W, C) float32 by OpenImageIO."""
    oiio = _oiio()
    with replacing(path) as file:
        out = oiio.ImageOutput.create(Path(path).suffix[1:])
        try:
            good = out is not None and out.open(file.name, spec) and out.write_image(pixels) and out.close()
        except TypeError:
            raise InputError("cannot be written: OpenImageIO needs a path in UTF-8", path=path) from None
        # OpenImageIO reports some failures, such as a full disk, by geterror alone.
        error = " ".join((oiio if out is None else out).geterror().split()).replace(file.name, os.fspath(path))
        if error or not good:
            raise InputError(f"cannot be written: {error or 'unknown error'}", path=path)


def _write_hdr(path: PathLike, pixels: np.ndarray) -> None:
    _warn_replaced(path, ~(np.isfinite(pixels) & (pixels >= 0.0)), "negative, NaN or infinite, which .hdr cannot hold")
    clipped = np.clip(np.nan_to_num(pixels, nan=0.0, posinf=1e38, neginf=0.0), 0.0, 1e38)
    _write_oiio(path, _oiio().ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float"), clipped)


def color_channels(layer: str, pixels: np.ndarray, names: str = "RGB") -> dict[str, np.ndarray]:
    """Split (H, W, 3) into the EXR channels `layer.R`, `layer.G`, `layer.B` (or other letters); `R`, `G`, `B` without a layer."""
    return {f"{layer}.{name}" if layer else name: pixels[..., i] for i, name in enumerate(names)}


def as_half(path: PathLike, pixels: np.ndarray) -> np.ndarray:
    """Convert to float16. Finite values beyond +-65504 are clipped, and a SceneWarning with `path` counts the pixels."""
    beyond = np.isfinite(pixels) & (np.abs(pixels) > HALF_MAX)
    _warn_replaced(path, beyond, f"beyond {HALF_MAX:g}, the largest half, and clipped to it")
    return np.where(beyond, np.copysign(np.float32(HALF_MAX), pixels), pixels).astype(np.float16)


def _utf8(value: object) -> bytes:
    """Encode a value as UTF-8 text; lone surrogates (from file names that are not UTF-8) become "?"."""
    return str(value).encode("utf-8", "replace")


def _warn_replaced(path: PathLike, where: np.ndarray, what: str) -> None:
    if where.any():
        count = int(where.any(axis=-1).sum())
        warn(f"{os.fspath(path)}: {count} pixel{'s' * (count != 1)} {what}")


def encode_png(codes: np.ndarray, metadata: Metadata | None = None) -> bytes:
    """Encode (H, W, 3) uint8 or uint16 sRGB codes as a PNG file, with metadata in iTXt (UTF-8) entries named `wrt:key`.

    Source: W3C, Portable Network Graphics Specification (third edition); every row has the filter "up"."""
    if codes.ndim != 3 or codes.shape[2] != 3 or codes.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"codes must be (H, W, 3) uint8 or uint16, got {codes.shape} {codes.dtype}")
    height, width = codes.shape[:2]
    rows = np.frombuffer(codes.astype(codes.dtype.newbyteorder(">")).tobytes(), np.uint8).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    filtered[1:, 1:] = rows[1:] - rows[:-1]  # modulo 256, as the filter requires

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8 * codes.dtype.itemsize, 2, 0, 0, 0)
    texts = [chunk(b"iTXt", (METADATA_PREFIX + key).encode("latin-1", "replace")[:79] + bytes(5) + _utf8(value))
             for key, value in (metadata or {}).items()]
    return b"".join([PNG_MAGIC, chunk(b"IHDR", header), chunk(b"sRGB", b"\0"), *texts,
                     chunk(b"IDAT", zlib.compress(filtered.tobytes(), 6)), chunk(b"IEND", b"")])


# --- reading ----------------------------------------------------------------------------------------------------------


def read_image(path: PathLike, *, environment: bool = False) -> np.ndarray:
    """Read the colours of an image file: (H, W, 3) float32, linear Rec. 709, row 0 on top, as large as the display window.

    - environment: replace what no radiance is: negative and NaN by 0, infinite by HALF_MAX. A SceneWarning counts the pixels.

    EXR: the first part with channels R, G and B, or grey Y. PNG, JPEG and similar files are decoded from sRGB, 16-bit PNG at full
    precision. Alpha is ignored. Raises InputError for a missing, truncated or too large file, and for what is not read."""
    suffix = Path(path).suffix.lower()
    with at(path=path), np.errstate(over="ignore", invalid="ignore"):  # factors and primaries of the header may be wild
        if suffix == ".exr":
            pixels, primaries = _read_exr(path)
        elif suffix == ".hdr":
            pixels, primaries = read_hdr(read_file(path), MAX_LINEAR_PIXELS, lambda: _read_runs(path))
        elif suffix in DISPLAY_SUFFIXES:
            data, primaries = read_file(path), REC_709
            formats = ("TGA",) if suffix == ".tga" else FORMATS_READ  # TGA files have no magic number: the suffix decides
            codes = decode_png16(data) if data[:8] + data[24:25] == PNG_MAGIC + b"\x10" else decode_rgba8(data, formats)[..., :3]
            pixels = decode_srgb(np.arange(np.iinfo(codes.dtype).max + 1) / np.iinfo(codes.dtype).max).astype(np.float32)[codes]
        else:
            raise InputError(f"is no image file: its suffix must be one of {', '.join(LINEAR_SUFFIXES + DISPLAY_SUFFIXES)}")
        if not environment:
            return to_rec_709(pixels, primaries)
        good = np.isfinite(pixels)
        pixels = to_rec_709(np.nan_to_num(pixels, nan=0.0, posinf=HALF_MAX, neginf=0.0), primaries)
    _warn_replaced(path, ~good | (pixels < 0.0), f"negative, NaN or infinite, read as 0 (infinite: as {HALF_MAX:g})")
    return np.maximum(pixels, 0.0)


def read_channels(path: PathLike) -> dict[str, np.ndarray]:
    """Read all channels of the first part of an EXR file, by name: (H, W) float32, as large as the display window.

    Raises InputError for a missing, truncated or too large file, and for a file that is no such picture."""
    with at(path=path), _opened(path, ".exr") as source:
        return _channels(source, 0, source.spec().channelnames)


def _read_exr(path: PathLike) -> tuple[np.ndarray, Sequence[float]]:
    """Read the colours of the first part that has some, and their primaries."""
    with _opened(path, ".exr") as source:
        others: list[str] = []
        while source.seek_subimage(len(others), 0):
            spec = source.spec()
            if names := _color_names(spec.channelnames):
                if spec.getattribute("openexr:envmap") == 1:
                    raise InputError("cannot be read as an image: it is a cube map", hint="exrenvmap converts it")
                primaries, space = spec.getattribute("chromaticities", _oiio().TypeDesc("float[8]")), spec.getattribute("colorInteropID")
                if primaries is None and space not in (None, "", "data", "unknown", "lin_rec709_scene"):
                    raise InputError(f"cannot be read as an image: its colour space is {space}", hint="use linear Rec. 709")
                channels = _channels(source, len(others), names)
                return np.stack([channels[name] for name in (names * 3)[:3]], axis=-1), primaries or REC_709
            others.append(", ".join(spec.channelnames))
        raise InputError(f"must have channels R, G and B, or grey Y; it has {'; '.join(others)}")


def _color_names(names: Sequence[str]) -> list[str]:
    """Return the names of red, green and blue, or of grey. Y is a coordinate beside X, and has its colour apart beside RY and BY."""
    known = {name.upper(): name for name in names} | {name: name for name in names}
    if known.keys() >= {"R", "G", "B"}:
        return [known[name] for name in "RGB"]
    return [known["Y"]] if "Y" in known and not known.keys() & {"X", "RY", "BY"} else []


def _channels(source: Any, part: int, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read channels of a part by name, (H, W) float32 in its display window. Pixels outside the data window are 0."""
    source.seek_subimage(part, 0)
    spec = source.spec()
    if spec.depth > 1 or spec.deep:
        raise InputError("cannot be read as an image: it must be flat, but has depth samples or slices")
    check_size(max(spec.width, spec.full_width), max(spec.height, spec.full_height), MAX_LINEAR_PIXELS)
    wanted = [i for i, name in enumerate(spec.channelnames) if name in names]
    first, last = wanted[0], wanted[-1] + 1
    block = _read(source, part, 0, first, last, "float")
    for i in wanted:
        if str(spec.channelformat(i)) == "uint":  # OpenImageIO divides whole numbers by the largest one if it converts them to float
            block[..., i - first] = _read(source, part, 0, i, i + 1, "uint")[..., 0]
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    whole = np.zeros((spec.full_height, spec.full_width, last - first), np.float32)
    whole[max(y, 0): max(y + spec.height, 0), max(x, 0): max(x + spec.width, 0)] = block[
        max(-y, 0): max(spec.full_height - y, 0), max(-x, 0): max(spec.full_width - x, 0)]
    return {spec.channelnames[i]: whole[..., i - first] for i in wanted}


def _read_runs(path: PathLike) -> np.ndarray:
    with _opened(path, ".hdr") as source:
        return _read(source, "float")


def _read(source: Any, *where: Any) -> np.ndarray:
    if (pixels := source.read_image(*where)) is None:
        raise InputError(f"cannot be read as an image: {_reason(source.geterror)}")
    return np.asarray(pixels)


@contextlib.contextmanager
def _opened(path: PathLike, suffix: str) -> Iterator[Any]:
    """Open an EXR or HDR file in OpenImageIO. The first bytes are checked before, because OpenImageIO would try every format."""
    if not read_file(path, 16).startswith(_MAGIC[suffix]):
        raise InputError(f"cannot be read as an image: it is no {suffix} file")
    oiio = _oiio()
    oiio.attribute("try_all_readers", 0)
    try:
        source = oiio.ImageInput.open(os.fspath(path))
    except TypeError:  # not UTF-8
        raise InputError("cannot be read: OpenImageIO needs a path in UTF-8") from None
    if source is None:
        raise InputError(f"cannot be read as an image: {_reason(oiio.geterror)}")
    try:
        yield source
    finally:
        source.close()


def _reason(geterror: Callable[[], str]) -> str:
    """Return the error message of OpenImageIO on one line."""
    try:
        return " ".join(geterror().split()) or "unknown error"
    except UnicodeDecodeError:  # it quotes names from the file
        return "its names are not UTF-8"
