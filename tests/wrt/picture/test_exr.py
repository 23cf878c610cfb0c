"""OpenEXR files say where their pixels lie, which part and which channels are colours, and in which primaries. OpenImageIO writes them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.refused import refused
from wrt.core.errors import SceneWarning
from wrt.picture.image import read_channels, read_image

oiio = pytest.importorskip("OpenImageIO")

AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)


def specification(pixels: np.ndarray, names: str = "R G B", kind: str = "float", **attributes: str) -> Any:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.channelnames = tuple(names.split())
    for key, value in attributes.items():
        spec.attribute(key, value)
    return spec


def save(path: Path, *parts: tuple[Any, np.ndarray]) -> Path:
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), tuple(spec for spec, _ in parts)), out.geterror()
    for i, (spec, pixels) in enumerate(parts):
        assert i == 0 or out.open(str(path), spec, "AppendSubimage"), out.geterror()
        assert out.write_image(pixels), out.geterror()
    out.close()
    return path


def colours(height: int = 2, width: int = 3, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3), dtype=np.float32)


def with_primaries(pixels: np.ndarray, primaries: tuple[float, ...]) -> Any:
    spec = specification(pixels)
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), primaries)
    return spec


# --- windows ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [(0, 0), (100, -40)], ids=str)
@pytest.mark.parametrize(("x", "y", "width", "height"), [
    (6, 3, 4, 2), (-2, -1, 20, 10), (0, 0, 16, 8), (12, -3, 9, 5), (-3, 6, 5, 9), (16, 0, 4, 4), (-4, -4, 4, 4), (40, 40, 2, 2),
])
def test_pixels_lie_where_the_windows_put_them(x: int, y: int, width: int, height: int, origin: tuple[int, int], tmp_path: Path) -> None:
    pixels = colours(height, width) + 1.0
    spec = specification(pixels)
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = *origin, 16, 8
    spec.x, spec.y = x + origin[0], y + origin[1]
    right = np.zeros((8, 16, 3), np.float32)
    for row in range(height):
        for column in range(width):
            if 0 <= y + row < 8 and 0 <= x + column < 16:
                right[y + row, x + column] = pixels[row, column]
    path = save(tmp_path / "a.exr", (spec, pixels))
    assert np.array_equal(read_image(path), right)
    assert np.array_equal(read_channels(path)["G"], right[..., 1])


# --- parts and channels -----------------------------------------------------------------------------------------------


def test_the_first_part_with_colours_is_read(tmp_path: Path) -> None:
    pixels, other = colours(), colours(seed=1)
    depth = specification(pixels[..., :1], "Z", name="depth")
    normals = specification(pixels, "X Y Z", name="normals")
    first, second = specification(pixels, name="first"), specification(pixels, name="second")
    path = save(tmp_path / "a.exr", (depth, other[..., :1]), (normals, other), (first, pixels), (second, other))
    assert np.array_equal(read_image(path), pixels)


@pytest.mark.parametrize(("names", "columns"), [
    ("R G B", (0, 1, 2)), ("B G R", (2, 1, 0)), ("A B G N R", (4, 2, 1)), ("r g b", (0, 1, 2)), ("Y", (0, 0, 0)), ("A Y", (1, 1, 1)),
    ("Z R G B Y", (1, 2, 3)), ("Y Z", (0, 0, 0)),
])
def test_channels_count_by_their_names(names: str, columns: tuple[int, ...], tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((2, 3, len(names.split())), dtype=np.float32)
    path = save(tmp_path / "a.exr", (specification(pixels, names), pixels))
    assert np.array_equal(read_image(path), pixels[..., columns])


@pytest.mark.parametrize("names", ["Z", "R", "A", "X Y Z", "R G", "diffuse.R diffuse.G diffuse.B", "id"])
def test_channels_without_colours_are_refused_and_named(names: str, tmp_path: Path) -> None:
    pixels = np.ones((2, 3, len(names.split())), np.float32)
    path = save(tmp_path / "a.exr", (specification(pixels, names), pixels))
    with refused(what="must have channels R, G and B, or grey Y; it has " + names.split()[0], path=path):
        read_image(path)


def test_whole_numbers_are_kept(tmp_path: Path) -> None:
    ids = np.array([[[10, 20, 30], [0, 1, 1 << 24]]], np.uint32)
    assert np.array_equal(read_image(save(tmp_path / "a.exr", (specification(ids, kind="uint"), ids))), ids)


# --- primaries --------------------------------------------------------------------------------------------------------


def test_chromaticities_are_converted_to_rec_709(tmp_path: Path) -> None:
    """ACES 2065-1 to Rec. 709, by the matrix that is published for it (with Bradford's adaptation)."""
    pixels = colours()
    matrix = np.array([[2.521686, -1.134131, -0.387555], [-0.276480, 1.372719, -0.096239], [-0.015378, -0.152975, 1.168353]])
    path = save(tmp_path / "a.exr", (with_primaries(pixels, AP0), pixels))
    assert read_image(path) == pytest.approx(pixels @ matrix.T, abs=2e-4)
    assert np.array_equal(read_channels(path)["R"], pixels[..., 0])  # channels are what the file holds


def test_white_stays_white_and_rec_709_stays_itself(tmp_path: Path) -> None:
    grey = np.full((1, 2, 3), 0.5, np.float32)
    for primaries in (AP0, REC_2020, (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)):
        assert read_image(save(tmp_path / "a.exr", (with_primaries(grey, primaries), grey))) == pytest.approx(grey, abs=1e-6)
    pixels = colours()
    same = with_primaries(pixels, (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290))
    assert np.array_equal(read_image(save(tmp_path / "b.exr", (same, pixels))), pixels)


@pytest.mark.parametrize("primaries", [(0.3,) * 8, (0.0,) * 8, (np.nan,) * 8], ids=["a point", "zeros", "NaN"])
def test_primaries_that_span_no_colours_are_refused(primaries: tuple[float, ...], tmp_path: Path) -> None:
    pixels = colours()
    path = save(tmp_path / "a.exr", (with_primaries(pixels, primaries), pixels))
    with refused(what="its primaries and white span no colours", path=path):
        read_image(path)


def test_another_colour_space_by_name_is_refused(tmp_path: Path) -> None:
    pixels = colours()
    for space, good in (("lin_rec709_scene", True), ("lin_ap1_scene", False), ("srgb_rec709_scene", False)):
        path = save(tmp_path / "a.exr", (specification(pixels, **{"oiio:ColorSpace": space}), pixels))
        if good:
            assert np.array_equal(read_image(path), pixels)
        else:
            with refused(what=f"its colour space is {space}", path=path):
                read_image(path)


# --- environments -----------------------------------------------------------------------------------------------------


def test_bad_pixels_of_an_environment_are_replaced_and_counted(tmp_path: Path) -> None:
    pixels = np.array([[[1, -0.001, 1], [np.inf, 1, 2], [np.nan, 5, 6], [-np.inf, 0, 0], [7, 8, 9]]], np.float32)
    path = save(tmp_path / "a.exr", (specification(pixels), pixels))
    with pytest.warns(SceneWarning, match=r"a\.exr: 4 pixels negative, NaN or infinite") as caught:
        sky = read_image(path, environment=True)
    assert len(caught) == 1
    assert sky.tolist() == [[[1, 0, 1], [65504, 1, 2], [0, 5, 6], [0, 0, 0], [7, 8, 9]]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(read_image(path), pixels, equal_nan=True)  # for `compare`: as the file has it


def test_an_infinite_sun_in_other_primaries_stays_white(tmp_path: Path) -> None:
    pixels = np.array([[[np.inf] * 3, [1.0, 1.0, 1.0]]], np.float32)
    with pytest.warns(SceneWarning, match="1 pixel negative, NaN or infinite"):
        sky = read_image(save(tmp_path / "a.exr", (with_primaries(pixels, AP0), pixels)), environment=True)
    assert sky[0, 0] == pytest.approx([65504.0] * 3, rel=1e-5)


def test_a_cube_map_is_refused(tmp_path: Path) -> None:
    pixels = colours(48, 8)
    spec = specification(pixels, textureformat="CubeFace Environment")
    spec.attribute("openexr:envmap", 1)
    with refused(what="it is a cube map", path="a.exr"):
        read_image(save(tmp_path / "a.exr", (spec, pixels)))
