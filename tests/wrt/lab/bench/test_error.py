"""`bench error`: its statistics on numbers whose answer is known, its sweep on scenes whose error is known."""

from __future__ import annotations

import json
import math
import signal
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as run_command
from wrt.accel.structures import ACCELERATORS
from wrt.cli.common import json_text
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted
from wrt.lab.bench import error as bench
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error import BASE
from wrt.lab.bench.report import Row, cells
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


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0.1, 10.0), st.floats(0.1, 10.0) | st.just(math.nan)), max_size=30))
def test_the_front_is_what_nothing_beats(points: list[tuple[float, float]]) -> None:
    front = statistics.pareto_front(points, tolerance=0.0)
    usable = [i for i, p in enumerate(points) if not math.isnan(p[1])]
    for i in usable:
        beaten = any(points[j][0] <= points[i][0] and points[j][1] <= points[i][1] and points[j] != points[i] for j in usable)
        assert (points[i] in [points[j] for j in front]) == (not beaten)
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)


def test_of_equal_errors_the_cheapest_is_on_the_front() -> None:
    points = [(3.0, 0.1), (1.0, 0.1001), (2.0, 0.0999), (5.0, 0.05), (4.0, 0.2)]
    assert statistics.pareto_front(points) == [1, 3]


# --- the knobs --------------------------------------------------------------------------------------------------------

MIRROR = Material("mirror", albedo=(0.5,) * 3, emission=(0.5,) * 3, two_sided=True)
MIRROR_BOX = Scene(objects=(Object(box((-1, -1, -1), (1, 1, 1)), (MIRROR,)),), name="mirrors",
                   cameras=(Camera.look_at((0.3, 0.2, 0.1), (1.0, 0.4, 0.3), fov_y=1.5),),
                   settings=Settings(size=(8, 6), max_depth=30, min_throughput=0.0, filter="box"))
GLASS = Scene(spheres=(Sphere((0, 0, 0), 1.0, Material("glass")),), background=GradientBackground(), cameras=MIRROR_BOX.cameras)
PLAIN = Scene(objects=(Object(quad(), (Material(albedo=(0, 0, 0)),)),), cameras=MIRROR_BOX.cameras, background=GradientBackground())


def labels(scene: Scene, *knobs: str, **options: Any) -> tuple[list[str], list[str]]:
    found, left_out = bench.variants(scene, Options(**options), features_of(scene, scene.camera()), knobs or tuple(bench.KNOBS))
    return [variant.label for variant in found], left_out


def test_every_knob_is_a_field_and_every_value_can_be_rendered_with() -> None:
    names = {"settings": {f.name for f in fields(Settings)}, "options": {f.name for f in fields(Options)}}
    assert {"sampler", "max_depth", "min_throughput", "fresnel", "triangle", "box", "accel"} <= set(bench.KNOBS)
    for knob in bench.KNOBS.values():
        assert knob.name in names[knob.kind]
        for scene in (MIRROR_BOX, GLASS):
            found, _ = bench.variants(scene, Options(), features_of(scene, scene.camera()), [knob.name])
            for variant in found[1:]:  # each is turned, and alone
                here = variant.scene.settings if knob.kind == "settings" else variant.options
                assert getattr(here, knob.name) == variant.value
                assert variant.value != getattr(scene.settings if knob.kind == "settings" else Options(), knob.name)


def test_a_structure_is_put_in_once_and_brute_force_only_where_it_ends() -> None:
    names = bench.structures(MIRROR_BOX)
    assert len({ACCELERATORS[name] for name in names}) == len(names) == len(set(ACCELERATORS.values()))
    many = Scene(objects=(Object(quad(), (Material(),)),) * (bench.BRUTE_FORCE_LIMIT // 2 + 1))
    assert "brute_force" in names and "brute_force" not in bench.structures(many)


def test_knobs_that_change_nothing_are_left_out_and_told() -> None:
    names, left_out = labels(PLAIN, "max_depth", "min_throughput", "fresnel", "sampler")
    assert names == [BASE, "sampler = independent"] and len(left_out) == 3
    names, left_out = labels(GLASS, "max_depth", "fresnel", "triangle")
    assert names == [BASE, *(f"max_depth = {d}" for d in (0, 1, 2, 4, 8, 16)), "fresnel = schlick"]
    assert left_out == ["triangle: it changes nothing in this scene"]


@pytest.mark.parametrize("wrong", [{"knobs": ("size",)}, {"repeats": 2}, {"max_spp": 0}, {"reference_spp": 0}])
def test_a_plan_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        bench.Plan(**wrong)


def test_levels_are_powers_of_two() -> None:
    assert bench.Plan(max_spp=20).levels == [1, 2, 4, 8, 16] and bench.Plan(max_spp=1).levels == [1]


# --- sweeps whose answer is known -------------------------------------------------------------------------------------


def test_a_box_of_mirrors_has_the_bias_of_its_depth_and_no_noise() -> None:
    plan = bench.Plan(knobs=("max_depth", "min_throughput"), max_spp=4, repeats=3, reference_spp=4)
    result = bench.sweep(MIRROR_BOX, plan, Options())
    assert np.allclose(result.reference.pixels, 1.0, atol=1e-6) and result.reference.rmse < 1e-6
    assert result.reference.lost_throughput_per_sample == pytest.approx(0.5**33, rel=1e-3)
    assert (result.reference.max_depth, result.reference.min_throughput) == (32, 0.0)
    rows = {(row.variant, row.spp): row for row in result.rows}
    for depth in (0, 1, 2, 4, 8):
        for spp in (1, 2, 4):
            row = rows[f"max_depth = {depth}", spp]
            assert row.bias == pytest.approx(0.5 ** (depth + 1), rel=1e-3)
            assert row.rmse.value == pytest.approx(row.bias, rel=1e-4) and row.noise < 1e-6
            assert row.rays_per_sample == depth + 1
            assert row.relmse.value == pytest.approx(0.25 ** (depth + 1) / 1.01, rel=1e-3)
            assert row.efficiency.value == pytest.approx(1.0 / (row.rmse.value**2 * row.seconds.value), rel=1e-6)
    assert rows["min_throughput = 0.1", 1].bias == pytest.approx(0.5**4, rel=1e-3)
    slopes = {slope.variant: slope for slope in result.slopes}
    assert slopes["max_depth = 2"].mse.value == pytest.approx(0.0, abs=1e-3)  # more samples do not help
    assert "max_depth = 2" not in result.same_pixels
    front = [row for row in result.rows if row.pareto]
    assert front and all(not (a.seconds.value <= b.seconds.value and a.rmse.value < 0.99 * b.rmse.value)
                         for a in result.rows for b in front)
    json.loads(json_text(result.as_dict()))


def edge_scene(filter: str = "box") -> Scene:
    """A slanted edge between black and white: nothing but the pixel's own two dimensions."""
    glow = Material(albedo=(0, 0, 0), emission=(1, 1, 1), emits_light=False)
    corner, along = np.array([-9.0, -9.31, 0.0]), np.array([18.0, 18.9, 0.0])
    return Scene(objects=(Object(quad(corner, along, (-20.0, 20.0, 0.0)), (glow,)),), name="edge",
                 cameras=(Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=0.6),), settings=Settings(size=(16, 16), filter=filter))


def slopes_of(scene: Scene, max_spp: int = 128) -> dict[str, float]:
    result = bench.sweep(scene, bench.Plan(knobs=("sampler",), max_spp=max_spp, repeats=6, reference_spp=2048), Options())
    assert result.reference.rmse < 0.2 * min(row.rmse.value for row in result.rows if row.knob is None)
    return {"independent" if "independent" in slope.variant else "sobol": slope.noise.value for slope in result.slopes}


def test_slopes_at_an_edge() -> None:
    found = slopes_of(edge_scene())
    assert found["independent"] == pytest.approx(-1.0, abs=0.12)
    assert found["sobol"] == pytest.approx(-1.5, abs=0.2)


def test_slopes_where_the_picture_is_smooth() -> None:
    # Radiance linear in the direction's y, and the filter table as the only integrand: float32 ends it near 1e-7.
    sky = Scene(background=GradientBackground((0, 0, 0), (2, 2, 2)), cameras=(Camera(fov_y=1.2),),
                settings=Settings(size=(8, 8), filter="gaussian"))
    found = slopes_of(sky, 32)
    assert found["independent"] == pytest.approx(-1.0, abs=0.15)
    assert -3.4 < found["sobol"] < -2.2


def test_a_sweep_can_be_repeated_and_seeds_differ() -> None:
    plan = bench.Plan(knobs=("accel",), max_spp=4, repeats=3, reference_spp=16)
    told: list[str] = []
    a, b = (bench.sweep(edge_scene(), plan, Options(seed=3), told.append) for _ in range(2))
    other = bench.sweep(edge_scene(), plan, Options(seed=4))
    assert [row.rmse for row in a.rows] == [row.rmse for row in b.rows] != [row.rmse for row in other.rows]
    assert [row._digest for row in a.rows] == [row._digest for row in b.rows]
    assert len(told) == 2 * (1 + len(a.rows)) and told[0].startswith("reference: 8 seeds of 16 spp")
    assert all(len(np.unique(np.diag(row.products))) == 3 for row in a.rows)  # three different pictures
    assert a.same_pixels == [f"accel = {name}" for name in bench.structures(edge_scene()) if name != Options().accel]


def test_rows_that_take_too_long_are_left_out_and_told() -> None:
    plan = bench.Plan(knobs=("sampler",), max_spp=64, repeats=3, reference_spp=4, row_limit=1e-9)
    result = bench.sweep(edge_scene(), plan, Options())
    assert [row.spp for row in result.rows] == [1, 1] and len(result.left_out) == 2
    assert "from 2 spp on" in result.left_out[0]
    assert math.isnan(result.slopes[0].mse.value) and result.slopes[0].theory == "-1 to -3"


def test_interrupted_renders_end_the_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    run = bench.Renderer.run

    def interrupted(self: Any, **how: Any) -> Any:
        film = run(self, **how)
        film.stats["interrupted"] = True
        return film

    monkeypatch.setattr(bench.Renderer, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        bench.sweep(edge_scene(), bench.Plan(max_spp=1, repeats=3), Options())


# --- reports ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> bench.Sweep:
    return bench.sweep(edge_scene(), bench.Plan(knobs=("sampler",), max_spp=4, repeats=3, reference_spp=64), Options())


def test_the_report_says_everything(small: bench.Sweep) -> None:
    text = bench.text(small)
    assert text.count("| sampler = independent | ") >= 4  # three rows, one slope
    assert f"Its standard error is {bench.number(small.reference.rmse)}" in text
    data = json.loads(json_text(small.as_dict()))
    assert [row["spp"] for row in data["rows"]] == [1, 2, 4] * 2 and data["reference"]["seeds"] == 8
    assert data["rows"][0]["rmse"]["low"] < data["rows"][0]["rmse"]["value"] < data["rows"][0]["rmse"]["high"]
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len({len(line) for line in rows[:6]}) == 1  # columns stand below each other
    assert sum(line.endswith(" * |") for line in rows) == sum(row.pareto for row in small.rows) > 0


def test_what_cannot_be_told_is_a_dash(small: bench.Sweep) -> None:
    row = small.rows[0]
    unknown = Row(**vars(row) | {"rmse": statistics.UNKNOWN, "efficiency": statistics.UNKNOWN, "bias": math.nan})
    named = dict(zip(bench.COLUMNS, cells(bench.COLUMNS, unknown), strict=True))
    assert named["RMSE"] == "-" and named["efficiency"] == "-" and named["bias"].startswith("< ")


def test_the_command(tmp_path: Path) -> None:
    scene = tmp_path / "sky.toml"
    scene.write_text('[cameras.main]\nposition = [0, 0, 4]\ntarget = [0, 0, 0]\n[background]\ntype = "gradient"\n'
                     '[materials.black]\nalbedo = 0\n[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\nmaterial = "black"\n')
    common = ("bench", "error", scene, "--size", "12x8", "--max-spp", "4", "--repeats", "3", "--reference-spp", "8")
    result = run_command(*common, "--knobs", "sampler,fresnel", "--json", "-o", tmp_path / "sky.md")
    assert result.code == 0 and "reference: 8 seeds of 8 spp" in result.err
    data = json.loads(result.out)
    assert data["size"] == [12, 8] and len(data["rows"]) == 6 and "sampler = independent" in Path(data["output"]).read_text()
    assert data["left_out"] == ["fresnel: it changes nothing in this scene"]
    quiet = run_command(*common, "--knobs", "sampler", "-q")
    assert quiet.code == 0 and not quiet.err and "sampler = independent" in quiet.out and "efficiency" in quiet.out
    wrong = run_command(*common, "--knobs", "flux")
    assert wrong.code == 2 and "there is sampler" in wrong.errors[0]
    assert run_command(*common[:2], tmp_path / "none.toml").code == 2


@pytest.mark.parametrize(("rows", "number"), [(1, signal.SIGINT), (4, signal.SIGTERM)])
def test_an_interrupted_sweep_keeps_the_rows_that_are_done(rows: int, number: int, tmp_path: Path,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    measure, done = bench.measure, 0

    def interrupting(*arguments: Any) -> Row:
        nonlocal done
        if done == rows:
            raise Interrupted(number)
        done += 1
        return measure(*arguments)

    monkeypatch.setattr(bench, "measure", interrupting)
    Path(tmp_path / "box.obj").write_text(BOX_OBJ)
    common = ("bench", "error", tmp_path / "box.obj", "--size", "8x6", "--max-spp", "4", "--repeats", "3", "--reference-spp", "8")
    result = run_command(*common, "--knobs", "sampler", "--json", "-o", tmp_path / "box.md")
    assert result.code == 128 + number and result.err.endswith("interrupted: the results so far are kept\n")
    data = json.loads(result.out)
    assert len(data["rows"]) == rows and data["interrupted"] == number and len(data["slopes"]) == (1 if rows < 4 else 2)
    unfinished = "sampler = independent" if rows == 4 else "as it is, sampler = independent"
    assert data["left_out"] == [f"what was not done when it was interrupted: {unfinished}"]
    assert "what was not done" in (tmp_path / "box.md").read_text()
    done = 0
    table = run_command(*common, "--knobs", "sampler")
    assert "what was not done" in table.out and "1/2 as it is: 1 spp, about 0:" in table.err


def test_ctrl_c_before_the_first_row_has_nothing_to_keep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "measure", interrupted)
    Path(tmp_path / "box.obj").write_text(BOX_OBJ)
    small = ("--size", "8x6", "--max-spp", "2", "--repeats", "3", "--knobs", "sampler")
    result = run_command("bench", "error", tmp_path / "box.obj", *small)
    assert result.code == 130 and result.out == "" and result.err.endswith("interrupted\n")


def test_constant_background_has_no_error() -> None:
    # Nothing to estimate: every value is 0 or NaN, and nothing fails.
    scene = Scene(background=ConstantBackground((0.5, 0.5, 0.5)), cameras=(Camera(),), settings=Settings(size=(4, 4)))
    result = bench.sweep(scene, bench.Plan(knobs=("fresnel",), max_spp=4, repeats=3, reference_spp=4), Options())
    assert all(math.isnan(row.rmse.value) and row.noise == 0.0 and not row.pareto for row in result.rows)
    assert bench.text(result)
