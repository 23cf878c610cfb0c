"""Time to equal error against Mitsuba: what is measured is what it says, and another light is noticed."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests import command_line
from tests.data import ROOT
from wrt.bench import equal_error
from wrt.bench.equal_error import Plan, Result, matte
from wrt.driver import Options
from wrt.errors import InputError
from wrt.scene import Camera, Material, Object, PointLight, Scene, Settings, Sphere
from wrt.shapes import box

pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')

WHITE, GREEN = Material(albedo=(0.9, 0.9, 0.9)), Material("mirror", albedo=(0.1, 0.8, 0.1))
ROOM = Scene(
    name="room", objects=(Object(box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)), (WHITE,)),),
    spheres=(Sphere((0.3, -0.4, 0.0), 0.6, WHITE),), lights=(PointLight((1.0, 1.5, 1.0), (9.0, 9.0, 9.0)),),
    cameras=(Camera.look_at((0.0, 0.0, 1.9), (0.0, 0.0, 0.0), fov_y=math.radians(70)),),
    settings=Settings(size=(32, 18), spp=8))
PLAN = Plan(spp=8, repeats=3, reference_spp=64, rival_seconds=1.0, starts=0)


def measured(integrator: str) -> Result:
    return equal_error.run(ROOM, replace(PLAN, integrator=integrator), Options())


def test_direct_light_is_the_same_and_the_ratio_is_its_own_definition() -> None:
    result = measured("direct")
    assert result.same_light
    assert result.wrt.spp == 8 and len(result.wrt.seconds) == len(result.mitsuba.seconds) == 3
    assert result.reference.max_depth == ROOM.settings.max_depth
    expected = np.median(result.mitsuba.seconds / result.wrt.seconds) * (result.mitsuba.rmse / result.wrt.rmse) ** 2
    assert result.ratio[1] == pytest.approx(expected)
    # Mitsuba was given about as many samples as it needs: the two errors are near each other.
    assert 0.4 < result.mitsuba.rmse / result.wrt.rmse < 2.5
    assert math.isnan(result.process_ratio)
    assert "times as long" in equal_error.text(result) and "not of the same light" not in equal_error.text(result)


def test_interreflection_is_another_light() -> None:
    result = measured("path")
    assert not result.same_light
    assert "not of the same light" in equal_error.text(result)


def test_matte_leaves_the_albedo_and_what_lights_others() -> None:
    lamp, glow = Material(emission=(5.0, 5.0, 5.0)), Material(emission=(1.0, 1.0, 1.0), emits_light=False)
    scene = replace(ROOM, spheres=(Sphere((0.0, 0.0, 0.0), 0.1, lamp), Sphere((1.0, 0.0, 0.0), 0.1, glow),
                                   Sphere((0.0, 1.0, 0.0), 0.1, GREEN)), ambient=(0.1, 0.1, 0.1))
    kinds = {m.kind for m in matte(scene).materials}
    first, second, third = (sphere.material for sphere in matte(scene).spheres)
    assert kinds == {"diffuse"} and matte(scene).ambient == (0.0, 0.0, 0.0)
    assert first.emission == lamp.emission and second.emission == (0.0, 0.0, 0.0) and third.albedo == GREEN.albedo


@pytest.mark.parametrize("wrong", [{"spp": 0}, {"repeats": 2}])
def test_plans_that_cannot_be_measured(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        Plan(**wrong)


def test_the_command(tmp_path) -> None:
    output = tmp_path / "report.md"
    scene = ROOT / "scenes" / "independent.toml"
    done = command_line.wrt("bench", "mitsuba", scene, "--matte", "--size", "16x9", "--spp", "4",
                            "--repeats", "3", "--starts", "0", "--rival-limit", "1s", "--json", "-q", "-o", output)
    assert json.loads(done.out)["mitsuba"]["spp"] >= 1
    assert "Mitsuba scalar_rgb, direct" in output.read_text()
