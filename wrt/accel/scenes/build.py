"""Acceleration structures from meshes, scenes and files: `wrt.build` and `wrt.load_accel`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar, Unpack, overload

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
from wrt.core.types import ArrayLike, PathLike
from wrt.io.load import LOADERS, load_scene
from wrt.io.mesh_file import load_mesh
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene

if TYPE_CHECKING:
    import trimesh

    from wrt.accel.brute_force import BruteForce
    from wrt.accel.bvh.binary import Bvh2
    from wrt.accel.bvh.volumes import Bvh2Kdop, Bvh2Sphere
    from wrt.accel.bvh.wide import Bvh4, Bvh8, Bvh8c
    from wrt.accel.cells.bsp import Bsp
    from wrt.accel.cells.grid import Grid
    from wrt.accel.cells.kdtree import KdTree
    from wrt.accel.cells.octree import Octree

    OneMeshLike: TypeAlias = Mesh | Geometry | trimesh.Trimesh | tuple[ArrayLike, ArrayLike]
    SceneLike: TypeAlias = Scene | InstancedGeometry | trimesh.Scene | PathLike
    MeshLike: TypeAlias = OneMeshLike | SceneLike
    WorldT = TypeVar("WorldT", bound=MeshLike)


class BuildOptions(TypedDict, total=False):
    """Options of `build`. Each structure has some of them, with defaults of its own (docs/acceleration.md)."""

    triangle: str  # all structures
    box: str
    builder: str  # bvh*
    max_leaf: int  # bvh*, kdtree, octree
    split_alpha: float  # bvh*
    split_budget: float
    cost_traversal: float  # bvh*, kdtree
    cost_intersection: float  # bvh*, kdtree, bsp
    cost_axis: float  # bsp
    cost_plane: float
    samples: int
    max_triangles: int
    progress: Callable[[float], None] | None
    max_depth: int | None  # kdtree, octree, bsp
    max_growth: float
    by_cost: bool  # kdtree, octree
    empty_bonus: float  # kdtree
    perfect_below: int
    clip: bool
    density: float  # grid
    mailbox: bool  # grid, octree


def reports_progress(accel: str) -> bool:
    """Return whether the structure has the option `progress`, because its build is slow."""
    return accel in ACCELERATORS and "progress" in default_options(accel)


@overload
def build(mesh: list[WorldT], accel: str = ..., device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Instances: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh", "bvh8"] = ..., device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh8: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh4"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh4: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh8c"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh8c: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh2"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh2: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh2_sphere"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh2Sphere: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bvh2_kdop"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bvh2Kdop: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["kdtree"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> KdTree: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["bsp"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Bsp: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["brute_force"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> BruteForce: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["grid"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Grid: ...
@overload
def build(mesh: OneMeshLike, accel: Literal["octree"], device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> Octree: ...
@overload
def build(mesh: OneMeshLike, accel: str, device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> OneMesh: ...
@overload
def build(mesh: SceneLike, accel: str = ..., device: str = ..., threads: int | None = ...,
          **options: Unpack[BuildOptions]) -> OneMesh | Instances: ...
def build(mesh: MeshLike | list[Any], accel: str = "bvh", device: str = "cpu", threads: int | None = None,
          **options: Unpack[BuildOptions]) -> OneMesh | Instances:
    """Build an acceleration structure over a mesh, a scene or several worlds.

    In a scene, prim_ids count the faces of its objects in their order, then the spheres. Meshes of several objects are stored once
    where that saves much memory; the structure is then `Instances`. Of a list, each mesh or scene without spheres is a world, and a
    query names the world that a ray sees. Its prim_ids count the faces of the world; `Instances.move` moves its objects.

    Parameters
    ----------
    mesh : Mesh, Scene, path, trimesh mesh or scene, pair (vertices, faces), geometry, or list of these
        What the structure is over. A path is that of a mesh file or of a scene file.
    accel : str
        Name in `wrt.ACCELERATORS`; "bvh" is bvh8.
    device : str
        Device of the structure: "cpu" or "cuda:0".
    threads : int, optional
        Threads that build and refit; one per core by default.
    **options
        `triangle` and `box`, the intersection tests, and the options of the structure (`BuildOptions`).

    Returns
    -------
    OneMesh or Instances
        Of the structure's own class, such as `Bvh8`; `Instances` over a list, and over a scene with shared meshes.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    ACCELERATORS.check(as_one(accel, str, "accel"), "accel")
    kind, device = ACCELERATORS[accel], as_one(device, str, "device")
    flat = (worlds_over([shape_given(each) for each in mesh]) if isinstance(mesh, list)
             else None if isinstance(mesh, Geometry | InstancedGeometry) else flat_scene_given(mesh))  # of a geometry no more is known
    geometry = mesh if flat is None else flat.geometry
    if isinstance(geometry, InstancedGeometry):
        return Instances(kind, geometry, flat, device=device, threads=threads, **options)
    return kind(geometry, flat, device=device, threads=threads, **options)


def load_accel(path: PathLike, mesh: MeshLike, device: str = "cpu", threads: int | None = None) -> OneMesh:
    """Read a structure that `OneMesh.save` or `wrt build` wrote.

    Parameters
    ----------
    path : str or path
        File with the suffix .accel.
    mesh, device, threads
        See `build`; the mesh must be the one that the structure was built over.

    Returns
    -------
    OneMesh
        Structure with the options and tests that it was built with.

    Raises
    ------
    InputError
        For a file that is missing, foreign, damaged, of another version or over another mesh.
    """
    flat = flat_scene_given(mesh)
    return read(path, one_geometry(flat), flat, as_one(device, str, "device"), threads)


def flat_scene_given(mesh: MeshLike) -> FlatScene:
    """Return the mesh or scene of `build` as arrays. Raises InputError for other things, and for a bad file."""
    if isinstance(mesh, Geometry | InstancedGeometry):
        return flat_scene_of(mesh)
    mesh = shape_given(mesh)
    if isinstance(mesh, Scene):
        return flatten(mesh, instanced_meshes(mesh))
    return flat_scene_of(Geometry.of(mesh), mesh.normals, mesh.uvs)


def shape_given(mesh: MeshLike) -> Mesh | Scene:
    """Load or convert the argument `mesh` of `build`, except geometries. Raises InputError as flat_scene_given."""
    if isinstance(mesh, str | os.PathLike) and Path(os.fsdecode(mesh)).suffix.lower() in LOADERS:
        mesh = load_scene(mesh)
    elif isinstance(mesh, str | os.PathLike):
        mesh = load_mesh(mesh)
    elif isinstance(mesh, tuple) and len(mesh) == 2:
        vertices, faces = (np.array(to_numpy(taken(each, name, None))) if is_tensor(each) else each  # it may be written to
                           for each, name in zip(mesh, ("vertices", "faces"), strict=True))
        mesh = Mesh(vertices, faces)  # type: ignore[arg-type]  # which converts them
    elif type(mesh).__module__.split(".")[0] == "trimesh":
        mesh = Mesh.from_trimesh(mesh)  # type: ignore[arg-type]  # narrowed without an import of trimesh
    if isinstance(mesh, Scene | Mesh):
        return mesh
    raise InputError("must be a Mesh, a Scene, the path of a mesh or scene file, a trimesh.Trimesh or trimesh.Scene, or a pair"
                     f" (vertices, faces), got {shown(mesh)}", argument="mesh")


def one_geometry(flat: FlatScene) -> Geometry:
    """Return the geometry of a scene without instances. Raises InputError for others."""
    if not isinstance(flat.geometry, Geometry):
        raise InputError("a scene with instances has no structure in a file")
    return flat.geometry
