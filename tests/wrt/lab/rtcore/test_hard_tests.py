"""`bench float64`: which triangle tests are hard, how many there are, and a command that prints them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from wrt.accel.scenes.build import build
from wrt.kernels.study.hard_tests import HARD, REFUSED, SURE
from wrt.lab.bench.rays import RaySet, endless
from wrt.lab.rtcore.hard_tests import classified, counted
from wrt.scene.mesh import Mesh

SQUARE = Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])


def downwards(*places: tuple[float, float]) -> RaySet:
    origins = np.array([(x, y, 2.0) for x, y in places], np.float32)
    return RaySet("made", origins, np.broadcast_to(np.float32([0, 0, -1]), origins.shape), endless(len(places)))


def test_a_ray_through_an_edge_is_a_hard_case_and_one_through_the_middle_is_not() -> None:
    """Of two triangles: rays through the first, the second, the edge that they share, and beside both."""
    accel, rays = build(SQUARE, "bvh2"), downwards((0.5, -0.3), (-0.5, 0.3), (0.25, 0.25), (4.0, 4.0))
    number = accel.data.primitives.numpy()["prim_id"].tolist()
    assert sorted(number) == [0, 1]
    answers = classified(accel, rays, np.repeat(np.arange(4), 2), np.tile([number.index(0), number.index(1)], 4))
    assert answers.reshape(4, 2).tolist() == [[SURE, REFUSED], [REFUSED, SURE], [HARD, HARD], [REFUSED, REFUSED]]
    assert counted(accel, rays) == {"rays": 4, "tests": 6, "accepted": 4, "hard": 2, "hard_rays": 1}


def test_every_test_of_a_query_is_counted(tmp_path: Path) -> None:
    mesh = tmp_path / "box.obj"
    mesh.write_text(BOX_OBJ)
    arguments = ("bench", "float64", str(mesh), "--rays", "1024", "--kinds", "primary")
    assert "hard tests" in command(*arguments, "-q").out
    (row,) = json.loads(command(*arguments, "--json").out)["rows"]
    assert row["rays"] == 1024 and row["tests"] > row["accepted"] > 200 and row["hard"] <= 0.05 * row["accepted"]
