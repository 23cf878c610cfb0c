"""From a mesh, or the path of its file, to an acceleration structure."""

from __future__ import annotations

import contextlib
import json
import os
from hashlib import sha256
from inspect import signature
from pathlib import Path
from typing import Any

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.instances import InstancedGeometry, Instances
from wrt.accel.store import check_target, read
from wrt.accel.structures import ACCELERATORS, chosen
from wrt.core.checks import as_one
from wrt.core.errors import InputError
from wrt.core.version import VERSION
from wrt.io.mesh_file import mesh_of
from wrt.scene.mesh import Mesh


def reports_progress(accel: str) -> bool:
    """Whether the structure is so slow to build that it has the option `progress`: called with the fraction done, 0 to 1."""
    return accel in ACCELERATORS and "progress" in signature(ACCELERATORS[accel]._build).parameters


def build(mesh: Mesh | Geometry | InstancedGeometry | str | os.PathLike[str], accel: str = "bvh", device: str = "cpu",
          threads: int | None = None, **options: Any) -> Accelerator:
    """An acceleration structure over a mesh, ready for `closest_hit` and `any_hit`.

    mesh: a Mesh, a Geometry, or the path of a mesh file; over an InstancedGeometry it is a tree over structures of
    the kind, one for each mesh. accel: a name in ACCELERATORS; "bvh" is bvh8, or what `wrt.tune` has kept for the device.
    options: `triangle` and `box`, the intersection tests (names in wrt.kernels.units.triangle.RAY_TRIANGLE and
    wrt.kernels.units.box.RAY_AABB), and the structure's own (see its class). Raises
    InputError that names the argument.
    """
    ACCELERATORS.check(as_one(accel, str, "accel"))
    kind = ACCELERATORS[chosen(accel, as_one(device, str, "device"))]
    if isinstance(mesh, InstancedGeometry):
        return Instances(kind, mesh, device, threads, **options)
    structure: Accelerator = kind(geometry_of(mesh), device=device, threads=threads, **options)
    return structure


def load_accel(path: str | os.PathLike[str], mesh: Mesh | Geometry | str | os.PathLike[str], device: str = "cpu",
               threads: int | None = None) -> Accelerator:
    """The structure that Accelerator.save or `wrt build` wrote to `path`, over the same mesh (or the path of its file).

    Raises InputError for a file that is missing, foreign, damaged, of another version or over another mesh.
    """
    return read(path, geometry_of(mesh), as_one(device, str, "device"), threads)


def build_cached(folder: str | os.PathLike[str], mesh: Mesh | Geometry, accel: str = "bvh", device: str = "cpu",
                 threads: int | None = None, **options: Any) -> Accelerator:
    """As `build`, but from `folder` where the same geometry was built with the same options before; else it is built, and left
    there. A damaged file there is written anew. Raises InputError as `build` does, and where the folder cannot be written."""
    geometry, accel = geometry_of(mesh), chosen(accel, device)
    given = {name: value for name, value in options.items() if name != "progress"}
    key = json.dumps([geometry.digest(), accel, given, VERSION], sort_keys=True)
    path = Path(folder) / f"{sha256(key.encode()).hexdigest()[:32]}.accel"
    if path.is_file():
        with contextlib.suppress(InputError):  # a damaged one is replaced below
            return read(path, geometry, device, threads)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", folder) from error
    check_target(path)
    structure = build(geometry, accel, device, threads, **options)
    structure.save(path)
    return structure


def geometry_of(mesh: Mesh | Geometry | str | os.PathLike[str]) -> Geometry:
    """Raises InputError for what is no mesh, and for a file that cannot be read."""
    return mesh if isinstance(mesh, Geometry) else Geometry.of(mesh_of(mesh))
