"""A scene as arrays: geometry, and the places, normals, texture coordinates, materials and objects of its primitives."""

from dataclasses import dataclass, replace

import numpy as np

from wrt.accel.geometry import Geometry, InstancedGeometry


@dataclass(frozen=True, eq=False)
class Placed:
    """Runs of consecutive prim_ids. A run is an instance or a series of joined objects; in a scene, the last run is all spheres."""

    first_prim: np.ndarray  # (I,) int64, first prim_id of each run.
    first_face: np.ndarray  # (I,) int64, its index in FlatScene.faces.
    first_material: np.ndarray  # (I,) int64, its index in FlatScene.prim_material.
    material_step: np.ndarray  # (I,) int64, 0 if the run has one material, else 1.
    to_world: np.ndarray  # (I, 3, 4) float64.


@dataclass(frozen=True, eq=False)
class FlatScene:
    """All shapes of a scene, or one mesh, as arrays. prim_ids number the faces of all objects in order, then the spheres.

    Without `placed`, arrays are in world space, in the order of prim_id. With `placed`, instanced meshes are stored once, in their own
    spaces. A row of `own_materials` is a world, an index in prim_material's scene, and the index of this material in the world's own scene.
    """

    geometry: Geometry | InstancedGeometry
    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    normals: np.ndarray | None  # (V, 3), with zeros for objects without normals.
    uvs: np.ndarray  # (V, 2), with zeros for objects without uvs; (0, 2) for a mesh without uvs.
    prim_material: np.ndarray  # Index in the scene's materials.
    placed: Placed | None = None
    objects: np.ndarray | None = None  # First prim_id of each object, then of each sphere. None over worlds: the instances are the objects.
    own_materials: np.ndarray | None = None  # Over worlds, (K, 3) int, sorted, see above.
    names: tuple[str, ...] = ()  # Of all objects, if there are instances.

    def places(self, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of each triangle in `faces`, and the index of its run in `placed` (0 without `placed`), (N,) each."""
        if self.placed is None:
            return prim_id, np.zeros(len(prim_id), np.int32)
        run, local = self._run(prim_id)
        return self.placed.first_face[run] + local, run

    def materials(self, prim_id: np.ndarray) -> np.ndarray:
        """Return the index of the material of each primitive, (N,) int32."""
        if self.placed is None:
            return self.prim_material[prim_id]
        run, local = self._run(prim_id)
        return self.prim_material[self.placed.first_material[run] + self.placed.material_step[run] * local]

    def corners(self, prim_id: np.ndarray) -> np.ndarray:
        """Return the corners of triangles in world space, (N, 3, 3) float64: N triangles, 3 corners, 3 coordinates."""
        face, run = self.places(prim_id)
        corners = self.vertices[self.faces[face]].astype(np.float64)
        if self.placed is None:
            return corners
        to_world = self.placed.to_world[run]
        return corners @ to_world[:, :, :3].transpose(0, 2, 1) + to_world[:, None, :, 3]

    def _run(self, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self.placed is not None
        run = np.searchsorted(self.placed.first_prim, prim_id, side="right") - 1
        return run, prim_id - self.placed.first_prim[run]


def flat_scene_of(geometry: Geometry | InstancedGeometry, normals: np.ndarray | None = None, uvs: np.ndarray | None = None) -> FlatScene:
    """Make a flat scene of a mesh with its normals and uvs, or of instances without normals and uvs."""
    material = np.zeros(0, np.int32)
    uvs = np.zeros((0, 2), np.float32) if uvs is None else uvs
    if isinstance(geometry, Geometry):
        return FlatScene(geometry, geometry.vertices, geometry.faces, normals, uvs, material)
    first_vertex = np.cumsum([0, *(len(part.vertices) for part in geometry.parts)])
    first_face = np.cumsum([0, *(len(part.faces) for part in geometry.parts)])
    nothing = np.zeros(len(geometry.part), np.int64)
    return FlatScene(geometry, np.concatenate([part.vertices for part in geometry.parts]),
                 np.concatenate([part.faces + np.int32(first) for part, first in zip(geometry.parts, first_vertex, strict=False)]),
                 None, uvs, material, Placed(geometry.first_prim, first_face[geometry.part], nothing, nothing, geometry.to_world))


def placed_now(scene: FlatScene, geometry: Geometry | InstancedGeometry) -> Placed | None:
    """Return scene.placed with the matrices of `geometry`, whose instances may have moved."""
    if scene.placed is None or not isinstance(geometry, InstancedGeometry):
        return None
    to_world = scene.placed.to_world.copy()
    to_world[run_of(scene.placed, geometry)] = geometry.to_world[geometry.is_placed]
    return replace(scene.placed, to_world=to_world)


def run_of(placed: Placed, geometry: InstancedGeometry) -> np.ndarray:
    """Return the index of the run of each instance in `geometry.is_placed`. An instance without primitives gets another run."""
    return np.searchsorted(placed.first_prim, geometry.first_prim[geometry.is_placed], side="right") - 1
