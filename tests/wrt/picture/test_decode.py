"""Untrusted pictures: the size is checked first, few formats are tried, and all of 16 bits are read."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.refused import refused
from wrt.picture import image
from wrt.picture.decode import decode_rgba8
from wrt.picture.tonemap import to_codes


def png(codes: np.ndarray, color_type: int, interlaced: bool = False) -> bytes:
    """A 16-bit PNG, each row with another filter (1 and 2 by hand, the rest none)."""
    height, width = codes.shape[:2]
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in codes)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, interlaced)) + chunk(
        b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("channels", "color_type"), [(1, 0), (3, 2), (2, 4), (4, 6)])
def test_sixteen_bits_are_read(channels: int, color_type: int, tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(0, 65536, (5, 7, channels)).astype(np.uint16)
    expected = codes[..., :3] if channels > 2 else np.repeat(codes[..., :1], 3, axis=2)
    data = png(codes, color_type)
    (tmp_path / "a.png").write_bytes(data)
    assert np.array_equal(to_codes(image.read_image(tmp_path / "a.png"), bits=16), expected)
    assert np.array_equal(decode_rgba8(data)[..., :3], expected >> 8)
    (tmp_path / "a.png").write_bytes(data[:-40])
    with refused(what="read", path="a.png"):
        image.read_image(tmp_path / "a.png")


def keyed(kind: int, bits: int, key: tuple[int, ...], rows: list[list[tuple[int, ...]]]) -> bytes:
    """A PNG of grey (kind 0) or RGB (kind 2) with a transparent colour, `bits` a channel, packed without Pillow."""
    raw = b""
    for row in rows:
        digits = "".join(f"{value:0{bits}b}" for pixel in row for value in pixel)
        digits += "0" * (-len(digits) % 8)
        raw += b"\0" + int(digits, 2).to_bytes(len(digits) // 8, "big")

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", len(rows[0]), len(rows), bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"tRNS", struct.pack(f">{len(key)}H", *key)) + chunk(
        b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("kind", "bits"), [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16)])
def test_the_transparent_colour_of_every_depth(kind: int, bits: int) -> None:
    """Source: W3C, PNG specification (third edition), 11.3.1.1: samples are compared in the file's own bits."""
    most = 2**bits - 1
    choice = range(most + 1) if bits < 16 else [0x1234, 0x1235, 0x3412, 0x0034]  # these share bytes
    values = np.random.default_rng(bits).choice(choice, (9, 41, 1 if kind == 0 else 3))
    for key in (tuple(values[2, 3].tolist()), tuple(values[0, 0].tolist()), (most,) * values.shape[2]):
        data = keyed(kind, bits, key, values.tolist())
        decoded = decode_rgba8(data)
        assert np.array_equal(decoded[..., 3], np.where((values == key).all(axis=2), 0, 255))
        assert np.array_equal(decoded[..., :3], np.broadcast_to(values * 255 // most if bits < 16 else values >> 8, (*values.shape[:2], 3)))


def png_header(width: int, height: int) -> bytes:
    """A PNG with this size in its header, and a single pixel."""
    data = png(np.zeros((1, 1, 3)), 2)
    header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def exr_header(width: int, height: int) -> bytes:
    """An OpenEXR file with this size in its header, and no pixels."""
    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"".join(name + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    return b"\x76\x2f\x31\x01\2\0\0\0" + b"".join([
        attribute(b"channels", b"chlist", channels), attribute(b"compression", b"compression", b"\0"),
        attribute(b"dataWindow", b"box2i", window), attribute(b"displayWindow", b"box2i", window),
        attribute(b"lineOrder", b"lineOrder", b"\0"), attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        attribute(b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1.0))]) + b"\0"


@pytest.mark.parametrize("size", [(30000, 30000), (40000, 1), (1, 40000), (2**30, 2**30)])
@pytest.mark.parametrize("suffix", [".png", ".exr", ".hdr", ".bmp"])
def test_bombs_are_refused_by_their_headers(suffix: str, size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    data = {".png": png_header(width, height), ".exr": exr_header(width, height),
            ".hdr": f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode(),
            ".bmp": b"BM" + struct.pack("<IIIIiiHHIIiiII", 70, 0, 54, 40, width, height, 1, 24, 0, 16, 0, 0, 0, 0)}[suffix]
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    with refused(path=path) as caught:
        image.read_image(path)
    if max(size) < 2**20 and size[0] * size[1] < 2**27:  # beyond, some libraries have words of their own
        assert f"it is {width}x{height}; at most 32768 pixels a side and" in str(caught.value)


@pytest.mark.parametrize("form", ["TIFF", "PPM", "ICO", "PCX", "EPS", "TGA"])
def test_no_other_format_is_tried(form: str, tmp_path: Path) -> None:
    """Pillow and OpenImageIO have many more formats, and some run programs. No file name leads to these formats."""
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(buffer, form)
    with refused(what="none"):
        decode_rgba8(buffer.getvalue())
    for suffix in (".png", ".exr", ".hdr"):
        (tmp_path / f"a{suffix}").write_bytes(buffer.getvalue())
        with refused(path=f"a{suffix}"):
            image.read_image(tmp_path / f"a{suffix}")
