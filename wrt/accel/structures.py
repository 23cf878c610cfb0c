"""The table of acceleration structures: by name, where each one is. Each is imported when it is first asked for: the command line's
help must not wait for Warp."""

from __future__ import annotations

from typing import Any

from wrt.core.registry import Registry
from wrt.core.tuned import DEFAULT, choice_for

ACCELERATORS: Registry[type[Any]] = Registry("structure", {
    "bvh": "wrt.accel.bvh.wide:Bvh8",  # the default, unless the device is tuned (`chosen`)
    "bvh2": "wrt.accel.bvh.binary:Bvh2",
    "bvh4": "wrt.accel.bvh.wide:Bvh4",
    "bvh8": "wrt.accel.bvh.wide:Bvh8",
    "bvh2_sphere": "wrt.accel.bvh.volumes:Bvh2Sphere",
    "bvh2_kdop": "wrt.accel.bvh.volumes:Bvh2Kdop",
    "bvh8c": "wrt.accel.bvh.wide:Bvh8c",
    "kdtree": "wrt.accel.cells.kdtree:KdTree",
    "bsp": "wrt.accel.cells.bsp:Bsp",
    "brute_force": "wrt.accel.brute_force:BruteForce",
    "grid": "wrt.accel.cells.grid:Grid",
    "octree": "wrt.accel.cells.octree:Octree",
})


def meant(accel: str) -> str:
    """The name of what a name stands for: "bvh" is another name of the default."""
    return DEFAULT.accel if accel == "bvh" else accel


def chosen(accel: str, device: str) -> str:
    """As `meant`, where "bvh" is what the device is tuned for (wrt.tune). Raises InputError where there is no such device."""
    if accel != "bvh":
        return accel
    from wrt.core.device import start

    return choice_for(start(device)).accel


def stack_on(device: str, *, tuned: bool = True) -> str:
    """In kernels.traverse.stack.PLACES, where kernels for a device have their stacks: what the device is tuned for, or with
    tuned=False, which asks no device, the default. Raises InputError where there is no such device."""
    if device == "cpu":
        return "local"  # a CPU's threads have no other
    from wrt.core.device import start

    return (choice_for(start(device)) if tuned else DEFAULT).stack
