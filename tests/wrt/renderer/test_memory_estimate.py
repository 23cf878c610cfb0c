"""What a scene takes is told before the work, in both numbers, and the estimate is no less than what is measured."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.data import ROOT
from tests.device import NAME
from wrt.accel.build import build
from wrt.accel.instancing import instanced_meshes
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.renderer.memory_estimate import BYTES_OF_SKY, BYTES_OF_TEXEL, bytes_of_scene
from wrt.renderer.options import Options
from wrt.renderer.render import render
from wrt.renderer.renderer import Renderer
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material, Texture
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

BALL = icosphere(3)
PLAIN = Material()
SCENE = Scene((Object(BALL, (PLAIN,)),), lights=(PointLight((0, 3, 0), 1.0),), cameras=(Camera(),))


def test_it_grows_with_what_the_scene_holds() -> None:
    brute, kdtree = ACCELERATORS["brute_force"], ACCELERATORS["kdtree"]
    alone = bytes_of_scene(SCENE, brute)
    assert len(BALL.faces) * 50 < alone < len(BALL.faces) * 500 < bytes_of_scene(SCENE, kdtree)
    moved = [replace(SCENE.objects[0], transform=np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * i) for i in range(9)]
    nine = replace(SCENE, objects=tuple(moved))
    assert bytes_of_scene(nine, brute) == pytest.approx(9 * alone)
    assert bytes_of_scene(nine, brute, instanced_meshes(nine, "always")) == pytest.approx(alone + 8000.0)
    picture = Texture(np.zeros((100, 200, 4), np.uint8))
    twice = Material(albedo_texture=picture, emission_texture=replace(picture, srgb=False))
    textured = replace(SCENE, objects=(Object(BALL, (twice,)),), background=EnvironmentBackground(np.zeros((10, 20, 3))))
    assert bytes_of_scene(textured, brute) == pytest.approx(alone + 20000 * BYTES_OF_TEXEL + 200 * BYTES_OF_SKY)


def test_a_scene_larger_than_the_memory_is_refused_before_any_work(say_memory: Callable[[str], None],
                                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    say_memory("100M")
    monkeypatch.setattr("wrt.renderer.renderer.prepare", lambda *_: pytest.fail("work was done"))
    scene = replace(SCENE, objects=SCENE.objects * 1000)
    with pytest.raises(InputError, match=r"a picture of 8x8 takes \d+ MiB of memory, its scene \d\.\d GiB;"
                                          rf" {'cpu' if NAME == 'cpu' else 'the host'} has 100 MiB free"):
        render(scene, size=(8, 8), instancing="never")
    monkeypatch.setattr("wrt.renderer.renderer.prepare", lambda *_: None)
    Renderer(replace(SCENE, settings=replace(SCENE.settings, size=(8, 8))), Options())


def test_so_is_a_structure(say_memory: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    say_memory("64M")
    monkeypatch.setattr(ACCELERATORS["bvh2"], "bytes_to_build", 1e5)
    with pytest.raises(InputError, match=r"a bvh2 over 1280 primitives takes 0\.1 GiB of memory; 64 MiB are free"):
        build(BALL, "bvh2")


MEASURE = """
import re, sys
from pathlib import Path
import numpy as np
from wrt.accel.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import start
from wrt.renderer.upload import upload_scene
from wrt.renderer.memory_estimate import bytes_of_scene
from wrt.scene.mesh import Mesh
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene

def status(key):
    return int(re.search(rf"^{key}:\\s+(\\d+)", Path("/proc/self/status").read_text(), re.M)[1]) * 1024

def scene(n):
    corners = np.random.default_rng(0).random((n, 1, 3)) + 0.03 * np.random.default_rng(1).normal(size=(n, 3, 3))
    mesh = Mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))
    return Scene((Object(mesh, (Material(emission=1.0),), np.diag([2.0, 2.0, 2.0, 1.0])),))

def make(scene):
    there = upload_scene(scene, start("cpu"))
    return there, build(there.world.geometry, sys.argv[1])

make(scene(100))
large = scene(int(sys.argv[2]))
estimate = bytes_of_scene(large, ACCELERATORS[sys.argv[1]])
Path("/proc/self/clear_refs").write_text("5")
before = status("VmRSS")
kept = make(large)
print(estimate, status("VmHWM") - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({cls.name for cls in ACCELERATORS.values()}))
def test_the_estimate_is_no_less_than_what_is_taken(name: str) -> None:
    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("needs /proc/self/clear_refs to measure a peak")
    done = subprocess.run([sys.executable, "-c", MEASURE, name, "20000" if name == "bsp" else "300000"], cwd=ROOT,
                          capture_output=True, text=True, check=True)
    estimate, taken = map(float, done.stdout.split())
    print(f"{name}: estimated {estimate / 2**20:.0f} MiB, taken {taken / 2**20:.0f}")
    assert 0.9 * taken < estimate < 6.0 * taken
