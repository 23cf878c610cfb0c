"""Time to equal error against Mitsuba: the figures hold, a picture of other light is noticed, and unusable variants are named."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests import command_line
from tests.data import ROOT
from tests.mitsuba_oracle import render_mitsuba
from tests.refused import refused
from wrt.lab.bench.report import Row
from wrt.lab.mitsuba import VARIANTS, equal_error
from wrt.lab.mitsuba.equal_error import Job, Plan, Rival, compared, matte
from wrt.lab.mitsuba.translate import PATH_VARIABLE, llvm_missing
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box

pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')

WHITE, GREEN = Material(albedo=(0.9, 0.9, 0.9)), Material("mirror", albedo=(0.1, 0.8, 0.1))
ROOM = Scene(
    name="room", objects=(Object(box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)), (WHITE,)),),
    spheres=(Sphere((0.3, -0.4, 0.0), 0.6, WHITE),), lights=(PointLight((1.0, 1.5, 1.0), (9.0, 9.0, 9.0)),),
    cameras=(Camera.look_at((0.0, 0.0, 1.9), (0.0, 0.0, 0.0), fov_y=math.radians(70)),),
    settings=Settings(size=(32, 18), spp=8))
BALLS = Scene(
    spheres=(Sphere((0.0, 0.0, 0.0), 0.5, Material("glass", albedo=(0.9, 0.6, 0.9))), Sphere((0.7, 0.0, -0.5), 0.4, GREEN)),
    cameras=(Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov_y=0.8),), background=ConstantBackground((0.5, 1.0, 2.0)),
    settings=Settings(size=(24, 16), filter="box", min_throughput=0.0))
PLAN = Plan(ROOM, size="32x18", spp=8, repeats=3, reference_spp=64, rival_limit=1.0, starts=0)


def measured(integrator: str, variant: str) -> Row:
    if variant == "llvm_ad_rgb" and (reason := llvm_missing()):
        pytest.skip(reason)
    return compared(replace(PLAN, integrator=integrator, variants=(variant,)))


def told(result: Row) -> str:
    return equal_error.parts([result], PLAN)[0].text


@pytest.mark.parametrize("variant", VARIANTS)
def test_direct_light_is_the_same_and_the_ratio_is_its_own_definition(variant: str) -> None:
    result = measured("direct", variant)
    (name, rival), = result.mitsuba.items()
    assert name == variant and rival.same_light and not result.not_available
    assert result.wrt.spp == 8 and len(result.wrt.seconds) == len(rival.seconds) == 3
    assert result.reference.max_depth == ROOM.settings.max_depth
    expected = np.median(np.array(rival.seconds) / np.array(result.wrt.seconds)) * (rival.rmse / result.wrt.rmse) ** 2
    assert rival.ratio[1] == pytest.approx(expected)
    assert 0.4 < rival.rmse / result.wrt.rmse < 2.5  # Mitsuba was given about as many samples as it needs.
    assert math.isnan(rival.process_ratio) and "not of the same light" not in told(result)


@pytest.mark.parametrize("variant", VARIANTS)
def test_interreflection_is_another_light(variant: str) -> None:
    result = measured("path", variant)
    assert not result.mitsuba[variant].same_light and f"The picture of {variant} is not of the same light" in told(result)


def test_a_variant_without_its_library_is_left_out_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PATH_VARIABLE, "/nowhere/libLLVM.so")
    result = compared(replace(PLAN, integrator="direct"))
    assert set(result.mitsuba) == {"scalar_rgb"} and "/nowhere/libLLVM.so" in result.not_available["llvm_ad_rgb"]
    with refused(what="Mitsuba llvm_ad_rgb"):
        compared(replace(PLAN, integrator="direct", variants=("llvm_ad_rgb",)))


def test_a_picture_without_error_has_nothing_to_be_equal_to() -> None:
    empty = Scene(cameras=ROOM.cameras, background=ConstantBackground((0.5, 0.5, 0.5)), settings=ROOM.settings)
    with refused(what="no error"):
        compared(replace(PLAN, scene=empty, variants=("scalar_rgb",)))


def test_a_process_renders_what_is_rendered_here_and_its_end_is_reported() -> None:
    with Rival(Job("scalar_rgb", BALLS, 0, "path", 2)) as rival:
        np.testing.assert_array_equal(rival.render(1, 5)[1], render_mitsuba(BALLS, spp=1, seed=5, integrator="path").pixels)
        with refused(what="ended without an answer"):
            rival.ask(os._exit, 3)


def test_starts_have_all_that_a_process_takes(tmp_path) -> None:
    scene = tmp_path / "room.toml"
    shutil.copy(ROOT / "scenes" / "independent.toml", scene)
    result = compared(replace(PLAN, scene=scene, size="8x8", matte=True, starts=1, variants=("scalar_rgb",)))
    rival = result.mitsuba["scalar_rgb"]
    assert result.wrt.process_seconds > np.median(result.wrt.seconds) and rival.process_seconds > rival.prepare_seconds
    assert rival.process_ratio == pytest.approx(rival.process_seconds / result.wrt.process_seconds)


def test_matte_leaves_the_albedo_and_what_lights_others() -> None:
    lamp, glow = Material(emission=(5.0, 5.0, 5.0)), Material(emission=(1.0, 1.0, 1.0), emits_light=False)
    scene = replace(ROOM, spheres=(Sphere((0.0, 0.0, 0.0), 0.1, lamp), Sphere((1.0, 0.0, 0.0), 0.1, glow),
                                   Sphere((0.0, 1.0, 0.0), 0.1, GREEN)), ambient=(0.1, 0.1, 0.1))
    kinds = {m.kind for m in matte(scene).materials}
    first, second, third = (sphere.material for sphere in matte(scene).spheres)
    assert kinds == {"diffuse"} and matte(scene).ambient == (0.0, 0.0, 0.0)
    assert first.emission == lamp.emission and second.emission == (0.0, 0.0, 0.0) and third.albedo == GREEN.albedo


def test_the_command(tmp_path) -> None:
    output = tmp_path / "report.md"
    done = command_line.wrt("bench", "mitsuba", ROOT / "scenes" / "independent.toml", "--matte", "--size", "16x9", "--spp", "4",
                            "--repeats", "3", "--starts", "0", "--rival-limit", "1s", "--json", "-q", "-o", output)
    assert done.code == 0, done.err
    (row,) = json.loads(done.out)["rows"]
    assert row["mitsuba"]["scalar_rgb"]["spp"] >= 1 and set(row["mitsuba"]) | set(row["not_available"]) == set(VARIANTS)
    assert "Mitsuba scalar_rgb, direct" in output.read_text()
