"""Acceleration structures: the registry. Everything that offers a choice of structure reads it from here."""

from __future__ import annotations

from inspect import signature
from typing import Any

from wrt.accel.base import Accelerator, AccelStats, Geometry, Hits, Structure
from wrt.accel.instances import InstancedGeometry, Instances
from wrt.accel.store import build_cached, load_accel
from wrt.accel.structures import STRUCTURES
from wrt.core.registry import Registry
from wrt.scene.mesh import Mesh

__all__ = ["ACCELERATORS", "AccelStats", "Accelerator", "Geometry", "Hits", "InstancedGeometry", "Instances", "Structure", "build",
           "build_cached", "load_accel", "tells_progress"]

ACCELERATORS: Registry[type[Accelerator]] = Registry("structure", STRUCTURES)


def tells_progress(accel: str) -> bool:
    """Whether the structure is so slow to build that it has the option `progress`: called with the fraction done, 0 to 1."""
    return accel in ACCELERATORS and "progress" in signature(ACCELERATORS[accel]._build).parameters


def build(mesh: Mesh | Geometry | InstancedGeometry, accel: str = "bvh", device: str = "cpu", threads: int | None = None,
          **options: Any) -> Accelerator:
    """A structure over a mesh. accel: a name in ACCELERATORS; options: `triangle` and `box`, the intersection tests (names in
    kernels.ray_triangle.RAY_TRIANGLE and kernels.ray_aabb.RAY_AABB), and the structure's own (see its class). Over instances, it
    is a tree over such structures, one for each mesh.

    Raises InputError for an unknown name or device.
    """
    ACCELERATORS.check(accel)
    if isinstance(mesh, InstancedGeometry):
        return Instances(ACCELERATORS[accel], mesh, device, threads, **options)
    geometry = Geometry.of(mesh) if isinstance(mesh, Mesh) else mesh
    return ACCELERATORS[accel](geometry, device=device, threads=threads, **options)
