"""Acceleration structures from meshes, scenes and files: `wrt.build` and `wrt.load_accel`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar, Unpack, overload

import warp as wp

from wrt.accel.base import OneMesh, from_tree
from wrt.accel.box_tree import BoxTree
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.flat_scene import FlatScene, flat_scene_of
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.flatten import flatten, with_shared, worlds_over
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.store import read
from wrt.accel.structures import ACCELERATORS
from wrt.core.arrays import from_tensor, is_tensor, to_numpy
from wrt.core.building import reported_to
from wrt.core.checks import as_one, shown
from wrt.core.errors import InputError
from wrt.core.files import require_file
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike, PathLike
from wrt.io.load import LOADERS, load_scene
from wrt.io.mesh_file import load_mesh
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene, moved_by, scene_origin
from wrt.scene.values import warn_if_far

if TYPE_CHECKING:
    import trimesh

    OneMeshLike: TypeAlias = Mesh | Geometry | trimesh.Trimesh | wp.Mesh | tuple[ArrayLike, ArrayLike]
    SceneLike: TypeAlias = Scene | InstancedGeometry | trimesh.Scene | PathLike
    MeshLike: TypeAlias = OneMeshLike | SceneLike
    WorldT = TypeVar("WorldT", bound=MeshLike)

OTHER_MESHES = {"pyvista": "wrt.build(wrt.compat.pyvista.to_mesh(mesh))",  # hints, by package
                "open3d": "wrt.build((mesh.vertices, mesh.triangles)), or (mesh.vertex.positions, mesh.triangle.indices) of a tensor mesh",
                "newton": "wrt.build((mesh.vertices, mesh.indices.reshape(-1, 3))); a model: docs/compat.md, MuJoCo and Newton",
                "mujoco": "docs/compat.md, MuJoCo and Newton, has the meshes of a model"}


class BuildOptions(TypedDict, total=False):
    """Options of `build`. A comment names the structures that have an option and the options below it. See docs/acceleration.md."""

    triangle: str  # all structures
    box: str
    builder: str  # bvh*
    max_leaf: int  # bvh*, kdtree, octree
    split_alpha: float  # bvh*
    split_budget: float
    cost_traversal: float  # bvh*, kdtree
    cost_intersection: float  # bvh*, kdtree, bsp
    samples: int  # bsp
    max_triangles: int
    max_depth: int | None  # kdtree, octree, bsp
    max_growth: float
    by_cost: bool  # octree
    empty_bonus: float  # kdtree
    clip: bool
    density: float  # grid
    mailbox: bool  # grid, octree


@overload
def build(mesh: OneMeshLike, accel: str = ..., device: str | None = ..., threads: int | None = ...,
          *, progress: Callable[[float], None] | None = ..., **options: Unpack[BuildOptions]) -> OneMesh: ...
@overload
def build(mesh: MeshLike, accel: str = ..., device: str | None = ..., threads: int | None = ..., *, movable: Literal[True],
          progress: Callable[[float], None] | None = ..., **options: Unpack[BuildOptions]) -> Instances: ...
@overload
def build(mesh: SceneLike, accel: str = ..., device: str | None = ..., threads: int | None = ..., *, movable: bool = ...,
          progress: Callable[[float], None] | None = ..., **options: Unpack[BuildOptions]) -> OneMesh | Instances: ...
@overload
def build(mesh: list[WorldT], accel: str = ..., device: str | None = ..., threads: int | None = ..., *, movable: bool = ...,
          shared: MeshLike | None = ..., progress: Callable[[float], None] | None = ..., **options: Unpack[BuildOptions]) -> Instances: ...
def build(mesh: MeshLike | list[Any], accel: str = "bvh", device: str | None = None, threads: int | None = None, *,
          movable: bool = False, shared: MeshLike | None = None, progress: Callable[[float], None] | None = None,
          **options: Unpack[BuildOptions]) -> OneMesh | Instances:
    """Build an acceleration structure over a mesh, a scene or several worlds.

    In a scene, prim_ids number the faces of all objects in order, then the spheres. A mesh that several objects share is stored once
    if that saves much memory; the structure is then `Instances`. In a list, each entry is a world: a mesh, or a scene without
    spheres. A query names the world that each ray sees; prim_ids of hits number the faces of that world. `Instances.move` moves objects.

    Parameters
    ----------
    mesh : Mesh, Scene, path, trimesh mesh or scene, wp.Mesh, pair (vertices, faces), geometry, or list of these
        Surfaces that rays can hit; all arrays are copied. A path names a mesh file or a scene file.
    accel : str
        Name in `wrt.ACCELERATORS`; "bvh" is bvh8.
    device : str, optional
        Device of the structure: "cpu" or "cuda:0". By default that of the mesh's arrays if they are on a GPU, else the one that the
        environment variable WRT_DEVICE names, else "cpu". Warp's current device (`wp.set_device`) has no effect.
    threads : int, optional
        Threads that build and refit; one per core by default.
    movable : bool
        Make each object of the scene, or the mesh, an instance that `Instances.move` moves. Not for scenes with spheres.
    shared : mesh or scene as above, optional
        Objects of all worlds of a list, such as a terrain, behind each world's own. Their meshes are stored once.
    progress : function, optional
        Function that is called with the finished share of the build, 0 to 1, perhaps from several threads.
    **options
        Intersection tests `triangle` and `box`, and the options of the structure (`BuildOptions`).

    Returns
    -------
    OneMesh or Instances
        An object of the structure's class, such as `Bvh8`; `Instances` for a list, if `movable`, and for a scene whose shared meshes are
        stored once.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    if not isinstance(accel, str):
        raise InputError(f"must be the name of a structure, got {shown(accel)}", argument="accel",
                         hint="vertices and faces are one argument: wrt.build((vertices, faces))")
    ACCELERATORS.check(accel, "accel")
    kind, device = ACCELERATORS[accel], device_of(mesh, device)
    if unnamed := as_one(movable, bool, "movable") and not isinstance(mesh, list):
        mesh = [mesh]
    if shared is not None and (unnamed or not isinstance(mesh, list)):
        raise InputError("is for several worlds, a list", argument="shared", hint="wrt.build([scene, ...], shared=terrain)")
    common = None if shared is None else to_mesh_or_scene(shared)
    flat: Any = (worlds_over(with_shared([to_mesh_or_scene(each) for each in mesh], common), unnamed) if isinstance(mesh, list)
             else None if isinstance(mesh, Geometry | InstancedGeometry) else to_flat_scene(mesh))  # a geometry has no attributes
    geometry = own(mesh) if isinstance(mesh, Geometry | InstancedGeometry) else flat.geometry
    structure: type[Any] | partial[Any] = partial(Instances, kind) if isinstance(geometry, InstancedGeometry) else kind
    if not (progress is None or callable(progress)):
        raise InputError(f"must be a function of one number, got {shown(progress)}", argument="progress")
    with nullcontext() if progress is None else reported_to(progress):
        built: OneMesh | Instances = structure(geometry, flat, device=device, threads=threads, **options)
    return built


def load_accel(path: PathLike, mesh: MeshLike | None = None, device: str | None = None, threads: int | None = None) -> OneMesh:
    """Read a structure that `OneMesh.save` or `wrt build` wrote.

    Parameters
    ----------
    path : str or path
        File with the suffix .accel.
    mesh, device, threads
        See `build`; the mesh must equal the one that the structure was built over. None: the file holds it.

    Returns
    -------
    OneMesh
        Structure with the same intersection tests as the saved one.

    Raises
    ------
    InputError
        If the file is missing, damaged, not a structure, of another version, or over another mesh.
    """
    geometry, flat = (None, None) if mesh is None else one_mesh(mesh)
    loaded: OneMesh = read(path, geometry, flat, device_of(mesh, device), threads)
    return loaded


def accel_from_tree(mesh: MeshLike, tree: BoxTree | Mapping[str, Any] | PathLike, accel: str | None = None, device: str | None = None,
                    threads: int | None = None, *, spatial_splits: bool = False) -> OneMesh:
    """Make a BVH from the tree of another builder, so that wrt's queries, counters and models measure it.

    The tree is checked first. Boxes grow by the padding that wrt's intersection tests need, so that no ray is lost; a tree from
    `OneMesh.tree` keeps its boxes.

    Parameters
    ----------
    mesh
        See `build`; the surfaces that the tree was built over.
    tree : BoxTree, mapping of its arrays, or path of a .npz file
        `lo`, `hi`, `child`, `count` and `primitives`, as `OneMesh.tree` returns and `BoxTree` describes.
    accel : str, optional
        BVH in `wrt.ACCELERATORS`; by default bvh2, bvh4 or bvh8 after the tree's width. Wide BVHs collapse a binary tree.
    device, threads
        See `build`.
    spatial_splits : bool
        Allow several leaves to list the same primitive. Their boxes must contain the padded parts of the primitive; this is not checked.

    Returns
    -------
    OneMesh
        Structure of the class `accel`.

    Raises
    ------
    InputError
        Says what is wrong and names the node and child, if the arrays are not a tree over the mesh.
    """
    boxes, (geometry, flat) = BoxTree.of(tree), one_mesh(mesh)
    name = accel or ("bvh2" if boxes.width <= 2 else "bvh4" if boxes.width <= 4 else "bvh8")
    ACCELERATORS.check(as_one(name, str, "accel"), "accel")
    return from_tree(ACCELERATORS[name], boxes, geometry, flat, device_of(mesh, device), threads, spatial_splits)


def device_of(mesh: Any, device: str | None) -> str:
    """Return the argument `device` of `build`; None stands for the GPU of the mesh's arrays, else for the default."""
    for each in () if device is not None else mesh if isinstance(mesh, list) else [mesh]:
        points = each[0] if isinstance(each, tuple) and each else getattr(each, "points", None)  # of wp.Mesh and DeviceGeometry
        if isinstance(points := from_tensor(points, "vertices", None), wp.array) and points.device.is_cuda:
            return str(points.device)
    return DEFAULT_DEVICE if device is None else as_one(device, str, "device")


def own(geometry: Geometry | InstancedGeometry) -> Geometry | InstancedGeometry:
    """Return a geometry with copies of its arrays, because the caller may write to its own later."""
    if isinstance(geometry, DeviceGeometry):
        return DeviceGeometry.unchecked(wp.clone(geometry.points), wp.clone(geometry.indices), geometry.spheres.copy())
    return deepcopy(geometry)


def one_mesh(mesh: MeshLike) -> tuple[Geometry, FlatScene]:
    """Convert as `to_flat_scene` does. Raises InputError for a scene with instances."""
    flat = to_flat_scene(mesh)
    if not isinstance(flat.geometry, Geometry):
        raise InputError("must not be a scene with instances", argument="mesh")
    return flat.geometry, flat


def to_flat_scene(mesh: MeshLike) -> FlatScene:
    """Convert the argument `mesh` of `build` to a FlatScene of copied arrays. Raises InputError for other types, and for a bad file."""
    if isinstance(mesh, Geometry | InstancedGeometry):
        return flat_scene_of(own(mesh))
    mesh = to_mesh_or_scene(mesh)
    if isinstance(mesh, Scene):
        origin = scene_origin(mesh)
        near = moved_by(mesh, origin)
        flat = flatten(near, instanced_meshes(near))
        return flat if origin is None else replace(flat, geometry=replace(flat.geometry, origin=origin))
    return deepcopy(flat_scene_of(Geometry.of(mesh), mesh.normals, mesh.uvs))


def to_mesh_or_scene(mesh: MeshLike) -> Mesh | Scene:
    """Convert the argument `mesh` of `build` to a Mesh or Scene; load it if it is a path.
    Raises InputError for a bad file and for any other type, also for a Geometry and an InstancedGeometry."""
    from_file = isinstance(mesh, str | os.PathLike)
    if isinstance(mesh, str | os.PathLike) and Path(os.fsdecode(mesh)).suffix.lower() in LOADERS:
        require_file(path := Path(os.fsdecode(mesh)))
        mesh = LOADERS[path.suffix.lower()](path, shapes_only=True) if path.suffix.lower() in (".gltf", ".glb") else load_scene(path)
    elif isinstance(mesh, str | os.PathLike):
        mesh = load_mesh(mesh)
    elif isinstance(mesh, tuple) and len(mesh) == 2:
        vertices, faces = (to_numpy(from_tensor(each, name, None)) if is_tensor(each) or isinstance(each, wp.array) else each
                           for each, name in zip(mesh, ("vertices", "faces"), strict=True))
        mesh = Mesh(vertices, faces)
    elif isinstance(mesh, wp.Mesh):
        mesh = Mesh(mesh.points.numpy(), mesh.indices.numpy().reshape(-1, 3))
    elif type(mesh).__module__.split(".")[0] == "trimesh":
        mesh = Mesh.from_trimesh(mesh)  # type: ignore[arg-type]  # narrowed without an import of trimesh
    if isinstance(mesh, Mesh) and not from_file:
        warn_if_far(mesh.vertices, mesh.name, mesh.origin)
    if isinstance(mesh, Scene | Mesh):
        return mesh
    raise InputError("must be a Mesh, a Scene, the path of a mesh or scene file, a trimesh.Trimesh or trimesh.Scene, a wp.Mesh, or a pair"
                     f" (vertices, faces), got {shown(mesh)}", argument="mesh", hint=OTHER_MESHES.get(type(mesh).__module__.split(".")[0]))
