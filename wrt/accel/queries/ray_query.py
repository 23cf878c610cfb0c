"""Hits from inside a kernel of one's own: what wrt.ray_query gives."""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.snapshot import Snapshot
from wrt.accel.structure import Structure, check_units
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_one
from wrt.core.device import made_once
from wrt.core.errors import InputError
from wrt.kernels.ray_query import QueryHit, QueryRay, make_ray_query, query_ray
from wrt.kernels.traverse.common import Units


class RayQuery(NamedTuple):
    """Warp functions and types for kernels over structures of one kind; they have the answers of Accelerator.closest_hit, to the
    last bit.

    World: the type of the argument that OneMesh.world is. ray(origin, direction) -> Ray, from the origin to infinity; its
    t_min and t_max can be set. closest_hit(world, ray) -> Hit, with t, u, v and prim_id, which is -1 on a miss.
    any_hit(world, ray) -> bool. next_hit(world, ray, hit) -> Hit: the one after a hit of this ray, in the order of t and prim_id.
    """

    World: Any
    Ray: Any
    Hit: Any
    ray: Any
    closest_hit: Any
    any_hit: Any
    next_hit: Any


def ray_query(accel: Accelerator | str, *, triangle: str | None = None, box: str | None = None) -> RayQuery:
    """What a kernel needs to ask structures for hits, on the CPU and on CUDA.

    accel: a structure that the kernel is for, or for all of a kind its name in wrt.ACCELERATORS, with the intersection tests that
    they are built with. Make the kernel with @wrt.kernel, which takes no arguments: where a kernel is compiled with fused
    multiply-add, or gets a structure of another kind, it prints so once, and its rays hit nothing.
    Raises InputError for unknown names, and for structures over several meshes.
    """
    message = "accel must be a structure over one mesh, or the name of one"
    if isinstance(accel, str):
        units = Units(as_one(triangle or Units().triangle, str, "triangle"), as_one(box or Units().box, str, "box"))
        ACCELERATORS.check(accel)
        check_units(units.triangle, units.box)
        structure = Structure(ACCELERATORS[accel], units)
    elif triangle is not None or box is not None:
        raise InputError("triangle and box belong to a structure's name; a structure has its own")
    elif isinstance(accel, Accelerator):
        structure = accel.structure
    else:
        raise InputError(message)
    structure.require_one_mesh(message)
    world, closest_hit, any_hit, next_hit = query_of(structure)
    return RayQuery(world, QueryRay, QueryHit, query_ray, closest_hit, any_hit, next_hit)


@made_once
def query_of(structure: Structure) -> tuple[Any, Any, Any, Any]:
    """make_ray_query of a structure."""
    resuming = structure._replace(units=structure.units._replace(resumes=True))
    return make_ray_query(structure.struct, structure.traversal(any_hit=False), structure.traversal(any_hit=True),
                          resuming.traversal(any_hit=False), kind_of(structure))


def kind_of(structure: Structure) -> int:
    """A number for the layout of a structure's records and for its triangle test."""
    return zlib.crc32(f"{structure.accel.name} {structure.units.triangle}".encode()) & 0x7FFFFFFF


def kernel_argument(snapshot: Snapshot) -> Any:
    """A structure and what it is over as one record. Raises InputError where it is not over one mesh."""
    structure = snapshot.structure
    structure.require_one_mesh("kernels of one's own ask structures over one mesh")
    world = query_of(structure)[0]()
    world.kind = kind_of(structure)
    world.accel, world.surfaces = snapshot.data, snapshot.surfaces
    return world
