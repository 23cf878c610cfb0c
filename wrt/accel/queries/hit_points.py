"""Properties of hits, computed on access: points with error bounds, normals, texture coordinates and ids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Generic, NamedTuple, TypeAlias

import numpy as np
import warp as wp

from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.flat_scene import FlatScene, Placed, flat_scene_of, placed_now, run_of
from wrt.accel.geometry import Geometry, InstancedGeometry, MovedGeometry, NumberedGeometry
from wrt.accel.queries.arguments import WorldIds, in_shape, over_worlds
from wrt.accel.queries.gradients import ONE_MESH, Cotangents, Gradients, adjoint, check_recorded, record
from wrt.accel.queries.rays import rays_on, to_origin
from wrt.accel.snapshot import Snapshot, once, once_for_all
from wrt.core.arrays import from_tensor, given_like, to_numpy, to_tensor_like, to_warp
from wrt.core.device import launch_on, records, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, ArrayT, WarpArray, WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels import structs
from wrt.kernels.query import HitArrays, RayArrays, Worlds
from wrt.kernels.warp_private import fields_of

HITS_PER_LAUNCH = 65536
FROM_RAYS = "point", "error", "normal", "shading", "uv"  # arrays of HitPlaces that need the rays
Source: TypeAlias = tuple[Snapshot, Any, WorldIds | None]  # the second: Rays, or None for answers that have ids, but no points


class DeviceScene(NamedTuple):
    """Scene of a structure, and the same scene on the device as arguments of the kernel `hit_places`."""

    scene: FlatScene
    surfaces: WarpStruct
    object_ids: WarpStruct
    rows: WarpArray | None = None  # Instance of each run of surfaces.instances; -1: none.
    refitted: tuple[tuple[int, WarpArray], ...] = ()  # Index in surfaces.vertices and points of parts that are refitted in place.

    def follow(self, snapshot: Snapshot) -> None:
        """Write the matrices of instances that moved in place, and the points of meshes that were refitted in place."""
        for first, points in self.refitted:
            wp.copy(self.surfaces.vertices, points, first)
        if isinstance(snapshot.geometry, MovedGeometry):
            from wrt.kernels.shade.hit_points import place_instances

            instances = self.surfaces.instances
            launch_on(snapshot.device, place_instances, len(instances), self.rows, snapshot.geometry.places, instances,
                      captured=True)


class PartFaces(NamedTuple):
    """Triangles of all parts of an InstancedGeometry, on the structure's device."""

    vertices: WarpArray  # In the parts' own spaces.
    faces: WarpArray  # Of each part in the order of its prim_ids, with gaps where the part lacks prim_ids.
    first_face: WarpArray  # (P,) int32, index in `faces` of the face with prim_id 0 of each part.


class HitIds(Generic[ArrayT]):
    """Ids of hits or closest points, computed from `prim_id` on each access, as arrays of the same library and shape (...)."""

    prim_id: ArrayT
    source: Source | None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of `prim_id`."""
        return tuple(from_tensor(self.prim_id, "prim_id", None).shape)

    @property
    def face(self) -> ArrayT:
        """Index of the face within the mesh of `object` (prim_id counts on over the meshes): (...) int32, -1 on a miss or a sphere."""
        return self._filled("face")

    @property
    def object(self) -> ArrayT:
        """Index into `scene.objects`, or len(scene.objects) plus the index into `scene.spheres`: (...) int32, -1 on a miss.

        Over worlds, `scene` is that of the ray's world; a mesh is its only object.
        """
        return self._filled("object")

    @property
    def instance(self) -> ArrayT:
        """Index for `Instances.move`: `object` over a scene, else the row of `accel.geometry.to_world`. (...) int32, -1 on a miss."""
        return self._filled("instance")

    @property
    def material(self) -> ArrayT:
        """Index into `scene.materials`, over worlds those of the ray's world: (...) int32, -1 on a miss."""
        return self._filled("material")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple(getattr(self, each.name) for each in fields(self) if each.name != "source")  # type: ignore[arg-type]

    def _source(self, rays: bool = True) -> Source:
        """Return the source. Raises InputError without it, and, if `rays` are needed, without rays."""
        if not isinstance(self.prim_id, wp.array):
            refuse_capture()
        if self.source is None or (rays and self.source[1] is None):
            raise InputError("these hits have no rays, from which distances, points, normals and ids are computed: lists of hits have ids"
                             " alone, copies and pickled hits lose all", hint="ask the result of closest_hit before it is copied")
        return self.source

    def _filled(self, name: str) -> ArrayT:
        from wrt.kernels.shade.hit_points import HitPlaces, hit_places  # not at the top: pictures do not need it

        snapshot, rays, worlds = self._source(name in FROM_RAYS)
        shape, device = self.shape, snapshot.device
        n = int(np.prod(shape))
        origin = snapshot.geometry.origin
        if name in ("error", "normal", "shading", "uv") or (name == "point" and origin is not None):
            check_recorded(self, name)
        on_device = device_scene(snapshot)
        scene = on_device.scene
        if name in FROM_RAYS:
            on_device.follow(snapshot)
        if name == "shading" and scene.normals is None:
            name = "normal"
        require(scene, name)
        to_own = own_materials(scene, worlds) if name == "material" else None
        if to_own is not None or not isinstance(self.prim_id, wp.array):  # computed on the host
            refuse_capture(device)
        out: Any = HitPlaces()
        setattr(out, name, array := wp.empty(n, dtype=fields_of(HitPlaces)[name].dtype, device=device))
        hits: Any = HitArrays()
        for each in fields_of(HitArrays) if name in FROM_RAYS else ("prim_id",):
            setattr(hits, each, in_shape(to_warp(getattr(self, each)).to(device), (n,)))
        inputs = [on_device.surfaces, on_device.object_ids, rays_on(device, rays) if name in FROM_RAYS else RayArrays(),
                  Worlds() if worlds is None else worlds.arrays, hits, out]
        launch_on(device, hit_places, n, *inputs, None, threads=thread_count(None), step=HITS_PER_LAUNCH, captured=True)
        if to_own is not None:
            array = upload(to_own(array.numpy()), wp.int32, device)
        if name == "error" and origin is not None:  # the sum with the origin is rounded, too
            array = upload(array.numpy() + np.float32(np.spacing(2.0 * np.abs(origin).max())), array.dtype, device)
        if isinstance(self.prim_id, wp.array):
            if name == "point":
                own: Any = self
                record(own.in_shape((n,)), point=array)
                array = to_origin(array, origin)
            return in_shape(array, shape)
        give: Any = to_tensor_like(self.prim_id)
        values = array if give is not None and device.is_cuda else array.numpy()
        if name == "point":
            values = to_origin(values, origin)
        return in_shape(values, shape) if give is None else give(in_shape(values, shape))


class HitPoints(HitIds[ArrayT]):
    """Properties of hits that `closest_hit` found, as arrays of the same library and leading shape (...) as the hits.

    Points and normals are (..., 3) float32 in world space; on a miss, all numbers are NaN. Each access computes the property again from
    the arrays of hits and rays. These arrays are not copied: do not modify them. A property raises InputError if the hits have no
    `source`, or the structure lacks the data for the property.
    """

    t: ArrayT
    u: ArrayT
    v: ArrayT

    @property
    def hit(self) -> ArrayT:
        """Whether each ray hits something: (...) bool."""
        hit: ArrayT = given_like(self.prim_id, to_numpy(self.prim_id) >= 0)
        return hit

    @property
    def distance(self) -> ArrayT:
        """Distance of each hit from the ray's origin in scene units, t times the direction's length: (...) float32, inf on a miss."""
        _, rays, _ = self._source()
        check_recorded(self, "distance")
        length = np.linalg.norm(to_numpy(rays.directions).astype(np.float64), axis=1).reshape(self.shape)
        t = to_numpy(self.t)
        far = np.multiply(t, length, out=np.full(t.shape, np.inf), where=np.isfinite(t)).astype(np.float32)
        distance: ArrayT = given_like(self.prim_id, far)
        return distance

    @property
    def points(self) -> ArrayT:
        """The same as `point`."""
        return self.point

    @property
    def normals(self) -> ArrayT:
        """The same as `normal`."""
        return self.normal

    @property
    def point(self) -> ArrayT:
        """Point where each ray meets its primitive, to within `point_error`; float64 (vec3d) far from 0 (`Accelerator.origin`).

        It is computed from the ray in float64 and rounded once, because u and v are inaccurate on needle-shaped triangles. If the
        exact ray misses the triangle by a rounding error, the point is moved onto the triangle, and `point_error` includes the
        move. If the ray lies in the triangle's plane, the point comes from u and v, and `point_error` is the triangle's size.
        """
        return self._filled("point")

    @property
    def point_error(self) -> ArrayT:
        """Error bound of each coordinate of `point`, usually half a float32 rounding step."""
        return self._filled("error")

    @property
    def normal(self) -> ArrayT:
        """Unit geometric normal, on a triangle's counter-clockwise side or outwards of a sphere."""
        return self._filled("normal")

    @property
    def shading_normal(self) -> ArrayT:
        """Unit normal interpolated from vertex normals, which no refit changes, on the side of `normal`; `normal` without these."""
        return self._filled("shading")

    @property
    def uv(self) -> ArrayT:
        """Interpolated texture coordinates, (..., 2) float32; (0, 0) is the texture's top left, and stands for objects without uvs."""
        return self._filled("uv")

    def gradients(self, t: ArrayLike | None = None, u: ArrayLike | None = None, v: ArrayLike | None = None,
                  point: ArrayLike | None = None) -> Gradients[ArrayT]:
        """Compute the gradient of a loss with respect to vertices, origins and directions from its gradient with respect to hits.

        The prim_id of each ray is fixed, so that the gradient ignores the motion of silhouettes (docs/gradients.md).

        Parameters
        ----------
        t, u, v : (...) array_like, optional
            Gradient of the loss with respect to `t`, `u` and `v`; zero by default. Values of misses are ignored.
        point : (..., 3) array_like, optional
            Gradient of the loss with respect to `point`; zero by default.

        Returns
        -------
        Gradients
            Arrays of float64. Only a structure over one mesh without spheres has gradients.
        """
        snapshot, rays, _ = self._source()
        snapshot.structure.require_one_mesh(ONE_MESH)
        shape = self.shape
        give: Any = to_tensor_like(self.t)
        found: Gradients[Any] = adjoint(snapshot.mesh, rays.origins, rays.directions, to_numpy(self.prim_id), Cotangents(t, u, v, point))
        found = Gradients(found.vertices, *(each.reshape(*shape, 3) for each in found[1:]))
        if give is not None:
            found = Gradients(*map(give, found))
        return found


def require(scene: FlatScene, name: str) -> None:
    """Raise InputError if hits in this scene do not have the property."""
    if name == "uv" and not len(scene.uvs):
        raise InputError("the mesh has no texture coordinates (uvs)", hint="the weights of a face's corners are hits.u and hits.v")
    if name == "instance" and not isinstance(scene.geometry, InstancedGeometry):
        raise InputError("the structure has no instances", hint="wrt.build(scene, movable=True) makes some")
    if name in ("object", "material") and scene.objects is None and scene.own_materials is None:
        raise InputError(f"hits have no {name}, because the structure is not over a scene", hint="wrt.build(wrt.Scene.of([mesh]))")


def own_materials(scene: FlatScene, worlds: WorldIds | None) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the function that converts materials among all worlds, (N,) int32, to those of each ray's world, or None."""
    own = scene.own_materials
    if own is None or not over_worlds(scene.geometry):
        return None

    def convert(ids: np.ndarray) -> np.ndarray:
        world = np.zeros(len(ids), np.int64) if worlds is None else worlds.arrays.id.numpy()
        hit = ids >= 0
        step = int(own[:, 1].max(initial=0)) + 1
        row = np.searchsorted(own[:, 0] * step + own[:, 1], world[hit] * step + ids[hit])
        out = np.full(len(ids), -1, np.int32)
        out[hit] = own[row, 2]
        return out

    return convert


@once_for_all
def device_scene(snapshot: Snapshot) -> DeviceScene:
    """Upload the scene of a structure to its device. Moves in place: see DeviceScene.follow."""
    from wrt.kernels.shade.hit_points import ObjectIds

    geometry, device = snapshot.geometry, snapshot.device
    scene, surfaces = snapshot.attributes or flat_scene_of(geometry), structs.Surfaces()
    placed = placed_now(scene, geometry)
    surfaces.n_triangles = geometry.n_triangles
    if isinstance(geometry, DeviceGeometry) and geometry.points.device == device:
        surfaces.vertices = geometry.points  # which refits in place write
    else:
        surfaces.vertices = upload(geometry.vertices if isinstance(geometry, Geometry) else scene.vertices.copy(), wp.vec3, device)
    surfaces.faces = upload(scene.faces, wp.vec3i, device)
    surfaces.normals = upload(np.zeros((1, 3)) if scene.normals is None else scene.normals, wp.vec3, device)
    surfaces.uvs = upload(scene.uvs, wp.vec2, device)
    surfaces.spheres = snapshot.surfaces.spheres
    surfaces.prim_material = upload(scene.prim_material, wp.int32, device)
    object_ids = ObjectIds()
    first = geometry.first_prim if isinstance(geometry, InstancedGeometry) else np.zeros(1)
    object_ids.first_prim = upload(first if scene.objects is None else scene.objects, wp.int32, device)
    if over_worlds(geometry):
        object_ids.world_prim = upload(geometry.world_first_prim, wp.int32, device)
        object_ids.world_object = upload(geometry.first_instance, wp.int32, device)
    if placed is None or not isinstance(geometry, InstancedGeometry):
        return DeviceScene(scene, surfaces, object_ids)
    surfaces.instances = upload(instance_records(placed), structs.Instance, device)
    rows = np.full(len(placed.first_prim), -1, np.int32)  # of each run; -1 for joined objects and spheres
    rows[run_of(placed, geometry)] = np.flatnonzero(geometry.is_placed)
    if scene.objects is None:
        object_ids.instance = upload(np.maximum(rows, 0), wp.int32, device)
    begin = np.cumsum([0, *(part.n_vertices for part in geometry.parts)]).tolist()
    refitted = tuple((at, part.points) for at, part in zip(begin, geometry.parts, strict=False) if isinstance(part, DeviceGeometry))
    return DeviceScene(scene, surfaces, object_ids, upload(rows, wp.int32, device), refitted)


def instance_records(placed: Placed) -> np.ndarray:
    """Convert the runs of primitives to records of kernels.structs.Instance."""
    out = records(structs.Instance, len(placed.first_prim))
    for name in ("first_prim", "first_face", "first_material", "material_step"):
        out[name] = getattr(placed, name)
    linear = placed.to_world[:, :, :3]
    inverse = np.linalg.inv(linear)
    inverse /= np.abs(inverse).max(axis=(1, 2), keepdims=True)  # normals keep their directions, and squares do not overflow
    for i, axis in enumerate("xyz"):
        out[f"world_{axis}"], out[f"normal_{axis}"] = placed.to_world[:, i], inverse[:, i]
    out["handedness"] = np.where(np.linalg.det(linear) < 0.0, -1.0, 1.0)
    return out


@once
def part_faces(snapshot: Snapshot) -> PartFaces:
    """Upload the faces of all parts of a structure over instances."""
    geometry, device = snapshot.geometry, snapshot.device
    assert isinstance(geometry, InstancedGeometry)
    faces = [_by_prim_id(part) for part in geometry.parts]
    first_vertex, first_face = (np.cumsum([0, *map(len, rows)]) for rows in ([part.vertices for part in geometry.parts], faces))
    joined = [rows + np.int32(first) for rows, first in zip(faces, first_vertex, strict=False)]
    return PartFaces(upload(np.concatenate([part.vertices for part in geometry.parts]), wp.vec3, device),
                     upload(np.concatenate(joined), wp.vec3i, device), upload(first_face[:-1], wp.int32, device))


def _by_prim_id(part: Geometry) -> np.ndarray:
    """Return the faces of a part, row i with prim_id i; (0, 0, 0) where the part has no such prim_id."""
    if not isinstance(part, NumberedGeometry):
        return part.faces
    prim_ids = part.prim_ids[: len(part.faces)]
    out = np.zeros((int(prim_ids.max(initial=-1)) + 1, 3), np.int32)
    out[prim_ids] = part.faces
    return out
