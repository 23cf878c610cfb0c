"""The z-buffer against rays on whole pictures, the sweeps, and the command."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import wrt as command
from tests.data import data_path
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.io.mesh_file import load_mesh
from wrt.lab.bench.rays import terrain
from wrt.lab.bench.report import Row
from wrt.lab.bench.visibility import SURFACES, compared, rasterizer, ray_caster
from wrt.scene.cameras import Camera, FisheyeCamera
from wrt.scene.defaults import frame_camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import box, icosphere, teapot

SIDE = 128
WIDE = math.radians(80.0)
STRAIGHT = Camera(fov_y=math.pi / 2)
SCENES = {
    "teapot": (lambda: teapot(48), None),
    "terrain": (lambda: terrain(60), Camera.look_at((0.1, 0.35, 0.9), (0.0, 0.0, -0.3), fov_y=WIDE)),
    "inside a ball": (lambda: icosphere(4), Camera.look_at((0.2, 0.1, -0.3), (1.0, 0.3, 0.5), fov_y=WIDE)),
    "inside a box": (box, Camera.look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), fov_y=WIDE)),
    "bunny": (lambda: load_mesh(data_path("meshes/medium/stanford_bunny.ply")), None),
}


@pytest.mark.parametrize("name", SCENES)
def test_rays_and_z_buffer_see_the_same(name: str) -> None:
    """What is not a tie is a pixel whose centre lies on an outline: the silhouettes of few pixels."""
    make, camera = SCENES[name]
    mesh = make()
    geometry, camera = Geometry.of(mesh), camera or frame_camera(Scene(objects=(Object(mesh, (Material(),)),)))
    found = compared(rasterizer(geometry, camera, SIDE)(), ray_caster(geometry, camera, SIDE)[0]())
    assert found["covered"] > 0.01 * SIDE**2 and found["differ"] <= 1e-3 * SIDE**2
    assert found["differ"] - found["ties"] <= 3


@pytest.mark.parametrize("kind", ["lost", "through to the back", "wrong triangle", "tie"])
def test_a_wrong_answer_is_counted(kind: str) -> None:
    geometry = Geometry.of(icosphere(4))
    camera = SURFACES["sphere"][1]
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


def test_the_command(tmp_path: Path) -> None:
    few = "--size", 48, "--max-size", 130, "--max-triangles", 1280, "--runs", 2, "-q"
    done = command("bench", "visibility", *few, "--json", "-o", tmp_path / "a.md")
    assert done.code == 0 and "As pixels grow" in (tmp_path / "a.md").read_text()
    rows = [Row(**row) for row in json.loads(done.out)["rows"]]
    assert [(row.surface, row.sweep, row.triangles, row.pixels) for row in rows] == [
        (name, sweep, triangles, side**2) for name, triangles in (("sphere", 1280), ("terrain", 968))
        for sweep, side in (("triangles", 48), ("pixels", 64), ("pixels", 128))]
    assert all(len(r.raster) == len(r.cast) == 2 and min(*r.raster, *r.cast, r.build) > 0.0 and r.differ <= 3 for r in rows)
    for option, value in (("--size", 0), ("--max-size", 63), ("--accel", "kd")):
        assert command("bench", "visibility", option, value).code == 2
