"""wrt on virtual GPUs: `python -m pytest --device cuda:0 tests/virtual_gpu`. These tests find most defects in little time; all other
tests accept `--device`, too."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests import bits, device
from tests.data import ROOT
from tests.refused import refused
from tests.structures import STRUCTURES as ALL
from tests.virtual_gpu import gpus
from wrt.accel.scenes.build import build
from wrt.core.arrays import to_numpy
from wrt.lab.bench import Queries
from wrt.lab.bench.report import run
from wrt.scene import shapes

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")
PICTURE = {"spp": 2, "size": (48, 27), "seed": 5}
SCENE = ROOT / "scenes" / "spot.toml"
STRUCTURES = [name for name in ALL if name != "brute_force"]
QUICK = ("bvh8", "kdtree")


@pytest.mark.parametrize("accel", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in STRUCTURES])
def test_hits_have_the_bits_of_the_cpu(accel: str) -> None:
    before = gpus().counts.launches.total()
    assert bits.hits(accel) == bits.stored()["hits"]
    assert gpus().counts.launches.total() == before + 3


@pytest.mark.parametrize("order", ["given", "in place"])
def test_moving_worlds_have_the_same_depth_and_ids_as_on_the_cpu(order: str) -> None:
    assert bits.moving_worlds(order=order) == bits.stored()["moving_worlds"]


@pytest.mark.parametrize("scene", [path if path == SCENE else pytest.param(path, marks=pytest.mark.slow) for path in bits.SCENES],
                         ids=lambda path: path.stem)
def test_pixels_have_the_bits_of_the_cpu(scene: Path) -> None:
    before = gpus().counts.launches.total()
    there, here = (wrt.render(scene, device=name, aov="depth", **PICTURE) for name in ("cuda:0", "cpu"))
    assert gpus().counts.launches.total() > before
    assert there.pixels.tobytes() == here.pixels.tobytes() and there.pixels.max() > 0.0
    assert there.aov["depth"].tobytes() == here.aov["depth"].tobytes()


def test_rays_on_other_devices_are_copied_and_answers_there_are_refused() -> None:
    origins, directions = bits.primary_rays(16, 9)
    mesh, ends = shapes.icosphere(1), np.linspace(1.0, 9.0, len(origins), dtype=np.float32)
    arrays = (origins, wp.vec3), (directions, wp.vec3), (ends, float)
    expected = build(mesh, "bvh8", device="cpu").closest_hit(origins, directions, 0.0, ends)
    assert (expected.prim_id >= 0).any()
    for mine, other in (("cpu", "cuda:0"), ("cuda:0", "cpu"), ("cuda:0", "cuda:1")):
        accel = build(mesh, "bvh8", device=mine)
        there = [wp.array(array, dtype=kind, device=other) for array, kind in arrays]
        for rays in (there, [there[0].to(mine), there[1], there[2]], [origins, directions, there[2]]):
            with pytest.warns(wrt.SceneWarning, match=f"arrays from {other} to {mine}.*device='{other}'") as warned:
                hits = accel.closest_hit(*rays[:2], 0.0, rays[2])
            assert {warning.filename for warning in warned} == {__file__}
            assert hits.t.device == wp.get_device(mine) if isinstance(hits.t, wp.array) else rays[0] is origins
            for name in ("t", "u", "v", "prim_id"):
                assert to_numpy(getattr(hits, name)).tobytes() == getattr(expected, name).tobytes()
        with pytest.warns(wrt.SceneWarning, match=f"to {mine}"):
            seen = wrt.visible(accel, *there[:2])
        assert seen.device == wp.get_device(mine)
        with pytest.warns(wrt.SceneWarning, match=f"to {mine}"):
            assert np.array_equal(to_numpy(wrt.count_hits(accel, *there[:2])), wrt.count_hits(accel, origins, directions))
        with refused("out"):
            accel.any_hit(*there[:2], out=wp.zeros(len(origins), dtype=wp.bool, device=other))
        with warnings.catch_warnings(action="ignore"), refused("t_max") if "cpu" in (mine, other) else nullcontext():
            accel.closest_hit(*there[:2], 0.0, wp.full(len(origins), np.nan, dtype=float, device=other))


@pytest.mark.parametrize("default", ["cpu", "cuda:0"])
def test_the_gpu_of_a_meshs_arrays_decides(default: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.accel.scenes.build.DEFAULT_DEVICE", default)
    mesh = shapes.icosphere(1)
    host = mesh.vertices, mesh.faces

    def on(name: str) -> tuple[wp.array, wp.array]:
        return wp.array(mesh.vertices, dtype=wp.vec3, device=name), wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=name)

    there = on("cuda:1")
    pair, geometry, tree = (there[0], mesh.faces), wrt.DeviceGeometry(*there), build(mesh, "bvh2", device="cpu").tree()
    for given, expected in ((pair, "cuda:1"), (geometry, "cuda:1"), (host, default), (mesh, default),
                            ((on("cpu")[0], mesh.faces), default)):
        assert str(build(given, "bvh2").device) == str(wrt.accel_from_tree(given, tree).device) == expected
        assert str(build(given, "bvh2", device="cpu").device) == str(wrt.accel_from_tree(given, tree, device="cpu").device) == "cpu"
        assert str(build(given, "bvh2", device="cuda:0").device) == "cuda:0"
    assert [str(build(given, movable=movable).device) for given, movable in (([mesh, pair], False), (pair, True), ([mesh], False))] == [
        "cuda:1", "cuda:1", default]
    with wp.ScopedDevice("cuda:1"):
        assert str(build(mesh).device) == default


def test_a_file_is_loaded_on_the_gpu_of_its_meshs_arrays(tmp_path: Path) -> None:
    mesh = shapes.icosphere(1)
    build(mesh, "bvh2", device="cpu").save(tmp_path / "a.accel")
    pair = wp.array(mesh.vertices, dtype=wp.vec3, device="cuda:1"), mesh.faces
    assert [str(wrt.load_accel(tmp_path / "a.accel", *more).device) for more in ((pair,), (pair, "cpu"), (mesh,))] == [
        "cuda:1", "cpu", device.NAME]


# A defect in a branch for CUDA only: it clears one bit of the mask of triangles that a ray may hit.
CHANGED, RIGHT, WRONG = "kernels/wide/lanes.py", "return plain(rows, first, ray)", "return plain(rows, first, ray) & ~1"


def checked(folder: Path, *more: str) -> tuple[int, dict[str, Any]]:
    """Run `devices --check` of the project in a folder; return the exit code and its JSON."""
    words = ["-m", "tests.virtual_gpu", "devices", "--check", "--rays", "400", "--json", "-q", *more]
    ended = subprocess.run([sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True,
                           text=True, check=False, timeout=1200)
    return ended.returncode, json.loads(ended.stdout) if ended.returncode < 2 else {"error": ended.stderr}


@pytest.mark.slow
def test_one_bit_in_a_branch_for_cuda_fails_the_check(tmp_path: Path) -> None:
    for name in ("wrt", "kernels", "tests/virtual_gpu", "scenes"):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    text = (tmp_path / CHANGED).read_text()
    assert text.count(RIGHT) == 1
    (tmp_path / CHANGED).write_text(text.replace(RIGHT, WRONG))
    code, report = checked(tmp_path, "--scene", "scenes/spot.toml")
    assert code == 1, report
    differ = {row["what"]: row["differ"] for row in report["rows"]}
    assert differ["bvh8"] > 100 and differ["spot"] > 100 and differ["bvh2"] == differ["brute_force"] == 0


@pytest.mark.slow
def test_a_check_of_everything() -> None:
    code, report = checked(ROOT)
    assert code == 0 and report["differ"] == 0
    assert {row["what"] for row in report["rows"]} >= {*STRUCTURES, "brute_force", *(scene.stem for scene in bits.SCENES)}


def test_lists_of_hits_in_several_parts_equal_those_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, rng = shapes.icosphere(2), np.random.default_rng(0)
    origins = 2.0 * rng.normal(size=(1000, 3))
    directions = 0.5 * rng.normal(size=(1000, 3)) - origins  # towards points in the ball
    monkeypatch.setattr("wrt.accel.queries.all_hits.BATCH_ON_GPU", 300)
    there, here = (wrt.all_hits(wrt.build(mesh, device=name), origins, directions) for name in ("cuda:0", "cpu"))
    for field in ("first", "t", "u", "v", "prim_id"):
        assert np.array_equal(to_numpy(getattr(there, field)), getattr(here, field))
    assert len(here.t) > 500


def test_the_comparison_of_contestants_runs_on_a_gpu() -> None:
    """Virtual GPUs have no meshes of Warp, the only other library on a GPU."""
    kinds = ("primary", "shadow", "points", "tiles")
    plan = Queries(("bvh8", "bvh2"), (shapes.icosphere(2),), kinds, number=400, runs=1, worlds=2)
    there, here = (run(replace(plan, device=device)) for device in ("cuda:0", "cpu"))
    assert [(row.kind, row.name, row.hit) for row in there] == [(row.kind, row.name, row.hit) for row in here]
    assert {row.kind for row in there} == set(kinds) and {row.threads for row in there} == {1}
    with refused("contestants", "embree runs on the CPU only, not on cuda:0"):
        Queries(("embree",), device="cuda:0")
