"""Points of hits with error bounds, normals, texture coordinates and ids: computed when asked for."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene, Placed, flat_scene_of, placed_now, run_of
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.queries.gradients import ONE_MESH, Cotangents, Gradients, adjoint, check_recorded, record
from wrt.accel.queries.rays import Rays, rays_on
from wrt.accel.queries.world_ids import WorldIds
from wrt.accel.snapshot import Snapshot, once
from wrt.core.arrays import returned, to_warp
from wrt.core.device import launch_on, records, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.kernels import structs
from wrt.kernels.query import HitArrays
from wrt.kernels.shade.hit_points import HitPlaces, ObjectIds, hit_places
from wrt.kernels.warp_private import fields_of

HITS_PER_LAUNCH = 65536


class Surroundings(NamedTuple):
    """What a structure was over on a device when it was asked: as the kernel takes it, and where it is from."""

    scene: FlatScene
    surfaces: Any
    object_ids: Any


class HitPoints:
    """Properties of hits that a structure gave. Each is computed anew each time, from the arrays of the hits and of the rays, which
    are kept and not copied: leave them as they were until then. Arrays are of the library that the hits are of.

    Raises InputError where the hits are not closest_hit's, or what is asked for is not there.
    """

    t: Any
    u: Any
    v: Any
    prim_id: Any
    source: tuple[Snapshot, Rays, WorldIds | None] | None

    @property
    def point(self) -> Any:
        """(N, 3) float32: where each ray as it is given meets its primitive, in the world, to point_error; NaN on a miss.

        It is of the ray and not of u and v, whose rounding needles make large: float64, rounded once. Where the ray passes its
        triangle by, to rounding, the point is moved onto the triangle, and the error is as large as the move; where it runs along,
        the point is that of u and v, and the error the triangle's size.
        """
        return self._filled("point")

    @property
    def point_error(self) -> Any:
        """(N, 3) float32: no component of `point` is farther off than this; most often half a float32 step. NaN on a miss."""
        return self._filled("error")

    @property
    def normal(self) -> Any:
        """(N, 3) float32: unit normal of the flat triangle, on the side from which it is counter-clockwise (of a sphere: outwards),
        whatever side the ray comes from; NaN on a miss."""
        return self._filled("normal")

    @property
    def shading_normal(self) -> Any:
        """(N, 3) float32: the normals that the mesh had when the structure was built, interpolated, of unit length, on the side of
        `normal`; the same as `normal` where there are none. NaN on a miss."""
        return self._filled("shading")

    @property
    def uv(self) -> Any:
        """(N, 2) float32: texture coordinates interpolated, (0, 0) the top left of a picture; in a scene (0, 0) where an object has
        none. NaN on a miss."""
        return self._filled("uv")

    @property
    def object(self) -> Any:
        """(N,) int32: index into scene.objects, and behind them into scene.spheres; -1 on a miss."""
        return self._filled("object")

    @property
    def instance(self) -> Any:
        """(N,) int32: what Instances.move takes: over a scene the same as `object`, else a row of accel.geometry.to_world; -1 on a
        miss."""
        return self._filled("instance")

    @property
    def material(self) -> Any:
        """(N,) int32: index into scene.materials; -1 on a miss."""
        return self._filled("material")

    def gradients(self, t: Any = None, u: Any = None, v: Any = None, point: Any = None) -> Gradients:
        """Derivatives of a number, such as a sum of squares to be made small, by vertices, origins and directions at fixed prim_id,
        from its derivatives by these hits, (N,) and (N, 3); of misses they are not looked at (wrt.accel.queries.gradients.adjoint).

        Raises InputError for other shapes, and where the structure is not over one mesh.
        """
        snapshot, rays, _ = self._source()
        snapshot.structure.require_one_mesh(ONE_MESH)
        found = adjoint(snapshot.geometry, rays.origins, rays.directions, self.prim_id, Cotangents(t, u, v, point))
        give = returned(self.t)
        return found if give is None else Gradients(*map(give, found))

    def _source(self) -> tuple[Snapshot, Rays, WorldIds | None]:
        if self.source is None:
            raise InputError("these hits do not know their rays: only those of closest_hit have points, normals and ids")
        return self.source

    def _filled(self, name: str) -> Any:
        snapshot, rays, worlds = self._source()
        if name in ("error", "normal", "shading", "uv"):
            check_recorded(self, name)
        scene, surfaces, object_ids = surroundings(snapshot)
        if name == "shading" and scene.normals is None:
            name = "normal"
        _require(scene, name)
        if name == "instance" and scene.objects is not None:
            name = "object"
        n, device = len(self.t), snapshot.device
        out: Any = HitPlaces()
        setattr(out, name, array := wp.empty(n, dtype=fields_of(HitPlaces)[name].dtype, device=device))
        hits: Any = HitArrays()
        for each in fields_of(HitArrays):
            setattr(hits, each, to_warp(getattr(self, each)).to(device))
        if worlds is not None:
            hits.prim_id = upload(worlds.numbered(self.prim_id), wp.int32, device)
        inputs = [surfaces, object_ids, rays_on(device, rays), hits, out]
        launch_on(device, hit_places, n, *inputs, None, threads=thread_count(None), step=HITS_PER_LAUNCH)
        if isinstance(self.t, wp.array):
            if name == "point":
                record(self, point=array)
            return array
        give = returned(self.t)
        return array.numpy() if give is None else give(array)


def _require(scene: FlatScene, name: str) -> None:
    """Raise InputError where hits in this scene have no such thing."""
    if name == "uv" and not len(scene.uvs):
        raise InputError("the mesh has no texture coordinates (uvs)")
    if name == "instance" and not isinstance(scene.geometry, InstancedGeometry):
        raise InputError("the structure has no instances")
    if name in ("object", "material") and scene.objects is None:
        if isinstance(scene.geometry, InstancedGeometry) and scene.geometry.worlds is not None:
            raise InputError(f"hits over worlds do not know their {name} yet; hits.instance is known")
        raise InputError(f"the structure is not over a scene: there is no {name}")


@once
def surroundings(snapshot: Snapshot) -> Surroundings:
    """Of a structure, on its device."""
    geometry, device = snapshot.geometry, snapshot.device
    scene, surfaces = snapshot.attributes or flat_scene_of(geometry), structs.Surfaces()
    placed = placed_now(scene, geometry)
    surfaces.n_triangles = geometry.n_triangles
    surfaces.vertices = upload(geometry.vertices if placed is None else scene.vertices, wp.vec3, device)
    surfaces.faces = upload(scene.faces, wp.vec3i, device)
    surfaces.normals = upload(np.zeros((1, 3)) if scene.normals is None else scene.normals, wp.vec3, device)
    surfaces.uvs = upload(scene.uvs, wp.vec2, device)
    surfaces.spheres = snapshot.surfaces.spheres
    surfaces.prim_material = upload(scene.prim_material, wp.int32, device)
    object_ids = ObjectIds()
    if scene.objects is not None:
        object_ids.first_prim = upload(scene.objects, wp.int32, device)
    if placed is not None:
        surfaces.instances = upload(instance_records(placed), structs.Instance, device)
        object_ids.instance = upload(_instance_of(placed, geometry), wp.int32, device)
    return Surroundings(scene, surfaces, object_ids)


def _instance_of(placed: Placed, geometry: InstancedGeometry) -> np.ndarray:
    """Which instance each run of primitives is; those that are joined are all of the first, and spheres too."""
    out = np.zeros(len(placed.first_prim), np.int32)
    out[run_of(placed, geometry)] = np.nonzero(geometry.is_placed)[0]
    return out


def instance_records(placed: Placed) -> np.ndarray:
    """As kernels.structs.Instance."""
    out = records(structs.Instance, len(placed.first_prim))
    for name in ("first_prim", "first_face", "first_material", "material_step"):
        out[name] = getattr(placed, name)
    linear = placed.to_world[:, :, :3]
    inverse = np.linalg.inv(linear)
    inverse /= np.abs(inverse).max(axis=(1, 2), keepdims=True)  # a factor changes no direction, and its square is a float32
    for i, axis in enumerate("xyz"):
        out[f"world_{axis}"], out[f"normal_{axis}"] = placed.to_world[:, i], inverse[:, i]
    out["handedness"] = np.where(np.linalg.det(linear) < 0.0, -1.0, 1.0)
    return out
