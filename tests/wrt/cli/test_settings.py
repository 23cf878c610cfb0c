"""Settings on the command line: --set, names in --help and completion, and the hint that max_depth darkens pixels."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.shell_completion import ShellComplete

import wrt
from tests.command_line import BOX_OBJ, Result
from tests.command_line import wrt as run
from tests.data import ROOT
from wrt.cli.common import ACCEL
from wrt.cli.main import cli
from wrt.picture.image import read_image
from wrt.renderer.film import GROUPS, VISIBLE
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.settings import DEPTH, FILTERS, FRESNELS, GLASS_DEPTH, MAX_DEPTH, SETTINGS, Settings
from wrt.scene.shapes import quad

SMALL = ("--size", "32x18", "--spp", 2)
SCENE = """\
[materials.glass]
kind = "glass"
[materials.floor]
[[spheres]]
center = [0, 1, 0]
radius = 1
material = "glass"
[[quads]]
corner = [-3, 0, 3]
edge_u = [6, 0, 0]
edge_v = [0, 0, -6]
material = "floor"
[cameras.main]
position = [0, 2, 6]
target = [0, 0.5, 0]
[[lights]]
type = "directional"
direction = [-1, -2, -1]
irradiance = 2
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    return tmp_path


def with_settings(text: str) -> None:
    Path("scene.toml").write_text(f"[settings]\n{text}\n{SCENE}")


# --- --set ------------------------------------------------------------------------------------------------------------


def test_set_is_the_setting_of_a_file() -> None:
    values = {"size": [20, 12], "spp": 3, "max_depth": 3, "min_throughput": 0.01, "clamp": 0.8, "filter": "gaussian",
              "fresnel": "schlick",
              "glass_shadows": "tinted", "sampler": "independent", "exposure": -1, "tonemap": "reinhard",
              "auto_exposure": True}
    assert tuple(values) == SETTINGS
    with_settings("\n".join(f"{name} = {json.dumps(value)}" for name, value in values.items()))
    assert run("render", "scene.toml", "-o", "expected.png").code == 0
    Path("scene.toml").write_text(SCENE)
    words = {**values, "size": "20x12"}
    assert run("render", "scene.toml", "-o", "set.png", *(f"--set={name}={value}" for name, value in words.items())).code == 0
    assert np.array_equal(read_image("set.png"), read_image("expected.png"))
    plain = ("render", "scene.toml", "-o", "plain.png", "--size", "20x12")
    assert run(*plain).code == 0 and not np.array_equal(read_image("plain.png"), read_image("set.png"))


def test_set_wins_over_the_file_and_stands_beside_flags() -> None:
    with_settings('spp = 7\nglass_shadows = "opaque"')
    result = run("render", "scene.toml", "--size", "8x6", "--set", "spp=3", "--set", "glass_shadows=tinted", "--json")
    assert json.loads(result.out)["spp"] == 3
    described = json.loads(run("info", "scene.toml", "--json", "--set", "glass_shadows=tinted").out)
    assert described["features"]["tinted_shadows"] is True
    assert json.loads(run("info", "scene.toml", "--json").out)["features"]["tinted_shadows"] is False


@pytest.mark.parametrize(("arguments", "message"), [
    (["--set", "fitler=box"], "--set: fitler: unknown key 'fitler'; did you mean 'filter'?"),
    (["--set", "ambient=1"], "--set: ambient: is a key of the scene, not of its settings"),
    (["--set", "glass_shadows=tint"], "did you mean 'tinted'? known are 'opaque', 'tinted'"),
    (["--set", "spp=1.5"], "--set: spp: got 1.5, expected a whole number"), (["--set", "spp=" + "9" * 5000], "--set: spp: got "),
    (["--set", "exposure=nan"], "exposure: got nan"), (["--set", "exposure=True"], "exposure: got true, expected a number"),
    (["--set", "size=0x3"], "--set size must be 1x1 to"), (["--set", "=box"], "'=box' is not NAME=VALUE"),
    (["--set", "spp=4", "--set", "spp=5"], "--set spp has two values, 4 and 5; give one"),
    (["--set", "size=3x4", "--size", "4x3"], "--set size and --size have different values"),
    (["--set", "max_depth=4", "--max-depth", "0"], "--set max_depth and --max-depth have different values"),
    (["--set", "fitler=box", "--set", "spp=0"], "error: --set: 2 errors"),
], ids=lambda value: str(value)[:40])
def test_a_wrong_setting_is_reported_before_the_scene_is_read(arguments: list[str], message: str) -> None:
    Path("box.obj").write_text("")  # a command that reads the file ends with another error
    result = run("render", "box.obj", *arguments)
    assert result.code == 2 and result.out == "" and len(result.errors) == 1 and message in result.errors[0], result
    assert not Path("box.png").exists()


@pytest.mark.parametrize(("command", "setting", "who"), [
    (("view", "box.obj"), "size=9x9", "the browser's window"), (("profile", "box.obj"), "spp=9", "--spp"),
    (("bench", "error", "box.obj"), "size=9x9", "--size"), (("bench", "mitsuba", "box.obj"), "spp=9", "another option"),
])
def test_what_a_command_decides_on_itself_is_not_set(command: tuple[str, ...], setting: str, who: str) -> None:
    pytest.importorskip("websockets")
    result = run(*command, "--set", setting)
    assert result.code == 2 and f"--set {setting.split('=')[0]} cannot be used with this command; {who} decides" in result.err, result


# --- what --help and completion know ----------------------------------------------------------------------------------


def options_of(command: click.Command) -> list[click.Parameter]:
    below = command.commands.values() if isinstance(command, click.Group) else ()
    return [*command.params, *(each for inner in below for each in options_of(inner))]


def test_help_shows_the_names_of_each_table() -> None:
    text = re.sub(r"\s+", " ", run("render", "--help").out)
    for option, names in (("accel", wrt.ACCELERATORS), ("filter", FILTERS), ("fresnel", FRESNELS)):
        assert f"--{option} [{'|'.join(names)}]" in text
    accels = [each for each in options_of(cli) if each.name == "accel"]
    assert len(accels) > 5 and all(each.type is ACCEL for each in accels)


@pytest.mark.parametrize("arguments", ["--help", "render --help", "bench --help", "bench queries --help", "rendr"])
def test_help_does_not_wait_for_warp(arguments: str) -> None:
    code = ("import sys\nfrom wrt.cli.main import cli\ntry:\n    cli()\nfinally:\n"
            "    print({name.split('.')[0] for name in sys.modules} & {'warp', 'scipy', 'trimesh', 'rich'})")
    done = subprocess.run([sys.executable, "-c", code, *arguments.split()], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.endswith("set()\n"), done


@pytest.mark.parametrize(("arguments", "incomplete", "expected"), [
    (["render", "--accel"], "bvh2", ["bvh2", "bvh2_sphere", "bvh2_kdop"]),
    (["render", "--tonemap"], "", ["none", "reinhard", "aces", "agx"]),
])
def test_completion(arguments: list[str], incomplete: str, expected: list[str]) -> None:
    words = ShellComplete(cli, {}, "wrt", "_WRT_COMPLETE").get_completions(arguments, incomplete)
    assert [word.value for word in words] == expected


@pytest.mark.parametrize(("arguments", "message"), [
    (["render", "box.obj", "--accel", "bhv"], "no structure 'bhv'; did you mean 'bvh'? there is bvh, "),
    (["render", "box.obj", "--filter", "gausian"], "got 'gausian'; did you mean 'gaussian'?"),
    (["bench", "queries", "gird:density=4"], "no contestant 'gird'; did you mean 'grid'?"),
    (["profile", "box.obj", "--gpu", "rtx2080"], "no GPU 'rtx2080'; did you mean 'rtx2080ti'?"),
    (["rendr"], "No such command 'rendr'. Did you mean 'render'?"), (["render", "box.obj", "--sizes", "3"], "'--size'"),
])
def test_a_wrong_name_is_answered_with_the_nearest(arguments: list[str], message: str) -> None:
    result = run(*arguments)
    assert result.code == 2 and len(result.errors) == 1 and message in result.errors[0], result


# --- what max_depth cuts ----------------------------------------------------------------------------------------------


def mirrors(albedo: float, **settings: Any) -> Scene:
    """Return a scene with a mirror over the left half of the picture, in front of a white sky."""
    mirror = Material("mirror", albedo=(albedo,) * 3)
    half = Object(quad((-100, -100, 0), (100, 0, 0), (0, 200, 0)), (mirror,))
    return Scene(objects=(half,), background=ConstantBackground((1, 1, 1)), cameras=(Camera.look_at((0, 0, 5), (0, 0, 0)),),
                 settings=Settings(size=(8, 6), spp=4, filter="box", **settings))


@pytest.mark.parametrize(("albedo", "settings", "expected"), [
    (0.5, {"max_depth": 0}, 0.5), (0.5, {"max_depth": 1}, 0.0), (1.2 * VISIBLE, {"max_depth": 0}, 0.5),
    (0.8 * VISIBLE, {"max_depth": 0}, 0.0), (0.5, {"min_throughput": 0.9}, 0.0),
    (0.5, {"max_depth": 0, "min_throughput": 0.9}, 0.5),
])
@pytest.mark.parametrize("options", [{}, {"target_error": 1e-9, "spp": 4 * GROUPS}], ids=["one sequence", "groups"])
def test_pixels_that_are_visibly_darker_are_counted(albedo: float, settings: dict[str, Any], expected: float,
                                                    options: dict[str, Any]) -> None:
    film = wrt.render(mirrors(albedo, **settings), **options)
    assert film.stats["visibly_cut"] == expected


@pytest.mark.parametrize("pane", [Material("glass", thin=True, albedo=(1, 1, 1)),
                                  Material("metallic_roughness", transmission=1.0, thin=True, albedo=(1, 1, 1))])
def test_glass_without_a_given_depth_is_followed_through_all_its_surfaces(pane: Material) -> None:
    behind = tuple(Object(quad((-100, -100, -0.1 * i), (200, 0, 0), (0, 200, 0)), (pane,)) for i in range(20))
    scene = replace(mirrors(0.5), objects=behind, settings=Settings(size=(8, 6), spp=4))
    assert scene.settings.max_depth == GLASS_DEPTH
    assert wrt.render(scene).stats["visibly_cut"] == 0.0 < wrt.render(scene, max_depth=8).stats["visibly_cut"]
    assert scene.with_settings(max_depth=3).with_settings(spp=1).settings.max_depth == 3
    assert mirrors(0.5).settings.max_depth == DEPTH == replace(scene, objects=(), settings=Settings()).settings.max_depth


@pytest.mark.parametrize(("albedo", "needed"), [(0.5, 4), (0.9, 28), (1.0, MAX_DEPTH)])
def test_the_needed_depth_between_two_mirrors(albedo: float, needed: int) -> None:
    # After n bounces the share albedo^n of the light is left: below VISIBLE after needed + 1 bounces.
    mirror = Material("mirror", albedo=(albedo,) * 3)
    walls = tuple(Object(quad((-1e4, -1e4, z), (2e4, 0, 0), (0, 2e4, 0)), (mirror,)) for z in (-1.0, 1.0))
    scene = Scene(walls, background=ConstantBackground((1, 1, 1)), cameras=(Camera.look_at((0, 0, 0), (0, 0, 1), fov_y=0.1),),
                  settings=Settings(size=(8, 6), spp=1, filter="box"))
    for depth in (1, 2, 3):
        stats = wrt.render(scene, max_depth=depth).stats
        assert stats["visibly_cut"] == 1.0 and stats["needed_depth"] == needed
        assert stats["lost_by_depth"] == pytest.approx(albedo ** (depth + 1), rel=1e-5)
    enough = wrt.render(scene, max_depth=needed).stats
    assert enough["visibly_cut"] == (albedo == 1.0) and enough["needed_depth"] == needed


def hints(result: Result) -> list[str]:
    assert result.code == 0, result
    return [line for line in result.err.splitlines() if "visibly too dark" in line]


def test_the_command_line_tells_what_was_cut() -> None:
    with_settings("max_depth = 1")
    small = ("--size", "32x18", "--spp", "4")
    told, = hints(run("render", "scene.toml", *small))
    assert re.fullmatch(r"max_depth 1 leaves [0-9.]+% of the pixels visibly too dark; .*: try --max-depth [0-9]+", told)
    assert not hints(run("render", "scene.toml", *small, "-q"))
    assert not hints(run("render", "scene.toml", *small, "--max-depth", 20))
    assert 0.0 < json.loads(run("render", "scene.toml", *small, "--json").out)["visibly_cut"] < 0.5
    assert len(hints(run("animate", "scene.toml", *small, "--frames", 2, "-o", "a.gif"))) == 1  # once, not for each frame
