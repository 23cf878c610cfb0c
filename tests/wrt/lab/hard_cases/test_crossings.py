"""Points inside closed meshes, and crossings: the judge sees what is wrong."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import wrt
from tests.command_line import wrt as run
from wrt.accel.geometry import Geometry
from wrt.lab.hard_cases import crossings as closed
from wrt.lab.oracle.oracle import Reference
from wrt.scene import shapes


def test_exactly_inside_of_a_box_and_on_its_surface() -> None:
    points = np.stack(np.meshgrid(*[np.float32([-0.75, -0.5, 0.0, 0.25, 0.5])] * 3), axis=-1).reshape(-1, 3)
    reference = Reference(Geometry.of(shapes.box()))
    inside, on_surface = closed.exactly_inside(reference, points, np.random.default_rng(0))
    size = np.abs(points).max(axis=1)
    assert np.array_equal(on_surface, size == 0.5) and np.array_equal(inside[size != 0.5], size[size != 0.5] < 0.5)


def test_wrong_points_are_counted() -> None:
    geometry = Geometry.of(shapes.icosphere(2))
    reference, accel = Reference(geometry), wrt.build(geometry)
    right = closed.points_wrong(geometry, reference, lambda points: wrt.contains(accel, points), 3000, 0)
    assert (right["asked"], right["wrong"]) == (3000, 0)

    def others(points: np.ndarray) -> np.ndarray:
        out = wrt.contains(accel, points)
        out[1:121:3] ^= True  # points aimed at corners are left out: they may be on the surface
        return out

    wrong = closed.points_wrong(geometry, reference, others, 3000, 0)
    assert (wrong["wrong"], wrong["touching"]) == (40, 0)
    assert np.allclose(closed.distances(Geometry.of(shapes.box()), np.float32([[2.0, 0.0, 0.0], [0.0, 0.4, 0.0]])), [1.5, 0.1])


def crossings(mesh: wrt.Mesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    geometry = Geometry.of(mesh)
    found = wrt.all_hits(wrt.build(geometry), origins, directions)
    return closed.crossings_of(geometry, found, np.asarray(directions, np.float32))


def test_a_boxs_edges_and_corners_are_one_crossing_or_a_touch() -> None:
    towards = np.float32([[0.1, 0.2, 0.5], [0.25, 0.25, 0.5], [0.5, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, 0.5, 0.0]])
    origins = np.float32([[0.1, 0.2, 3.0], [0.25, 0.25, 3.0], [3.0, 0.0, 0.0], [2.0, 2.0, 2.0], [1.5, -0.5, 0.0]])
    counted, touched = crossings(shapes.box(), origins, towards - origins)
    # Through faces, a face's diagonal twice, corners; the last one passes along an edge's point and touches the box there.
    assert counted.tolist() == [2, 2, 2, 2, 0] and touched.tolist() == [0, 0, 0, 0, 1]


def test_from_inside_a_surface_is_crossed_once() -> None:
    for mesh in (shapes.icosphere(2), shapes.box()):
        corners = np.unique(mesh.vertices, axis=0)
        counted, touched = crossings(mesh, np.zeros_like(corners), corners)
        assert (counted == 1).all() and not touched.any()


def test_no_crossing_is_lost_and_a_lost_one_is_seen() -> None:
    geometry = Geometry.of(shapes.torus(segments=16, tube_segments=8))
    accel = wrt.build(geometry)
    right = closed.crossed(geometry, accel, partial(wrt.count_hits, accel, crossings=True), True, 3000, 0)
    assert right["wrong"] == 0 and right["hits"] > 6000 and right["touching"] > 0
    lossy = closed.crossed(geometry, accel, lambda o, d: np.minimum(wrt.count_hits(accel, o, d), 1), False, 3000, 0)
    assert 2500 < lossy["wrong"] <= 3000 - lossy["touching"]  # some rays pass the mesh


def test_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed, "made", lambda: [shapes.box(), shapes.icosphere(1)])
    result = run("bench", "closed", "--points", "200", "--rays", "200", "--others", "0")
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in result.out.splitlines() if line.startswith("|")]
    assert result.code == 0 and [line[:2] + line[4:6] for line in lines[2:4]] == [["inside", "all", "400", "0"],
                                                                                 ["crossings", "all", "400", "0"]]


def test_an_open_mesh_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed, "made", lambda: [shapes.quad()])
    result = run("bench", "closed", "--others", "0")
    assert result.code == 2 and "the mesh is not closed" in result.err


@pytest.mark.parametrize("who", closed.OTHERS)
def test_others_are_asked(who: str) -> None:
    package, answers = closed.OTHERS[who]
    pytest.importorskip(package)
    geometry = Geometry.of(shapes.icosphere(1))
    points = np.float32([[0.1, 0.2, 0.3], [0.1, 2.0, 0.2]])  # Open3D counts both triangles at an edge
    inside, crossings = answers(geometry)
    assert np.asarray(inside(points)).tolist() == [True, False]
    assert np.asarray(crossings(points * 10.0, -points)).tolist() == [2, 2]
