"""Files of structures over one mesh, which `wrt build` writes and `wrt.load_accel` reads: .npz archives with the suffix .accel.

An array `header` is the version, the class and the statistics as JSON; `order` and the arrays of the structure's Warp struct follow.
The arrays "mesh.vertices" ... hold the mesh; without them, the header has a checksum of it. Nothing is unpickled, and all indices are
checked before a ray follows them.
"""

import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene, flat_scene_of
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built, Snapshot, Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_one
from wrt.core.device import empty_aligned, row_type
from wrt.core.errors import InputError, at
from wrt.core.files import check_writable, read_file, replacing
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import PathLike, WarpType
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of

VERSION = 4
STATS = ("nodes", "leaves", "depth", "sah_cost")
MESH = "mesh."
# Type and shape of a row of each array of a mesh with its attributes; all but the last three must be there.
MESH_TYPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "vertices": ("<f4", (3,)), "faces": ("<i4", (3,)), "spheres": ("<f4", (4,)), "uvs": ("<f4", (2,)), "prim_material": ("<i4", ()),
    "normals": ("<f4", (3,)), "objects": ("<i8", ()), "origin": ("<f8", ())}
# The head of an array. NumPy parses it as Python, and two threads that parse at once make CPython 3.11 raise SystemError.
NPY, MAGIC = struct.Struct("<8sH"), b"\x93NUMPY\x01\x00"
HEADER = re.compile(r"\{'descr': '([<|][A-Za-z][0-9]{1,9})', 'fortran_order': False, 'shape': \(([0-9, ]*)\), \}\s*")


def array_types(accel: type[Any], units: Units) -> dict[str, WarpType]:
    """Return the type of each entry of Built.arrays, by its name."""
    kinds = fields_of(Structure(accel, units._replace(instances=False)).struct())
    return {name: kind for name, kind in kinds.items() if name not in ("primitives", "recorder")}


def check_target(path: PathLike) -> None:
    """Raise InputError if a structure cannot be written to `path`."""
    if Path(path).suffix.lower() != ".accel":
        raise InputError("the file of a structure must have the suffix .accel", path=path)
    check_writable(path)


def save(snapshot: Snapshot, path: PathLike, mesh: bool = False) -> None:
    """Write a structure over one mesh to a file atomically; mesh: with the mesh. Raises InputError if the file cannot be written."""
    check_target(path)
    (accel, units), built, geometry = snapshot.structure, snapshot.arrays.on_host(), snapshot.mesh
    header = {"version": VERSION, "accel": accel.name, "triangle": units.triangle, "box": units.box, "geometry": geometry.checksum(),
              "stats": [getattr(built, name) for name in STATS]}
    arrays: dict[str, Any] = {"header": np.array(json.dumps(header)), "order": built.order}
    for name, kind in array_types(accel, units).items():
        row = row_type(kind.dtype if isinstance(kind, wp.array) else kind)
        arrays[name] = np.ascontiguousarray(built.arrays[name]).astype(row.base, copy=False).reshape(-1).view(np.uint8)
    if as_one(mesh, bool, "mesh"):
        scene = snapshot.attributes or flat_scene_of(geometry)
        for name, (dtype, shape) in MESH_TYPES.items():
            array = getattr(geometry if name in ("vertices", "spheres", "origin") else scene, name)
            if array is not None:
                arrays[MESH + name] = np.ascontiguousarray(array, dtype).reshape(-1, *shape)
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
         threads: int | None = None) -> Any:
    """Read a structure over `geometry`; None: over the mesh in the file.

    Raises InputError if the file is missing, damaged, not a structure, of another version, or over another mesh.
    """
    with at(path=path):
        read_file(path, 1)  # refuses pipes and devices
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # for values near the largest float32
                return _restored(read_arrays(path), geometry, attributes, device, threads)
        except (InputError, MemoryError):
            raise
        except Exception as error:  # zipfile, zlib, NumPy and json raise many kinds
            raise InputError(f"is damaged, or not a structure of this version of wrt ({type(error).__name__}: {error})") from error


def _restored(arrays: dict[str, np.ndarray], geometry: Geometry | None, attributes: FlatScene | None, device: str,
              threads: int | None) -> Any:
    """Make the structure of a file's arrays, as `read` does."""
    header = json.loads(str(arrays["header"]))
    if header["version"] != VERSION:
        raise ValueError("another version")
    cls, units, order = ACCELERATORS.get(header["accel"]), Units(header["triangle"], header["box"]), arrays["order"]
    if cls is None:
        raise InputError(f"holds a structure {header['accel']!r}, which this version of wrt does not have")
    if order.dtype != np.int32 or order.ndim != 1:
        raise ValueError("an order of another type")
    rows = {}
    for name, kind in array_types(cls, units).items():
        row = row_type(kind.dtype if isinstance(kind, wp.array) else kind)
        rows[name] = arrays[name].view(row.base).reshape((-1, *row.shape) if isinstance(kind, wp.array) else row.shape)
    nodes, leaves, depth, sah_cost = header["stats"]
    built = Built(rows, order, int(nodes), int(leaves), int(depth), float(sah_cost))
    if geometry is None:
        attributes = _mesh_of(arrays)
        assert isinstance(attributes.geometry, Geometry)
        geometry = attributes.geometry
    if header["geometry"] != geometry.checksum():
        raise InputError("was built over another mesh")
    return cls.restore(built, geometry, attributes, device, threads, units=units)


def _mesh_of(arrays: Mapping[str, np.ndarray]) -> FlatScene:
    """Make the mesh of a file with its attributes. Raises InputError for indices and lengths that do not fit."""
    if MESH + "vertices" not in arrays:
        raise InputError("must be given: the file does not hold it", argument="mesh", hint="accel.save(path, mesh=True)")
    a = {name: arrays[MESH + name] for name in MESH_TYPES if MESH + name in arrays}
    if any(array.dtype != (kind := MESH_TYPES[name])[0] or array.shape[1:] != kind[1] for name, array in a.items()):
        raise ValueError("an array of another type")
    geometry, n, origin = Geometry(a["vertices"], a["faces"], a["spheres"], a.get("origin")), len(a["vertices"]), a.get("origin")
    first = np.append(a.get("objects", np.zeros(1, np.int64)), len(geometry))
    if not (((a["faces"] >= 0) & (a["faces"] < n)).all() and len(a["uvs"]) in (0, n) and len(a.get("normals", a["vertices"])) == n
            and (origin is None or (origin.shape == (3,) and np.isfinite(origin).all())) and (a["prim_material"] >= 0).all()
            and ("objects" not in a or len(a["prim_material"]) == len(geometry)) and first[0] == 0 and (np.diff(first) >= 0).all()):
        raise InputError("is damaged: an array of its mesh has a wrong length, or leads beyond another")
    return FlatScene(geometry, geometry.vertices, geometry.faces, a.get("normals"), a["uvs"], a["prim_material"], objects=a.get("objects"))


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
        inner = count == 0
        if (empty & ((first != 0) | ~inner)).any():  # kernels read `first` and `count`, not the box
            raise InputError("is damaged: a child that does not exist has a link")
        check_ranges(first[~inner], count[~inner], n_primitives)
        inner_of.append(np.flatnonzero(inner & ~empty))
    check_tree(len(nodes), np.concatenate(inner_of), np.concatenate([nodes[f"first_{i}"][of] for i, of in enumerate(inner_of)]),
               max_depth - 1)


def check_ranges(first: np.ndarray, count: np.ndarray, n: int) -> None:
    """Raise InputError unless the records first .. first + count - 1 of each leaf are among n records."""
    first, count = first.astype(np.float64), count.astype(np.float64)
    if not ((first >= 0.0) & (count >= 0.0) & (first + count <= n)).all():
        raise InputError("is damaged: a leaf leads out of the primitives")


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
