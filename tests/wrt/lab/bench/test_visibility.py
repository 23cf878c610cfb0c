"""The z-buffer against rays on whole pictures, the sweeps, and the command."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import data_path
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.io.mesh_file import load_mesh
from wrt.lab.bench.meshes import terrain
from wrt.lab.bench.report import Row, run
from wrt.lab.bench.visibility import Plan, compared, exponents, framing, rasterizer, ray_caster, subdivided, surfaces
from wrt.scene.cameras import Camera, FisheyeCamera
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import box, icosphere, merged, prism, teapot, torus

SIDE = 128
WIDE = math.radians(80.0)
STRAIGHT = Camera(fov_y=math.pi / 2)
SCENES = {
    "teapot": (lambda: teapot(48), None),
    "torus": (torus, None),
    "terrain": (lambda: terrain(60), Camera.look_at((0.1, 0.35, 0.9), (0.0, 0.0, -0.3), fov_y=WIDE)),
    "inside a ball": (lambda: icosphere(4), Camera.look_at((0.2, 0.1, -0.3), (1.0, 0.3, 0.5), fov_y=WIDE)),
    "inside a box": (box, Camera.look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), fov_y=WIDE)),
    "boxes in boxes": (lambda: merged([box((-s,) * 3, (s,) * 3) for s in (0.5, 1.0, 2.0)], "boxes"), None),
    **{name: (lambda name=name: load_mesh(data_path(name)), None) for name in ("meshes/small/cow.obj", "meshes/medium/stanford_bunny.ply")},
}


@pytest.mark.parametrize("name", SCENES)
def test_rays_and_z_buffer_see_the_same(name: str) -> None:
    """What is not a tie is a pixel whose centre lies on an outline: the silhouettes of few pixels."""
    make, camera = SCENES[name]
    mesh = make()
    geometry, camera = Geometry.of(mesh), camera or framing(mesh)
    found = compared(rasterizer(geometry, camera, SIDE)(), ray_caster(geometry, camera, SIDE)[0]())
    assert found["covered"] > 0.01 * SIDE**2 and found["differ"] <= 1e-3 * SIDE**2
    assert found["differ"] - found["ties"] <= 3


@pytest.mark.parametrize("kind", ["lost", "through to the back", "wrong triangle", "tie"])
def test_a_wrong_answer_is_counted(kind: str) -> None:
    geometry = Geometry.of(icosphere(4))
    camera = framing(icosphere(4))
    depth, prim_id = (each.copy() for each in rasterizer(geometry, camera, 64)())
    places = np.array([32 * 64 + 32, 25 * 64 + 40, 38 * 64 + 30])
    changed = {"lost": (np.inf, -1), "through to the back": (depth[places] + 1.5, 7), "wrong triangle": (depth[places] * 0.9, 11),
               "tie": (depth[places] * np.float32(1.000001), 11)}[kind]
    raster = depth.copy(), prim_id.copy()
    depth[places], prim_id[places] = changed
    assert compared(raster, (depth, prim_id)) == {
        "covered": int((raster[1] >= 0).sum()), "differ": 3, "ties": 3 if kind == "tie" else 0}


def test_a_plane_through_the_camera_ends_at_the_horizon() -> None:
    """A triangle at y = -1 extends far beyond the view on all sides of the camera. Its depth below the horizon is 1 / -d_y."""
    corners = np.array([[-1e4, -1.0, 2e4], [2e4, -1.0, 0.0], [-1e4, -1.0, -2e4]], np.float32)
    depth, prim_id = (each.reshape(64, 64) for each in rasterizer(Geometry.of(Mesh(corners, np.array([[0, 1, 2]]))), STRAIGHT, 64)())
    assert (prim_id[:32] == -1).all() and (prim_id[32:] == 0).all() and np.isinf(depth[:32]).all()
    x, y = np.meshgrid((np.arange(64) + 0.5) / 32 - 1.0, 1.0 - (np.arange(64) + 0.5) / 32)
    truth = np.sqrt(x**2 + y**2 + 1.0)[32:] / -y[32:]
    np.testing.assert_allclose(depth[32:], truth, rtol=2.0**-23)


def test_at_equal_depth_the_lowest_prim_id_wins_and_the_order_does_not_matter() -> None:
    far = [[-9.0, -9.0, -2.0], [9.0, -9.0, -2.0], [0.0, 9.0, -2.0]]
    near = [[-9.0, -9.0, -1.0], [0.0, -9.0, -1.0], [0.0, 9.0, -1.0]]
    corners = np.array([far, far, near, far, near], np.float32).reshape(-1, 3)
    prim_id = rasterizer(Geometry(corners, np.arange(15, dtype=np.int32).reshape(-1, 3), np.zeros((0, 4), np.float32)), STRAIGHT, 8)()[1]
    assert set(np.unique(prim_id)) == {0, 2}


def test_only_a_perspective_camera_can_be_rasterized() -> None:
    with refused(what="fisheye", place="camera 'sky'"):
        rasterizer(Geometry.of(icosphere(1)), FisheyeCamera(name="sky"), 8)  # type: ignore[arg-type]


def test_surfaces_grow_to_the_limit_and_keep_their_shape(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    first = {surface.name: surface for surface in surfaces(Plan(max_triangles=20_000))}
    assert [len(mesh.faces) for mesh in first["sphere"].meshes] == [1280, 5120]
    assert [len(mesh.faces) for mesh in first["terrain"].meshes] == [968, 3872, 15488]
    given, = surfaces(Plan(meshes=[tmp_path / "box.obj"], max_triangles=1000))
    assert [len(mesh.faces) for mesh in given.meshes] == [12, 48, 192, 768]
    mesh = merged([prism(5), icosphere(1)], "both")
    areas = []
    for each in (mesh, subdivided(mesh)):
        corner = each.vertices[each.faces].astype(np.float64)
        areas.append(np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum())
        directed = {tuple(edge) for edge in each.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
        assert all((b, a) in directed for a, b in directed)  # closed
    assert areas[1] == pytest.approx(areas[0], rel=1e-6)


def test_exponents_are_those_of_powers() -> None:
    rows = [Row(sweep="triangles", surface="s", triangles=n, raster=[3e-9 * n**0.7] * 3, cast=[1e-4] * 3, build=2e-8 * n)
            for n in (1000, 4000, 16000)]
    found = {row.cost: row.exponent for row in exponents(rows)}
    assert found == {"raster": pytest.approx(0.7), "cast": pytest.approx(0.0, abs=1e-9), "build": pytest.approx(1.0)}
    assert exponents(rows[:1]) == []


def test_a_run_and_the_command(tmp_path: Path) -> None:
    plan = Plan(meshes=[icosphere(2)], size=48, max_size=130, max_triangles=1280, runs=2)
    told: list[Row] = []
    rows = run(plan, told.extend)
    assert rows == told and [(r.sweep, r.triangles, r.pixels) for r in rows] == [
        ("triangles", 320, 48**2), ("triangles", 1280, 48**2), ("pixels", 1280, 64**2), ("pixels", 1280, 128**2)]
    assert all(len(r.raster) == len(r.cast) == 2 and min(*r.raster, *r.cast, r.build) > 0.0 and r.differ <= 3 for r in rows)
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    few = "--size", 32, "--max-size", 64, "--max-triangles", 48, "--runs", 1, "-q"
    done = command("bench", "visibility", tmp_path / "box.obj", *few, "--json", "-o", tmp_path / "a.md")
    assert done.code == 0 and len(json.loads(done.out)["rows"]) == 3 and "As pixels grow" in (tmp_path / "a.md").read_text()
    for option, value in (("--size", 0), ("--max-size", 63), ("--accel", "kd"), ("--device", "gpu")):
        assert command("bench", "visibility", option, value).code == 2
