"""Checkpoints: a resumed render equals an uninterrupted one; no file is overwritten, and damaged or foreign files are refused."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kernel_tools import cpu_only
from tests.refused import refused
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.renderer.checkpoint import MAGIC, read
from wrt.renderer.options import Progress
from wrt.renderer.render import render
from wrt.renderer.schedule import LocalTracer, Steps
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad

# The scene has the same features as that of test_renderer.py, so that both share kernels.
SCENE = Scene(
    objects=(Object(box(), (Material(albedo=(0.7, 0.6, 0.5)),)),
             Object(quad((-4, -1, -4), (0, 0, 8), (8, 0, 0)), (Material(albedo=(0.2, 0.4, 0.8)),))),
    lights=(DirectionalLight((-1, -2, -1.5), (1.5, 1.4, 1.3)),), cameras=(Camera.look_at((2, 2, 4), (0, 0, 0)),),
    background=GradientBackground(), settings=Settings(size=(61, 34), spp=24),
)
COUNTS = ("rays", "rays_per_sample", "cut_by_depth", "cut_by_throughput", "lost_throughput_per_sample", "not_finite", "samples")


def same(a: Film, b: Film) -> bool:
    """Return True if pixels, layers and counts have the same bits."""
    layers = {"pixels": a.pixels, **a.layers}, {"pixels": b.pixels, **b.layers}
    return layers[0].keys() == layers[1].keys() and all(
        layers[0][name].tobytes() == layers[1][name].tobytes() for name in layers[0]) and [
        a.stats[name] for name in COUNTS] == [b.stats[name] for name in COUNTS]


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov="depth")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.checkpoint"


def stop_at(share: float) -> Callable[[Progress], None]:
    def stop(progress: Progress) -> None:
        if progress.done > share * progress.total:
            raise KeyboardInterrupt

    return stop


def files(path: Path) -> list[str]:
    return sorted(each.name for each in path.parent.iterdir())


# --- going on ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "then"), [
    pytest.param({"pass_size": 24, "tile_size": 4}, {}, marks=cpu_only),  # a GPU traces all tiles of a pass at once
    ({"pass_size": 5, "tile_size": 7}, {"pass_size": 3, "tile_size": 11, "threads": 1}),
], ids=str)
def test_a_resumed_render_equals_an_uninterrupted_one(first: dict[str, Any], then: dict[str, Any], path: Path, whole: Film,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LocalTracer, "trace", slowly(LocalTracer.trace))
    part = render(SCENE, checkpoint=path, progress=stop_at(0.3), aov="depth", **first)
    assert part.stats["interrupted"] and part.stats["checkpoint"] == str(path) and part.stats["resumed"] is None
    assert 0 < part.stats["samples"] < whole.stats["samples"] and files(path) == [path.name]
    saved = read(path)
    assert saved.samples == (part.samples.min(), part.samples.max()) and 0.0 < saved.seconds <= part.stats["seconds"]["trace"]

    again = render(SCENE, checkpoint=path, resume=True, aov="depth", **then)
    assert same(again, whole) and not again.stats["interrupted"] and files(path) == [path.name]
    assert again.stats["resumed"] == {"samples": saved.samples[0], "seconds": saved.seconds}
    assert again.stats["seconds"]["trace"] > saved.seconds and read(path).samples == (24, 24)


def slowly(trace: Any) -> Any:
    """Return LocalTracer.trace with a step after every three tiles, so that an interruption can come within a pass."""

    def traced(self: LocalTracer, film: Any, work: list[Any], due: Any) -> Steps:
        done = 0
        for i in range(0, len(work), 3):
            yield from ((done + n, at_rest) for n, at_rest in trace(self, film, work[i : i + 3], due))
            done += sum(job.total for job in work[i : i + 3])

    return traced


def test_saving_all_the_time_changes_nothing(path: Path, whole: Film) -> None:
    film = render(SCENE, checkpoint=path, checkpoint_every=1e-9, tile_size=5, aov="depth")
    assert same(film, whole) and files(path) == [path.name]


def test_many_resumes_with_a_target_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {"target_error": 0.012, "tile_size": 8}
    expected = render(SCENE, **options)
    assert expected.stats["target_reached"] and expected.metadata["spp"] > 8
    monkeypatch.setattr(LocalTracer, "trace", slowly(LocalTracer.trace))
    shares = iter((0.05, 0.1, 0.4))
    film = render(SCENE, checkpoint=path, progress=stop_at(next(shares)), **options)
    while film.stats["interrupted"]:
        film = render(SCENE, checkpoint=path, resume=True, progress=stop_at(next(shares, 2.0)), **options)
    assert same(film, expected) and film.stats["estimated_error"] == expected.stats["estimated_error"]
    finer = render(SCENE, checkpoint=path, resume=True, target_error=0.006)
    assert same(finer, render(SCENE, target_error=0.006)) and finer.stats["samples"] > film.stats["samples"]


def test_a_finished_render_can_resume_with_more_samples(path: Path, whole: Film) -> None:
    render(SCENE, spp=10, checkpoint=path)
    assert same(render(SCENE, checkpoint=path, resume=True, aov="depth"), whole)
    again = render(SCENE, checkpoint=path, resume=True, aov="depth")
    assert same(again, whole) and again.stats["resumed"]["samples"] == 24
    with refused("spp", "must be 24 or more"):
        render(SCENE, spp=23, checkpoint=path, resume=True)


# --- what is refused --------------------------------------------------------------------------------------------------


def refuses(what: str, path: Path, **options: Any) -> None:
    before = path.read_bytes() if path.is_file() else None
    there = files(path)
    scene = options.pop("scene", SCENE)
    with refused(what=what, path=path):
        render(scene, checkpoint=path, **options)
    assert files(path) == there and (path.read_bytes() if path.is_file() else None) == before


def test_an_existing_file_is_never_overwritten(path: Path) -> None:
    path.write_bytes(b"a diary")
    refuses("exists already", path)
    refuses("is no checkpoint", path, resume=True)
    path.write_bytes(pickle.dumps({"seconds": 0}))
    refuses("is no checkpoint", path, resume=True)
    path.unlink()
    path.mkdir()
    refuses("is a folder", path)
    refuses("is a folder", path, resume=True)


def test_a_checkpoint_of_another_render_is_refused(path: Path) -> None:
    render(SCENE, spp=1, checkpoint=path)
    refuses("exists already", path)
    refuses("another render: seed was 0, is 1", path, resume=True, seed=1)
    refuses("crop was [0, 0, 61, 34], is [0, 0, 61, 33]", path, resume=True, crop=(0, 0, 61, 33))
    refuses("triangle was watertight, is ", path, resume=True, triangle="moeller_trumbore")
    refuses("groups of samples was 1, is 4", path, resume=True, target_error=0.1)
    refuses("other camera", path, resume=True, camera=Camera.look_at((2, 2, 4.1), (0, 0, 0)))
    refuses("another render: other scene", path, resume=True, scene=replace(SCENE, ambient=(0.1, 0.1, 0.1)))
    render(replace(SCENE, name="another name"), spp=2, checkpoint=path, resume=True, threads=1, tile_size=5, exposure=2.0)


def test_any_damage_is_noticed(path: Path) -> None:
    render(SCENE, spp=1, size=(8, 6), checkpoint=path)
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    places = {len(MAGIC), len(good) - 1, *rng.integers(len(MAGIC), len(good), 10).tolist()}
    for place in places:
        bad = bytearray(good)
        bad[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        with refused(what="damaged: its checksum"):
            read(path)
    for end in (0, len(MAGIC), len(good) - 1):
        path.write_bytes(good[:end])
        with pytest.raises(InputError, match=r"is damaged|is no checkpoint"):
            read(path)
    path.write_bytes(good + b"\0")
    refuses("is damaged", path, resume=True, size=(8, 6))


# --- the disk ---------------------------------------------------------------------------------------------------------


def test_a_removed_folder_prevents_only_the_checkpoint(tmp_path: Path, whole: Film) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()

    def take(progress: Progress) -> None:
        shutil.rmtree(folder, ignore_errors=True)

    with pytest.warns(RuntimeWarning, match="the checkpoint is not saved: .*: its folder does not exist"):
        film = render(SCENE, checkpoint=folder / "a", aov="depth", progress=take)
    assert same(film, whole) and film.stats["checkpoint"] is None and not folder.exists()
