"""The ray class of trimesh, implemented with wrt's queries.

>>> from wrt.compat.trimesh import RayMeshIntersector
>>> mesh.ray = RayMeshIntersector(mesh)                 # mesh.contains and the rest of trimesh use it from now on
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from wrt.accel.points.closest_points import closest_points
from wrt.accel.points.contains import contains, enclosing, open_edges_of
from wrt.accel.queries.batches import MadeRays, trace_made
from wrt.accel.queries.raw_launches import RowKernel
from wrt.accel.scenes.build import build
from wrt.compat.common import every_hit
from wrt.core.arrays import real_numbers
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, WarpStruct
from wrt.core.warp_private import array_record, record_of
from wrt.kernels.placed_rays import Placement, locate_hits, place_rays
from wrt.scene.clean import flip_collinear
from wrt.scene.mesh import Mesh

with needed_by("wrt.compat.trimesh"):
    from trimesh.caching import Cache, cache_decorator
    from trimesh.ray.ray_util import contains_points
    from trimesh.triangles import closest_point

if TYPE_CHECKING:
    import trimesh

MAX_HITS = 100  # of a ray, by default, as in trimesh
FAR = 4.0  # in radii of a mesh: an origin farther from the mesh is moved near it before it is rounded to float32
PLACE_RAYS, LOCATE_HITS = RowKernel(place_rays, 2), RowKernel(locate_hits, 6)


class RayMeshIntersector:
    """A ray class like that of trimesh.ray.ray_pyembree, with the keywords of ray_triangle. docs/compat.md lists the differences.

    The watertight test finds faces in float32, in coordinates relative to the mesh; points are computed in float64. A ray that is
    not finite, or has direction 0, hits nothing. All methods raise InputError, a ValueError, for arrays of other shapes.

    Parameters
    ----------
    geometry : trimesh.Trimesh
        Mesh. After the mesh changes, the next query builds a new structure.
    scale_to_box : bool
        Scale meshes whose coordinates or areas exceed the range of float32.
    device, threads
        See `wrt.build`.
    ray_origins, ray_directions : (N, 3) array_like
        In methods: rays in the mesh's units; directions of any length.
    multiple_hits, max_hits
        In methods: whether to find more than the first hit, and the largest number of hits of a ray.
    """

    def __init__(self, geometry: trimesh.Trimesh, scale_to_box: bool = True, *, device: str = "cpu",
                 threads: int | None = None) -> None:
        self.mesh = geometry
        self._options: dict[str, Any] = {"scale_to_box": scale_to_box, "device": device, "threads": threads}
        self._cache = Cache(id_function=self.mesh.__hash__)

    @cache_decorator
    def scaled(self) -> _ScaledStructure:
        """Structure over the present mesh."""
        return _ScaledStructure(self.mesh.vertices, self.mesh.faces, **self._options)

    def intersects_id(self, ray_origins: ArrayLike, ray_directions: ArrayLike, multiple_hits: bool = True, max_hits: int = MAX_HITS,
                      return_locations: bool = False) -> tuple[np.ndarray, ...]:
        """Find the faces that rays hit: first hits in the order of the rays, then second hits, and so on.

        A ray through an edge or a corner of a surface hits the surface once (docs/compat.md).

        Parameters
        ----------
        return_locations
            Also return the points.

        Returns
        -------
        tuple
            Face and ray of each hit, (M,) int64; with return_locations also the point, (M, 3) float64.
        """
        origins, directions = _rays(ray_origins, ray_directions)
        scaled, most = self.scaled, max_hits if multiple_hits else min(max_hits, 1)
        ray, face, u, v = scaled.every_hit(origins, directions, most) if most > 1 else scaled.first_hit(origins, directions)
        if most < 1 or (most > 1 and len(origins) > 1):  # the hits of one ray are in order
            order = _first_hits_first(ray) if most > 1 else np.zeros(0, np.int64)
            ray, face, u, v = (array[order] for array in (ray, face, u, v))
        given = scaled.given(face)
        return (given, ray, scaled.located(origins, directions, ray, face, u, v)) if return_locations else (given, ray)

    def intersects_location(self, ray_origins: ArrayLike, ray_directions: ArrayLike, multiple_hits: bool = True,
                            max_hits: int = MAX_HITS) -> tuple[np.ndarray, ...]:
        """Find the points where rays hit the mesh, in the order of `intersects_id`.

        Returns
        -------
        tuple
            Point (M, 3) float64, ray and face (M,) int64 of each hit.
        """
        face, ray, where = self.intersects_id(ray_origins, ray_directions, multiple_hits, max_hits, return_locations=True)
        return where, ray, face

    def intersects_first(self, ray_origins: ArrayLike, ray_directions: ArrayLike) -> np.ndarray:
        """Find the face that each ray hits first, (N,) int32, -1 on a miss. At equal distance, the lowest index wins."""
        scaled = self.scaled
        return scaled.given(scaled.traced(*_rays(ray_origins, ray_directions))[3])

    def intersects_any(self, ray_origins: ArrayLike, ray_directions: ArrayLike) -> np.ndarray:
        """Test whether each ray hits anything: (N,) bool."""
        scaled = self.scaled
        return scaled.traced(*_rays(ray_origins, ray_directions), any_hit=True)[0]

    def contains_points(self, points: Any) -> np.ndarray:
        """Test whether points (N, 3) are inside, by wrt.contains: (N,) bool; False for points that are not finite.

        For an open mesh, trimesh's rule decides from the hits of this class: rays in two opposite directions must agree.
        """
        points = _rows(points, "points")
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"must be (N, 3), got {points.shape}", argument="points")
        scaled = self.scaled
        inside = ((points >= scaled.low) & (points <= scaled.high)).all(axis=1)
        if inside.any():
            near = points[inside]
            if open_edges_of(enclosing(scaled.accel).snapshot):
                inside[inside] = contains_points(self, near)
            else:
                inside[inside] = contains(scaled.accel, scaled.to_local(near), threads=scaled.threads)
        return inside

    def __reduce__(self) -> tuple[Any, ...]:  # a copy and a pickled one build their own structure
        return partial(type(self), **self._options), (self.mesh,)


class _ScaledStructure:
    """A structure over a mesh, shifted to the origin if far from it, and, with scale_to_box, scaled to about size 1 by a power of two.

    Faces with a corner that is not finite keep their indices and become faces without area, which no ray hits.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, scale_to_box: bool, device: str, threads: int | None) -> None:
        vertices, faces = np.array(vertices, np.float64), np.array(faces, np.int64).reshape(-1, 3)
        faces[~np.isfinite(vertices).all(axis=1)[faces].all(axis=1)] = 0
        unused = np.ones(len(vertices), bool)
        unused[faces[faces.any(axis=1)]] = False
        used = vertices[~unused] if not unused.all() else np.zeros((1, 3))
        self.low, self.high = used.min(axis=0), used.max(axis=0)
        half = (self.high / 2 - self.low / 2).max()
        self.shift = np.where(np.abs(used).max() > FAR * half, self.low / 2 + self.high / 2, 0.0)
        self.exponent = -int(np.frexp(half)[1]) if scale_to_box else 0
        vertices[unused] = self.low
        local = Mesh(self.to_local(vertices), faces)
        self.faces, source = flip_collinear(local.vertices, local.faces, by_place=True)
        self.source = None if np.array_equal(self.faces, local.faces) else np.append(source, -1)
        self.accel = build(local if self.source is None else Mesh(local.vertices, self.faces), device=device, threads=threads)
        self.threads, self.vertices = thread_count(threads), vertices
        self.mesh = array_record(self.vertices), array_record(self.faces)
        box = self.to_local(np.stack([self.low, self.high]))
        center, radius = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0])) / 2
        place: WarpStruct = Placement()
        place.shift, place.center = wp.vec3d(*self.shift), wp.vec3d(*center)
        half_way = self.exponent // 2
        place.scale, place.scale_again = 2.0**half_way, 2.0**(self.exponent - half_way)
        place.radius, place.near = radius, FAR * radius
        self.placement = record_of(place)

    def given(self, face: np.ndarray) -> np.ndarray:
        """Return the mesh's face for each face of the structure, where collinear faces are flipped; -1 stays."""
        return face if self.source is None else self.source[face].astype(face.dtype)

    def to_local(self, points: np.ndarray) -> np.ndarray:
        return np.ldexp(points - self.shift, self.exponent)

    def placed(self, *rays: np.ndarray) -> MadeRays:
        """Move and scale rays, origins and directions, to the place of the structure, and round them to float32."""
        return MadeRays(PLACE_RAYS, rays, (self.placement,))

    def traced(self, *rays: np.ndarray, any_hit: bool = False) -> list[np.ndarray]:
        """Return t, u, v and prim_id of the closest hit of each ray, or whether it hits anything. rays: origins and directions."""
        return trace_made(self.accel.snapshot, self.placed(*rays), any_hit, self.threads)

    def first_hit(self, *rays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return ray, face, u and v of each ray's first hit."""
        _, u, v, prim_id = self.traced(*rays)
        hit = np.flatnonzero(prim_id >= 0)
        return hit, prim_id[hit].astype(np.int64), u[hit], v[hit]

    def every_hit(self, origins: np.ndarray, directions: np.ndarray, limit: int) -> tuple[np.ndarray, ...]:
        """Return ray, face, u and v of all hits, at most `limit` per ray, ray by ray in order of distance."""
        ray, face, _, u, v = every_hit(self.accel, self.placed(origins, directions).rays(self.threads), self.threads, limit)
        return ray, face.astype(np.int64), u, v

    def located(self, origins: np.ndarray, directions: np.ndarray, *hits: np.ndarray) -> np.ndarray:
        """Return the points (M, 3) float64 of hits: ray and face (M,) int64, u and v (M,) float32."""
        return LOCATE_HITS.rows(len(hits[0]), (origins, directions, *hits), *self.mesh, threads=self.threads)[0]

    def face_at(self, point: np.ndarray, reach: float) -> int:
        """Return a face with area at a distance of at most `reach` from a point (3,), computed in float64; -1 if there is none."""
        if not len(self.faces) or not ((point >= self.low - reach) & (point <= self.high + reach)).all():
            return -1
        face = int(closest_points(self.accel, self.to_local(point)[None], self.threads).prim_id[0])
        corners = self.vertices[self.faces[face]]
        near = np.linalg.norm(closest_point(corners[None], point[None])[0] - point) <= reach
        return face if near and np.cross(corners[1] - corners[0], corners[2] - corners[0]).any() else -1


def _rows(value: ArrayLike, name: str) -> np.ndarray:
    """Convert to contiguous float64; an empty list becomes (0, 3). Raises InputError for values that are not real numbers."""
    rows = np.asarray(real_numbers(value, name, "(N, 3)"), np.float64)
    return np.ascontiguousarray(rows.reshape(0, 3) if rows.shape == (0,) else rows)


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    origins, directions = _rows(origins, "ray_origins"), _rows(directions, "ray_directions")
    if origins.ndim != 2 or origins.shape[1] != 3 or origins.shape != directions.shape:
        raise InputError(f"and ray_directions must both be (N, 3), got {origins.shape} and {directions.shape}",
                         argument="ray_origins")
    return origins, directions


def _first_hits_first(ray: np.ndarray) -> np.ndarray:
    """Return indices that sort hits: the first hit of every ray, then all second hits, and so on.
    ray: (M,) index of each hit's ray. The hits of a ray are consecutive, the nearest first."""
    begins = np.flatnonzero(np.diff(ray, prepend=-1))
    counts = np.diff(begins, append=len(ray))
    rank = np.arange(len(ray)) - np.repeat(begins, counts)  # 0 for the first hit of each ray
    if counts.max(initial=0) <= 1 << 16:
        rank = rank.astype(np.uint16)  # NumPy sorts short integers in linear time
    return np.argsort(rank, kind="stable")
