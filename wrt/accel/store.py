"""Files of structures, which `wrt build` writes and `wrt.load_accel` reads.

A file has a checksum (wrt.core.checked_file). Its header describes the structure and the arrays, and has a hash of the geometry. The
types of the arrays come from the structure's class. Indices are checked before a ray follows them.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.built import Built
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Snapshot
from wrt.accel.structure import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.checked_file import read_checked, write_checked
from wrt.core.default_device import DEFAULT_DEVICE
from wrt.core.device import row_type
from wrt.core.errors import InputError
from wrt.core.threads import thread_count, verifying
from wrt.core.types import JsonObject, PathLike
from wrt.core.version import VERSION
from wrt.core.write_file import check_writable, replacing
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of

MAGIC = b"wrt acceleration structure 1\n"
STATS = ("nodes", "leaves", "depth", "sah_cost")


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


def save(snapshot: Snapshot, path: PathLike) -> None:
    """Write a structure to a file atomically. Raises InputError if the file cannot be written."""
    check_target(path)
    structure, built = snapshot.structure, snapshot.arrays.on_host()
    units = structure.units
    rows = {name: np.ascontiguousarray(np.atleast_1d(array)) for name, array in built.arrays.items()}
    types = array_types(structure.accel, units.triangle)
    body = [rows[name].astype(types[name].base, copy=False).tobytes() for name in types]
    body.append(built.order.astype("<i4").tobytes())
    header = {"accel": structure.accel.name, "triangle": units.triangle, "box": units.box, "wrt": VERSION,
              "geometry": snapshot.mesh.digest(), "bytes": {name: len(part) for name, part in zip(types, body, strict=False)},
              "order": len(built.order)} | {name: getattr(built, name) for name in STATS}
    with replacing(path) as file:
        write_checked(file, MAGIC, header, body)


def read(path: PathLike, geometry: Geometry, attributes: FlatScene | None = None, device: str = DEFAULT_DEVICE,
         threads: int | None = None) -> Any:
    """Read a structure over `geometry`.

    Raises InputError if the file is missing, damaged, not a structure, of another version, or over another mesh.
    """
    at_once = thread_count(threads)
    try:
        with read_checked(path, MAGIC, "acceleration structure", at_once) as (header, body):
            cls = ACCELERATORS.get(header["accel"])
            if cls is None:
                raise InputError(f"holds a structure {header['accel']!r}, which this version of wrt does not have")
            with verifying(partial(require_same_mesh, header, geometry), at_once):
                built = read_arrays(cls, header, body)
                with np.errstate(over="ignore", invalid="ignore"):  # for values near the largest float32
                    return cls.restore(built, geometry, attributes, device, threads, units=Units(header["triangle"], header["box"]))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise error.at(path) from error
        raise InputError(f"is not a structure of this version of wrt ({type(error).__name__}: {error})", path=path) from error


def require_same_mesh(header: JsonObject, geometry: Geometry) -> None:
    """Raise InputError unless the structure was built over a geometry with the same arrays."""
    if header["geometry"] != geometry.digest():
        raise InputError("was built over another mesh")


def read_arrays(cls: type[Any], header: JsonObject, body: memoryview) -> Built:
    types = array_types(cls, header["triangle"])
    arrays, at = {}, 0
    for name, dtype in types.items():
        size = header["bytes"][name]
        if not isinstance(size, int) or size < 0 or size % dtype.itemsize or at + size > len(body):
            raise InputError(f"is damaged: array {name!r} does not fit")
        arrays[name] = np.frombuffer(body[at:at + size], dtype.base).reshape((-1, *dtype.shape)).copy()
        at += size
    if len(body) - at != 4 * header["order"]:
        raise InputError("is damaged: the order does not fit")
    order = np.frombuffer(body[at:], "<i4").astype(np.int32)
    nodes, leaves, depth, sah_cost = (header[name] for name in STATS)
    return Built(arrays, order, int(nodes), int(leaves), int(depth), float(sah_cost))


def check_order(order: np.ndarray, count: int, name: str) -> None:
    """Raise InputError unless `order` contains exactly the prim_ids 0 .. count - 1, each at least once."""
    within = order.min(initial=0) >= 0 and order.max(initial=-1) < count
    if not (within and np.bincount(order, minlength=count).all()):
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
