"""Renders: tiles, passes, threads, Ctrl-C, the resulting film, and errors."""

from __future__ import annotations

import itertools
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.data import ROOT
from tests.device import NAME
from tests.refused import Refusal, refused
from wrt.core import device as core_device
from wrt.core.errors import SceneWarning
from wrt.io.load import load_scene
from wrt.io.mesh_file import load_mesh
from wrt.picture.film import Film
from wrt.renderer import prepare
from wrt.renderer.options import AOVS, Options, Progress, RenderOptions
from wrt.renderer.plan import plan_of
from wrt.renderer.render import builder_for, render
from wrt.renderer.schedule import Passes
from wrt.scene.backgrounds import EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, icosphere, quad

SIZE = (37, 22)  # not a multiple of any tile size
# Nearly all tests here use one set of features, because each further set needs a kernel of its own.
SCENE = Scene(
    objects=(Object(box(), (Material(albedo=(0.7, 0.6, 0.5)),), name="box"),
             Object(quad((-4, -1, -4), (0, 0, 8), (8, 0, 0)), (Material(albedo=(0.2, 0.4, 0.8)),), name="floor")),
    lights=(DirectionalLight((-1, -2, -1.5), (1.5, 1.4, 1.3)),),
    cameras=(Camera.look_at((2, 2, 4), (0, 0, 0), name="first"), Camera.look_at((-3, 1, 4), (0, 0, 0), name="second")),
    background=GradientBackground(),
    settings=Settings(size=SIZE, spp=5),
    name="scene",
)


def same(a: Film, b: Film) -> bool:
    return (np.array_equal(a.pixels, b.pixels) and np.array_equal(a.variance, b.variance)
            and np.array_equal(a.samples, b.samples) and a.aov.keys() == b.aov.keys()
            and all(np.array_equal(a.aov[name], b.aov[name]) for name in a.aov))


def counts(film: Film) -> list[Any]:
    return [film.stats[name] for name in ("rays", "cut_by_depth", "cut_by_throughput", "not_finite", "samples")]


# --- the same pixels --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reference() -> Film:
    return render(SCENE, aov=AOVS)


@pytest.mark.parametrize("options", [
    {"threads": 1}, {"threads": 7}, {"tile_size": 1}, {"pass_size": 2}, {"time_limit": 1e9}, {"progress": lambda progress: None},
    {"threads": 2, "tile_size": 3, "pass_size": 4},
], ids=lambda options: " ".join(f"{name}={'...' if callable(value) else value}" for name, value in options.items()))
def test_no_way_of_dividing_the_work_changes_a_pixel(options: dict[str, Any], reference: Film) -> None:
    film = render(SCENE, aov=AOVS, **options)
    assert same(film, reference) and counts(film) == counts(reference)


@pytest.mark.parametrize("crop", [(0, 0, 37, 22), (3, 5, 20, 6), (36, 21, 37, 22), (0, 7, 37, 8)], ids=str)
def test_a_crop_is_that_part_of_the_whole_picture(crop: tuple[int, int, int, int], reference: Film) -> None:
    x0, y0, x1, y1 = crop
    film = render(SCENE, aov=AOVS, crop=crop)
    assert film.pixels.shape == (y1 - y0, x1 - x0, 3) and film.stats["samples"] == 5 * (y1 - y0) * (x1 - x0)
    part = {name: getattr(reference, name)[y0:y1, x0:x1] for name in ("pixels", "variance", "samples")}
    assert same(film, Film(**part, aov={name: array[y0:y1, x0:x1] for name, array in reference.aov.items()}))


def test_the_seed_changes_the_noise_and_nothing_else(reference: Film) -> None:
    assert same(render(SCENE, aov=AOVS, seed=0), reference)
    films = [render(SCENE, seed=seed, spp=16) for seed in (1, 2, 2**32 - 1)]
    for a, b in itertools.combinations(films, 2):
        differ = (a.pixels != b.pixels).any(axis=-1)
        assert differ.mean() > 0.5
        sigma = np.sqrt(a.variance + b.variance)
        z = np.abs(a.pixels - b.pixels)[sigma > 0] / sigma[sigma > 0]
        assert np.median(z) < 1.0  # 0.67 for a normal distribution, less for these stratified samples


# --- what comes back --------------------------------------------------------------------------------------------------


def test_statistics_and_metadata(reference: Film) -> None:
    stats, n = reference.stats, SIZE[0] * SIZE[1] * 5
    assert stats["samples"] == n == reference.samples.sum() and (reference.samples == 5).all()
    assert n <= stats["rays"] and stats["rays_per_sample"] == stats["rays"] / n
    assert stats["rays_per_second"] == pytest.approx(stats["rays"] / stats["seconds"]["trace"])
    assert stats["triangles"] == 14 and stats["spheres"] == 0 and stats["not_finite"] == 0
    assert stats["seconds"].keys() == {"compile", "upload", "build", "aov", "trace"}
    assert not stats["interrupted"] and not stats["timed_out"]
    expected = {"scene": "scene", "camera": "first", "spp": 5, "seed": 0, "version": wrt.__version__, "accel": "bvh"}
    assert expected.items() <= reference.metadata.items()


def test_mean_and_variance_are_those_of_the_single_samples() -> None:
    """The value of sample i is computed, in float64, from the means of two renders with i and i + 1 samples."""
    films = [render(SCENE, spp=spp) for spp in range(1, 7)]
    totals = np.stack([np.zeros_like(films[0].pixels, np.float64), *(f.pixels.astype(np.float64) * (i + 1)
                                                                       for i, f in enumerate(films))])
    samples = np.diff(totals, axis=0)
    expected = samples.var(axis=0, ddof=1) / 6
    assert np.allclose(films[5].variance, expected, rtol=1e-3, atol=1e-6)
    assert np.isposinf(films[0].variance).all()  # one sample allows no estimate of the variance


def test_aovs_are_what_the_pixels_see() -> None:
    """A square of side 2 at distance 3 faces the camera: depth along the ray, and the normal towards the camera."""
    scene = Scene(objects=(Object(quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)), (Material(albedo=(0.1, 0.5, 0.9)),)),),
                  lights=SCENE.lights, background=SCENE.background,
                  cameras=(Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=2 * np.arctan(2 / 3)),))  # 4 wide and high at z = 0
    film = render(scene, size=(9, 9), spp=1, aov=AOVS)
    center = (np.arange(9) + 0.5) / 9 * 4 - 2
    x, y = np.meshgrid(center, -center)
    inside = (np.abs(x) < 1) & (np.abs(y) < 1)
    assert inside.sum() == 25  # 5 of 9 pixel centres in each direction
    depth = np.where(inside, np.sqrt(x * x + y * y + 9), np.inf)
    assert np.allclose(film.aov["depth"], depth, rtol=1e-6)
    assert (film.aov["material_id"] == np.where(inside, 0, -1)).all()
    assert ((film.aov["prim_id"] >= 0) == inside).all() and set(film.aov["prim_id"][inside]) == {0, 1}
    assert np.allclose(film.aov["normal"], np.where(inside[..., None], (0, 0, 1), 0), atol=1e-6)
    assert np.allclose(film.aov["albedo"][inside], (0.1, 0.5, 0.9), atol=1e-6) and not film.aov["albedo"][~inside].any()


def test_a_sample_that_is_not_finite_is_black_and_counted() -> None:
    # A scene's numbers are at most 1e30; a background picture's pixels times its scale can still exceed float32.
    scene = replace(SCENE, background=EnvironmentBackground(np.full((2, 4, 3), 3e38, np.float32), scale=4.0))
    film = render(scene, spp=4)
    assert film.stats["not_finite"] > 0 and np.isfinite(film.pixels).all() and (film.samples == 4).all()


def test_cameras_by_name_index_and_object() -> None:
    first, second = (render(SCENE, spp=1, camera=camera) for camera in ("first", "second"))
    assert not np.array_equal(first.pixels, second.pixels)
    assert second.metadata["camera"] == "second"
    for camera in (1, "1", SCENE.cameras[1]):
        assert same(render(SCENE, spp=1, camera=camera), second)
    with refused("camera", "no camera 'third'"):
        render(SCENE, camera="third")


def test_names_can_be_written() -> None:
    named = replace(SCENE, name="ö😀\udcff\ud800")
    assert render(named, spp=1, size=(2, 2)).metadata["scene"] == "ö😀??"


# --- passes and time --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spp", "pass_size", "expected"), [
    (1, None, [1]), (8, None, [1, 3, 4]), (16, None, [1, 3, 12]), (20, None, [1, 3, 12, 4]), (7, 3, [3, 3, 1]), (3, 100, [3]),
    (300, None, [1, 3, 12, 48, 64, 64, 64, 44]),
])
def test_passes_take_each_sample_once(spp: int, pass_size: int | None, expected: list[int]) -> None:
    film: Any = SimpleNamespace(groups=[None])
    passes = Passes(film, Options(pass_size=pass_size), spp, (0, 0), math.inf)
    assert [count for _, count in passes] == expected and not passes.timed_out
    assert [first for first, _ in passes] == [sum(expected[:i]) for i in range(len(expected))]


def test_a_time_limit_leaves_a_whole_picture() -> None:
    film = render(SCENE, spp=1 << 24, time_limit=0.2)
    assert film.stats["timed_out"] and not film.stats["interrupted"]
    assert 1 <= film.samples.min() == film.samples.max() == film.metadata["spp"] < 1 << 24
    assert same(film, render(SCENE, spp=int(film.samples.max())))
    assert not render(SCENE, spp=2, time_limit=1e6).stats["timed_out"]


def test_progress_goes_from_nothing_to_all() -> None:
    reported: list[Progress] = []
    film = render(SCENE, spp=9, progress=reported.append)
    done = [progress.done for progress in reported]
    assert done == sorted(done) and reported[-1].done == reported[-1].total == film.stats["samples"]
    assert reported[-1].rays == film.stats["rays"]
    assert all(progress.seconds >= 0.0 and progress.total == reported[0].total for progress in reported)
    assert Progress(50, 200, 10, 2.0).seconds_left == 6.0 and Progress(0, 200, 0, 0.0).seconds_left == float("inf")


# --- Ctrl-C -----------------------------------------------------------------------------------------------------------


def interrupt(progress: Progress) -> None:
    if progress.done > 0:
        signal.raise_signal(signal.SIGINT)


def stop(progress: Progress) -> None:
    if progress.stage == "trace":  # while kernels compile, there are no samples to keep
        raise KeyboardInterrupt


@pytest.mark.parametrize("progress", [interrupt, stop])
@pytest.mark.parametrize("pass_size", [None, 3])
def test_ctrl_c_returns_the_samples_so_far(progress: Callable[[Progress], None], pass_size: int | None) -> None:
    film = render(SCENE, spp=1000, size=(200, 150), tile_size=8, progress=progress, pass_size=pass_size, aov=["depth"])
    assert film.stats["interrupted"] and not film.stats["timed_out"]
    assert film.samples.max() - film.samples.min() <= (pass_size or 1) and film.samples.max() < 1000
    assert film.stats["samples"] == film.samples.sum() and film.aov.keys() == {"depth"}
    assert not film.pixels[film.samples == 0].any()
    fewest = int(film.samples.max())
    whole = render(SCENE, spp=fewest, size=(200, 150)) if fewest else film
    there = film.samples == fewest
    assert np.array_equal(film.pixels[there], whole.pixels[there])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_does_not_wait_for_the_end_of_a_pass() -> None:
    """On the CPU, a tile is traced completely or not at all: 500 samples or none. On a GPU, all tiles are one launch."""
    film = render(SCENE, spp=1000, size=(200, 150), tile_size=8, pass_size=500, progress=interrupt, device="cpu")
    assert film.stats["interrupted"] and np.unique(film.samples).tolist() == [0, 500]
    tiles = [film.samples[y : y + 8, x : x + 8] for y in range(0, 150, 8) for x in range(0, 200, 8)]
    assert all(np.unique(tile).size == 1 for tile in tiles)


def test_ctrl_c_while_compiling_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    may_end, ended = threading.Event(), threading.Event()

    first = iter([True])

    def compile_for_ever(kernel: Any, device: Any) -> None:
        if next(first, False):
            time.sleep(0.2)  # by then the main thread waits
            signal.raise_signal(signal.SIGINT)
        may_end.wait(10.0)
        ended.set()

    monkeypatch.setattr(prepare, "load_kernel", compile_for_ever)
    try:
        with pytest.raises(KeyboardInterrupt):
            render(SCENE)
        assert not ended.is_set()
    finally:
        may_end.set()


def test_an_error_in_a_progress_callback_comes_through() -> None:
    def fail(progress: Progress) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        render(SCENE, progress=fail)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_users_handler_of_ctrl_c_stays() -> None:
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        film = render(SCENE, spp=2, progress=interrupt)
    finally:
        signal.signal(signal.SIGINT, before)
    assert came and not film.stats["interrupted"] and (film.samples == 2).all()


def test_renders_in_other_threads(reference: Film) -> None:
    films: list[Film] = []
    threads = [threading.Thread(target=lambda: films.append(render(SCENE, aov=AOVS))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(films) == 3 and all(same(film, reference) for film in films)


# --- what cannot be rendered ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "message"), [
    ({"accel": "nope"}, ("accel", "no structure 'nope'", None, None, "bvh")),
    ({"device": "nope"}, ("device", "no device 'nope'", None, None, "cpu")),
    ({"aov": ["depth", "nope"]}, ("aov", "no AOV 'nope'", None, None, "depth, normal")),
    ({"threads": 0}, ("threads", "must be 1 to")),
    ({"seed": 2**32}, ("seed",)), ({"seed": 0.5}, ("seed", "whole number")), ({"tile_size": 0}, ("tile_size",)),
    ({"time_limit": 0.0}, ("time_limit", "more than 0")), ({"target_error": float("nan")}, ("target_error",)),
    ({"checkpoint_every": "30s"}, ("checkpoint_every",)), ({"checkpoint_every": None}, ("checkpoint_every",)), ({"seed": None}, ("seed",)),
    ({"camera": "nope"}, ("camera", "no camera 'nope'")),
    ({"spp": 0}, ("spp", "1")), ({"size": (100000, 100000)}, ("size", "1x1 to 32768x32768")), ({"size": "32*18"}, ("size", "two whole")),
    ({"max_depth": 65}, ("max_depth",)), ({"filter": "nope"}, ("filter", "must be one")),
    *(({"crop": crop}, ("crop", "within the picture")) for crop in ((0, 0, 38, 22), (-1, 0, 5, 5), (5, 5, 5, 6))),
    ({"crop": (0, 0, 4)}, ("crop", "x0, y0, x1, y1")), ({"sp": 4}, ("sp", "unknown argument", None, None, "'spp'")),
    ({"threads": "two"}, ("threads", "whole number")), ({"progress": True}, ("progress", "function")), ({"accel": None}, ("accel", "str")),
    ({"aov": 3}, ("aov", "one or more names")), ({"accel_options": []}, ("accel_options", "dict")),
], ids=str)
def test_the_error_names_the_wrong_argument(options: dict[str, Any], message: Refusal) -> None:
    with refused(*message):
        render(SCENE, **options)


@pytest.mark.parametrize("value", [None, 5, [SCENE], np.zeros(3)], ids=str)
def test_what_is_no_scene_is_refused_by_name(value: Any) -> None:
    with refused("scene", "Scene, a Mesh"):
        render(value)


def test_a_path_and_a_mesh_are_rendered_as_the_command_line_does(tmp_path: Path) -> None:
    path = tmp_path / "box.obj"
    path.write_text(BOX_OBJ)
    with pytest.warns(SceneWarning, match="box.obj: it has no camera: a camera that frames the scene was added; it has no lights"):
        expected = render(load_scene(path), spp=1, size=SIZE)
    for value in (path, str(path), load_mesh(path)):
        with pytest.warns(SceneWarning, match="box.obj: it has no camera"):
            assert same(render(value, spp=1, size=SIZE), expected)
    with refused(what="no such file", path="nothing.toml"):
        render("nothing.toml")


def test_one_name_and_text_for_a_size_and_settings_by_keyword() -> None:
    film = render(SCENE, spp=np.int64(1), size="12x7", aov="depth", filter="box", tonemap="aces", max_depth=None)
    assert film.pixels.shape == (7, 12, 3) and list(film.aov) == ["depth"] and film.metadata["filter"] == "box"
    assert film.tonemap == "aces" and film.metadata["max_depth"] == SCENE.settings.max_depth
    assert same(film, render(SCENE, spp=1, size=(12, 7), aov=["depth"], filter="box"))


def test_the_keywords_of_render_are_typed_as_the_settings_and_options_are() -> None:
    typed = {name: each.__forward_arg__ for name, each in RenderOptions.__annotations__.items()}
    expected = {each.name: f"{each.type} | None" for each in fields(Settings)} | {each.name: each.type for each in fields(Options)}
    expected |= {"size": "tuple[int, int] | str | int | None", "aov": "str | Sequence[str]"}  # render takes more
    assert typed == expected


def test_depth_is_the_distance_along_the_ray_and_normals_face_it() -> None:
    for side in (1.0, -1.0):  # the front, then the back of a wall at z = 0
        wall = Object(quad((-50, -50, 0), (100, 0, 0), (0, 100, 0)), (Material(),))
        camera = Camera.look_at((0, 0, 2 * side), (0, 0, 0), fov_y=1.5, aperture_radius=0.1, focus_distance=2)
        film = render(replace(SCENE, objects=(wall,), cameras=(camera,)), spp=1, size=(16, 16), aov=("depth", "normal"))
        x = (np.arange(16) + 0.5) / 8 - 1
        slope = np.tan(0.75) * np.hypot(x[None], x[:, None])
        assert np.allclose(film.aov["depth"], 2 * np.sqrt(1 + slope**2), rtol=1e-6)
        assert np.array_equal(film.aov["normal"], np.broadcast_to(np.float32((0, 0, side)), (16, 16, 3)))


def test_a_picture_larger_than_the_memory_is_refused_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.renderer.plan.memory_of", lambda device: 2.0**30)
    monkeypatch.setattr("wrt.renderer.render.prepare", lambda *_: pytest.fail("work was done"))
    with refused(what="4096x4096 takes 2.1 GiB"):
        render(SCENE, size=(4096, 4096))


def test_a_tree_is_refined_for_many_samples_without_changing_pixels(tmp_path: Path) -> None:
    ball = Object(icosphere(4), (Material(),))
    few = replace(SCENE, objects=(*SCENE.objects, ball)).with_settings(size=(40, 20), spp=2)
    many = 8 * len(ball.mesh.faces) // 800 + 1

    def chosen(scene: Scene, **options: Any) -> dict[str, str]:
        return builder_for(plan_of(scene, Options(**options)))

    assert chosen(few) == {"builder": "binned"} and chosen(few.with_settings(spp=many)) == {}
    assert chosen(few.with_settings(spp=many), crop=(0, 0, 20, 20)) == {"builder": "binned"}
    assert chosen(few, accel="grid") == chosen(few, accel="bvh2") == {}
    copies = replace(few, objects=(ball,) * 9).with_settings(spp=2 * many)
    assert chosen(copies, instancing="never") == {"builder": "binned"} and chosen(copies, instancing="always") == {}
    path = tmp_path / "a.checkpoint"
    films = [render(few, aov=["prim_id"], **options)
             for options in ({"checkpoint": path}, {"accel_options": {"builder": "refined"}})]
    assert same(*films) and films[0].stats["accel"]["sah_cost"] > films[1].stats["accel"]["sah_cost"]
    more = render(few, spp=many, aov=["prim_id"], checkpoint=path, resume=True)  # with the tree of the other builder
    assert more.stats["accel"] | {"build_seconds": 0.0} == films[1].stats["accel"] | {"build_seconds": 0.0}
    assert same(more, render(few, spp=many, aov=["prim_id"]))


# --- kernels compiled ahead of time -----------------------------------------------------------------------------------


def test_a_render_finds_its_kernels_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(ROOT / "scenes" / "fisheye.toml").with_settings(size=(8, 8), spp=1, max_depth=7)
    names = prepare.compile_picture(scene, "bvh")
    assert ({"shade_wave", "begin_wave", "aov_wave", "trace"} if NAME == "cpu" else {"render", "aovs"}) <= set(names)
    asked: list[Any] = []
    monkeypatch.setattr(prepare, "load_kernel", lambda kernel, target: asked.append(kernel))
    render(scene, aov=AOVS)
    assert len(asked) == len(names) and all(NAME in dict(core_device._loaded[kernel].devices) for kernel in asked)


def test_queries_of_a_structure_and_wrong_names() -> None:
    assert prepare.compile_queries("bvh") == ["closest_hit", "any_hit"]
    with refused("accel", "nosuch"):
        prepare.compile_queries("nosuch")
