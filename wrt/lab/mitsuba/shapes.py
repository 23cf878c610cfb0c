"""Translate objects and spheres to Mitsuba: a mesh in world space for each material of an object, and exact spheres."""

from collections.abc import Iterator
from types import ModuleType
from typing import NamedTuple

import numpy as np

from wrt.lab.mitsuba.bsdfs import MitsubaObject, Plugin, bsdf, emission, refuse
from wrt.scene.materials import Material
from wrt.scene.model import Object, Sphere


class Part(NamedTuple):
    """The part of a scene in one Mitsuba shape. object_id: objects first, then spheres; face_index: (F,) faces, None for a sphere."""

    object_id: int
    face_index: np.ndarray | None
    material: Material


class Triangles(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None

    def of(self, vertices: np.ndarray, faces: np.ndarray) -> "Triangles":
        """Return triangles over some of the vertices. vertices: indices of the vertices to keep; faces: indices into `vertices`."""
        normals, uvs = (None if array is None else array[vertices] for array in (self.normals, self.uvs))
        return Triangles(self.vertices[vertices], faces.reshape(-1, 3), normals, uvs)


def object_parts(mi: ModuleType, thing: Object, object_id: int) -> Iterator[tuple[str, MitsubaObject, Part]]:
    """Yield (shape id, `mitsuba.Mesh`, Part) for each material that the object's faces use."""
    world = _to_world(thing)
    of_face = np.zeros(len(world.faces), np.int32) if thing.face_material is None else thing.face_material
    for index in np.unique(of_face).tolist():
        material = thing.materials[index]
        chosen = np.flatnonzero(of_face == index)
        used, faces = np.unique(world.faces[chosen], return_inverse=True)
        triangles = world if len(chosen) == len(world.faces) else world.of(used, faces)
        if material.textures and triangles.uvs is None:
            triangles = triangles._replace(uvs=np.zeros((len(triangles.vertices), 2), np.float32))
        name = f"object{object_id}_{index}"
        part = Part(object_id, chosen, material)
        yield name, make_mesh(mi, name, triangles, _properties(mi, material)), part


def sphere_shape(mi: ModuleType, sphere: Sphere) -> Plugin:
    """Return a sphere, rotated for its texture coordinates: Mitsuba's u runs around z, wrt's around y. +z becomes +y, +x becomes -x."""
    pose = np.eye(4)
    pose[:3, :3] = sphere.radius * np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    pose[:3, 3] = sphere.center
    return {"type": "sphere", "to_world": mi.ScalarTransform4f(pose), **_properties(mi, sphere.material)}


def _properties(mi: ModuleType, material: Material) -> Plugin:
    """Return the plugins of a shape: its BSDF, its emitter and the medium inside."""
    nested: Plugin = {"bsdf": bsdf(mi, material)}
    if material.is_emissive:
        if material.two_sided:
            refuse("two_sided emission", f"material {material.name!r}")
        nested["emitter"] = emission(mi, material)
    if max(material.absorption) > 0.0 and not material.thin:
        strongest = max(material.absorption)  # colours above 1 are refused, hence the scale
        ratio = [value / strongest for value in material.absorption]
        nested["interior"] = {"type": "homogeneous", "albedo": 0.0, "scale": strongest, "sigma_t": {"type": "rgb", "value": ratio}}
    return nested


def _to_world(thing: Object) -> Triangles:
    """Return triangles in world space, computed in float64 and rounded once to float32, as in wrt."""
    mesh, linear = thing.mesh, thing.transform[:3, :3]
    vertices = mesh.vertices.astype(np.float64) @ linear.T + thing.placement[:3, 3]
    # A mirroring transform reverses the winding; exchanging two corners restores it.
    faces = mesh.faces if np.linalg.det(linear) >= 0.0 else mesh.faces[:, [0, 2, 1]]
    world = Triangles(vertices.astype(np.float32), faces, None, mesh.uvs)
    if mesh.normals is None:
        return world
    normals = mesh.normals.astype(np.float64) @ np.linalg.inv(linear)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = length[:, 0] == 0.0
    normals = (normals / np.where(length > 0.0, length, 1.0)).astype(np.float32)
    if not flat[faces].any():
        return world._replace(normals=normals)
    # A zero normal means a flat corner, which gets the normal of its face. So faces can no longer share vertices.
    corners = world._replace(normals=normals).of(faces.reshape(-1), np.arange(faces.size))
    assert corners.normals is not None
    own = np.repeat(_face_normals(corners), 3, axis=0)
    return corners._replace(normals=np.where(np.any(corners.normals, axis=1, keepdims=True), corners.normals, own))


def _face_normals(triangles: Triangles) -> np.ndarray:
    """Return (F, 3) float32 unit normals of the faces; zero for a triangle without area."""
    a, b, c = (triangles.vertices[triangles.faces[:, corner]].astype(np.float64) for corner in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals / np.where(length > 0.0, length, 1.0)).astype(np.float32)


def make_mesh(mi: ModuleType, name: str, triangles: Triangles, nested: Plugin) -> MitsubaObject:
    properties = mi.Properties()
    for key, value in nested.items():
        properties[key] = mi.load_dict(value)
    mesh = mi.Mesh(name, len(triangles.vertices), len(triangles.faces), props=properties,
                   has_vertex_normals=triangles.normals is not None, has_vertex_texcoords=triangles.uvs is not None)
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = triangles.vertices.ravel()
    arrays["faces"] = triangles.faces.astype(np.uint32).ravel()
    if triangles.normals is not None:
        arrays["vertex_normals"] = triangles.normals.ravel()
    if triangles.uvs is not None:
        arrays["vertex_texcoords"] = triangles.uvs.ravel()
    arrays.update()
    return mesh
