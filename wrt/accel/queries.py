"""Ray queries from Python: `wrt.build` makes a structure of a mesh or of a mesh file."""

from __future__ import annotations

import os
from typing import Any

from wrt import accel as structures
from wrt.core.checks import as_one, shown
from wrt.core.errors import InputError
from wrt.io.mesh_file import load_mesh
from wrt.scene.mesh import Mesh


def build(mesh: Mesh | structures.Geometry | str | os.PathLike[str], accel: str = "bvh", device: str = "cpu",
          threads: int | None = None, **options: Any) -> structures.Accelerator:
    """An acceleration structure over a mesh, ready for `closest_hit` and `any_hit`.

    mesh: a Mesh, a Geometry, or the path of a mesh file. accel: a name in ACCELERATORS. options: `triangle` and
    `box`, the intersection tests, and the structure's own (see its class). Raises InputError that names the argument.
    """
    return structures.build(_read(mesh), as_one(accel, str, "accel"), as_one(device, str, "device"), threads, **options)


def load_accel(path: str | os.PathLike[str], mesh: Mesh | structures.Geometry | str | os.PathLike[str], device: str = "cpu",
               threads: int | None = None) -> structures.Accelerator:
    """The structure that Accelerator.save or `wrt build` wrote to `path`, over the same mesh (or the path of its file).

    Raises InputError for a file that is missing, foreign, damaged, of another version or over another mesh.
    """
    return structures.load_accel(path, _read(mesh), as_one(device, str, "device"), threads)


def _read(mesh: Mesh | structures.Geometry | str | os.PathLike[str]) -> Mesh | structures.Geometry:
    if isinstance(mesh, str | os.PathLike):
        return load_mesh(mesh)
    if not isinstance(mesh, Mesh | structures.Geometry):
        raise InputError(f"mesh must be a Mesh or the path of a mesh file, got {shown(mesh)}")
    return mesh
