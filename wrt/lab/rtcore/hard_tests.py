"""`python -m wrt bench float64`: count how often the watertight triangle test needs float64 on a GPU.

Record the triangle tests of closest-hit queries through bvh2, then classify each test. Both steps run on the CPU."""

from functools import partial

import numpy as np
import warp as wp

from wrt.accel.base import Accelerator
from wrt.accel.scenes.build import build
from wrt.core.device import launch_on, upload
from wrt.io.mesh_file import as_mesh
from wrt.kernels.query import RayArrays
from wrt.kernels.structs import Primitive, size_of
from wrt.kernels.study.hard_tests import HARD, REFUSED, classify
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.bench.rays import RaySet, counters_of, ray_sets
from wrt.lab.bench.report import Columns, Groups, Row, mesh_name
from wrt.lab.rtcore import Float64 as Plan
from wrt.scene.mesh import Mesh

TITLE = "How often the triangle test needs float64 on a GPU"
COLUMNS: Columns = {
    "mesh": "{mesh}", "rays": "{kind}", "tests/ray": lambda row: f"{row.tests / row.rays:.2f}",
    "accepted in float32/ray": lambda row: f"{row.accepted / row.rays:.2f}", "hard tests": "{hard}",
    "hard tests/test": lambda row: f"{row.hard / max(row.tests, 1):.1e}", "hard rays/ray": lambda row: f"{row.hard_rays / row.rays:.1e}"}
LEGEND = """\
Closest hits through bvh2. accepted in float32: tests that float32 cannot refuse. Float-float arithmetic decides the bits of most of
them; the others are hard and take float64. hard rays: rays with at least one hard test."""


def groups(plan: Plan) -> Groups:
    return (partial(mesh_rows, plan, mesh) for mesh in map(as_mesh, plan.meshes))


def mesh_rows(plan: Plan, mesh: Mesh) -> list[Row]:
    accel = build(mesh, "bvh2")
    sets = ray_sets(accel, plan.rays, plan.seed, plan.inside)
    return [Row(mesh=mesh_name(mesh), kind=kind, **counted(accel, sets[kind])) for kind in plan.kinds]


def counted(accel: Accelerator, rays: RaySet) -> dict[str, int]:
    """Count the triangle tests of all rays, and the hard tests, which need float64. accel: a bvh2 over triangles, on the CPU."""
    counters = counters_of(accel, rays, trace=True)
    of_ray = np.repeat(np.arange(len(rays)), np.diff(counters.first))
    tests = counters.address >= int(PRIMITIVE_SPACE)
    of_ray, place = of_ray[tests], (counters.address[tests] - int(PRIMITIVE_SPACE)) // size_of(Primitive)
    answers = classified(accel, rays, of_ray, place)
    hard = answers == HARD
    return {"rays": len(rays), "tests": len(answers), "accepted": int((answers != REFUSED).sum()), "hard": int(hard.sum()),
            "hard_rays": len(np.unique(of_ray[hard]))}


def classified(accel: Accelerator, rays: RaySet, of_ray: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return REFUSED, SURE or HARD (needs float64) for each test, (N,): of ray of_ray[i] with primitive record place[i] of `accel`."""
    arrays = RayArrays()
    arrays.origin, arrays.direction = (upload(rows, wp.vec3, accel.device) for rows in (rays.origins, rays.directions))
    arrays.t_min, arrays.t_max = wp.zeros(len(rays), device=accel.device), upload(rays.t_max, wp.float32, accel.device)
    out = wp.zeros(len(of_ray), dtype=wp.int32, device=accel.device)
    indices = [upload(each, wp.int32, accel.device) for each in (of_ray, place)]
    launch_on(accel.device, classify, len(of_ray), accel.data.primitives, arrays, *indices, out)
    return out.numpy()

