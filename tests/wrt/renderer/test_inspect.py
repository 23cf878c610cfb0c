"""wrt.inspect: the tree of rays of a pixel. Its sum is the pixel that `render` makes; its rays obey the laws of optics."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests import command_line
from tests.inspect_all import SCENES, differing_pixels
from tests.refused import refused
from wrt.cli.common import json_text
from wrt.renderer.inspector.inspect import Inspection, Inspector
from wrt.renderer.inspector.section import Plane, cut, plane_of
from wrt.renderer.inspector.tree import Ray
from wrt.scene.shapes import box

# Each compiles for seconds; together they have most kinds of rays. The slow tests inspect all scenes.
FAST = ("blend", "fisheye", "glass_slab")
GLASS = next(path for path in SCENES if path.stem == "glass_slab")
BLEND = next(path for path in SCENES if path.stem == "blend")


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem, marks=() if path.stem in FAST else pytest.mark.slow) for path in SCENES])
def test_the_sum_over_the_tree_is_the_pixel(path: Path) -> None:
    differ, rays = differing_pixels(path, camera=0, pixels=25, spp=3)
    assert differ == [] and rays > 25


@cache
def inspector(path: Path = GLASS) -> Inspector:
    return Inspector(path, spp=4, seed=7)


@cache
def some_pixels() -> list[Inspection]:
    return [inspector().pixel((x, y)) for x in range(60, 640, 90) for y in range(60, 360, 60)]


def rays_of(pixels: list[Inspection]) -> list[Ray]:
    return [ray for pixel in pixels for sample in pixel.samples for ray in sample.rays]


def test_counts_of_rays_are_those_of_the_film() -> None:
    for pixel in some_pixels()[::5]:
        x, y = pixel.pixel
        stats = wrt.render(GLASS, spp=4, seed=7, crop=(x, y, x + 1, y + 1)).stats
        rays = rays_of([pixel])
        traced = sum(not ray.ended.startswith("cut") for ray in rays) + sum(len(light.parts) for ray in rays for light in ray.lights)
        cut = [sum(ray.ended == f"cut by {reason}" for ray in rays) for reason in ("depth", "throughput")]
        assert [traced, *cut] == [stats["rays"], stats["cut_by_depth"], stats["cut_by_throughput"]]


def test_what_a_ray_adds_is_what_its_lights_and_its_surface_give() -> None:
    rays = rays_of(some_pixels())
    for ray in rays:
        direct = np.zeros(3, np.float32)
        for light in ray.lights:
            direct = direct + light.radiance
            assert light.radiance.tobytes() == (light.value * light.transmittance).tobytes()
            assert (light.state == "dark") == (not light.parts) and (light.state == "blocked") <= (not light.transmittance.any())
        assert direct.tobytes() == ray.direct.tobytes()
        assert (ray.weight * (ray.own + ray.direct)).tobytes() == ray.radiance.tobytes()
    assert {"missed", "absorbed", "continued", "cut by throughput"} <= {ray.ended for ray in rays}
    assert {"seen", "blocked"} <= {light.state for ray in rays for light in ray.lights}


def test_rays_begin_at_hits_and_obey_the_laws_of_reflection_and_refraction() -> None:
    ior = {material.name: material.ior for material in inspector().scene.materials}
    bent = 0
    for ray in rays_of(some_pixels()):
        if math.isfinite(ray.t):
            np.testing.assert_allclose(ray.end, ray.point, atol=1e-4)
        for child in ray.children:
            np.testing.assert_allclose(child.origin, ray.point, atol=1e-4)
            n, wi, wo = (each.astype(np.float64) for each in (ray.shading_normal, ray.direction, child.direction))
            if child.kind == "reflected":
                np.testing.assert_allclose(wo, wi - 2.0 * (wi @ n) * n, atol=1e-5)
            else:  # Snell's law: n1 sin a1 = n2 sin a2
                eta = 1.0 / ior[ray.material] if ray.front else ior[ray.material]
                np.testing.assert_allclose(np.cross(n, wo), eta * np.cross(n, wi), atol=1e-5)
                assert wo @ n < 0.0
                bent += 1
    assert bent > 50


def test_a_blocking_surface_is_on_the_way_to_the_light() -> None:
    parts = [light.parts[-1] for ray in rays_of(some_pixels()) for light in ray.lights if light.state == "blocked"]
    assert len(parts) > 20
    for part in parts:
        assert part.t_min <= part.t <= part.t_max and part.prim_id != part.exclude and part.object and part.material
    origins, directions, t = (np.array([getattr(part, name) for part in parts]) for name in ("origin", "direction", "t"))
    accel = wrt.build(inspector().scene)
    assert accel.any_hit(origins, directions, t_min=0.999 * t, t_max=1.001 * t).all()


def test_one_sample_a_structure_and_short_arrays_change_no_bit() -> None:
    whole, short = inspector().pixel((430, 190)), Inspector(GLASS, spp=4, seed=7, accel_options={"builder": "lbvh"})
    other = short.pixel((430, 190))
    assert whole.radiance.tobytes() == other.radiance.tobytes()
    assert inspector().pixel((430, 190), 2).radiance.tobytes() == whole.samples[2].radiance.tobytes()
    short._sizes = [1, 1, 1]
    assert json_text(short.pixel((430, 190)).to_dict()) == json_text(other.to_dict())


def test_rays_through_blended_surfaces_go_on() -> None:
    rays = rays_of([inspector(BLEND).pixel((320, 200))])
    assert "onward" in {ray.kind for ray in rays} and "dimmed" in {light.state for ray in rays for light in ray.lights}
    for ray in rays:
        for child in ray.children:
            if child.kind == "onward":
                assert child.direction.tobytes() == ray.direction.tobytes() and child.depth == ray.depth


def test_the_text_and_the_json_have_every_ray() -> None:
    tree = inspector().pixel((430, 190), 0)
    rays = tree.samples[0].rays
    lines = str(tree).splitlines()
    assert len(lines) == 1 + len(rays) + sum(len(ray.lights) for ray in rays)
    assert "430,190" in lines[0] and "prism (amber)" in lines[1] and sum("cut by" in line for line in lines) > 0
    written = json.loads(json_text(tree.to_dict()))
    rows = written["samples"][0]["rays"]
    assert len(rows) == len(rays) and rows[0]["parent"] is None
    for i, row in enumerate(rows[1:], 1):
        assert 0 <= row["parent"] < i and rays[i] in rays[row["parent"]].children
    assert np.float32(written["radiance"]).tobytes() == tree.radiance.tobytes()


def test_the_section_of_a_box_is_a_rectangle() -> None:
    mesh = box((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0))
    plane = Plane(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8]))
    lines = cut(mesh.vertices.astype(np.float64)[mesh.faces], plane)
    height = 2.0 * 2.0 / 0.6  # it ends at y = -2 and y = 2
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(2.0 * (2.0 + height))
    np.testing.assert_allclose(np.abs(lines).max(axis=(0, 1)), (1.0, 0.5 * height))


def test_the_command_prints_and_draws(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    drawing = tmp_path / "rays.svg"
    arguments = ("inspect", GLASS, "--pixel", "430,190", "--sample", "1", "--spp", "4", "--seed", "7")
    done = command_line.wrt(*arguments, "-o", drawing)
    assert (done.code, done.err) == (0, "") and done.out == f"{inspector().pixel((430, 190), 1)}\n"
    assert "<svg" in drawing.read_text() and list(tmp_path.iterdir()) == [drawing]
    done = command_line.wrt(*arguments, "--json")
    assert json.loads(done.out)["samples"][0]["index"] == 1


def test_the_drawing_shows_the_rays_and_the_shapes() -> None:
    pytest.importorskip("matplotlib")
    from wrt.renderer.inspector.drawing import COLORS

    tree = wrt.inspect(GLASS, (430, 190), 0, spp=1)
    (axes,), plane = tree.figure().axes, plane_of(tree.samples[0], tree.camera)
    drawn = {line.get_color(): [np.transpose(each.get_data()) for each in axes.lines if each.get_color() == line.get_color()]
             for line in axes.lines}
    traced = [ray for ray in tree.samples[0].rays if math.isfinite(ray.t)]
    assert len(traced) > 5 and {"slab", "prism"} <= {text.get_text() for text in axes.texts}
    for ray in traced:
        ends = plane.project(np.array([ray.origin, ray.end], np.float64))
        assert any(line.shape == ends.shape and np.allclose(line, ends) for line in drawn[COLORS[ray.kind]])


def test_mistakes_are_named() -> None:
    for pixel in ((640, 0), (0, -1), (0, 360)):
        with refused("pixel", "640x360"):
            wrt.inspect(GLASS, pixel)
    with refused("pixel", "x, y"):
        wrt.inspect(GLASS, (1, 2, 3))  # type: ignore[arg-type]
    with refused("sample", "0 to 3, got 4"):
        wrt.inspect(GLASS, (1, 2), 4, spp=4)
    with refused("crop", "unknown argument"):
        wrt.inspect(GLASS, (1, 2), crop=(0, 0, 1, 1))  # type: ignore[call-arg]
    with refused("sample", "(0 to 0)"):
        inspector().pixel((1, 2), 0).figure(sample=3)
    assert "'5' is not a pixel; write X,Y" in command_line.wrt("inspect", GLASS, "--pixel", "5").err


@pytest.mark.parametrize("arguments", [("--pixel", "640,1"), ("--pixel", "1"), ("--pixel", "1,2", "--sample", "-1"), (),
                                       ("--pixel", "1,2", "-o", "rays.txt")])
def test_the_command_ends_with_code_2(arguments: tuple[str, ...]) -> None:
    done = command_line.wrt("inspect", GLASS, *arguments)
    assert done.code == 2 and len(done.errors) == 1 and done.out == ""
