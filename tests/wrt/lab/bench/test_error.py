"""`bench error`: its statistics on numbers whose answer is known, its sweep on scenes whose error is known."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command_line import wrt as run_command
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.lab.bench import error as bench
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error import BASE
from wrt.lab.bench.report import Row, cells, run
from wrt.renderer.options import Options
from wrt.renderer.plan import features_of
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad

# --- statistics -------------------------------------------------------------------------------------------------------


def test_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(1).normal(size=9)
    value, error = statistics.jackknife(lambda i: float(values[i].mean()), 9)
    assert value == pytest.approx(values.mean()) and error == pytest.approx(values.std(ddof=1) / 3.0)
    interval = statistics.mean_estimate(values.tolist())
    assert interval.high - interval.value == pytest.approx(2.306004 * error)  # Student's t, 8 degrees of freedom


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    # Mean squares of few normal numbers: skewed, as an mse is.
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(1000):
        squares = (rng.normal(size=(8, 20)) ** 2).mean(axis=1)
        found = statistics.estimate(lambda i, squares=squares: float(squares[i].mean()), 8, logarithmic=True)
        held += found.low <= 1.0 <= found.high
    assert 0.92 < held / 1000 < 0.98


@pytest.mark.parametrize("bias", [0.0, 0.02, 0.5])
def test_bias_and_noise_are_told_apart(bias: float) -> None:
    rng = np.random.default_rng(3)
    shape, noise, known = (40, 50, 3), 0.1, 0.01**2
    found: list[tuple[float, float, float]] = []
    for _ in range(20):
        truth = np.full(shape, 2.0) + 0.01 * rng.normal(size=shape)  # the reference has noise of its own
        pictures = [2.0 + bias * np.sign(np.arange(3) - 0.5) + noise * rng.normal(size=shape) for _ in range(6)]
        products = statistics.gram(pictures, truth)
        found.append((statistics.mse_of(products, known), statistics.squared_bias_of(products, known),
                      statistics.noise_of(products)))
    mse, squared, variance = np.mean(found, axis=0)
    assert np.allclose([a - b - c for a, b, c in found], 0.0, atol=1e-12 + 1e-3 * known)
    assert variance == pytest.approx(noise**2, rel=0.02)
    assert squared == pytest.approx(bias**2, abs=0.02 * bias**2 + 2e-5)
    assert mse == pytest.approx(bias**2 + noise**2, rel=0.02)


def test_a_bias_is_claimed_only_where_it_shows() -> None:
    rng = np.random.default_rng(4)
    shape = (30, 40, 3)
    claims = 0
    for _ in range(60):
        products = statistics.gram([0.3 * rng.normal(size=shape) for _ in range(6)], np.zeros(shape))
        bias, below = statistics.bias_with_bound(products, 0.0)
        claims += not math.isnan(bias)
        assert below > 0.0
    assert claims <= 8  # one side of a 95 % interval: 1.5 in 60
    products = statistics.gram([0.1 + 0.3 * rng.normal(size=shape) for _ in range(6)], np.zeros(shape))
    bias, below = statistics.bias_with_bound(products, 0.0)
    assert bias == pytest.approx(0.1, rel=0.1) and bias < below < 0.15


def test_slope_of_a_power_law() -> None:
    spp = [1, 2, 4, 8, 16]
    factors = np.array([0.9, 1.0, 1.2, 0.95])
    found = statistics.slope(spp, lambda i: [float(factors[i].mean()) * n**-1.5 for n in spp], 4)
    assert found.value == pytest.approx(-1.5) and found.high - found.low < 1e-6
    assert math.isnan(statistics.slope(spp[:2], lambda i: [1.0, 0.5], 4).value)
    assert math.isnan(statistics.slope(spp, lambda i: [1.0, 0.5, 0.0, 0.1, 0.1], 4).value)


# --- the knobs --------------------------------------------------------------------------------------------------------

MIRROR = Material("mirror", albedo=(0.5,) * 3, emission=(0.5,) * 3, two_sided=True)
MIRROR_BOX = Scene(objects=(Object(box((-1, -1, -1), (1, 1, 1)), (MIRROR,)),), name="mirrors",
                   cameras=(Camera.look_at((0.3, 0.2, 0.1), (1.0, 0.4, 0.3), fov_y=1.5),),
                   settings=Settings(size=(8, 6), max_depth=30, min_throughput=0.0, filter="box"))
GLASS = Scene(spheres=(Sphere((0, 0, 0), 1.0, Material("glass")),), background=GradientBackground(), cameras=MIRROR_BOX.cameras)
PLAIN = Scene(objects=(Object(quad(), (Material(albedo=(0, 0, 0)),)),), cameras=MIRROR_BOX.cameras, background=GradientBackground())


def variants(scene: Scene, *knobs: str) -> tuple[list[bench.Variant], list[str]]:
    return bench.variants(scene, Options(), features_of(scene, scene.camera()), knobs or tuple(bench.KNOBS))


def test_every_knob_is_a_field_and_every_value_can_be_rendered_with() -> None:
    names = {"settings": {f.name for f in fields(Settings)}, "options": {f.name for f in fields(Options)}}
    assert {"sampler", "max_depth", "min_throughput", "fresnel", "triangle", "box", "accel"} <= set(bench.KNOBS)
    for knob in bench.KNOBS.values():
        assert knob.name in names[knob.kind]
        for scene in (MIRROR_BOX, GLASS):
            for variant in variants(scene, knob.name)[0][1:]:  # each is turned, and alone
                here = variant.scene.settings if knob.kind == "settings" else variant.options
                assert getattr(here, knob.name) == variant.value
                assert variant.value != getattr(scene.settings if knob.kind == "settings" else Options(), knob.name)
    many = Scene(objects=(Object(quad(), (Material(),)),) * (bench.BRUTE_FORCE_LIMIT // 2 + 1))
    names_of_structures = bench.structures(MIRROR_BOX)
    assert len({ACCELERATORS[name] for name in names_of_structures}) == len(names_of_structures) == len(set(ACCELERATORS.values()))
    assert "brute_force" in names_of_structures and "brute_force" not in bench.structures(many)


def test_knobs_that_change_nothing_are_left_out_and_told() -> None:
    found, without_effect = variants(PLAIN, "max_depth", "min_throughput", "fresnel", "sampler")
    assert [each.label for each in found] == [BASE, "sampler = independent"] and len(without_effect) == 3
    found, without_effect = variants(GLASS, "max_depth", "fresnel", "triangle")
    assert [each.label for each in found] == [BASE, *(f"max_depth = {d}" for d in (0, 1, 2, 4, 8, 16)), "fresnel = schlick"]
    assert without_effect == ["triangle"]


@pytest.mark.parametrize("wrong", [{"knobs": ("size",)}, {"repeats": 2}, {"max_spp": 0}, {"reference_spp": 0}, {"size": "big"}])
def test_a_plan_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        bench.Plan(PLAIN, **wrong)
    assert bench.Plan(PLAIN, max_spp=20).levels == [1, 2, 4, 8, 16] and bench.Plan(PLAIN, max_spp=1).levels == [1]


# --- sweeps whose answer is known -------------------------------------------------------------------------------------


def sweep(scene: Scene, *knobs: str, **options: Any) -> list[Row]:
    return run(bench.Plan(scene, knobs=knobs, size="x".join(map(str, scene.settings.size)), **{"repeats": 3, "max_spp": 4} | options))


def test_a_box_of_mirrors_has_the_bias_of_its_depth_and_no_noise() -> None:
    result = sweep(MIRROR_BOX, "max_depth", "min_throughput", reference_spp=4)
    truth = result[0]
    assert np.allclose(truth.pixels, 1.0, atol=1e-6) and truth.rmse < 1e-6
    assert truth.lost_throughput_per_sample == pytest.approx(0.5**33, rel=1e-3)
    assert (truth.max_depth, truth.min_throughput) == (32, 0.0)
    rows = {(row.variant, row.spp): row for row in bench.pictures_of(result)}
    for depth in (0, 1, 2, 4, 8):
        for spp in (1, 2, 4):
            row = rows[f"max_depth = {depth}", spp]
            assert row.bias == pytest.approx(0.5 ** (depth + 1), rel=1e-3)
            assert row.rmse.value == pytest.approx(row.bias, rel=1e-4) and row.noise < 1e-6
            assert row.efficiency.value == pytest.approx(1.0 / (row.rmse.value**2 * row.seconds.value), rel=1e-6)
    assert rows["min_throughput = 0.1", 1].bias == pytest.approx(0.5**4, rel=1e-3)
    slopes = {slope.variant: slope for slope in bench.slopes(result)}
    assert slopes["max_depth = 2"].mse.value == pytest.approx(0.0, abs=1e-3)  # more samples do not help
    assert "max_depth = 2" not in bench.same_pixels(result)


def edge_scene(filter: str = "box") -> Scene:
    """A slanted edge between black and white: nothing but the pixel's own two dimensions."""
    glow = Material(albedo=(0, 0, 0), emission=(1, 1, 1), emits_light=False)
    corner, along = np.array([-9.0, -9.31, 0.0]), np.array([18.0, 18.9, 0.0])
    return Scene(objects=(Object(quad(corner, along, (-20.0, 20.0, 0.0)), (glow,)),), name="edge",
                 cameras=(Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=0.6),), settings=Settings(size=(16, 16), filter=filter))


# Radiance linear in the direction's y, and the filter table as the only integrand: float32 ends it near 1e-7.
SKY = Scene(background=GradientBackground((0, 0, 0), (2, 2, 2)), cameras=(Camera(fov_y=1.2),),
            settings=Settings(size=(8, 8), filter="gaussian"))


@pytest.mark.parametrize(("scene", "max_spp", "low", "high"), [(edge_scene(), 128, -1.7, -1.3), (SKY, 32, -3.4, -2.2)],
                         ids=["edge", "smooth"])
def test_slopes_at_an_edge_and_where_the_picture_is_smooth(scene: Scene, max_spp: int, low: float, high: float) -> None:
    result = sweep(scene, "sampler", max_spp=max_spp, repeats=6, reference_spp=2048)
    assert result[0].rmse < 0.2 * min(row.rmse.value for row in bench.pictures_of(result) if row.knob is None)
    found = {"independent" if "independent" in slope.variant else "sobol": slope.noise.value for slope in bench.slopes(result)}
    assert found["independent"] == pytest.approx(-1.0, abs=0.15) and low < found["sobol"] < high


def test_a_sweep_can_be_repeated_and_seeds_differ() -> None:
    a, b, other = (bench.pictures_of(sweep(edge_scene(), "accel", reference_spp=16, seed=seed)) for seed in (3, 3, 4))
    assert [row.rmse for row in a] == [row.rmse for row in b] != [row.rmse for row in other]
    assert [row._digest for row in a] == [row._digest for row in b]
    assert all(len(np.unique(np.diag(row.products))) == 3 for row in a)  # three different pictures
    assert bench.same_pixels(a) == [f"accel = {name}" for name in bench.structures(edge_scene()) if name != Options().accel]


def test_constant_background_has_no_error() -> None:
    # Nothing to estimate: every value is 0 or NaN, and nothing fails.
    scene = Scene(background=ConstantBackground((0.5, 0.5, 0.5)), cameras=(Camera(),), settings=Settings(size=(4, 4)))
    result = sweep(scene, "fresnel", reference_spp=4)
    rows = bench.pictures_of(result)
    assert rows and all(math.isnan(row.rmse.value) and row.noise == 0.0 for row in rows)
    cells_of = dict(zip(bench.COLUMNS, cells(bench.COLUMNS, rows[0]), strict=True))
    assert cells_of["RMSE"] == cells_of["efficiency"] == "-"
    assert "change nothing in this scene: fresnel" in str(bench.parts(result, bench.Plan(scene)))


def test_the_command(tmp_path: Path) -> None:
    scene = tmp_path / "sky.toml"
    scene.write_text('[cameras.main]\nposition = [0, 0, 4]\ntarget = [0, 0, 0]\n[background]\ntype = "gradient"\n'
                     '[materials.black]\nalbedo = 0\n[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\nmaterial = "black"\n')
    common = ("bench", "error", scene, "--size", "12x8", "--max-spp", "4", "--repeats", "3", "--reference-spp", "8", "--set", "filter=box")
    result = run_command(*common, "--knobs", "sampler,fresnel", "--json", "-o", tmp_path / "sky.md")
    assert result.code == 0 and "reference: " in result.err and "about 0:" in result.err
    data, page = json.loads(result.out), (tmp_path / "sky.md").read_text()
    assert [row.get("spp") for row in data["rows"]] == [None, 1, 2, 4, 1, 2, 4] and data["rows"][0]["seeds"] == 8
    assert data["rows"][1]["rmse"]["low"] < data["rows"][1]["rmse"]["value"] < data["rows"][1]["rmse"]["high"]
    assert page.count("| sampler = independent | ") == 4  # three rows, one slope
    assert "--size 12x8 --set filter=box --knobs sampler,fresnel --max-spp 4" in page and "in this scene: fresnel" in page
    wrong = run_command(*common, "--knobs", "flux")
    assert wrong.code == 2 and "there is sampler" in wrong.errors[0]
    assert run_command(*common[:2], tmp_path / "none.toml").code == 2
    assert run_command(*common, "--camera", "top").errors[0].startswith(f"error: {scene}: the scene has no camera 'top'")
