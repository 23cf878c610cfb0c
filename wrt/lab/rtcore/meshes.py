"""`python -m wrt bench rtcore`: apply the model of the RT core to meshes, structures and kinds of rays."""

from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.bvh.binary import Bvh2
from wrt.accel.bvh.wide import CollapsedBvh
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, mesh_name, tabled
from wrt.lab.rtcore import RtCore as Plan
from wrt.lab.rtcore.model import LEGEND as LEGEND
from wrt.lab.rtcore.model import MODEL_COLUMNS, WARP, blocks, model_row, simt, trace_rays
from wrt.lab.rtcore.parameters import GPUS
from wrt.scene.mesh import Mesh


def bvhs() -> list[str]:
    """Return the names of the registry's BVHs, without aliases: all structures that are built from a binary tree."""
    return [name for name, cls in ACCELERATORS.items() if name == cls.name and issubclass(cls, Bvh2 | CollapsedBvh)]


def in_warps(accel: Accelerator, sets: dict[str, RaySet]) -> dict[str, RaySet]:
    """Sort the rays by warp and lane (index in the warp). A warp is a block of 8 x 4 pixels of the camera's picture.
    A shadow or diffuse ray has the warp and lane of the pixel whose camera ray hit its start point. Random rays keep their order."""
    primary = sets["primary"]
    side = round(len(primary) ** 0.5)
    warp, lane = blocks(side, side)
    place = warp * WARP + lane
    pixels = np.flatnonzero(accel.closest_hit(primary.origins, primary.directions).prim_id >= 0)
    started = pixels[np.arange(len(primary)) * len(pixels) // len(primary)] if len(pixels) else np.arange(len(primary))
    orders = {"primary": np.argsort(place), "random": np.arange(len(primary))}
    starts_at_hits = np.argsort(place[started], kind="stable")
    return {kind: rays.part(orders.get(kind, starts_at_hits)) for kind, rays in sets.items()}


TITLE = "The model of the RT core on meshes"
COLUMNS: Columns = {
    "structure": "{structure}", "rays": "{name}",
    "B/triangle": lambda row: f"{row.bytes / row.mesh_triangles:.0f}",
    **{head: column for head, column in MODEL_COLUMNS.items() if head != "rays"},
    "SIMT efficiency": "{simt_efficiency[as they come]:.0%}", "if sorted": "{simt_efficiency[sorted]:.0%}"}


def groups(plan: Plan) -> Groups:
    for path in plan.meshes:
        mesh = as_mesh(path)
        names = list(dict.fromkeys(plan.structures)) or bvhs()
        rays = cache(partial(mesh_rays, plan, mesh, names[0]))
        for name in names:
            yield partial(structure_rows, plan, mesh, name, rays)


def mesh_rays(plan: Plan, mesh: Mesh, structure: str) -> dict[str, RaySet]:
    accel = build(Geometry.of(mesh), structure)
    return in_warps(accel, ray_sets(accel, plan.rays, plan.seed, plan.inside))


def structure_rows(plan: Plan, mesh: Mesh, structure: str, rays_by_kind: Callable[[], dict[str, RaySet]]) -> list[Row]:
    geometry, out = Geometry.of(mesh), []
    accel = build(geometry, structure)
    for rays in (rays_by_kind()[kind] for kind in plan.kinds):
        work = trace_rays(accel, rays.kind, rays.origins, rays.directions, rays.t_max)  # shadow rays also search the closest hit
        efficiencies = simt(work.counters.counts, work.warp, rays.origins, rays.directions)
        out.append(model_row(work, GPUS[plan.gpu], efficiencies, mesh=mesh_name(mesh), mesh_triangles=len(geometry),
                             structure=structure, bytes=accel.stats.bytes))
    return out


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return a table for each mesh."""
    return [tabled(COLUMNS, group, f"{mesh}, {triangles} triangles")
            for (mesh, triangles), group in grouped(rows, "mesh", "mesh_triangles").items()]
