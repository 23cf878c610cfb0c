"""The RaycastingScene of Open3D, implemented with wrt's queries.

>>> from wrt.compat.open3d import RaycastingScene          # in place of open3d.t.geometry.RaycastingScene
"""

from __future__ import annotations

import math
import sys
from contextlib import suppress
from typing import Any, ClassVar, TypeAlias

import numpy as np

from wrt.accel.points.closest_points import closest_points
from wrt.accel.points.contains import enclosing, odd_crossings
from wrt.accel.queries.all_hits import ListQuery
from wrt.accel.queries.arguments import of_each
from wrt.accel.queries.batches import MadeRays, trace_made
from wrt.accel.queries.lists import begins
from wrt.accel.queries.raw_launches import RowKernel
from wrt.compat.common import JoinedMeshes, every_hit, hit_counts, scatter
from wrt.core.arrays import float32, real_numbers
from wrt.core.checks import as_integer, shown
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike
from wrt.kernels.placed_rays import split_rays
from wrt.kernels.query import FARTHEST
from wrt.scene.values import LARGEST, as_number, type_of

MOST_SAMPLES = 1 << 16
WIDEST = 1 << 15  # pixels
SPLIT_RAYS = RowKernel(split_rays, 1)


class Array(np.ndarray):
    """A NumPy array with the methods by which programs convert Open3D tensors to NumPy."""

    def numpy(self) -> np.ndarray:
        """Return a plain array that shares the memory."""
        return self.view(np.ndarray)

    def cpu(self) -> Array:
        """Return the array itself."""
        return self


Answer: TypeAlias = Any  # an Array, or an Open3D tensor
MeshOrArray: TypeAlias = Any  # (V, 3) positions, or a mesh of any library


class RaycastingScene:
    """A scene like open3d.t.geometry.RaycastingScene. docs/compat.md lists the differences.

    Results are Open3D tensors if the program has imported open3d, and NumPy arrays otherwise. A ray or a point that is not finite, or
    has a coordinate beyond 1e37, hits nothing, and neither does a ray with direction 0. All methods raise InputError, a ValueError, for
    invalid arguments.

    Parameters
    ----------
    nthreads : int
        Number of threads: in the constructor for the build, in methods for the query. 0 and below: one per core.
    device
        "cpu", "cuda:0", or Open3D's names for these.
    rays : (..., 6) array_like
        In methods: origins and directions of any length, converted to float32; far from 0, relative to the meshes.
    query_points : (..., 3) array_like
        In methods: points, converted as rays are.
    """

    INVALID_ID: ClassVar[int] = 0xFFFFFFFF

    def __init__(self, nthreads: int = 0, device: Any = "cpu") -> None:
        name = str(device).lower()
        self._device, self._threads = "cpu" if name == "cpu:0" else name, _threads(nthreads)
        self._meshes: list[tuple[np.ndarray, np.ndarray]] = []
        self._built: JoinedMeshes | None = None

    def add_triangles(self, vertex_positions: MeshOrArray = None, triangle_indices: ArrayLike | None = None,
                      mesh: object = None) -> int:
        """Add a copy of a mesh and return its geometry ID. The next query builds the structure.

        Parameters
        ----------
        vertex_positions, triangle_indices
            (V, 3) real numbers and (F, 3) indices; or a mesh as the only argument.
        mesh
            Mesh in place of the two arrays: a TriangleMesh of Open3D, a `wrt.Mesh` or a `trimesh.Trimesh`.
        """
        if mesh is None and triangle_indices is None:
            mesh = vertex_positions
        if mesh is not None:
            vertex_positions, triangle_indices = _arrays_of(mesh)
        vertices = np.array(real_numbers(vertex_positions, "vertex_positions", "(N, 3)"))
        indices = real_numbers(triangle_indices, "triangle_indices", "(N, 3)")
        with np.errstate(invalid="ignore"):
            faces = indices.astype(np.int64)
        for array, name in ((vertices, "vertex_positions"), (faces, "triangle_indices")):
            if array.ndim != 2 or array.shape[1] != 3:
                raise InputError(f"must be (N, 3), got {array.shape}", argument=name)
        if not ((faces == indices) & (faces >= 0) & (faces < len(vertices))).all():
            raise InputError(f"must be 0 to {len(vertices) - 1}, whole numbers", argument="triangle_indices")
        if (np.abs(vertices[np.isfinite(vertices).all(axis=1)]) > LARGEST).any():
            raise InputError(f"must be at most {LARGEST:g}", argument="vertex_positions")
        self._meshes.append((vertices, faces))
        self._built = None
        return len(self._meshes) - 1

    def cast_rays(self, rays: ArrayLike, nthreads: int = 0) -> dict[str, Answer]:
        """Find the first hit of each ray. At equal distance, the lowest geometry ID wins, then the lowest primitive ID.

        Returns
        -------
        dict
            t_hit (...), inf on a miss; geometry_ids and primitive_ids (...) uint32, INVALID_ID on a miss; primitive_uvs (..., 2)
            and primitive_normals (..., 3), 0 on a miss.
        """
        scene = self._scene()
        shape, rows = _rows(rays, "rays", 6, scene.origin)
        threads = _threads(nthreads)
        t, u, v, prim_id = trace_made(scene.accel.snapshot, _split(rows), False, threads)
        return _answers({"t_hit": t, **scene.found(prim_id, u, v), "primitive_normals": scene.normals.take(prim_id, 0)}, shape)

    def test_occlusions(self, rays: ArrayLike, tnear: float = 0.0, tfar: float = math.inf, nthreads: int = 0) -> Answer:
        """Test whether each ray hits anything: (...) bool.

        Parameters
        ----------
        tnear, tfar
            Ends of the segment in units of the direction's length. As in Open3D, tnear may be below 0; tfar < 0 and NaN hit nothing.
        """
        threads, scene = _threads(nthreads), self._scene()
        accel, (shape, rows) = scene.accel, _rows(rays, "rays", 6, scene.origin)
        if type(tnear) is type(tfar) is float and tnear == 0.0 and tfar == math.inf:  # these need no arrays
            return _answer(trace_made(accel.snapshot, _split(rows), True, threads)[0], shape)
        origins, directions, t_min, t_max = map(np.asarray, _split(rows).rays(threads))
        near, far = (np.broadcast_to(float32(of_each(value, (len(rows),), name)), len(rows)) for value, name in (
            (tnear, "tnear"), (tfar, "tfar")))
        end = np.where((near <= far) & (far >= 0.0), far, np.float32(-np.inf))
        hit = accel.any_hit(origins, directions, np.fmax(near, np.float32(0.0)), np.minimum(t_max, end), threads)
        if (near < 0.0).any():
            hit |= accel.any_hit(origins, -directions, t_min, np.minimum(t_max, np.where(end >= 0.0, -near, end)), threads)
        return _answer(hit, shape)

    def count_intersections(self, rays: ArrayLike, nthreads: int = 0) -> Answer:
        """Count the intersections of each ray with surfaces, (...) int32. An intersection at an edge or a corner counts once."""
        threads, scene = _threads(nthreads), self._scene()
        shape, rows = _rows(rays, "rays", 6, scene.origin)
        return _answer(hit_counts(scene.accel, _split(rows).rays(threads), threads).astype(np.int32), shape)

    def list_intersections(self, rays: ArrayLike, nthreads: int = 0) -> dict[str, Answer]:
        """List the M intersections that `count_intersections` counts, ray by ray in order of distance.

        Returns
        -------
        dict
            ray_splits (N + 1,): rows ray_splits[i] .. ray_splits[i + 1] - 1 are of ray i; ray_ids, geometry_ids, primitive_ids (M,),
            all uint32; t_hit (M,); primitive_uvs (M, 2).
        """
        scene, threads = self._scene(), _threads(nthreads)
        rows = _rows(rays, "rays", 6, scene.origin)[1]
        ray, face, t, u, v = every_hit(scene.accel, _split(rows).rays(threads), threads)
        splits = begins(np.bincount(ray, minlength=len(rows)))
        return _answers({"ray_splits": splits.astype(np.uint32), "ray_ids": ray.astype(np.uint32), "t_hit": t,
                         **scene.found(face, u, v)})

    def compute_closest_points(self, query_points: ArrayLike, nthreads: int = 0) -> dict[str, Answer]:
        """Find the point on the meshes that is closest to each query point (wrt.closest_points).

        Returns
        -------
        dict
            points (..., 3), geometry_ids and primitive_ids (...) uint32, primitive_uvs (..., 2), primitive_normals (..., 3).
            Without a mesh, IDs are INVALID_ID, and all other values are 0.
        """
        scene = self._scene()
        shape, valid, points = _valid_points(query_points, scene.origin)
        found = closest_points(scene.accel, points, _threads(nthreads))
        points = found.point if scene.origin is None else found.point + scene.origin
        answers = {"points": points, **scene.found(found.prim_id, found.u, found.v),
                   "primitive_normals": scene.normals.take(found.prim_id, 0)}
        missing = dict.fromkeys(("geometry_ids", "primitive_ids"), self.INVALID_ID)
        return _answers({name: scatter(array, valid, missing.get(name, 0.0)) for name, array in answers.items()}, shape)

    def compute_distance(self, query_points: ArrayLike, nthreads: int = 0) -> Answer:
        """Compute the distance of each point to the meshes, (...) float32: inf without a mesh, NaN for points that are not finite."""
        shape, valid, points = _valid_points(query_points, self._scene().origin)
        return _answer(scatter(closest_points(self._scene()[0], points, _threads(nthreads)).distance, valid, np.nan), shape)

    def compute_signed_distance(self, query_points: ArrayLike, nthreads: int = 0, nsamples: int = 1) -> Answer:
        """Compute distances to the meshes, (...) float32; negative for points where `compute_occupancy` with `nsamples` is 1."""
        shape, valid, points = _valid_points(query_points, self._scene().origin)
        inside = self._inside(points, nthreads, nsamples)
        distance = closest_points(self._scene()[0], points, _threads(nthreads)).distance
        return _answer(scatter(np.where(inside, -distance, distance), valid, np.nan), shape)

    def compute_occupancy(self, query_points: ArrayLike, nthreads: int = 0, nsamples: int = 1) -> Answer:
        """Return 1.0 for points inside and 0.0 for others, (...) float32. A ray from inside crosses surfaces an odd number of times.

        Parameters
        ----------
        nsamples
            Odd number of rays; the majority decides. For closed surfaces one ray is exact (wrt.contains).
        """
        shape, valid, points = _valid_points(query_points, self._scene().origin)
        return _answer(scatter(self._inside(points, nthreads, nsamples).astype(np.float32), valid, 0.0), shape)

    @staticmethod
    def create_rays_pinhole(*given: Any, **named: Any) -> Answer:
        """Make a ray through each pixel's center, (height_px, width_px, 6) float32. Rows go along the camera's y axis.

        Far from 0, where float32 would round the eye by more than 1e-4, they are float64.

        Parameters
        ----------
        *given, **named
            Either intrinsic_matrix (3, 3), extrinsic_matrix (4, 4) from world to camera, width_px, height_px. Or fov_deg (horizontal
            field of view in degrees), center (point to look at), eye (camera position), up, width_px, height_px. In the second case
            y is up, as in Open3D, so that the first row is the lowest.
        """
        make = _rays_looking_at if len(given) + len(named) == 6 else _rays_of_matrices
        rays = make(*given, **named)
        return _answer(rays.reshape(-1, 6), rays.shape[:2])

    def _scene(self) -> JoinedMeshes:
        """Return the structure over the present meshes."""
        if self._built is None:
            self._built = JoinedMeshes.of(self._meshes, int(self.INVALID_ID), self._device, self._threads)
        return self._built

    def _inside(self, points: np.ndarray, nthreads: int, nsamples: int) -> np.ndarray:
        if as_integer(nsamples, "nsamples", 1, MOST_SAMPLES) % 2 == 0:
            raise InputError(f"must be odd, got {nsamples}", argument="nsamples")
        query = ListQuery(enclosing(self._scene().accel), _threads(nthreads), crossings=True)
        votes = np.zeros(len(points), np.int32)
        for seed in range(nsamples):
            votes += odd_crossings(query, points, seed)
        return np.asarray(2 * votes > nsamples)


def _threads(nthreads: int) -> int:
    return thread_count(max(as_integer(nthreads, "nthreads", -(1 << 31), (1 << 31) - 1), 0) or None)


def _arrays_of(mesh: Any) -> tuple[Any, Any]:
    """Return positions and indices of a mesh of another library."""
    if hasattr(mesh, "vertex"):
        with suppress(KeyError):  # Open3D raises it for an empty mesh
            return mesh.vertex.positions, mesh.triangle.indices
    for name in ("faces", "triangles"):
        if hasattr(mesh, "vertices") and hasattr(mesh, name):
            return getattr(mesh, "positions", mesh.vertices), getattr(mesh, name)  # of a wrt.Mesh: with its origin
    raise InputError(f"must have vertices and triangles, got {shown(mesh)}", argument="mesh")


def _rows(value: Any, name: str, width: int, origin: np.ndarray | None) -> tuple[tuple[int, ...], np.ndarray]:
    """Return the leading shape of `value`, (..., width), and its rows minus `origin`, (N, width) float32."""
    array = real_numbers(value, name, f"(..., {width})")
    if array.ndim < 1 or array.shape[-1] != width:
        raise InputError(f"must be (..., {width}), got {array.shape}", argument=name)
    rows = array.reshape(-1, width)
    return array.shape[:-1], float32(rows if origin is None else rows - np.append(origin, np.zeros(width - 3)))


def _valid_points(value: Any, origin: np.ndarray | None) -> tuple[tuple[int, ...], np.ndarray | None, np.ndarray]:
    """Return the leading shape, the mask of valid points (None: all), and the valid points minus `origin`."""
    shape, points = _rows(value, "query_points", 3, origin)
    valid = np.abs(points) <= FARTHEST
    if valid.all():  # the usual case
        return shape, None, points
    rows = valid.all(axis=1)
    return shape, rows, points[rows]


def _split(rows: np.ndarray) -> MadeRays:
    """Return the rays of rows of six. Rays that hit nothing have t_max = -inf."""
    return MadeRays(SPLIT_RAYS, (rows,))


def _answers(found: dict[str, np.ndarray], shape: tuple[int, ...] | None = None) -> dict[str, Answer]:
    """Convert results, by name, as `_answer`."""
    return {name: _answer(array, array.shape[:1] if shape is None else shape) for name, array in found.items()}


def _answer(array: np.ndarray, shape: tuple[int, ...]) -> Answer:
    """Convert a result to an array or tensor with the leading shape of the caller's rays or points."""
    if len(shape) != 1 or not array.flags.c_contiguous:
        array = np.ascontiguousarray(array).reshape((*shape, *array.shape[1:]))
    open3d = sys.modules.get("open3d")
    return array.view(Array) if open3d is None else open3d.core.Tensor.from_numpy(array)


def _rays_of_matrices(intrinsic_matrix: Any, extrinsic_matrix: Any, width_px: int, height_px: int) -> np.ndarray:
    """Make the rays of create_rays_pinhole from matrices."""
    width_px, height_px = (as_integer(size, name, 0, WIDEST) for size, name in ((width_px, "width_px"), (height_px, "height_px")))
    try:
        inverse = np.linalg.inv(_matrix(intrinsic_matrix, "intrinsic_matrix", (3, 3)))
    except np.linalg.LinAlgError as error:
        raise InputError("must have an inverse", argument="intrinsic_matrix") from error
    to_camera = _matrix(extrinsic_matrix, "extrinsic_matrix", (4, 4))
    x, y = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    to_world = to_camera[:3, :3].T
    eye = -to_world @ to_camera[:3, 3]
    rays: np.ndarray = np.empty((height_px, width_px, 6), type_of(eye))
    rays[..., :3] = eye
    rays[..., 3:] = np.stack([x, y, np.ones_like(x)], axis=-1) @ (to_world @ inverse).T
    return rays


def _rays_looking_at(fov_deg: float, center: Any, eye: Any, up: Any, width_px: int, height_px: int) -> np.ndarray:
    """Make the rays of create_rays_pinhole from a point to look at."""
    center, eye, up = (_matrix(value, name, (3,)) for value, name in ((center, "center"), (eye, "eye"), (up, "up")))
    if not 0.0 < as_number(fov_deg, "fov_deg") < 180.0:
        raise InputError(f"must be between 0 and 180, got {fov_deg:g}", argument="fov_deg")
    focal = 0.5 * as_integer(width_px, "width_px", 0, WIDEST) / math.tan(math.radians(0.5 * fov_deg))
    z = center - eye
    x = np.cross(up, z)
    if not x.any():
        raise InputError("must differ from eye, and center - eye must not be parallel to up", argument="center")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    to_camera = np.eye(4)
    to_camera[:3, :3] = x, np.cross(z, x), z
    to_camera[:3, 3] = -to_camera[:3, :3] @ eye
    to_picture = [[focal, 0.0, 0.5 * width_px], [0.0, focal, 0.5 * height_px], [0.0, 0.0, 1.0]]
    return _rays_of_matrices(to_picture, to_camera, width_px, height_px)


def _matrix(value: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = real_numbers(value, name, str(shape)).astype(np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"must be {shape} finite numbers, got {shown(value)}", argument=name)
    return array
