"""Profiles: every ray of a render, no more and no less, with its kind, its depth and exactly its cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.rewalk import REWALK, rays
from wrt.lab.rtcore.profiler import COUNTERS, KINDS, PICTURES, Profile, profile
from wrt.renderer.options import Progress
from wrt.scene.model import Scene
from wrt.scene.shapes import box

# Left, a matte wall under one lamp; right, two mirrors that face each other with the camera between them.
MIRRORS = """
[settings]
size = [16, 8]
max_depth = 5
min_throughput = 0.0
filter = "box"
[cameras.main]
position = [0, 0, 0]
target = [0, 0, -1]
fov_y = 20
[materials.mirror]
kind = "mirror"
albedo = 1.0
[materials.matte]
albedo = 0.5
[[lights]]
type = "point"
position = [-1, 0, 0]
intensity = 1
[[quads]]
corner = [-900, -900, -2]
edge_u = [1800, 0, 0]
edge_v = [0, 1800, 0]
material = "mirror"
[[quads]]
corner = [-900, -900, 2]
edge_u = [1800, 0, 0]
edge_v = [0, 1800, 0]
material = "mirror"
[[quads]]
corner = [-9, -9, -1]
edge_u = [9, 0, 0]
edge_v = [0, 18, 0]
material = "matte"
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("scene") / "mirrors.toml"
    path.write_text(MIRRORS)
    return wrt.load_scene(path)


@pytest.fixture(scope="module")
def measured(scene: Scene) -> Profile:
    return profile(scene, spp=3)


def test_every_ray_has_its_kind_and_depth(measured: Profile) -> None:
    found = {(row["kind"], row["depth"]): (row["probes"], row["hits"]) for row in measured.by_depth()}
    half = 8 * 8 * 3
    assert found == {("primary", 0): (2 * half, 2 * half), ("shadow", 0): (half, 0)} | {
        ("reflection", depth): (half, half) for depth in range(1, 6)}
    assert set(measured.maps) == set(PICTURES)
    left, right = (measured.maps[f"probes_{kind}"] for kind in ("shadow", "reflection"))
    assert (left[:, :8] == 1.0).all() and (left[:, 8:] == 0.0).all()
    assert (right[:, :8] == 0.0).all() and (right[:, 8:] == 5.0).all()


def test_a_profile_renders_the_same_picture_with_the_same_rays(scene: Scene, measured: Profile) -> None:
    film = wrt.render(scene, spp=3)
    np.testing.assert_array_equal(film.pixels, measured.pixels)
    assert film.stats["rays"] == len(measured.rays) == measured.rays.counts["probes"].sum()


def test_tiles_and_threads_change_nothing(scene: Scene, measured: Profile) -> None:
    other = profile(scene, spp=3, tile_size=5, threads=1)
    order, there = (np.argsort(each.rays.pixel, kind="stable") for each in (measured, other))
    for name in ("rays", "counts", "pixel", "kind", "depth", "lines"):
        np.testing.assert_array_equal(getattr(measured.rays, name)[order], getattr(other.rays, name)[there])
    for name, picture in measured.maps.items():
        np.testing.assert_array_equal(picture, other.maps[name])


def test_costs_are_those_of_a_walk_in_python(measured: Profile) -> None:
    """Also of rays that start on a surface."""
    table, accel = measured.rays, measured.accel
    walk_of = REWALK[accel.name]
    first = dict(zip(table.trace_rows.tolist(), table.trace_first.tolist(), strict=False))
    chosen = np.flatnonzero(table.rays["any_hit"] == 0)[::7]
    assert set(table.kind[chosen]) == {KINDS.index("primary"), KINDS.index("reflection")}
    entries = table.rays[chosen]
    for row, entry, ray in zip(chosen, entries, rays(accel.geometry, entries["origin"], entries["direction"]), strict=True):
        ray.hits.pop(int(entry["exclude_plus_one"]) - 1, None)
        walk = walk_of(accel, ray)
        names = [name for name in COUNTERS if hasattr(walk, name)]
        assert {name: int(table.counts[name][row]) for name in names} == {name: getattr(walk, name) for name in names}
        part = slice(first[row], first[row] + len(walk.trace))
        assert list(zip(table.address[part].tolist(), table.size[part].tolist(), strict=True)) == walk.trace
        lines = {line for at, size in walk.trace for line in range(at // 128, (at + size - 1) // 128 + 1)}
        assert table.lines[row] == len(lines)


def test_a_crop_is_a_part(scene: Scene, measured: Profile) -> None:
    part = profile(scene, spp=3, crop=(6, 2, 12, 7))
    assert part.size == (6, 5)
    for name, picture in part.maps.items():
        np.testing.assert_array_equal(picture, measured.maps[name][2:7, 6:12])


@pytest.mark.filterwarnings("ignore:.*it has no camera:wrt.SceneWarning")
def test_a_scene_has_its_own_samples_a_mesh_one_and_progress_ends_at_all_samples(scene: Scene, tmp_path: Path) -> None:
    told: list[Progress] = []
    found = profile(scene.with_settings(spp=2), tile_size=5, progress=told.append)
    assert found.spp == 2
    (tmp_path / "mirrors.toml").write_text(MIRRORS.replace("[settings]", "[settings]\nspp = 3"))
    box().save(tmp_path / "box.obj")
    assert [profile(path, size=8).spp for path in (tmp_path / "mirrors.toml", tmp_path / "box.obj", box())] == [3, 1, 1]
    assert [each.done for each in told] == sorted({each.done for each in told}) and len(told) > 2
    assert told[-1].done == told[-1].total == 3 * found.spp * found.size[0] * found.size[1] and told[-1].rays == 3 * len(found.rays)
