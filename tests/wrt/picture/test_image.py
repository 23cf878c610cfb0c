from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command_line import largest_file
from tests.picture_metadata import read_metadata
from tests.refused import Refusal, refused
from wrt.core.errors import SceneWarning
from wrt.picture.decode import decode_rgba8
from wrt.picture.image import EXACT_IN_FLOAT, FORMATS, check_writable, read_channels, read_image, write_exr, write_image
from wrt.picture.tonemap import decode_srgb, to_codes

H, W = 70, 51  # more rows than are written at a time
METADATA = {"scene": "scenes/öl auf 漢.toml", "spp": 64, "seed": 3, "seconds": 12.25, "version": "0.1.0"}
EACH_SUFFIX = pytest.mark.parametrize("suffix", FORMATS)


@pytest.fixture
def pixels() -> np.ndarray:
    return (np.random.default_rng(0).random((H, W, 3)) ** 4 * 50).astype(np.float32)


def mitsuba_bitmap(path: Path) -> np.ndarray:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    return np.array(mi.Bitmap(str(path)))


def oiio_pixels(path: Path, format: str) -> np.ndarray:
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    pixels = source.read_image(format)
    source.close()
    return pixels


# --- PNG --------------------------------------------------------------------------------------------------------------


def test_png8_holds_the_codes_and_pillow_agrees(pixels: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_image(path, pixels, exposure=-2.0, tonemap="aces", metadata=METADATA)
    codes = to_codes(pixels, -2.0, "aces")
    with Image.open(path) as image:
        assert image.mode == "RGB"
        assert np.array_equal(np.asarray(image), codes)
        assert image.text == {f"wrt:{key}": str(value) for key, value in METADATA.items()}
        assert "srgb" in image.info
    assert np.array_equal(decode_rgba8(path.read_bytes())[..., :3], codes)
    assert np.array_equal(to_codes(read_image(path)), codes)


def test_png16_holds_the_codes_and_openimageio_agrees(pixels: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_image(path, pixels, bits=16, tonemap="agx", metadata=METADATA)
    codes = to_codes(pixels, 0.0, "agx", bits=16)
    assert len(np.unique(codes & 255)) > 100
    assert np.array_equal(oiio_pixels(path, "uint16"), codes)
    assert np.array_equal(to_codes(read_image(path), bits=16), codes)
    assert np.array_equal(decode_rgba8(path.read_bytes())[..., :3], codes >> 8)


def test_png_of_nonfinite_pixels_is_clipped_and_counted(pixels: np.ndarray, tmp_path: Path) -> None:
    pixels[0, :3] = np.array([np.nan, np.inf, -np.inf])[:, None]
    with pytest.warns(SceneWarning, match=r"a\.png: 3 pixels NaN or infinite"):
        write_image(tmp_path / "a.png", pixels)
    assert decode_rgba8((tmp_path / "a.png").read_bytes())[0, :3, 0].tolist() == [0, 255, 0]


# --- EXR --------------------------------------------------------------------------------------------------------------


def test_exr_is_exact_and_mitsuba_agrees(pixels: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    pixels[0, 0] = (np.nan, np.inf, -np.inf)
    pixels[0, 1] = (-1.0, 1e-42, 3e38)
    write_image(path, pixels, exposure=3.0, tonemap="aces", metadata=METADATA)
    assert np.array_equal(read_image(path), pixels, equal_nan=True)
    assert np.array_equal(mitsuba_bitmap(path), pixels, equal_nan=True)
    assert read_metadata(path) == {key: str(value) for key, value in METADATA.items()}


def test_half_exr_clips_what_a_half_cannot_hold_and_counts_it(pixels: np.ndarray, tmp_path: Path) -> None:
    pixels[0, 0] = (1e6, np.inf, np.nan)
    pixels[0, 1] = -1e6
    with pytest.warns(SceneWarning, match=r"a\.exr: 2 pixels beyond 65504"):
        write_image(tmp_path / "a.exr", pixels, bits=16)
    back = read_image(tmp_path / "a.exr")
    assert np.array_equal(back[0, :2], [[65504, np.inf, np.nan], [-65504] * 3], equal_nan=True)


def test_exr_keeps_each_channel_with_its_own_type(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    rng = np.random.default_rng(0)
    channels = {
        "R": rng.random((H, W)).astype(np.float16),
        "depth.Z": np.where(rng.random((H, W)) < 0.1, np.inf, rng.random((H, W))).astype(np.float32),
        "prim_id": rng.integers(-1, EXACT_IN_FLOAT + 1, (H, W)).astype(np.int32),
    }
    write_exr(tmp_path / "a.exr", channels)
    for name, array in read_channels(tmp_path / "a.exr").items():
        assert np.array_equal(array, channels[name]), name
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    types = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    assert types == {"R": "half", "depth.Z": "float", "prim_id": "float"}


# --- HDR --------------------------------------------------------------------------------------------------------------


def test_hdr_keeps_eight_bits_of_the_brightest_channel(pixels: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    write_image(path, pixels, exposure=3.0, tonemap="aces", metadata=METADATA)
    bound = pixels.max(axis=-1, keepdims=True) / 128
    for back in (read_image(path), mitsuba_bitmap(path)):
        assert (np.abs(back - pixels) <= bound).all()


@pytest.mark.parametrize(("suffix", "kind"), [(".jpg", "JPEG"), (".JPEG", "JPEG"), (".webp", "WEBP")])
def test_pictures_with_losses_are_close_to_the_png_and_say_what_they_are(suffix: str, kind: str, tmp_path: Path) -> None:
    y, x = np.mgrid[0:48, 0:64] / 64
    smooth = np.stack([x, y, 1 - x], axis=-1).astype(np.float32) * 2.0
    write_image(tmp_path / "a.png", smooth, exposure=-1, tonemap="aces")
    write_image(tmp_path / f"a{suffix}", smooth, exposure=-1, tonemap="aces", metadata={"scene": "ä b"})
    with Image.open(tmp_path / f"a{suffix}") as image, Image.open(tmp_path / "a.png") as exact:
        assert image.format == kind and image.getexif()[0x010E] == "wrt:scene=? b"
        assert np.abs(np.asarray(image.convert("RGB"), int) - np.asarray(exact, int)).max() <= 12


# --- whole or not at all ----------------------------------------------------------------------------------------------


@EACH_SUFFIX
def test_a_full_disk_leaves_the_old_file_and_nothing_else(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    noise = np.random.default_rng(0).random((H, 4 * W, 3)).astype(np.float32)
    with largest_file(10_000), refused(None, "cannot be written", path=path) as caught:
        write_image(path, noise)
    assert not re.search("[0-9a-f]{32}", str(caught.value))  # the temporary name is nobody's business
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


# --- refused before the work ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "bits", "message"),
    [
        ("a.gif", None, (None, "cannot write .gif", None, "a.gif", "use .png, .exr, .hdr, .jpg")),
        ("a", None, (None, "file without a suffix", None, "a")),
        ("a.png", 32, ("bits", "png is written")),
        ("a.hdr", 16, ("bits", "hdr is written")),
        ("missing/a.png", None, (None, "its folder does", None, "a.png")),
        ("file/a.png", None, (None, "its folder does")),
        ("folder.png", None, (None, "folder")),
    ],
)
def test_unusable_outputs_are_refused(
    name: str, bits: int | None, message: Refusal, pixels: np.ndarray, tmp_path: Path
) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    uses: tuple[Callable[[Path], None], ...] = (
        lambda path: check_writable(path, bits), lambda path: write_image(path, pixels, bits=bits))
    for use in uses:
        with refused(*message):
            use(tmp_path / name)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.png"]


def test_pixels_of_a_wrong_shape_are_refused(tmp_path: Path) -> None:
    for shape in ((4, 4), (4, 4, 4), (0, 4, 3)):
        with refused("pixels", "(H, W, 3)"):
            write_image(tmp_path / "a.png", np.zeros(shape))


# --- reading ----------------------------------------------------------------------------------------------------------


def test_pictures_of_every_pillow_mode_are_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    table = decode_srgb(np.arange(256) / 255).astype(np.float32)

    alpha = rng.integers(0, 256, (H, W, 1), dtype=np.uint8)
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "alpha.png")
    assert np.array_equal(read_image(tmp_path / "alpha.png"), table[rgb])
    assert np.array_equal(decode_rgba8((tmp_path / "alpha.png").read_bytes()), np.dstack([rgb, alpha]))

    Image.fromarray(rgb[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(read_image(tmp_path / "grey.png"), table[np.repeat(rgb[..., :1], 3, axis=-1)])

    palette = Image.fromarray(rgb).quantize(16)
    palette.save(tmp_path / "palette.png")
    assert np.array_equal(read_image(tmp_path / "palette.png"), table[np.asarray(palette.convert("RGB"))])

    deep = rng.integers(0, 65536, (H, W), dtype=np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    assert np.array_equal(decode_rgba8((tmp_path / "deep.png").read_bytes())[..., 1], deep >> 8)
    assert np.array_equal(to_codes(read_image(tmp_path / "deep.png"), bits=16)[..., 2], deep)


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_files_by_mitsuba_are_read(suffix: str, pixels: np.ndarray, tmp_path: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.Bitmap(pixels).write(str(tmp_path / f"a{suffix}"))
    bound = pixels.max(axis=-1, keepdims=True) / 128 if suffix == ".hdr" else 0.0
    assert (np.abs(read_image(tmp_path / f"a{suffix}") - pixels) <= bound).all()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.99])
@pytest.mark.parametrize("kind", ["a.png", "a16.png", "a.exr", "a.hdr", "a.jpg"])
def test_truncated_files_are_refused(
    kind: str, share: float, pixels: np.ndarray, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / kind
    if path.suffix == ".jpg":
        Image.fromarray(to_codes(pixels)).save(path)
    else:
        write_image(path, pixels, bits=16 if kind == "a16.png" else None)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with refused(None, "cannot be read as an image", path=path) as caught:
        read_image(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""  # no library talks beside the one message


@pytest.mark.parametrize("name", ["a.png", "a.exr", "a.hdr", "a.jpg"])
def test_what_is_no_picture_is_refused(name: str, tmp_path: Path) -> None:
    with refused(None, "No such file", path=name):
        read_image(tmp_path / name)
    (tmp_path / name).write_text("hello " * 50)
    with refused(None, "as an image", path=name):
        read_image(tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    with refused(path=name):
        read_image(tmp_path / name)
