"""bench bvh: rays and counts have closed forms, and the trees are as good as published ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import data_path
from tests.refused import Refusal, refused
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.io.mesh_file import load_mesh
from wrt.lab.bench import bvh as bench
from wrt.lab.bench.bvh import VOLUMES, Plan, inward, published_cost
from wrt.lab.bench.report import run
from wrt.lab.bench.timing import peak_bytes
from wrt.scene.shapes import icosphere

# Of legocar.obj, by tinybvh: SAH cost and the cost of 262,144 cosine-inward rays, with C_trav = C_int = 1.
PUBLISHED = {"binned": (30.27, 13.4), "sweep": (30.07, 13.5), "sbvh": (29.58, 12.7)}


@pytest.fixture
def box(tmp_path: Path) -> Path:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    return tmp_path / "box.obj"


def test_inward_rays_meet_the_box_as_often_as_its_surface_says() -> None:
    # The share of uniform lines through a convex body that meet an inner convex body is the ratio of their surfaces.
    geometry = Geometry.of(icosphere(2))
    ball = build(geometry, "bvh")
    rays = inward(geometry, 40_000, 1)
    lo, hi = (b.astype(np.float64) for b in geometry.bounds())
    e = (hi.max(axis=0) - lo.min(axis=0))
    v = geometry.vertices.astype(np.float64)[geometry.faces]
    area = 0.5 * np.linalg.norm(np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]), axis=1).sum()
    expected = area / (2.0 * (e[0] * e[1] + e[1] * e[2] + e[2] * e[0]))
    share = ball.any_hit(rays.origins, rays.directions).mean()
    assert len(rays) == 40_000 and share == pytest.approx(expected, abs=4.0 * 0.5 / 200.0)
    np.testing.assert_allclose(np.linalg.norm(rays.origins, axis=1), np.linalg.norm(e) / 2.0, rtol=1e-5)


def test_the_published_cost_counts_what_was_pushed_in_vain() -> None:
    geometry = Geometry.of(icosphere(3))
    accel = build(geometry, "bvh2")
    rays = inward(geometry, 2000)
    c = accel.closest_hit(rays.origins, rays.directions, counters=True).counters
    assert c is not None
    own = float((c.nodes + c.leaves + c.primitives).mean())
    cost = published_cost(accel, rays)
    assert own < cost < own + 5.0 * float(c.pushes.mean())
    # Rays that miss drop nothing.
    missing = accel.closest_hit(rays.origins, rays.directions).prim_id < 0
    part = bench.RaySet("missing", rays.origins[missing], rays.directions[missing], rays.t_max[missing])
    assert published_cost(accel, part) == pytest.approx(float((c.nodes + c.leaves + c.primitives)[missing].mean()))


def test_peak_memory_is_what_was_taken_and_given_back() -> None:
    _, peak = peak_bytes(lambda: np.ones(30_000_000).sum())
    assert np.isnan(peak) or 2.3e8 < peak < 2.8e8


def test_rows_and_command(box) -> None:
    rows = run(Plan((box,), rays=500, builds=1, runs=1))
    builders, volumes = ([row for row in rows if bench.columns(row) is kind] for kind in (bench.BUILDERS, bench.VOLUME))
    assert [row.builder for row in builders] == list(BVH_BUILDERS) and [row.volume for row in volumes] == list(VOLUMES)
    assert all(row.differ == 0 for row in volumes)
    assert volumes[0].inner_area == volumes[0].leaf_area == 1.0 < volumes[1].leaf_area and volumes[2].leaf_area < 1.0001
    assert [row.node_bytes for row in volumes] == [64, 48, 128]
    done = command("bench", "bvh", str(box), "--rays", "300", "--builds", "1", "--runs", "1", "--builders", "binned", "--json")
    told = json.loads(done.out)
    assert [row["builder"] for row in told["builders"]] == ["binned"] and len(told["volumes"]) == 3


@pytest.mark.parametrize(("options", "message"), [
    ({"meshes": ()}, ("meshes",)), ({"builders": ("guess",)}, ("builders", "no builder 'guess'")), ({"rays": 0}, ("rays",)),
    ({"threads": 0}, ("threads",))])
def test_plans_that_are_refused(options, message: Refusal) -> None:
    with refused(*message):
        Plan(**{"meshes": ("a.ply",), **options})


@pytest.mark.slow
@pytest.mark.parametrize("builder", PUBLISHED)
def test_trees_are_as_good_as_published_ones(builder: str) -> None:
    mesh = load_mesh(data_path("meshes/small/legocar.obj"))
    accel = build(mesh, "bvh2", builder=builder)
    sah_cost, cost = PUBLISHED[builder]
    assert accel.stats.sah_cost < 1.05 * sah_cost
    assert published_cost(accel, inward(Geometry.of(mesh), 2**18)) < 1.05 * cost


@pytest.mark.slow
def test_the_default_tree_of_the_dragon_takes_less_than_600_bytes_a_triangle() -> None:
    mesh = load_mesh(data_path("meshes/large/dragon_871k.ply"))
    build(icosphere(0), "bvh")
    _, peak = peak_bytes(lambda: build(mesh, "bvh"))
    assert np.isnan(peak) or peak < 600.0 * len(mesh.faces)
