"""`python -m wrt bench visibility`: compare rasterising with ray casting as the numbers of triangles and pixels grow."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.threads import thread_count
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.rasterizer import Rasterizer, RayCaster
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, tabled
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.bench.visibility_check import agreement
from wrt.lab.plans import Visibility as Plan
from wrt.scene.cameras import Camera
from wrt.scene.defaults import frame_camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

MIN_SIDE = 64  # pixels; the sweep over picture sizes starts here and doubles the side
SWEEP_TRIANGLES = 80_000  # about the triangles of the mesh in the sweep over picture sizes
MAX_BUILDS = 3
SPHERES, TERRAINS = range(3, 10), [22 * 2**k for k in range(8)]  # subdivisions of an icosphere; cells a side of a terrain
TITLE = "Rasterising against ray casting"
COLUMNS: Columns = {
    "surface": lambda row: Path(row.surface).name, "triangles": "{triangles}", "pixels": "{pixels}",
    "covered": lambda row: f"{row.agreement.covered / row.agreement.pixels:.1%}", "raster ms": lambda row: spread(row.raster, 1e3),
    "cast ms": lambda row: spread(row.cast, 1e3), "build ms": lambda row: f"{1e3 * row.build_median:.3g}",
    "cast / raster": lambda row: spread(np.array(row.cast) / np.array(row.raster)),
    "(cast + build) / raster": "{cast_and_build_over_raster:.3g}",
    "differ": "{agreement.differ}", "ties": "{agreement.ties}", "silhouettes": "{agreement.silhouettes}",
    "unexplained": "{agreement.unexplained}", "depth error": "{agreement.depth_error:.1e}",
    "error / bound": "{agreement.depth_share:.2f}"}
EXPONENTS: Columns = {"cost": "{cost}", "surface": lambda row: Path(row.surface).name, "n": "{sweep}",
                      "exponent": "{exponent:.3f} ± {error:.3f}", "last exponent": "{last:.3f}"}
LEGEND = """\
covered: pixels with a triangle. raster: time of a z-buffer over all triangles. cast: time of one ray a pixel; rays and structure are made
beforehand. build: time to build that structure. Medians of alternating runs, quartiles in brackets, ratios run by run. cast / raster:
above 1 rasterising is faster. (cast + build) / raster: the structure serves one picture only. differ: pixels whose prim_id differs, the
sum of the next three. ties: depths agree within their bound (common edges, coincident triangles). silhouettes: the rays' answer is exact
at a point within a rounding error, some 1e-4 pixels, of the centre. unexplained: must be 0. depth error: largest relative difference
where prim_id agrees. error / bound: its share of the derived bound (at most 1)."""


def row_of(raster: Sequence[float], cast: Sequence[float], build: Sequence[float], agreement: Row, **subject: object) -> Row:
    """Return the row of one mesh in one picture. raster, cast, build: seconds of each run; subject: further fields of the row."""
    ratio = [np.median((np.array(cast) + extra) / np.array(raster)) for extra in (0.0, np.median(build))]
    return Row(**subject, raster=list(raster), cast=list(cast), build=list(build), agreement=agreement,
               raster_median=float(np.median(raster)), cast_median=float(np.median(cast)), build_median=float(np.median(build)),
               cast_over_raster=float(ratio[0]), cast_and_build_over_raster=float(ratio[1]))


def terrain(cells: int) -> Mesh:
    """Return hills of a fixed shape over the square [-1, 1]^2 in x and z, with `2 * cells**2` triangles."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    y = sum(0.3 / k * np.sin(k * (2.1 * x + 0.7 * z) + k * k) * np.cos(k * (1.9 * z - 0.6 * x) + 2.0 * k) for k in (1, 2, 4, 8))
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = (i * (cells + 1) + j).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, name="terrain")


def subdivided(mesh: Mesh) -> Mesh:
    """Cut each triangle into four at the midpoints of its sides; the result has no vertex normals."""
    from trimesh.remesh import subdivide

    vertices, faces = subdivide(mesh.vertices.astype(np.float64), mesh.faces)
    return Mesh(vertices, faces, name=mesh.name)


@dataclass(frozen=True)
class Surface:
    """One shape as meshes of growing numbers of triangles, and its camera for square pictures."""

    name: str
    meshes: list[Mesh]
    camera: Camera


def surfaces(plan: Plan) -> Iterator[Surface]:
    """Yield each surface with its meshes of up to plan.max_triangles triangles. The coarsest mesh may have more."""
    for path in plan.meshes:
        mesh = as_mesh(path)
        finer = [replace(mesh, normals=None)]
        while 4 * len(finer[-1].faces) <= plan.max_triangles:
            finer.append(subdivided(finer[-1]))
        yield Surface(str(path), finer, framing(mesh))
    if not plan.meshes:
        balls = [icosphere(n) for n in SPHERES if n == SPHERES[0] or 20 * 4**n <= plan.max_triangles]
        yield Surface("sphere", balls, framing(balls[0]))
        hills = [terrain(n) for n in TERRAINS if n == TERRAINS[0] or 2 * n * n <= plan.max_triangles]
        yield Surface("terrain", hills, Camera.look_at((0.0, 0.9, 1.2), (0.0, -0.3, -0.2), fov_y=math.radians(60.0)))


def framing(mesh: Mesh) -> Camera:
    return frame_camera(Scene(objects=(Object(mesh, (Material(),)),)))


def groups(plan: Plan) -> Groups:
    sides = [MIN_SIDE * 2**k for k in range(int(math.log2(plan.max_size / MIN_SIDE)) + 1)]
    for surface in surfaces(plan):
        swept = min(surface.meshes, key=lambda mesh: abs(math.log(len(mesh.faces) / SWEEP_TRIANGLES)))
        for mesh in surface.meshes:
            made = cache(partial(ready, plan, surface, mesh))
            for sweep, side in [("triangles", plan.size), *(("pixels", side) for side in sides if mesh is swept)]:
                yield partial(picture_rows, made, sweep, side)


def picture_rows(made: Callable[[], Callable[[str, int], Row]], sweep: str, side: int) -> list[Row]:
    return [made()(sweep, side)]


def ready(plan: Plan, surface: Surface, mesh: Mesh) -> Callable[[str, int], Row]:
    """Prepare one mesh for both methods. Return a function (sweep, side) -> row that measures a picture of `side` x `side` pixels."""
    geometry = Geometry.of(mesh)
    rasterizer = Rasterizer(geometry, plan.device, plan.threads)
    caster = RayCaster(geometry, plan.accel, plan.device, plan.threads)
    again = [build(geometry, plan.accel, plan.device, plan.threads) for _ in range(min(plan.runs, MAX_BUILDS) - 1)]
    builds = [accel.stats.build_seconds for accel in (caster.accel, *again)]

    def measure(sweep: str, side: int) -> Row:
        size = (side, side)
        seconds = alternate({drawer: partial(drawer.draw, surface.camera, size) for drawer in (rasterizer, caster)}, plan.runs)
        checked = agreement(rasterizer, caster, geometry, surface.camera, size)
        return row_of(seconds[rasterizer].tolist(), seconds[caster].tolist(), builds, checked, sweep=sweep, surface=surface.name,
                      triangles=len(geometry.faces), pixels=side * side)

    return measure


def fit(n: Sequence[float], seconds: Sequence[float]) -> dict[str, float]:
    """Fit seconds ~ n^exponent by least squares on logarithms.
    error: standard deviation of the exponent (NaN for two points); last: exponent between the last two points."""
    from scipy.stats import linregress

    x, y = np.log(np.asarray(n, np.float64)), np.log(np.asarray(seconds, np.float64))
    if len(x) < 2:
        raise ValueError("an exponent needs two points")
    line = linregress(x, y)
    return {"exponent": float(line.slope), "error": float(line.stderr) if len(x) > 2 else math.nan,
            "last": float((y[-1] - y[-2]) / (x[-1] - x[-2]))}


def series(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Group rows by (sweep, surface); sort each group by the quantity that the sweep varies."""
    return {(sweep, surface): sorted(group, key=lambda row: getattr(row, sweep))
            for (sweep, surface), group in grouped(rows, "sweep", "surface").items()}


def fits(rows: Sequence[Row]) -> list[dict[str, object]]:
    """Return the exponents of rasterising and casting in each sweep with two or more points; over triangles, also those of building."""
    return [{"sweep": sweep, "surface": surface, "cost": cost,
             **fit([getattr(row, sweep) for row in group], [getattr(row, f"{cost}_median") for row in group])}
            for (sweep, surface), group in series(rows).items() if len(group) > 1
            for cost in (("raster", "cast", "build") if sweep == "triangles" else ("raster", "cast"))]


def machine(plan: Plan) -> str:
    threads = f"{thread_count(plan.threads)} threads used" if plan.device == "cpu" else ""
    return machine_line(threads, f"structure {plan.accel}, {plan.runs} runs", device=plan.device)


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    out = []
    for sweep in ("triangles", "pixels"):
        lines = [row for key, group in series(rows).items() if key[0] == sweep for row in group]
        out += [tabled(COLUMNS, lines, f"As {sweep} grow")] if lines else []
    found = [Row(**each) for each in fits(rows)]
    note = "seconds ~ n^exponent over the whole sweep (± one standard deviation). last exponent: between the last two points alone."
    return [*out, *([tabled(EXPONENTS, found, "Exponents", note)] if found else [])]


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {"exponents": fits(rows)}
