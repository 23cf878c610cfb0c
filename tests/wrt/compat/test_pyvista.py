"""wrt.compat.pyvista has the results of PyVista's ray methods, in their dtypes and their order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import data_path
from tests.refused import refused
from wrt.compat.pyvista import RayTracer, to_mesh, to_polydata
from wrt.io.mesh_file import load_mesh
from wrt.scene import shapes

pv = pytest.importorskip("pyvista", reason="PyVista is not installed")


def rays(mesh: Any, n: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from a ball around the mesh to points in its box."""
    rng = np.random.default_rng(0)
    out = rng.normal(size=(n, 3))
    origins = np.array(mesh.center) + mesh.length * out / np.linalg.norm(out, axis=1)[:, None]
    low, high = np.reshape(mesh.bounds, (3, 2)).T
    return origins, rng.uniform(low, high, (n, 3)) - origins


def meshes() -> Iterator[Any]:
    yield pv.Sphere()
    yield pv.Plane().triangulate()  # open
    torus = shapes.torus(1.0, 0.4, 24, 16)
    yield pv.PolyData.from_regular_faces(torus.vertices.astype(np.float64) + 50.0, torus.faces)
    for name in ("meshes/medium/stanford_bunny.ply", "meshes/small/suzanne.obj"):
        yield to_polydata(load_mesh(data_path(name)))


@pytest.mark.parametrize("number", range(5))
@pytest.mark.parametrize("options", [{}, {"first_point": True}, {"retry": True}, {"first_point": True, "retry": True}])
def test_many_rays_have_the_rows_of_pyvista(number: int, options: dict[str, bool]) -> None:
    pytest.importorskip("embreex", reason="PyVista needs embreex for many rays")
    mesh = next(mesh for i, mesh in enumerate(meshes()) if i == number)
    origins, directions = rays(mesh)
    found, other = RayTracer(mesh).multi_ray_trace(origins, directions, **options), mesh.multi_ray_trace(origins, directions, **options)
    if options.get("retry"):  # PyVista's sort is not stable
        other = tuple(each[np.lexsort((np.linalg.norm(other[0] - origins[other[1]], axis=1), other[1]))] for each in other)
    for mine, theirs in zip(found, other, strict=True):
        assert mine.dtype == theirs.dtype and mine.shape == theirs.shape and len(mine) > 100
    assert np.array_equal(found[1], other[1]) and np.array_equal(found[2], other[2])
    assert np.abs(found[0] - other[0]).max() < 1e-5 * mesh.length


@pytest.mark.parametrize("number", range(5))
def test_a_segment_has_the_points_of_pyvista(number: int) -> None:
    mesh = next(mesh for i, mesh in enumerate(meshes()) if i == number)
    tracer, hits = RayTracer(mesh), 0
    for origin, direction in zip(*rays(mesh, 60), strict=True):
        for end in (origin + direction, origin + 2.0 * direction):
            (points, cells), (other, other_cells) = tracer.ray_trace(origin, end), mesh.ray_trace(origin, end)
            assert points.dtype == other.dtype and cells.dtype == other_cells.dtype and points.shape == other.shape
            nearest = np.argsort(np.linalg.norm(other - origin, axis=1))  # PyVista's order is that of the coordinates
            assert np.array_equal(cells, other_cells[nearest])
            assert np.allclose(points, other[nearest], rtol=0.0, atol=1e-5 * mesh.length)
            first = tracer.ray_trace(origin, end, first_point=True)[0]
            assert np.array_equal(first, points[0] if len(points) else points)
            hits += len(points)
    assert hits > 50


def test_edges_and_corners_count_once_and_equal_points_are_one() -> None:
    box = pv.Cube().triangulate()
    corners = np.array(box.points, np.float64)
    points, ray, _ = RayTracer(box).multi_ray_trace(2.0 * corners, -corners)
    assert np.array_equal(np.bincount(ray), np.full(len(corners), 2)) and len(points) == 2 * len(corners)
    twice = pv.PolyData.from_regular_faces(box.points, np.tile(box.regular_faces, (2, 1)))
    for mesh in (box, twice):
        found = RayTracer(mesh).ray_trace([-1, 0, 0], [1, 0, 0])[0]  # through a diagonal
        assert found.tolist() == [[-0.5, 0, 0], [0.5, 0, 0]]
    assert RayTracer(box).ray_trace([-1, 0.1, 0.2], [0.4, 0.1, 0.2])[0].tolist() == pytest.approx(np.array([[-0.5, 0.1, 0.2]]))


@pytest.mark.parametrize("shape", ["cube", "ball", "plane"])
@pytest.mark.parametrize("move", [0.0, 1e3, 2.6e6])
def test_a_segment_with_an_end_on_the_mesh_has_a_hit_there(shape: str, move: float) -> None:
    """Both ends, on corners, edges and faces, also where the line leaves the mesh or grazes its outline."""
    mesh = {"cube": pv.Cube, "ball": pv.Sphere, "plane": pv.Plane}[shape]().triangulate()
    mesh = pv.PolyData.from_regular_faces(np.array(mesh.points, np.float64) + move, mesh.regular_faces)
    tracer, rng = RayTracer(mesh), np.random.default_rng(0)
    corners = np.array(mesh.points)[mesh.regular_faces]
    weights = np.array([[1, 0, 0], [0.5, 0.5, 0], [0.7, 0, 0.3], [0.2, 0.5, 0.3]])
    targets = np.einsum("kc,fcx->fkx", weights, corners)[:60].reshape(-1, 3)
    for target, away in zip(targets, rng.normal(size=targets.shape), strict=True):
        for start, end in ((target + away, target), (target, target + away)):
            points, cells = tracer.ray_trace(start, end)
            assert len(points) == len(cells) and (np.abs(points - target).max(axis=1) <= 1e-12 * move).sum() == 1
            along = (points - start) @ (end - start)
            assert (np.diff(along) > 0.0).all() and len(points) <= 3


def test_segments_that_end_short_of_the_mesh_and_those_without_length() -> None:
    plate = pv.Plane(i_resolution=1, j_resolution=1).triangulate()
    tracer, point = RayTracer(plate), [0.1, 0.2, 0.0]
    for end, hits in ((0.0, 1), (-1e-3, 1), (1e-6, 0), (1e-3, 0)):
        found, other = (each.ray_trace([0.1, 0.2, 1.0], [0.1, 0.2, end])[1] for each in (tracer, plate))
        assert len(found) == len(other) == hits
        assert len(tracer.ray_trace([0.1, 0.2, end], [0.1, 0.2, 1.0])[1]) == (end <= 0.0)
    mine, other = tracer.ray_trace(point, point), plate.ray_trace(point, point)
    assert np.array_equal(mine[0], other[0]) and np.array_equal(mine[1], other[1]) and len(mine[1]) == 1
    assert len(tracer.ray_trace([0.1, 0.2, 1.0], [0.1, 0.2, 1.0])[1]) == 0
    for ends in (([np.nan, 0, 0], [0, 0, 1]), ([0, 0, 1], [np.inf, 0, 0])):
        assert tracer.ray_trace(*ends)[0].shape == (0, 3)


def test_points_stay_on_rays_along_an_axis() -> None:
    ball, grid = pv.Sphere(), np.stack(np.meshgrid(np.arange(-4, 5) * 0.1, np.arange(-4, 5) * 0.1), axis=-1).reshape(-1, 2)
    origins, ball.points = np.column_stack([np.full(len(grid), -5.0), grid]), np.array(ball.points, np.float64)
    points, ray, _ = RayTracer(ball).multi_ray_trace(origins, np.tile([1.0, 0.0, 0.0], (len(grid), 1)))
    assert len(points) > 80 and np.array_equal(points[:, 1:], origins[ray, 1:])
    assert (RayTracer(ball).ray_trace(origins[40], origins[40] * [-1, 1, 1])[0][:, 1:] == origins[40, 1:]).all()


def test_arguments_of_plots_and_meshes_without_cells() -> None:
    plate, ends = RayTracer(pv.Plane().triangulate()), ([0.1, 0.2, 1], [0.1, 0.2, -1])
    assert len(plate.ray_trace(*ends, False, False, None)[1]) == 1
    with refused("plot", "draws nothing"):
        plate.ray_trace(*ends, plot=True)
    with pytest.raises(pv.NotAllTrianglesError, match="It has no cells"):
        RayTracer(pv.PolyData()).ray_trace(*ends)


def test_wrt_build_names_the_function() -> None:
    with refused("mesh", "got a pyvista.PolyData", hint="to_mesh"):
        wrt.build(pv.Cube())


@pytest.mark.parametrize("change", [
    lambda mesh: mesh.points.__iadd__(1.0),  # VTK does not notice
    lambda mesh: mesh.translate((1, 1, 1), inplace=True),
    lambda mesh: setattr(mesh, "faces", mesh.faces[:4])])
def test_a_changed_mesh_is_built_again(change: Any) -> None:
    mesh = pv.Cube().triangulate()
    tracer = RayTracer(mesh)
    assert len(tracer.ray_trace([-9, 0.1, 0.2], [9, 0.1, 0.2])[0]) == 2
    change(mesh)
    assert len(tracer.ray_trace([-9, 0.1, 0.2], [9, 0.1, 0.2])[0]) == 0


def test_other_cells_have_the_message_of_pyvista() -> None:
    for mesh in (pv.Cube(), pv.Line(), pv.PolyData()):
        with pytest.raises(pv.NotAllTrianglesError, match=r"Input mesh for multi_ray_trace must be all triangles\."):
            RayTracer(mesh).multi_ray_trace([[0, 0, 0]], [[0, 0, 1]])
        with pytest.raises(pv.NotAllTrianglesError, match="to_mesh must be all triangles"):
            to_mesh(mesh)
    with refused("origin", "end_point must both be (3,), got (2,)"):
        RayTracer(pv.Sphere()).ray_trace([0, 0], [0, 0, 1])


def test_conversions_keep_everything() -> None:
    for mesh in meshes():
        middle = to_mesh(mesh)
        back = to_polydata(middle)
        if middle.origin is None:
            assert np.array_equal(back.points, mesh.points.astype(np.float32))
        assert np.abs(back.points - mesh.points).max() < 1e-6 and np.array_equal(back.regular_faces, mesh.regular_faces)
        for name in ("active_normals", "active_texture_coordinates"):
            mine, theirs = getattr(back.point_data, name), getattr(mesh.point_data, name)
            assert (mine is None) == (theirs is None) and (mine is None or np.allclose(mine, theirs, atol=1e-6)), name
    assert to_mesh(pv.Plane().triangulate()).uvs[0].tolist() == [0, 1]  # VTK counts v upwards
