"""Animations: each frame has the bits of a single render at its time, whether the structure was kept, refitted or rebuilt."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.refused import refused
from wrt.renderer.animate import Animation, animate, check_output, frame_path, orbited, save_movie
from wrt.renderer.options import Options
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, scene_at
from wrt.scene.motion import Motion
from wrt.scene.settings import Settings
from wrt.scene.shapes import icosphere, torus

GREY = Material()
CAMERA = Camera.look_at((0.0, 1.0, 6.0), (0.0, 0.0, 0.0))


def scene_of(*motions: Motion | None) -> Scene:
    objects = tuple(Object(icosphere(2), (GREY,), np.array([[1, 0, 0, 2.0 * i - 1.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
                           motion=motion) for i, motion in enumerate(motions))
    return Scene((*objects, Object(torus(segments=16, tube_segments=8), (GREY,))), cameras=(CAMERA,),
                 background=GradientBackground(), settings=Settings(size=(48, 32), spp=2, max_depth=1))


def tumbling() -> Scene:
    keys = np.zeros((3, 3, 3))
    keys[:, 2] = 1.0
    keys[1, 0], keys[:, 1, 1] = (0.0, 1.5, -1.0), (0.0, 180.0, 360.0)
    ball = icosphere(2)
    x, y, z = ball.vertices.T.astype(np.float64)
    turned = np.stack([x * np.cos(3.0 * y) - z * np.sin(3.0 * y), y, x * np.sin(3.0 * y) + z * np.cos(3.0 * y)], axis=1)
    # The ball is twisted, too, because stretching alone may lower the SAH cost.
    bent = replace(ball, vertices=(turned * np.array([0.4, 1.8, 0.7])).astype(np.float32))
    return scene_of(Motion(keys), Motion(target=bent))


@pytest.mark.parametrize(("accel", "rebuild_at", "done"), [
    ("bvh", 100.0, "refitted"), ("bvh", 1.0, "rebuilt"), ("grid", 1.5, "rebuilt")])
def test_each_frame_is_the_picture_of_its_moment(accel: str, rebuild_at: float, done: str) -> None:
    scene, options = tumbling(), Options(accel=accel)
    films = list(animate(scene, Animation(4, 90.0, rebuild_at), options))
    assert len(films) == 4 and films[0].stats["frame"]["structure"] == "built"
    assert done in {film.stats["frame"]["structure"] for film in films[1:]}
    middle = np.mean(scene.bounds(), axis=0)
    for film in films:
        time = film.stats["frame"]["time"]
        alone = wrt.render(scene_at(scene, time), accel=accel, camera=orbited(CAMERA, middle, 90.0 * time), instancing="never")
        np.testing.assert_array_equal(film.pixels, alone.pixels)
    assert len({film.pixels.tobytes() for film in films}) == 4


def test_a_turntable_keeps_its_structure_and_ends_where_it_began() -> None:
    films = list(animate(scene_of(None), Animation(3), Options()))
    assert [film.stats["frame"]["structure"] for film in films] == ["built", "kept", "kept"]
    assert [film.stats["frame"]["time"] for film in films] == [0.0, 1 / 3, 2 / 3]
    np.testing.assert_array_equal(films[0].pixels, wrt.render(scene_of(None)).pixels)
    assert not np.array_equal(films[1].pixels, films[2].pixels)


def test_the_camera_orbits_the_point_it_looks_at() -> None:
    for degrees in (30.0, 90.0, 180.0, 360.0):
        camera = orbited(CAMERA, np.zeros(3), degrees)
        pose = camera.camera_to_world
        assert np.linalg.norm(pose[:3, 3] - (0.0, 1.0, 0.0)) == pytest.approx(6.0)
        assert -pose[:3, 2] @ pose[:3, 3] == pytest.approx(-np.sqrt(37.0))  # the camera still looks at the origin
    np.testing.assert_allclose(orbited(CAMERA, np.zeros(3), 90.0).camera_to_world[:3, 3], (6.0, 1.0, 0.0), atol=1e-12)
    away = Camera.look_at((0.0, 0.0, 6.0), (0.0, 0.0, 9.0))  # a point behind the camera is not orbited
    np.testing.assert_allclose(orbited(away, np.zeros(3), 90.0).camera_to_world[:3, 3], (0.0, 0.0, 6.0), atol=1e-12)


def test_wrong_animations_are_refused(tmp_path: Path) -> None:
    with refused(what="nothing moves"):
        list(animate(scene_of(None), Animation(2, 0.0), Options()))
    for wrong in ({"frames": 0}, {"degrees": np.inf}, {"rebuild_at": 0.5}):
        with refused(next(iter(wrong))):
            Animation(**wrong)
    with refused(what="frames go into"):
        check_output(tmp_path / "film.mp4")
    with refused(what="cannot be created"):
        check_output(tmp_path / "no" / "folder")
    assert list(tmp_path.iterdir()) == []


def test_movies_hold_their_frames(tmp_path: Path) -> None:
    from PIL import Image

    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 256, (24, 32, 3), dtype=np.uint8) for _ in range(3)]
    for name in ("a.png", "a.apng", "a.gif"):
        save_movie(tmp_path / name, frames, 20.0)
        with Image.open(tmp_path / name) as movie:
            assert movie.n_frames == 3 and movie.info["loop"] == 0 and movie.info["duration"] == 50.0
            for i, frame in enumerate(frames):
                movie.seek(i)
                off = np.abs(np.asarray(movie.convert("RGB")).astype(int) - frame)
                assert off.max() == 0 if "png" in name else off.mean() < 30.0  # noise has more than 256 colours
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.apng", "a.gif", "a.png"]
    assert [frame_path(Path("f"), 7, n).name for n in (10, 20_000)] == ["frame_007.png", "frame_00007.png"]


def test_the_command_writes_frames_and_movies(tmp_path: Path) -> None:
    from PIL import Image

    common = ("animate", ROOT / "scenes" / "moving.toml", "--frames", 3, "--size", "32x18", "--spp", 1, "-q")
    result = run(*common, "-o", tmp_path / "frames", "--json")
    assert result.code == 0 and [row["structure"] for row in json.loads(result.out)["frames"]] == ["built", "refitted", "refitted"]
    assert run(*common, "-o", tmp_path / "all.png").code == 0
    with Image.open(tmp_path / "all.png") as movie:
        for i in range(3):
            movie.seek(i)
            with Image.open(frame_path(tmp_path / "frames", i, 3)) as alone:
                np.testing.assert_array_equal(np.asarray(movie.convert("RGB")), np.asarray(alone.convert("RGB")))
    refused = run(*common, "-o", tmp_path / "x.gif", "--fps", 0)
    assert refused.code == 2 and "fps" in refused.err and not (tmp_path / "x.gif").exists()
