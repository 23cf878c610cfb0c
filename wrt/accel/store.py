"""Files of structures, which `wrt build` writes and `wrt.load_accel` reads.

A file has a checksum (wrt.core.checked_file). Its header describes the structure and the arrays. It has a checksum of the geometry, or the
scene itself (wrt.accel.scene_arrays). The types of the arrays come from the structure's class. Indices are checked before a ray follows
them.
"""

from collections.abc import Callable, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.scene_arrays import KINDS, arrays_of, scene_of
from wrt.accel.snapshot import Built, Snapshot, Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.checked_file import read_checked, write_checked
from wrt.core.checks import as_one
from wrt.core.device import aligned, row_type
from wrt.core.errors import InputError
from wrt.core.files import check_writable, replacing
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import JsonObject, PathLike
from wrt.core.version import VERSION
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of

MAGIC = b"wrt acceleration structure 2\n"
STATS = ("nodes", "leaves", "depth", "sah_cost")
SIZES, OF_PARTS = "sizes of parts", "statistics of parts"  # arrays of files of instances: (P, n), and (P, 4) with STATS


def array_types(accel: type[Any], triangle: str = "watertight") -> dict[str, np.dtype]:
    """Return the NumPy type of one row of each array in Built.arrays, by the name of the array."""
    kinds = fields_of(Structure(accel, Units(triangle)).struct())
    return {name: row_type(kind.dtype if isinstance(kind, wp.array) else kind) for name, kind in kinds.items()
            if name not in ("primitives", "recorder")}


def check_target(path: PathLike) -> None:
    """Raise InputError if a structure cannot be written to `path`."""
    if Path(path).suffix.lower() != ".accel":
        raise InputError("the file of a structure must have the suffix .accel", path=path)
    check_writable(path)


def save(snapshot: Snapshot, path: PathLike, mesh: bool = False) -> None:
    """Write a structure over one mesh to a file atomically; mesh: with the mesh. Raises InputError if the file cannot be written."""
    check_target(path)
    structure, built = snapshot.structure, snapshot.arrays.on_host()
    body = [each.tobytes() for each in built_rows(structure, built)]
    sizes = {"bytes": dict(zip(array_types(structure.accel, structure.units.triangle), map(len, body), strict=False)),
             "order": len(built.order)}
    header = header_of(structure) | {"geometry": snapshot.mesh.checksum()} | sizes | {name: getattr(built, name) for name in STATS}
    scene = arrays_of(snapshot) if as_one(mesh, bool, "mesh") else {}
    with replacing(path) as file:
        write_checked(file, MAGIC, header | listed(scene), [*scene.values(), *body])


def save_instances(snapshot: Snapshot, bottoms: Sequence[Built], path: PathLike) -> None:
    """Write a structure over instances to a file atomically, with its scene; bottoms: of the structures of the lower level."""
    check_target(path)
    structure, scene = snapshot.structure, arrays_of(snapshot)
    rows = [built_rows(structure, built) for built in bottoms]
    scene[SIZES] = np.array([[each.nbytes for each in part] for part in rows], np.int64)
    scene[OF_PARTS] = np.array([[getattr(built, name) for name in STATS] for built in bottoms], np.float64)
    with replacing(path) as file:
        write_checked(file, MAGIC, header_of(structure) | listed(scene), [*scene.values(), *(each for part in rows for each in part)])


def header_of(structure: Structure) -> JsonObject:
    return {"accel": structure.accel.name, "triangle": structure.units.triangle, "box": structure.units.box, "wrt": VERSION}


def listed(arrays: Mapping[str, np.ndarray]) -> JsonObject:
    """Return the part of a header that describes the arrays at the begin of the body."""
    return {"arrays": {name: [each.dtype.str, *each.shape] for name, each in arrays.items()}} if arrays else {}


def built_rows(structure: Structure, built: Built) -> list[np.ndarray]:
    """Return the arrays of a builder's result and its order, as they stand in files."""
    types = array_types(structure.accel, structure.units.triangle)
    rows = {name: np.ascontiguousarray(np.atleast_1d(array)) for name, array in built.arrays.items()}
    return [*(rows[name].astype(types[name].base, copy=False) for name in types), built.order.astype("<i4")]


def read(path: PathLike, geometry: Geometry | None, attributes: FlatScene | None = None, device: str = DEFAULT_DEVICE,
         threads: int | None = None, place: Callable[..., Any] | None = None) -> Any:
    """Read a structure over `geometry`; None: over the scene in the file. place: `Instances.restore`, for files of instances.

    Raises InputError if the file is missing, damaged, not a structure, of another version, or over another mesh.
    """
    try:
        with (read_checked(path, MAGIC, "acceleration structure") as (header, body),
              np.errstate(over="ignore", invalid="ignore")):  # for values near the largest float32
            cls = ACCELERATORS.get(header["accel"])
            if cls is None:
                raise InputError(f"holds a structure {header['accel']!r}, which this version of wrt does not have")
            arrays, body = read_scene(header, body)
            units = Units(header["triangle"], header["box"])
            if SIZES in arrays:
                if geometry is not None or place is None:
                    raise InputError("must not be given: the file holds instances with their scene", argument="mesh")
                return place(*parts_of(cls, units, arrays, body, device, threads), device, threads)
            if geometry is None:
                if not arrays:
                    raise InputError("must be given: the file does not hold it", argument="mesh", hint="accel.save(path, mesh=True)")
                attributes = scene_of(arrays)
                geometry = mesh_of(attributes)
            require_same_mesh(header, geometry)
            built = read_arrays(cls, header, body)
            return cls.restore(built, geometry, attributes, device, threads, units=units)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise (error if error.path else error.at(path)) from error
        raise InputError(f"is not a structure of this version of wrt ({type(error).__name__}: {error})", path=path) from error


def read_scene(header: JsonObject, body: memoryview) -> tuple[dict[str, np.ndarray], memoryview]:
    """Return the arrays at the begin of the body, and the rest of the body. Raises InputError if they do not fit."""
    arrays, at = {}, 0
    for name, (kind, *shape) in dict(header.get("arrays", {})).items():
        dtype = np.dtype({SIZES: "<i8", OF_PARTS: "<f8"}.get(name) or KINDS[name][0])
        sound = kind == dtype.str and all(type(n) is int and n >= 0 for n in shape)  # a list times a number would be a long list
        if not sound or at + (size := dtype.itemsize * prod(shape)) > len(body):
            raise InputError(f"is damaged: array {name!r} does not fit")
        arrays[name] = np.frombuffer(body[at:at + size], dtype).reshape(shape).copy()
        at += size
    return arrays, body[at:]


def mesh_of(scene: FlatScene) -> Geometry:
    """Return the geometry of a scene without instances. Raises InputError for any other scene."""
    if not isinstance(scene.geometry, Geometry):
        raise InputError("is damaged: its scene has instances")
    return scene.geometry


def parts_of(cls: type[Any], units: Units, arrays: dict[str, np.ndarray], body: memoryview, device: str,
             threads: int | None) -> tuple[list[Any], InstancedGeometry, FlatScene]:
    """Return the structures of the lower level, the geometry and the scene from the arrays and the body of a file of instances."""
    sizes, stats, at = arrays.pop(SIZES), arrays.pop(OF_PARTS), 0
    scene = scene_of(arrays)
    types, bottoms, geometry = array_types(cls, units.triangle), [], scene.geometry
    if not isinstance(geometry, InstancedGeometry):
        raise InputError("is damaged: its scene has no instances")
    parts = geometry.parts
    if not (len(parts) == len(sizes) == len(stats) > 0 and sizes.shape[1:] == (len(types) + 1,) and (sizes >= 0).all()):
        raise InputError("is damaged: its instances do not fit")
    for part, row, numbers in zip(parts, sizes.tolist(), stats.tolist(), strict=True):
        header = {"triangle": units.triangle, "bytes": dict(zip(types, row, strict=False)), "order": row[-1] // 4}
        built = read_arrays(cls, header | dict(zip(STATS, numbers, strict=True)), body[at:at + sum(row)])
        at += sum(row)
        bottoms.append(cls.restore(built, part, None, device, threads, units=units))
    return bottoms, geometry, scene


def require_same_mesh(header: JsonObject, geometry: Geometry) -> None:
    """Raise InputError unless the structure was built over a geometry with the same arrays."""
    if header["geometry"] != geometry.checksum():
        raise InputError("was built over another mesh")


def read_arrays(cls: type[Any], header: JsonObject, body: memoryview) -> Built:
    types = array_types(cls, header["triangle"])
    arrays, at = {}, 0
    for name, dtype in types.items():
        size = header["bytes"][name]
        if not isinstance(size, int) or size < 0 or size % dtype.itemsize or at + size > len(body):
            raise InputError(f"is damaged: array {name!r} does not fit")
        arrays[name] = aligned(np.frombuffer(body[at:at + size], dtype.base).reshape((-1, *dtype.shape)))
        at += size
    if len(body) - at != 4 * header["order"]:
        raise InputError("is damaged: the order does not fit")
    order = np.frombuffer(body[at:], "<i4").astype(np.int32)
    nodes, leaves, depth, sah_cost = (header[name] for name in STATS)
    return Built(arrays, order, int(nodes), int(leaves), int(depth), float(sah_cost))


def check_order(order: np.ndarray, count: int, name: str) -> None:
    """Raise InputError unless `order` contains exactly the prim_ids 0 .. count - 1, each at least once."""
    found, within = np.zeros(count, bool), order.min(initial=0) >= 0 and order.max(initial=-1) < count
    if within:
        found[order] = True
    if not (within and found.all()):
        raise InputError(f"is not a {name} over this geometry: its prim_ids are not those of the geometry")


def check_binary(nodes: np.ndarray, n_primitives: int, max_depth: int) -> None:
    """Raise InputError unless Bvh2Node records are a tree with root 0 over `n_primitives`, no deeper than `max_depth`."""
    check_links(nodes, [(nodes["lo_" + side] == np.inf).all(axis=1) & (nodes["hi_" + side] == -np.inf).all(axis=1)
                        for side in ("0", "1")], n_primitives, max_depth)


def check_links(nodes: np.ndarray, empties: list[np.ndarray], n_primitives: int, max_depth: int) -> None:
    """Check the links of a binary tree, as check_binary does. empties: for each side, mask (N,) of the nodes without that child."""
    inner_of = []
    for side, empty in zip(("0", "1"), empties, strict=True):
        first, count = nodes["first_" + side].astype(np.int64), nodes["count_" + side].astype(np.int64)
        leaf = count > 0
        if (empty & ((first != 0) | leaf)).any():  # kernels read `first` and `count`, not the box
            raise InputError("is damaged: a child that does not exist has a link")
        if (count < 0).any() or (leaf & ((first < 0) | (first + count > n_primitives))).any():
            raise InputError("is damaged: a node leads out of the tree")
        inner_of.append(np.flatnonzero(~leaf & ~empty))
    check_tree(len(nodes), np.concatenate(inner_of), np.concatenate([nodes[f"first_{i}"][of] for i, of in enumerate(inner_of)]),
               max_depth - 1)


def check_tree(n: int, parent: np.ndarray, child: np.ndarray, max_depth: int) -> None:
    """Raise InputError unless n nodes form a tree with root 0 and at most max_depth levels below the root.

    parent, child: the two nodes of each link. A child must come after its parent, so that there are no cycles.
    """
    sound = n > 0 and bool((child > parent).all()) and np.array_equal(np.sort(child), np.arange(1, n))
    if sound:
        above, at = np.zeros(n, np.int64), np.arange(1, n)
        above[child] = parent
        for _ in range(max_depth):
            at = above[at]
            at = at[at > 0]
        sound = not len(at)
    if not sound:
        raise InputError(f"is damaged: its nodes do not form a tree with at most {max_depth} levels below the root")
