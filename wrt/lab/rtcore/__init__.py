"""A model of the RT core: counters of ray costs, caches, warps, and rays a second."""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from typing import Any

from wrt.lab import STRUCTURES, Plan, option, the_kinds, the_meshes, the_seed

MODELLED = "GPU to model: rtx2080ti, rtx2060, arcb580 or rx9070"


def the_gpu() -> str:
    return option("rtx2080ti", MODELLED, of=("GPU", "wrt.lab.rtcore.parameters:GPUS"))


def from_inside() -> bool:
    return option(False, "Put the camera at the centre of the mesh's bounding box, as in a room")


@dataclass(frozen=True)
class RtCore(Plan):
    """Model the RT core on MESHES. Find what limits it, a range of rays a second, and which assumption changes that range most."""

    COMMAND, STUDY, QUICK = "bench rtcore", "wrt.lab.rtcore.meshes", {"rays": 1 << 12}
    meshes: Sequence[Any] = the_meshes(MISSING)
    structures: Sequence[str] = option((), "Structures to model  [default: every BVH]", of=STRUCTURES)
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**16, "Number of rays of each kind", (1, 2**22))
    gpu: str = the_gpu()
    seed: int = the_seed()
    inside: bool = from_inside()


@dataclass(frozen=True)
class WhatIf(Plan):
    """Change one part of the RT core's design, and compare costs. Both designs trace the same rays through MESH.

    STUDY names the part. "width": children, format and bounding volume of a node. "stack": entries of a short stack with restarts.
    "planes": bits of a box plane. "order": order of children, early stop. "sorting": order of the rays."""

    COMMAND, STUDY, QUICK = "whatif", "wrt.lab.rtcore.whatif", {"rays": 1 << 12}
    study: str = option(MISSING, of=("study", "wrt.lab.rtcore.whatif:STUDIES"))
    mesh: Any = the_meshes(MISSING)  # noqa: RUF009
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**15, "Number of rays of each kind", (1, 2**22))
    gpu: str = the_gpu()
    seed: int = the_seed()
    inside: bool = from_inside()
