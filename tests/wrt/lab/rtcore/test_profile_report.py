"""`python -m wrt profile`: warps of a picture, heat maps that show what they say, and a command that writes it all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import wrt as command
from tests.refused import refused
from tests.wrt.lab.rtcore.test_profiler import MIRRORS
from wrt.lab.rtcore.parameters import GPUS
from wrt.lab.rtcore.profile_report import GROUPS, model_rows, warp_order, work_of
from wrt.lab.rtcore.profiler import KINDS, PICTURES, Profile, profile
from wrt.picture.heatmap import colors, heatmap, short, step_of, top_of
from wrt.picture.image import read_channels, read_image


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    path = tmp_path_factory.mktemp("scene") / "mirrors.toml"
    path.write_text(MIRRORS)
    return profile(path, spp=2)


def test_a_warp_is_rays_of_one_kind_depth_and_turn_in_a_block_of_pixels(measured: Profile) -> None:
    """16 x 8 pixels are four blocks; in the two on the left each pixel has a shadow ray, on the right 5 reflections, and that
    for both samples."""
    rays = measured.rays
    rows, warp = warp_order(measured, np.arange(len(rays)))
    assert sorted(rows.tolist()) == list(range(len(rays))) and (np.diff(warp) >= 0).all()
    assert len(np.unique(warp)) == 2 * (4 + 2 + 2 * 5) and (np.bincount(warp) == 32).all()
    for name in ("kind", "depth"):
        for w in np.unique(warp):
            assert len(np.unique(getattr(rays, name)[rows[warp == w]])) == 1
    y, x = np.divmod(rays.pixel[rows], 16)
    block = y // 4 * 2 + x // 8
    assert all(len(np.unique(block[warp == w])) == 1 and len(np.unique(rays.pixel[rows[warp == w]])) == 32 for w in np.unique(warp))


def test_work_has_the_fetches_of_its_rays(measured: Profile) -> None:
    rays = measured.rays
    assert len(rays.trace_rows) == len(rays)  # so small a picture is traced as a whole
    total = 0
    for group in GROUPS:
        work = work_of(measured, group)
        assert work is not None and len(work) == 32 * (int(work.warp[-1]) + 1)
        assert len(work) == np.isin(rays.kind, [KINDS.index(kind) for kind in GROUPS[group]]).sum()
        c = work.counters
        size = np.add.reduceat(c.size, c.first[:-1])
        assert (size == c.counts["node_bytes"].astype(int) + c.counts["primitive_bytes"]).all()
        total += len(work)
    assert total == 2 * len(rays)  # all, and each of the others once
    rows, _ = warp_order(measured, np.arange(len(rays)))
    everything = work_of(measured, "all")
    assert everything is not None
    for i in (0, 17, len(rays) - 1):
        a, b = (slice(first[j], first[j + 1]) for first, j in ((everything.counters.first, i), (rays.trace_first, rows[i])))
        assert everything.counters.address[a].tolist() == rays.address[b].tolist()


def test_a_notebook_shows_heat_maps_and_the_model(measured: Profile) -> None:
    picture = measured.heatmap("nodes")
    np.testing.assert_array_equal(np.asarray(picture), heatmap(measured.maps["nodes"], "nodes fetched a sample"))
    with refused(what="no map 'wings'"):
        measured.heatmap("wings")
    rows = model_rows(measured, GPUS["rtx2080ti"])
    page = rows._repr_html_()
    assert len(rows) == len(GROUPS) and page.count("<table>") == 2 and "RTX 2080 Ti" in page
    assert all(f">{row.limit}</td>" in page for row in rows)


def test_the_scale_of_a_heat_map() -> None:
    assert [top_of(np.full(9, v)) for v in (0.0, 0.7, 1.0, 37.0, 1001.0)] == pytest.approx([1.0, 0.7, 1.0, 40.0, 1200.0])
    assert [step_of(top) for top in (0.7, 1.0, 40.0, 1200.0)] == pytest.approx([0.1, 0.2, 10.0, 200.0])
    assert (heatmap(np.ones((2, 2)), "", top=2.0)[40, 100] == colors()[128]).all()
    outlier = np.ones(10_000)
    outlier[0] = 1e6
    assert top_of(outlier) == 1.0
    assert [short(v) for v in (0.0, 0.25, 3869.0, 12345.0, 2.5e7)] == ["0", "0.25", "3869", "12.3k", "25M"]


def test_the_colours_of_a_heat_map_are_its_values() -> None:
    table = colors().astype(int)
    light = table @ [0.2126, 0.7152, 0.0722]
    assert table.shape == (256, 3) and (np.diff(light) > -1.5).all() and light[0] < 10 and light[-1] > 230
    values = np.linspace(0.0, 100.0, 100 * 60).reshape(60, 100)
    picture = heatmap(values, "a ramp")
    inner = picture[30:30 + 300, 14:14 + 500]  # five times as large
    expected = colors()[np.rint(values / 100.0 * 255.0).astype(int)]
    np.testing.assert_array_equal(inner[2::5, 2::5], expected)
    assert (heatmap(np.zeros((4, 4)), "nothing")[40:500, 20:480] == colors()[0]).all()


def test_the_command_writes_what_it_says(tmp_path: Path, measured: Profile) -> None:
    scene, folder = tmp_path / "mirrors.toml", tmp_path / "out"
    scene.write_text(MIRRORS)
    result = command("profile", str(scene), "--spp", "2", "-o", str(folder))
    assert result.code == 0, result.err
    for words in ("## Rays by depth and kind", "## Model of RTX 2080 Ti (100% of the rays", "## SIMT efficiency", "range"):
        assert words in result.out
    written = {path.name for path in folder.iterdir()}
    assert written == {f"{name}.png" for name in PICTURES if measured.maps[name].any()} | {
        "counters.exr", "profile.md"}
    layers = read_channels(folder / "counters.exr")
    for name in PICTURES:
        np.testing.assert_allclose(layers[name], measured.maps[name], rtol=1e-6)
    assert read_image(folder / "nodes.png").shape[1] > 480
    told = json.loads(command("profile", str(scene), "--spp", "2", "--gpu", "rtx2060", "--json").out)
    assert told["rays"] == len(measured.rays) and [row["name"] for row in told["model"]] == list(GROUPS)
    for row in told["model"]:
        assert row["low"] <= row["rays_per_second"] <= row["high"] and row["gpu"] == "RTX 2060"
        assert max(row["utilisation"].values()) == 1.0 == row["utilisation"][row["limit"]]
