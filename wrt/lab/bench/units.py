"""`python -m wrt bench units`: compare the time of the default intersection tests with that of the other tests."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.io.mesh_file import as_mesh
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Groups, Row, machine_line, mesh_name
from wrt.lab.bench.timing import alternate, quartiles, shown
from wrt.lab.bench.visibility import terrain
from wrt.lab.hard_cases.common import soup
from wrt.lab.plans import Units as Plan
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, teapot

ALONE = 64  # triangles without a structure, to time the triangle test alone
TITLE = "Time of the default intersection tests over that of the others"
COLUMNS: Columns = {"mesh": "{mesh}", "triangles": "{triangles}", "rays": "{rays}", "test": "{unit}",
                    "Mray/s": lambda row: shown(row.mrays), "default / test": lambda row: shown(row.price),
                    "lowest": "{extremes[0]:.3g}", "highest": "{extremes[1]:.3g}", "B/triangle": "{bytes_per_triangle:.0f}"}
LEGEND = """\
One thread, alternating runs. The default is the watertight triangle test in conservative boxes. default / test: time of the default over
the time of the row's test, run by run, as median [quartiles], lowest and highest. Above 1 the default is slower."""


def groups(plan: Plan) -> Groups:
    """Yield timings of triangle tests with the default box test, box tests with the default triangle test, and triangle tests alone."""
    triangles = [{"triangle": name} for name in RAY_TRIANGLE]
    boxes = [{"box": name} for name in list(RAY_AABB)[1:]]
    for mesh in map(as_mesh, plan.meshes or [icosphere(6), terrain(300), teapot(64)]):
        for kind in ("primary", "random"):
            yield partial(mesh_rows, plan, mesh, kind, triangles + boxes)
    rng = np.random.default_rng(plan.seed)
    few = soup(rng.uniform(-1.0, 1.0, (ALONE, 1, 3)) + 0.3 * rng.normal(size=(ALONE, 3, 3)))
    rays = ray_sets(build(few, "brute_force"), plan.rays, plan.seed)["random"]
    yield partial(priced, plan, f"{ALONE} triangles, no structure", few, rays, "brute_force", triangles)


def mesh_rows(plan: Plan, mesh: Mesh, kind: str, units: Sequence[dict[str, Any]]) -> list[Row]:
    geometry = Geometry.of(mesh)
    rays = ray_sets(build(geometry, plan.accel), plan.rays, plan.seed)[kind]
    return priced(plan, mesh_name(mesh), geometry, rays, plan.accel, units)


def priced(plan: Plan, mesh: str, geometry: Geometry, rays: RaySet, accel: str, units: Sequence[dict[str, Any]]) -> list[Row]:
    """Return the timings of all `units` (options of `build`), measured alternately. The first of `units` is the default."""
    built = {" ".join(f"{value}{' boxes' if key == 'box' else ''}" for key, value in options.items()):
             build(geometry, accel, threads=1, **options) for options in units}
    seconds = alternate({unit: partial(structure.closest_hit, rays.origins, rays.directions, threads=1)
                         for unit, structure in built.items()}, plan.runs)
    default, out = next(iter(seconds.values())), []
    for unit, taken in seconds.items():
        price = default / taken
        out.append(Row(mesh=mesh, triangles=len(geometry), rays=rays.kind, unit=unit, mrays=quartiles(len(rays) / taken / 1e6),
                       price=quartiles(price), extremes=(float(price.min()), float(price.max())),
                       bytes_per_triangle=built[unit].stats.bytes / len(geometry)))
    return out


def machine(plan: Plan) -> str:
    return machine_line("one thread used", f"structure {plan.accel}, {plan.runs} runs")
