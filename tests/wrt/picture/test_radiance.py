"""Radiance HDR files say how their rows run, what their pixels were multiplied by, and how they are packed.

The files are packed by hand."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from wrt.picture.image import read_image

FORMAT = "FORMAT=32-bit_rle_rgbe\n"
DARK, BRIGHT = bytes([128, 128, 128, 126]), bytes([128, 128, 128, 129])  # 0.125 and 1


def read(folder: Path, size: str, body: bytes, header: str = FORMAT, magic: str = "#?RADIANCE") -> np.ndarray:
    (folder / "a.hdr").write_bytes(f"{magic}\n{header}\n{size}\n".encode() + body)
    return read_image(folder / "a.hdr")


def in_runs(rows: np.ndarray) -> bytes:
    """Rows of RGBE with the newer run lengths: each channel of a row as one run where it is constant, else as literal bytes."""
    packed = b""
    for row in rows:
        packed += bytes([2, 2, len(row) >> 8, len(row) & 255])
        for channel in row.T:
            packed += bytes([128 + len(row), channel[0]]) if (channel == channel[0]).all() else bytes([len(row)]) + channel.tobytes()
    return packed


@pytest.mark.parametrize("packed", [False, True], ids=["flat", "runs"])
@pytest.mark.parametrize(("first", "second", "axes"), [(*signs, axes) for signs in itertools.product("+-", "+-") for axes in ("YX", "XY")])
def test_each_of_the_eight_orientations(first: str, second: str, axes: str, packed: bool, tmp_path: Path) -> None:
    rgbe = np.random.default_rng(0).integers(128, 256, (9, 12, 4), dtype=np.uint8)
    rgbe[..., 3] = 130
    right = rgbe[..., :3] * np.float32(2.0 ** (130 - 136))
    signs = dict(zip(axes, (first, second), strict=True))  # "-Y" goes down from the top, "+X" to the right; lines go along the second
    lines = rgbe[:: 1 if signs["Y"] == "-" else -1, :: 1 if signs["X"] == "+" else -1]
    lines = lines if axes == "YX" else lines.swapaxes(0, 1)
    line = f"{first}{axes[0]} {lines.shape[0]} {second}{axes[1]} {lines.shape[1]}"
    assert np.array_equal(read(tmp_path, line, in_runs(lines) if packed else lines.tobytes()), right)


def test_pixels_are_divided_by_every_exposure_and_colour_correction(tmp_path: Path) -> None:
    header = "EXPOSURE=4\n" + FORMAT + "EXPOSURE= 5e-1\n\tEXPOSURE=100\nCOLORCORR=1 2 4\n# EXPOSURE=9\n"
    assert read(tmp_path, "-Y 1 +X 1", BRIGHT, header)[0, 0].tolist() == [0.5, 0.25, 0.125]
    eight = in_runs(np.frombuffer(BRIGHT * 8, np.uint8).reshape(1, 8, 4))
    assert read(tmp_path, "-Y 1 +X 8", eight, header)[0, 7].tolist() == [0.5, 0.25, 0.125]


def test_older_run_lengths(tmp_path: Path) -> None:
    def repeat(count: int) -> bytes:
        return bytes([1, 1, 1, count])

    assert (read(tmp_path, "-Y 1 +X 20", BRIGHT + repeat(19)) == 1.0).all()
    # A second colour of that kind holds the higher byte of the count: 44 + 2 * 256 = 556. Runs go on from one row to the next.
    pixels = read(tmp_path, "-Y 2 +X 300", DARK + BRIGHT + repeat(44) + repeat(2) + DARK + repeat(41)).reshape(-1, 3)
    assert (pixels == np.repeat([0.125, 1.0, 0.125], [1, 557, 42])[:, None]).all()
    for body in (BRIGHT + repeat(18), repeat(19) + BRIGHT, repeat(20), b"", BRIGHT * 19):
        with refused(what="of 20 pixels", path="a.hdr"):
            read(tmp_path, "-Y 1 +X 20", body)


def test_exponents_are_powers_of_two_and_an_exponent_of_zero_is_black(tmp_path: Path) -> None:
    rgbe = np.array([[200, 3, 0, e] for e in range(256)], np.uint8)
    right = np.ldexp(rgbe[:, :3].astype(np.float64), rgbe[:, 3:].astype(int) - 136)
    right[0] = 0.0
    assert np.array_equal(read(tmp_path, "-Y 256 +X 1", rgbe.tobytes())[:, 0], right.astype(np.float32))


def test_primaries_are_converted(tmp_path: Path) -> None:
    """ITU-R BT.2087, table of the conversion from BT.2020 to BT.709, of the colour (1, 0.5, 0.25)."""
    body, rec_2020 = bytes([128, 64, 32, 129]), "PRIMARIES=0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n"
    matrix = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    assert read(tmp_path, "-Y 1 +X 1", body, FORMAT + rec_2020)[0, 0] == pytest.approx(matrix @ [1.0, 0.5, 0.25], abs=1e-4)
    rec_709 = "PRIMARIES=0.640 0.330 0.300 0.600 0.150 0.060 0.3127 0.3290\n"
    assert read(tmp_path, "-Y 1 +X 1", body, FORMAT + rec_709)[0, 0].tolist() == [1.0, 0.5, 0.25]


@pytest.mark.parametrize(("header", "what"), [
    ("FORMAT=32-bit_rle_xyze\n", "must have FORMAT=32-bit_rle_rgbe"),
    (FORMAT + "GAMMA=2.2\n", "GAMMA 1"),
    (FORMAT + "EXPOSURE=0\n", "EXPOSURE and COLORCORR above 0"),
    (FORMAT + "COLORCORR=1 -1 1\n", "EXPOSURE and COLORCORR above 0"),
    (FORMAT + "EXPOSURE=1e300\nEXPOSURE=1e300\n", "EXPOSURE and COLORCORR above 0"),
    (FORMAT + "EXPOSURE=nan\n", "EXPOSURE and COLORCORR above 0"),
    (FORMAT + "EXPOSURE=bright\n", "each line EXPOSURE must hold 1 numbers"),
    (FORMAT + "COLORCORR=1 2\n", "each line COLORCORR must hold 3 numbers"),
    (FORMAT + "PRIMARIES=0.3 0.3 0.3 0.3 0.3 0.3 0.3 0.3\n", "span no colours"),
])
def test_what_is_not_read_is_refused_by_its_name(header: str, what: str, tmp_path: Path) -> None:
    with refused(what=what, path="a.hdr"):
        read(tmp_path, "-Y 1 +X 1", BRIGHT, header)


@pytest.mark.parametrize("size", ["-Y 1 +Y 1", "-Y 1", "1 1", ""])
def test_a_header_without_a_size_is_refused(size: str, tmp_path: Path) -> None:
    with refused(path="a.hdr"):
        read(tmp_path, size, BRIGHT)


def test_the_other_first_line_and_line_ends_of_windows(tmp_path: Path) -> None:
    assert read(tmp_path, "-Y 1 +X 1", BRIGHT, FORMAT, magic="#?RGBE")[0, 0, 0] == 1.0
    assert read(tmp_path, "\r\n-Y 1 +X 1\r", BRIGHT, "EXPOSURE=2\r\n" + FORMAT.replace("\n", "\r"), magic="#?RADIANCE\r")[0, 0, 0] == 0.5


def test_lines_with_and_without_run_lengths_are_refused_together(tmp_path: Path) -> None:
    rgbe = np.random.default_rng(0).integers(128, 255, (3, 16, 4), dtype=np.uint8)
    with refused(what="lines with run lengths and lines without", path="a.hdr"):
        read(tmp_path, "-Y 3 +X 16", rgbe[0].tobytes() + in_runs(rgbe[1:]))
