"""Ray queries inside the user's own Warp kernels: `wrt.ray_query`."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import warp as wp

from wrt.accel.geometry import MESH_OF_A_SPHERE
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.snapshot import Snapshot, Structure, check_units
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_one
from wrt.core.device import made_once
from wrt.core.errors import InputError
from wrt.core.types import DeviceFunction, WarpStruct, WarpType
from wrt.kernels.ray_query import QueryHit, QueryRay, Traversals, make_ray_query, query_ray
from wrt.kernels.traverse.common import Units


class RayQuery(NamedTuple):
    """Warp functions and types with which kernels query structures of one kind, bit for bit like `Accelerator.closest_hit`.

    Attributes
    ----------
    World : type
        Type of the kernel argument `accel.world`.
    Ray, Hit : type
        Structs. A Ray has `t_min`, `t_max` and `world`, the index of the world that it sees, at first 0; and, for `filtered` functions,
        `exclude` and `mask`, as in `Accelerator.closest_hit`, which `ray` sets to -1. A Hit has `t`, `u`, `v`
        and `prim_id` (-1 on a miss).
    ray : (origin, direction) -> Ray
        Ray from the origin to infinity.
    closest_hit : (world, ray) -> Hit
        Closest hit in the ray's segment.
    any_hit : (world, ray) -> bool
        Whether the ray hits anything in its segment.
    next_hit : (world, ray, hit) -> Hit
        Next hit of the ray after `hit`, in the order of t and prim_id.
    """

    World: WarpType
    Ray: WarpType
    Hit: WarpType
    ray: DeviceFunction
    closest_hit: DeviceFunction
    any_hit: DeviceFunction
    next_hit: DeviceFunction


def ray_query(accel: Accelerator | str, *, triangle: str | None = None, box: str | None = None, filtered: bool = False) -> RayQuery:
    """Return functions and types with which Warp kernels query structures, on the CPU and on CUDA.

    Make the kernel with `@wrt.kernel`. If a kernel is compiled with fused multiply-add, or receives a structure of another kind,
    it prints a message once, and its rays hit nothing.

    Parameters
    ----------
    accel : Accelerator or str
        A structure over meshes, instances or worlds; or a name in `wrt.ACCELERATORS`, for structures of that kind over one mesh.
    triangle, box : str, optional
        Intersection tests of the structures; only if `accel` is a name.
    filtered : bool
        Rays pass through instances by `Ray.exclude` and `Ray.mask`; only over instances.

    Returns
    -------
    RayQuery
        The same object for the same kind of structure and the same tests.

    Raises
    ------
    InputError
        For unknown names, and for structures over spheres.
    """
    message = "accel must be a structure without spheres, or a name in wrt.ACCELERATORS"
    if isinstance(accel, str):
        units = Units(as_one(triangle or Units().triangle, str, "triangle"), as_one(box or Units().box, str, "box"))
        ACCELERATORS.check(accel, "accel")
        check_units(units.triangle, units.box)
        structure = Structure(ACCELERATORS[accel], units)
    elif triangle is not None or box is not None:
        raise InputError("triangle and box belong to a structure's name; a structure has its own",
                         argument="triangle" if box is None else "box")
    elif isinstance(accel, Accelerator):
        structure = accel.structure
    else:
        raise InputError(message, argument="accel")
    require_no_spheres(structure, message)
    if as_one(filtered, bool, "filtered"):
        if not structure.units.instances:
            raise InputError("is for structures over instances", argument="filtered", hint="wrt.build(scene, movable=True) makes one")
        structure = structure.filtered
    world, closest_hit, any_hit, next_hit = query_of(structure)
    return RayQuery(world, QueryRay, QueryHit, query_ray, closest_hit, any_hit, next_hit)


@made_once
def query_of(structure: Structure) -> tuple[WarpType, DeviceFunction, DeviceFunction, DeviceFunction]:
    """Make the fields World, closest_hit, any_hit and next_hit of RayQuery for a kind of structure."""
    resuming = structure._replace(units=structure.units._replace(resumes=True))
    return make_ray_query(Traversals(structure.struct, structure.traversal(any_hit=False), structure.traversal(any_hit=True),
                                     resuming.traversal(any_hit=False), structure.units.instances, structure.units.filtered,
                                     kind_of(structure)))


def require_no_spheres(structure: Structure, message: str) -> None:
    """Raise InputError with `message` if the structure has spheres."""
    if structure.units.spheres:
        raise InputError(message, argument="accel", hint=MESH_OF_A_SPHERE)


def kind_of(structure: Structure) -> int:
    """Return a hash of the structure's name, triangle test and levels, with which kernels recognise a structure of another kind."""
    name = f"{structure.accel.name} {structure.units.triangle} {structure.units.instances}"
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def kernel_argument(snapshot: Snapshot) -> WarpStruct:
    """Return the structure as one kernel argument, RayQuery.World. Raises InputError if it has spheres."""
    structure = snapshot.structure
    require_no_spheres(structure, "a kernel can only query a structure without spheres")
    world = query_of(structure)[0]()
    world.kind = kind_of(structure)
    world.accel, world.surfaces = snapshot.data, snapshot.surfaces
    if snapshot.geometry.origin is not None:
        world.origin = wp.vec3d(*snapshot.geometry.origin)
    if snapshot.roots is not None:
        world.roots = snapshot.roots
    return world
