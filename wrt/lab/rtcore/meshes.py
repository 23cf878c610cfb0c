"""The model of the RT core on meshes: primary and diffuse rays through every structure, against what was published."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.bvh.binary import Bvh2
from wrt.accel.bvh.wide import WideBvh
from wrt.accel.geometry import Geometry
from wrt.accel.structures import ACCELERATORS
from wrt.core.html import Rows
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench import report
from wrt.lab.bench.rays import RAY_KINDS, RaySet, ray_sets
from wrt.lab.bench.report import Part, check_plan, gathered
from wrt.lab.rtcore.instructions import Software, box_unit, software, triangle_unit
from wrt.lab.rtcore.model import Work, simt, trace_rays
from wrt.lab.rtcore.parameters import GPUS
from wrt.lab.rtcore.report import COLUMNS, ModelRow, cells, model_row
from wrt.lab.rtcore.warps import WARP, blocks
from wrt.scene.mesh import Mesh


@dataclass(frozen=True)
class Plan:
    """meshes: Meshes or files; structures: names (none: all BVHs of the registry); kinds: of ray; rays: of each kind; gpu: a name
    in GPUS; inside: the camera is in a room. Raises InputError."""

    meshes: Sequence[Mesh | str | Path]
    structures: Sequence[str] = ()
    kinds: Sequence[str] = ("primary", "diffuse")
    rays: int = 2**16
    gpu: str = "rtx2080ti"
    seed: int = 0
    inside: bool = False

    def __post_init__(self) -> None:
        check_plan(self, {"structure": (self.structures, ACCELERATORS), "kind of ray": (self.kinds, RAY_KINDS),
                          "GPU": ([self.gpu], GPUS)}, rays=(1, 2**22))

    @property
    def names(self) -> list[str]:
        """Structures, each once."""
        return list(dict.fromkeys(self.structures)) or bvhs()


def bvhs() -> list[str]:
    """Every BVH of the registry by its own name: what is built from a binary tree."""
    return [name for name, cls in ACCELERATORS.items() if name == cls.name and issubclass(cls, Bvh2 | WideBvh)]


@dataclass(frozen=True)
class Row:
    """One mesh, structure and kind of ray; row: what the model says; bytes: of the structure."""

    mesh: str
    triangles: int
    structure: str
    bytes: int
    row: ModelRow

    def as_dict(self) -> dict[str, object]:
        return {**{name: getattr(self, name) for name in ("mesh", "triangles", "structure", "bytes")}, **self.row.as_dict()}


def in_warps(accel: Accelerator, sets: dict[str, RaySet]) -> dict[str, RaySet]:
    """The same rays in the order of warps and lanes: blocks of 8 x 4 pixels of the camera's picture; a ray that starts at a hit
    is where its pixel is, and rays between random points stay as they are."""
    primary = sets["primary"]
    side = round(len(primary) ** 0.5)
    warp, lane = blocks(side, side)
    place = warp * WARP + lane
    pixels = np.flatnonzero(accel.closest_hit(primary.origins, primary.directions).prim_id >= 0)
    started = pixels[np.arange(len(primary)) * len(pixels) // len(primary)] if len(pixels) else np.arange(len(primary))
    orders = {"primary": np.argsort(place), "random": np.arange(len(primary))}
    starts_at_hits = np.argsort(place[started], kind="stable")
    return {kind: rays.part(orders.get(kind, starts_at_hits)) for kind, rays in sets.items()}  # type: ignore[arg-type]


def work_of(accel: Accelerator, rays: RaySet) -> Work:
    """Closest hits, also of shadow rays: what any hit costs is a question of its own."""
    return trace_rays(accel, rays.kind, rays.origins, rays.directions, t_max=rays.t_max)


def run(plan: Plan, tell: Callable[[Row], None] = lambda row: None) -> Rows[Row]:
    """Every row in turn; `tell` gets each when it is there. Raises InputError for a mesh that cannot be read."""
    rows = (row for mesh in map(as_mesh, plan.meshes) for row in _mesh_rows(plan, mesh))
    return Rows(gathered(rows, tell), lambda rows: report.page(parts(rows)))


def _mesh_rows(plan: Plan, mesh: Mesh) -> Iterator[Row]:
    mesh_name, geometry = Path(mesh.name or "mesh").name, Geometry.of(mesh)
    sets = None
    for name in plan.names:
        accel = build(geometry, name)
        sets = sets or in_warps(accel, ray_sets(accel, plan.rays, plan.seed, plan.inside))
        for kind in plan.kinds:
            rays = sets[kind]
            work = work_of(accel, rays)
            efficiencies = simt(work.counters.counts, work.warp, rays.origins, rays.directions)
            yield Row(mesh_name, len(geometry), name, accel.stats.bytes, model_row(work, GPUS[plan.gpu], efficiencies))


MESH_COLUMNS = ("structure", "kind", "B/triangle", *COLUMNS[1:], "SIMT", "sorted")


def line(row: Row) -> str:
    """For the progress."""
    return "  ".join((row.mesh, row.structure, *cells(row.row)))


def parts(rows: Sequence[Row]) -> list[Part]:
    """A table for each mesh, with the structures' memory."""
    out = []
    for mesh in dict.fromkeys(row.mesh for row in rows):
        group = [row for row in rows if row.mesh == mesh]
        out.append(Part(f"{mesh}, {group[0].triangles} triangles", "", MESH_COLUMNS, [
            (row.structure, row.row.name, f"{row.bytes / row.triangles:.0f}", *cells(row.row)[1:],
             *(f"{row.row.simt[name]:.0%}" for name in ("as they come", "sorted"))) for row in group]))
    return out


def markdown(rows: Sequence[Row]) -> str:
    return report.markdown(parts(rows))


SOFTWARE_TITLE = """\
## In software, on a GTX 1080 Ti (28 SMs x 128 lanes, 1.582 GHz; 1.1 Grays/s claimed: 5154 instructions of a lane a ray)

Instructions of the default box test and triangle test alone, as they stand in the code for Turing."""


def in_software(rows: Sequence[Row]) -> list[Software]:
    """What the rays of these rows take in software; compiles the default units for Turing."""
    codes = box_unit("conservative"), triangle_unit("watertight")
    return [software(f"{row.mesh} {row.structure} {row.row.name}", row.row.boxes, row.row.triangles, row.row.simt["as they come"],
                     codes) for row in rows]
