"""From a mesh, or the path of its file, to an acceleration structure."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, overload

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.flat_scene import FlatScene, flat_scene_of
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.flatten import flatten
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.scenes.worlds import worlds_over
from wrt.accel.store import read
from wrt.accel.structure import default_options
from wrt.accel.structures import ACCELERATORS
from wrt.core.arrays import is_tensor, taken, to_numpy
from wrt.core.checks import as_one, shown
from wrt.core.errors import InputError
from wrt.io.load import LOADERS, load_scene
from wrt.io.mesh_file import load_mesh
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene


def reports_progress(accel: str) -> bool:
    """Whether the structure is so slow to build that it has the option `progress`: called with the fraction done, 0 to 1."""
    return accel in ACCELERATORS and "progress" in default_options(accel)


@overload
def build(mesh: list[Any], accel: str = "bvh", device: str = "cpu", threads: int | None = None, **options: Any) -> Instances: ...
@overload
def build(mesh: Scene | InstancedGeometry | str | os.PathLike[str], accel: str = "bvh", device: str = "cpu",
          threads: int | None = None, **options: Any) -> OneMesh | Instances: ...
@overload
def build(mesh: Any, accel: str = "bvh", device: str = "cpu", threads: int | None = None, **options: Any) -> OneMesh: ...
def build(mesh: Any, accel: str = "bvh", device: str = "cpu", threads: int | None = None,
          **options: Any) -> OneMesh | Instances:
    """An acceleration structure over a mesh or a scene, ready for `closest_hit` and `any_hit`.

    mesh: a Mesh, a Scene, the path of a mesh or scene file, a trimesh mesh or scene, or a pair (vertices, faces); or a Geometry.
    Of a scene, prim_ids count the faces of its objects in their order, then the spheres; meshes that several objects show are kept
    once where that saves much, as in pictures. Over those, and over an InstancedGeometry, it is a tree over structures of the kind,
    one for each mesh.

    A list of meshes and scenes without spheres: each is a world, and a ray sees the one that its query names (`world`). prim_ids
    count the faces of a world; each object is an instance, which can be moved (Instances.move); each mesh is kept once.

    accel: a name in ACCELERATORS; "bvh" is bvh8. options: `triangle` and `box`, the intersection tests (names in
    wrt.kernels.units.triangle.RAY_TRIANGLE and wrt.kernels.units.box.RAY_AABB), and the structure's own (see its class).
    Raises InputError that names the argument.
    """
    ACCELERATORS.check(as_one(accel, str, "accel"))
    kind, device = ACCELERATORS[accel], as_one(device, str, "device")
    flat = (worlds_over([shape_given(each) for each in mesh]) if isinstance(mesh, list)
             else None if isinstance(mesh, Geometry | InstancedGeometry) else flat_scene_given(mesh))  # of a geometry no more is known
    geometry = mesh if flat is None else flat.geometry
    if isinstance(geometry, InstancedGeometry):
        return Instances(kind, geometry, flat, device=device, threads=threads, **options)
    return kind(geometry, flat, device=device, threads=threads, **options)


def load_accel(path: str | os.PathLike[str], mesh: Any, device: str = "cpu", threads: int | None = None) -> OneMesh:
    """The structure that OneMesh.save or `wrt build` wrote to `path`, over the same mesh: as in `build`.

    Raises InputError for a file that is missing, foreign, damaged, of another version or over another mesh.
    """
    flat = flat_scene_given(mesh)
    return read(path, one_geometry(flat), flat, as_one(device, str, "device"), threads)


def flat_scene_given(mesh: Any) -> FlatScene:
    """What a structure is to be over: as in `build`, but no list. Raises InputError for what is none, and for a bad file."""
    if isinstance(mesh, Geometry | InstancedGeometry):
        return flat_scene_of(mesh)
    mesh = shape_given(mesh)
    if isinstance(mesh, Scene):
        return flatten(mesh, instanced_meshes(mesh))
    return flat_scene_of(Geometry.of(mesh), mesh.normals, mesh.uvs)


def shape_given(mesh: Any) -> Mesh | Scene:
    """As flat_scene_given, but for geometries."""
    if isinstance(mesh, str | os.PathLike) and Path(os.fsdecode(mesh)).suffix.lower() in LOADERS:
        mesh = load_scene(mesh)
    elif isinstance(mesh, str | os.PathLike):
        mesh = load_mesh(mesh)
    elif isinstance(mesh, tuple) and len(mesh) == 2:
        vertices, faces = (np.array(to_numpy(taken(each, name, None))) if is_tensor(each) else each  # it may be written to
                           for each, name in zip(mesh, ("vertices", "faces"), strict=True))
        mesh = Mesh(vertices, faces)
    elif type(mesh).__module__.split(".")[0] == "trimesh":
        mesh = Mesh.from_trimesh(mesh)
    if isinstance(mesh, Scene | Mesh):
        return mesh
    raise InputError("must be a Mesh, a Scene, the path of a mesh or scene file, a trimesh.Trimesh or trimesh.Scene, or a pair"
                     f" (vertices, faces), got {shown(mesh)}", argument="mesh")


def one_geometry(flat: FlatScene) -> Geometry:
    """Raises InputError where there are instances."""
    if not isinstance(flat.geometry, Geometry):
        raise InputError("a scene with instances has no structure in a file")
    return flat.geometry
