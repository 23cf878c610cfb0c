"""Files of structures, which `wrt build` writes and `wrt.load_accel` reads: archives of NumPy arrays (.npz) with the suffix .accel.

An array `header` is the version, the class and the statistics as JSON. The arrays "0.nodes", "0.order" ... are those of the first
structure; files of instances have several. The scene's arrays (wrt.accel.scene_arrays) are "scene.vertices" ...; without them, the
header has a checksum of the geometry. Nothing is unpickled, and all indices are checked before a ray follows them.
"""

import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.scene_arrays import KINDS, arrays_of, scene_of
from wrt.accel.snapshot import Built, Snapshot, Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_one
from wrt.core.device import empty_aligned, row_type
from wrt.core.errors import InputError, at
from wrt.core.files import check_writable, read_file, replacing
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import PathLike
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of

VERSION = 3
STATS = ("nodes", "leaves", "depth", "sah_cost")
SCENE = "scene."
# The head of an array. NumPy parses it as Python, and two threads that parse at once make CPython 3.11 raise SystemError.
NPY, MAGIC = struct.Struct("<8sH"), b"\x93NUMPY\x01\x00"
HEADER = re.compile(r"\{'descr': '([<|][A-Za-z][0-9]{1,9})', 'fortran_order': False, 'shape': \(([0-9, ]*)\), \}\s*")


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
    _write(snapshot, [snapshot.arrays.on_host()], path, as_one(mesh, bool, "mesh"), geometry=snapshot.mesh.checksum())


def save_instances(snapshot: Snapshot, bottoms: Sequence[Built], path: PathLike) -> None:
    """Write a structure over instances to a file atomically, with its scene; bottoms: of the structures of the lower level."""
    _write(snapshot, bottoms, path, True)


def _write(snapshot: Snapshot, parts: Sequence[Built], path: PathLike, scene: bool, **more: object) -> None:
    check_target(path)
    structure = snapshot.structure
    header = {"version": VERSION, "accel": structure.accel.name, "triangle": structure.units.triangle, "box": structure.units.box,
              "instances": structure.units.instances, "parts": [[getattr(part, name) for name in STATS] for part in parts], **more}
    arrays: dict[str, Any] = {"header": np.array(json.dumps(header))}
    arrays |= {f"{SCENE}{name}": array for name, array in arrays_of(snapshot).items()} if scene else {}
    for i, part in enumerate(parts):
        for name, kind in array_types(structure.accel, structure.units.triangle).items():
            rows = np.ascontiguousarray(np.atleast_1d(part.arrays[name])).astype(kind.base, copy=False)
            arrays[f"{i}.{name}"] = rows.reshape(-1).view(np.uint8)
        arrays[f"{i}.order"] = part.order
    with replacing(path) as file:
        np.savez(file, **arrays)


def read_arrays(path: PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of an uncompressed .npz file. Each begins at a cache line, and is read at once: np.load takes twice as long.

    Raises ValueError or an error of zipfile for anything else."""
    arrays = {}
    with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
        for info in archive.infolist():
            file.seek(info.header_offset + 26)
            begin = info.header_offset + 30 + sum(struct.unpack("<HH", file.read(4)))  # of the name and of the extra field
            if info.compress_type != zipfile.ZIP_STORED or begin + info.file_size > os.fstat(file.fileno()).st_size:
                raise ValueError(f"{info.filename} is compressed or truncated")
            data = empty_aligned(info.file_size, np.uint8)
            file.seek(begin)
            file.readinto(data.data)
            if zlib.crc32(data.data) != info.CRC:
                raise ValueError(f"the checksum of {info.filename} does not match")
            magic, size = NPY.unpack_from(data.data)
            head = HEADER.fullmatch(data[NPY.size : NPY.size + size].tobytes().decode("latin-1"))
            if magic != MAGIC or head is None:
                raise ValueError(f"{info.filename} is no array of numbers or text, by rows, in version 1.0 of the format")
            shape = tuple(map(int, head[2].replace(",", " ").split()))
            arrays[info.filename.removesuffix(".npy")] = data[NPY.size + size:].view(head[1]).reshape(shape)
    return arrays


def read(path: PathLike, geometry: Geometry | None, attributes: FlatScene | None = None, device: str = DEFAULT_DEVICE,
         threads: int | None = None, place: Callable[..., Any] | None = None) -> Any:
    """Read a structure over `geometry`; None: over the scene in the file. place: `Instances.restore`, for files of instances.

    Raises InputError if the file is missing, damaged, not a structure, of another version, or over another mesh.
    """
    with at(path=path):
        read_file(path, 1)  # refuses pipes and devices
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # for values near the largest float32
                return _restored(read_arrays(path), geometry, attributes, device, threads, place)
        except InputError:
            raise
        except Exception as error:  # zipfile, zlib, NumPy and json raise many kinds
            if isinstance(error, MemoryError):
                raise
            raise InputError(f"is damaged, or not a structure of this version of wrt ({type(error).__name__}: {error})") from error


def _restored(arrays: dict[str, np.ndarray], geometry: Geometry | None, attributes: FlatScene | None, device: str,
              threads: int | None, place: Callable[..., Any] | None) -> Any:
    """Make the structure of a file's arrays, as `read` does."""
    header = json.loads(str(arrays.pop("header")))
    if header["version"] != VERSION:
        raise ValueError("another version")
    cls, units = ACCELERATORS.get(header["accel"]), Units(header["triangle"], header["box"])
    if cls is None:
        raise InputError(f"holds a structure {header['accel']!r}, which this version of wrt does not have")
    parts = [_part(cls, units, arrays, i, *stats) for i, stats in enumerate(header["parts"])]
    in_file = {name.removeprefix(SCENE): array for name, array in arrays.items() if name.startswith(SCENE)}
    if any(array.dtype != KINDS[name][0] for name, array in in_file.items()):
        raise ValueError("an array of another type")
    if header["instances"] and (geometry is not None or place is None):
        raise InputError("must not be given: the file holds instances with their scene", argument="mesh")
    if geometry is None:
        if not in_file:
            raise InputError("must be given: the file does not hold it", argument="mesh", hint="accel.save(path, mesh=True)")
        attributes = scene_of(in_file)
        if isinstance(attributes.geometry, InstancedGeometry) != bool(header["instances"]):
            raise ValueError("a scene of another kind")
        if isinstance(attributes.geometry, InstancedGeometry):
            assert place is not None
            bottoms = [cls.restore(built, part, None, device, threads, units=units)
                       for built, part in zip(parts, attributes.geometry.parts, strict=True)]
            return place(bottoms, attributes.geometry, attributes, device, threads)
        geometry = attributes.geometry
    if header["geometry"] != geometry.checksum():
        raise InputError("was built over another mesh")
    (built,) = parts
    return cls.restore(built, geometry, attributes, device, threads, units=units)


def _part(cls: type[Any], units: Units, arrays: dict[str, np.ndarray], i: int, nodes: int, leaves: int, depth: int,
          sah_cost: float) -> Built:
    """Return the arrays and statistics of structure i of a file."""
    rows = {name: arrays[f"{i}.{name}"].view(kind.base).reshape((-1, *kind.shape))
            for name, kind in array_types(cls, units.triangle).items()}
    order = arrays[f"{i}.order"]
    if order.dtype != np.int32 or order.ndim != 1:
        raise ValueError("an order of another type")
    return Built(rows, order, int(nodes), int(leaves), int(depth), float(sah_cost))


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
