"""Closest points of wrt, Open3D and trimesh, for `bench peers`."""

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.points.closest_points import closest_points
from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import ball_around

POINTS_OF_RAYS = 50  # rays of a plan for each point: trimesh takes milliseconds a point
Query = Callable[[np.ndarray, int], np.ndarray]  # points (N, 3) float32, threads -> distances (N,)


class PointLibrary(NamedTuple):
    """A library that finds closest points. prepare: from a mesh and a device to the query. needs: packages that prepare imports."""

    name: str
    prepare: Callable[[Geometry, str], Query]
    needs: tuple[str, ...] = ()
    has_threads: bool = True
    on_gpu: bool = False

    def is_installed(self) -> bool:
        return all(importlib.util.find_spec(package) is not None for package in self.needs)


def of_wrt(geometry: Geometry, device: str) -> Query:
    accel = build(geometry, "bvh", device)
    return lambda points, threads: closest_points(accel, points, threads).distance


def of_open3d(geometry: Geometry, device: str) -> Query:
    import open3d

    tensor, scene = open3d.core.Tensor.from_numpy, open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(geometry.vertices.copy()), tensor(geometry.faces.astype(np.uint32)))

    def query(points: np.ndarray, threads: int) -> np.ndarray:
        found: np.ndarray = scene.compute_closest_points(tensor(points), nthreads=threads)["points"].numpy()
        return np.sqrt(((found.astype(np.float64) - points) ** 2).sum(axis=1))

    return query


def of_trimesh(geometry: Geometry, device: str) -> Query:
    import trimesh

    mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
    return lambda points, threads: trimesh.proximity.closest_point(mesh, points)[1]


LIBRARIES = {
    "wrt": PointLibrary("wrt bvh8", of_wrt, on_gpu=True),
    "open3d": PointLibrary("Open3D compute_closest_points", of_open3d, ("open3d",)),
    "trimesh": PointLibrary("trimesh.proximity", of_trimesh, ("rtree",), has_threads=False),
}


def points_around(geometry: Geometry, rays: int, seed: int) -> np.ndarray:
    """Return points in the box of the geometry, enlarged by a half, (N, 3) float32."""
    low, high, center, _ = ball_around(geometry)
    rng = np.random.default_rng(seed)
    return (center + 0.75 * (high - low) * rng.uniform(-1.0, 1.0, (max(rays // POINTS_OF_RAYS, 1), 3))).astype(np.float32)
