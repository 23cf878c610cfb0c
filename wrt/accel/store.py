"""Structures in files, to be built once: `wrt build`, `wrt.load_accel`, and a cache keyed by geometry and options.

A file is a checked one (wrt.core.checked_file), whose header says what is in it and over which geometry. Types come from the
structure's class, and indices are checked before a ray follows them.
"""

from __future__ import annotations

import contextlib
import json
import os
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.base import Accelerator, Built, Geometry
from wrt.core.checked_file import read_checked, write_checked
from wrt.core.errors import InputError
from wrt.core.version import VERSION
from wrt.core.write_file import check_writable, replacing
from wrt.scene.mesh import Mesh

MAGIC = b"wrt acceleration structure 1\n"
STATS = ("nodes", "leaves", "depth", "sah_cost")


def array_types(accel: type[Accelerator], triangle: str = "watertight") -> dict[str, np.dtype[Any]]:
    """What each array of Built.arrays holds, by the fields of the structure's struct."""
    from wrt.accel.base import Structure
    from wrt.kernels.traverse.common import Units

    struct = Structure(accel, Units(triangle)).struct()
    out = {}
    for name, field in struct._cls.vars.items():
        if name not in ("primitives", "recorder"):
            kind = field.type.dtype if isinstance(field.type, wp.array) else field.type
            out[name] = row_type(kind)
    return out


def row_type(kind: Any) -> np.dtype[Any]:
    """The NumPy type of one row of a Warp type: a struct, a vector or a number."""
    if hasattr(kind, "numpy_dtype"):
        return np.dtype(kind.numpy_dtype())
    scalar = wp.dtype_to_numpy(getattr(kind, "_wp_scalar_type_", kind))
    return np.dtype((scalar, getattr(kind, "_shape_", ())))


def check_target(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that saving to `path` would end in, before any work is done for it."""
    if Path(path).suffix.lower() != ".accel":
        raise InputError("a structure is written to a .accel file", path)
    check_writable(path)


def save(accel: Accelerator, path: str | os.PathLike[str]) -> None:
    """Write it whole or not at all. Raises InputError where the system refuses."""
    check_target(path)
    units, state = accel.structure.units, accel._state
    built = state.built
    rows = {name: np.ascontiguousarray(np.atleast_1d(array)) for name, array in built.arrays.items()}
    types = array_types(type(accel), units.triangle)
    body = [rows[name].astype(types[name].base, copy=False).tobytes() for name in types]
    body.append(built.order.astype("<i4").tobytes())
    header = {"accel": accel.name, "triangle": units.triangle, "box": units.box, "wrt": VERSION,
              "geometry": state.geometry.digest(), "bytes": {name: len(part) for name, part in zip(types, body, strict=False)},
              "order": len(built.order)} | {name: getattr(built, name) for name in STATS}
    with replacing(path) as temporary, open(temporary, "wb") as file:
        write_checked(file, MAGIC, header, body)


def load_accel(path: str | os.PathLike[str], mesh: Mesh | Geometry, device: str = "cpu", threads: int | None = None) -> Accelerator:
    """A structure from a file that `save` wrote, over the same mesh. Raises InputError for a file that is missing, foreign,
    damaged, of another version or over another mesh."""
    from wrt.accel import ACCELERATORS

    geometry = Geometry.of(mesh) if isinstance(mesh, Mesh) else mesh
    header, body = read_checked(path, MAGIC, "acceleration structure")
    try:
        cls = ACCELERATORS.get(header["accel"])
        if cls is None:
            raise InputError(f"holds a structure {header['accel']!r} that this version does not know")
        if header["geometry"] != geometry.digest():
            raise InputError("was built over another mesh")
        built = read_arrays(cls, header, body)
        with np.errstate(over="ignore", invalid="ignore"):  # numbers at the end of their range are looked at like all others
            return cls.restore(built, geometry, device, threads, triangle=header["triangle"], box=header["box"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise InputError(str(error), path) from error
        raise InputError(f"is no structure of this version ({type(error).__name__}: {error})", path) from error


def read_arrays(cls: type[Accelerator], header: dict[str, Any], body: memoryview) -> Built:
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


def build_cached(folder: str | os.PathLike[str], mesh: Mesh | Geometry, accel: str = "bvh", device: str = "cpu",
                 threads: int | None = None, **options: Any) -> Accelerator:
    """As wrt.build, but from `folder` where the same geometry was built with the same options before; else it is built, and left
    there. A damaged file there is written anew. Raises InputError as build does, and where the folder cannot be written."""
    from wrt.accel import build

    geometry = Geometry.of(mesh) if isinstance(mesh, Mesh) else mesh
    chosen = {name: value for name, value in options.items() if name != "progress"}
    key = json.dumps([geometry.digest(), accel, chosen, VERSION], sort_keys=True)
    path = Path(folder) / f"{sha256(key.encode()).hexdigest()[:32]}.accel"
    if path.is_file():
        with contextlib.suppress(InputError):  # a damaged one is replaced below
            return load_accel(path, geometry, device, threads)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", folder) from error
    check_target(path)
    structure = build(geometry, accel, device, threads, **options)
    structure.save(path)
    return structure


def check_binary(nodes: np.ndarray, n_primitives: int, max_depth: int) -> None:
    """Raise InputError unless these Bvh2Node records are a tree from node 0 over primitives 0 .. n - 1, no deeper than that."""
    check_links(nodes, [(nodes["lo_" + side] == np.inf).all(axis=1) & (nodes["hi_" + side] == -np.inf).all(axis=1)
                        for side in ("0", "1")], n_primitives, max_depth)


def check_links(nodes: np.ndarray, empties: list[np.ndarray], n_primitives: int, max_depth: int) -> None:
    """As check_binary, of any records with its links; empties: which of their two children do not exist, (N,) bool each."""
    n = len(nodes)
    parents, children = np.zeros(n, np.int64), []
    for side, empty in zip(("0", "1"), empties, strict=True):
        first, count = nodes["first_" + side].astype(np.int64), nodes["count_" + side].astype(np.int64)
        leaf = count > 0
        inner = ~leaf & ~empty
        # A child stands behind its parent: no walk returns to where it was.
        if (count < 0).any() or (leaf & ((first < 0) | (first + count > n_primitives))).any() or (
                inner & ((first <= np.arange(n)) | (first >= n))).any():
            raise InputError("is damaged: a node leads out of the tree")
        parents += np.bincount(first[inner], minlength=n)
        children.append(np.where(inner, first, 0))
    if n == 0 or parents[0] != 0 or (parents[1:] != 1).any():
        raise InputError("is damaged: its nodes are no tree")
    level, depth = np.zeros(1, np.int64), 0
    while len(level):
        depth += 1
        if depth > max_depth:
            raise InputError(f"is damaged: deeper than {max_depth}")
        level = np.concatenate([child[level] for child in children])
        level = level[level > 0]
