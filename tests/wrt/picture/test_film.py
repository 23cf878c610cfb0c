from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.picture_metadata import read_metadata
from tests.refused import refused
from wrt.picture.decode import decode_rgba8
from wrt.picture.film import AOV_VIEWS, Film, aov_to_srgb8
from wrt.picture.image import read_channels
from wrt.picture.tonemap import to_codes

H, W = 12, 17


@pytest.fixture
def film() -> Film:
    rng = np.random.default_rng(0)
    miss = np.zeros((H, W), bool)
    miss[0] = True
    normal = rng.normal(size=(H, W, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Film(
        pixels=rng.random((H, W, 3), dtype=np.float32) * 4,
        variance=rng.random((H, W, 3), dtype=np.float32),
        samples=np.full((H, W), 16, np.int32),
        aov={
            "depth": np.where(miss, np.inf, 1 + 9 * rng.random((H, W))).astype(np.float32),
            "normal": np.where(miss[..., None], 0, normal).astype(np.float32),
            "albedo": rng.random((H, W, 3), dtype=np.float32),
            "prim_id": np.where(miss, -1, rng.integers(0, 1 << 24, (H, W))).astype(np.int32),
            "material_id": np.where(miss, -1, rng.integers(0, 5, (H, W))).astype(np.int32),
        },
        metadata={"scene": "scenes/whitted.toml", "spp": 16, "seed": 7, "seconds": 1.5, "version": "0.1.0"},
        exposure=-1.0,
        tonemap="agx",
    )


def test_exr_holds_every_layer_exactly(film: Film, tmp_path: Path) -> None:
    assert film.save(tmp_path / "a.exr") == [tmp_path / "a.exr"]
    channels = read_channels(tmp_path / "a.exr")
    expected = {
        **{"RGB"[i]: film.pixels[..., i] for i in range(3)},
        **{f"variance.{'RGB'[i]}": film.variance[..., i] for i in range(3)},
        **{f"normal.{'XYZ'[i]}": film.aov["normal"][..., i] for i in range(3)},
        **{f"albedo.{'RGB'[i]}": film.aov["albedo"][..., i] for i in range(3)},
        "depth.Z": film.aov["depth"],
        "prim_id": film.aov["prim_id"],
        "material_id": film.aov["material_id"],
        "samples": film.samples,
    }
    assert channels.keys() == expected.keys()
    for name, array in expected.items():
        assert np.array_equal(channels[name].astype(array.dtype), array), name


def test_png_is_shown_as_the_film_says_and_layers_go_beside_it(film: Film, tmp_path: Path) -> None:
    written = film.save(tmp_path / "a.png", aov=["depth", "prim_id"])
    assert [path.name for path in written] == ["a.png", "a.depth.png", "a.prim_id.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in written)
    assert np.array_equal(decode_rgba8(written[0].read_bytes())[..., :3], to_codes(film.pixels, -1.0, "agx"))
    assert np.array_equal(decode_rgba8(written[1].read_bytes())[..., :3], aov_to_srgb8("depth", film.aov["depth"]))
    hit = film.aov["depth"][np.isfinite(film.aov["depth"])]
    told = read_metadata(written[1])
    assert (float(told["white"]), float(told["darkest"])) == (hit.min(), hit.max()) and "white" not in read_metadata(written[2])
    assert read_metadata(written[0]) == {key: str(value) for key, value in film.metadata.items()}


def test_wrong_names_write_nothing(film: Film, tmp_path: Path) -> None:
    with refused("aov", "no AOV 'dept'", hint="depth, normal"):
        film.save(tmp_path / "a.png", aov=["depth", "dept"])
    with refused(hint="use .png, .exr, .hdr"):
        film.save(tmp_path / "a.gif")
    (tmp_path / "a.depth.png").mkdir()
    with refused(what="folder", path="a.depth.png"):
        film.save(tmp_path / "a.png", aov=["normal", "depth"])
    assert [path.name for path in tmp_path.iterdir()] == ["a.depth.png"]


def test_notebook_display_is_the_picture(film: Film) -> None:
    with Image.open(io.BytesIO(film._repr_png_())) as image:
        assert np.array_equal(np.asarray(image), film.to_srgb8())


def test_shapes_are_checked(film: Film) -> None:
    with refused("pixels", "variance", place="film"):
        Film(film.pixels, film.variance[1:], film.samples)
    with refused("aov", "'depth'", place="film"):
        Film(film.pixels, film.variance, film.samples, aov={"depth": film.aov["depth"][:, 1:]})


# --- views ------------------------------------------------------------------------------------------------------------


def test_there_is_a_view_of_every_layer(film: Film) -> None:
    for name, array in film.layers.items():
        view = aov_to_srgb8(name, array)
        assert view.shape == (H, W, 3) and view.dtype == np.uint8
    assert set(film.layers) == set(AOV_VIEWS)
    with refused("aov", "'motion'"):
        aov_to_srgb8("motion", film.samples)


def test_depth_view_is_white_near_dark_far_and_black_on_a_miss() -> None:
    view = aov_to_srgb8("depth", np.array([[1.0, 3.0, 5.0, np.inf]]))[0, :, 0]
    assert view[0] == 255 and view[0] > view[1] > view[2] > view[3] == 0
    assert int(view[0]) - view[1] == pytest.approx(int(view[1]) - view[2], abs=1)
    assert aov_to_srgb8("depth", np.full((1, 2), np.inf)).max() == 0
    assert aov_to_srgb8("depth", np.full((1, 2), 3.0)).min() == 255


def test_normal_view_maps_minus_one_to_one_to_all_codes() -> None:
    view = aov_to_srgb8("normal", np.array([[[1.0, 0.0, -1.0], [0.0, 0.0, 0.0]]]))
    assert view[0, 0] == pytest.approx([255, 128, 0], abs=1)
    assert view[0, 1].max() == 0


def test_id_view_tells_numbers_apart_and_leaves_a_miss_black() -> None:
    ids = np.arange(-1, 2000, dtype=np.int32)[None]
    view = aov_to_srgb8("prim_id", ids)[0].astype(int)
    assert view[0].max() == 0 and view[1:].min() >= 64
    assert len(np.unique(view, axis=0)) > 1990
    neighbours = np.abs(np.diff(view[1:], axis=0)).sum(axis=1)
    assert np.median(neighbours) > 100
