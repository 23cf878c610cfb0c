"""`python -m wrt bench visibility`: the two classes of visibility, measured. Rasterising goes over triangles and then their
pixels, ray casting over pixels and then, down a tree, their triangle: what does each cost as triangles and pixels grow?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.accel.structures import ACCELERATORS
from wrt.core.address_space import require_scipy
from wrt.core.device import start, thread_count
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.rasterizer import Rasterizer, RayCaster
from wrt.lab.bench.report import Part, check_plan, gathered, markdown, write
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.bench.visibility_check import Agreement, agreement
from wrt.scene.cameras import Camera
from wrt.scene.defaults import frame_camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

MIN_SIDE = 64  # pixels; the sweep over pixels doubles it
SWEEP_TRIANGLES = 80_000  # about as many in the sweep over pixels
MAX_BUILDS = 3
SPHERES, TERRAINS = range(3, 10), [22 * 2**k for k in range(8)]  # subdivisions, cells a side
REPORT = "visibility.md"
PLOTS = {"visibility-triangles.png": "triangles", "visibility-pixels.png": "pixels"}
COLUMNS = ("surface", "triangles", "pixels", "covered", "raster ms", "cast ms", "build ms", "cast / raster", "with build", "differ",
           "ties", "silhouettes", "unexplained", "depth error", "of bound")
LEGEND = """\
covered: pixels with a triangle. raster: a z-buffer, all triangles; cast: one ray a pixel through a structure that is there;
build: of that structure. Medians of alternating runs, ratios taken run by run; in brackets the middle half of the runs. cast /
raster above 1: rasterising is cheaper; with build: as if the structure were built for this one picture. differ: pixels with
another prim_id, of which ties (depths agree within their bound: common edges, coincident triangles), silhouettes (the rays'
answer is the exact one within a rounding error, some 1e-4 pixels, of the centre), and unexplained (must be 0). depth error: the
largest relative one where prim_id agrees, and its share of the bound derived for it (must not be above 1)."""


@dataclass(frozen=True)
class Plan:
    """What to measure: meshes (files; none: the sphere and the terrain), pictures of size x size pixels for the sweep over
    triangles and up to max_size for that over pixels, runs of each kind, and on what. Raises InputError."""

    meshes: Sequence[str | Path] = ()
    size: int = 512
    max_size: int = 1024
    max_triangles: int = 1_500_000
    runs: int = 7
    accel: str = "bvh"
    device: str = "cpu"
    threads: int | None = None

    def __post_init__(self) -> None:
        check_plan(self, {"structure": ([self.accel], ACCELERATORS)}, size=(1, 16384), max_size=(MIN_SIDE, 16384),
                   max_triangles=(1, 2**30), runs=(1, 1000))
        thread_count(self.threads)
        start(self.device)


@dataclass(frozen=True)
class Row:
    """One mesh in one picture. raster, cast: seconds of each run, run i of the one next to run i of the other; build:
    seconds of each build of the structure, which casting needs first."""

    sweep: str
    surface: str
    triangles: int
    pixels: int
    raster: tuple[float, ...]
    cast: tuple[float, ...]
    build: tuple[float, ...]
    agreement: Agreement

    def ratios(self, with_build: bool) -> np.ndarray:
        """Seconds of casting over seconds of rasterising, run by run."""
        extra = float(np.median(self.build)) if with_build else 0.0
        return (np.array(self.cast) + extra) / np.array(self.raster)

    def as_dict(self) -> dict[str, Any]:
        medians = {f"{name}_median": float(np.median(getattr(self, name))) for name in ("raster", "cast", "build")}
        return asdict(self) | medians | {
            "cast_over_raster": float(np.median(self.ratios(False))),
            "cast_and_build_over_raster": float(np.median(self.ratios(True)))}


@dataclass(frozen=True)
class Fit:
    """seconds ~ n^exponent, by least squares on logarithms; error: of the exponent, one standard deviation (NaN for two
    points); last: the exponent between the two largest n."""

    exponent: float
    error: float
    last: float


def terrain(cells: int) -> Mesh:
    """2 cells^2 triangles over the square from -1 to 1, hills of a fixed form: finer cells change little of the picture."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    y = sum(0.3 / k * np.sin(k * (2.1 * x + 0.7 * z) + k * k) * np.cos(k * (1.9 * z - 0.6 * x) + 2.0 * k) for k in (1, 2, 4, 8))
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = (i * (cells + 1) + j).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, name="terrain")


def subdivided(mesh: Mesh) -> Mesh:
    """Each triangle cut into four at the middles of its sides: the same surface, but for rounding; flat-shaded."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    points = np.concatenate([mesh.vertices, mesh.vertices[ends].astype(np.float64).mean(axis=1)])
    (a, b, c), (ab, bc, ca) = mesh.faces.T, middle.reshape(-1, 3).T + len(mesh.vertices)
    faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Mesh(points, faces, name=mesh.name)


@dataclass(frozen=True)
class Surface:
    """One shape, ever finer, and the camera that sees each alike (square pictures)."""

    name: str
    meshes: list[Mesh]
    camera: Camera


def surfaces(plan: Plan) -> Iterator[Surface]:
    """What to see, up to plan.max_triangles (but its coarsest in any case)."""
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
    return frame_camera(Scene(objects=(Object(mesh, (Material(),)),)), 1.0)


def run(plan: Plan, report: Callable[[Row], None] | None = None) -> list[Row]:
    """Measure everything; `report` gets each row as it is done. Raises InputError (a file, a device, a structure)."""
    return gathered((row for surface in surfaces(plan) for row in _rows(plan, surface)), report)


def _rows(plan: Plan, surface: Surface) -> Iterator[Row]:
    swept = min(surface.meshes, key=lambda mesh: abs(math.log(len(mesh.faces) / SWEEP_TRIANGLES)))
    sides = [MIN_SIDE * 2**k for k in range(int(math.log2(plan.max_size / MIN_SIDE)) + 1)]
    for mesh in surface.meshes:
        bench = _Bench(plan, Geometry.of(mesh))
        yield bench.measure("triangles", surface, plan.size)
        if mesh is swept:
            for side in sides:
                yield bench.measure("pixels", surface, side)


class _Bench:
    """One geometry, ready to be seen in both ways."""

    def __init__(self, plan: Plan, geometry: Geometry) -> None:
        self.plan, self.geometry = plan, geometry
        self.rasterizer = Rasterizer(geometry, plan.device, plan.threads)
        self.caster = RayCaster(geometry, plan.accel, plan.device, plan.threads)
        again = [build(geometry, plan.accel, plan.device, plan.threads) for _ in range(min(plan.runs, MAX_BUILDS) - 1)]
        self.build = tuple(accel.stats.build_seconds for accel in (self.caster.accel, *again))

    def measure(self, sweep: str, surface: Surface, side: int) -> Row:
        camera, size = surface.camera, (side, side)
        seconds = alternate({name: partial(drawer.draw, camera, size)
                             for name, drawer in (("raster", self.rasterizer), ("cast", self.caster))}, self.plan.runs)
        raster, cast = (tuple(seconds[name].tolist()) for name in ("raster", "cast"))
        checked = agreement(self.rasterizer, self.caster, self.geometry, camera, size)
        return Row(sweep, surface.name, len(self.geometry.faces), side * side, raster, cast, self.build, checked)


def fit(n: Sequence[float], seconds: Sequence[float]) -> Fit:
    """The exponent of seconds over n. Raises ValueError for fewer than two points."""
    require_scipy()
    from scipy.stats import linregress

    x, y = np.log(np.asarray(n, np.float64)), np.log(np.asarray(seconds, np.float64))
    if len(x) < 2:
        raise ValueError("an exponent needs two points")
    line = linregress(x, y)
    return Fit(float(line.slope), float(line.stderr) if len(x) > 2 else math.nan, float((y[-1] - y[-2]) / (x[-1] - x[-2])))


def series(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows by (sweep, surface), in order of what grows."""
    out: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        out.setdefault((row.sweep, row.surface), []).append(row)
    return {key: sorted(group, key=lambda row: getattr(row, key[0])) for key, group in out.items()}


def fits(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The exponents of every sweep that has two points or more: of rasterising, casting and, over triangles, building."""
    out = []
    for (sweep, surface), group in series(rows).items():
        if len(group) < 2:
            continue
        for cost in ("raster", "cast", "build") if sweep == "triangles" else ("raster", "cast"):
            found = fit([getattr(row, sweep) for row in group], [float(np.median(getattr(row, cost))) for row in group])
            out.append({"sweep": sweep, "surface": surface, "cost": cost, **asdict(found)})
    return out


def crossings(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For every sweep of two points or more, the n from which on the other way of seeing costs less (the structure is there;
    between two points by interpolation of logarithms), and which that is; n is None where one is cheaper throughout."""
    out = []
    for (sweep, surface), group in series(rows).items():
        if len(group) < 2:
            continue
        n = np.log([getattr(row, sweep) for row in group])
        ratio = np.log([float(np.median(row.ratios(False))) for row in group])
        cheaper = np.where(ratio > 0.0, "raster", "cast")
        change = np.flatnonzero(cheaper[1:] != cheaper[:-1])
        found = None
        if len(change):
            i = change[-1]
            found = math.exp(n[i] + (n[i + 1] - n[i]) * ratio[i] / (ratio[i] - ratio[i + 1]))
        out.append({"sweep": sweep, "surface": surface, "n": found, "cheaper": str(cheaper[-1])})
    return out


def machine(plan: Plan) -> str:
    threads = f"{thread_count(plan.threads)} used" if plan.device == "cpu" else ""
    return machine_line(threads, f"structure {plan.accel}, {plan.runs} runs", device=plan.device)


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    a = row.agreement
    return (Path(row.surface).name, f"{row.triangles}", f"{row.pixels}", f"{a.covered / a.pixels:.1%}",
            spread(row.raster, 1e3), spread(row.cast, 1e3), f"{1e3 * float(np.median(row.build)):.3g}",
            spread(row.ratios(False)), f"{np.median(row.ratios(True)):.3g}",
            f"{a.differ}", f"{a.ties}", f"{a.silhouettes}", f"{a.unexplained}", f"{a.depth_error:.1e}", f"{a.depth_share:.2f}")


def line(row: Row) -> str:
    """For the progress."""
    return "  ".join(cells(row)[:8])


def parts(rows: Sequence[Row], plots: bool = False) -> list[Part]:
    """All tables; `plots`: with the pictures of PLOTS, which stand beside the file."""
    out = []
    for name, sweep in PLOTS.items():
        lines = [cells(row) for key, group in series(rows).items() if key[0] == sweep for row in group]
        if lines:
            out.append(Part(f"As {sweep} grow", "", COLUMNS, lines, name if plots else ""))
    found = fits(rows)
    if found:
        told = "seconds ~ n^exponent over the whole sweep (± one standard deviation), and between its two last points."
        out.append(Part("Exponents", told, ("cost", "surface", "n", "exponent", "at the end"), [
            (f["cost"], Path(f["surface"]).name, f["sweep"], f"{f['exponent']:.3f} ± {f['error']:.3f}", f"{f['last']:.3f}")
            for f in found]))
    for c in crossings(rows):
        since = "throughout" if c["n"] is None else f"from about {c['n']:.2g} {c['sweep']} on"
        out.append(Part("", f"{Path(c['surface']).name}, as {c['sweep']} grow: {c['cheaper']} costs less {since}."))
    return out


def text(rows: Sequence[Row], machine: str) -> str:
    """For the terminal."""
    return f"{machine}\n\n{markdown(parts(rows))}\n{LEGEND}"


def data(rows: Sequence[Row]) -> dict[str, object]:
    """For JSON."""
    return {"rows": [row.as_dict() for row in rows], "exponents": fits(rows), "crossings": crossings(rows)}


def plot(rows: Sequence[Row], sweep: str) -> LogLogPlot:
    """Medians over what grows; on the sweep over triangles also with the build."""
    costs: dict[str, Callable[[Row], float]] = {
        "raster": lambda row: float(np.median(row.raster)), "cast": lambda row: float(np.median(row.cast))}
    if sweep == "triangles":
        costs["build + cast"] = lambda row: float(np.median(row.cast) + np.median(row.build))
    lines = [Series(f"{Path(surface).name}: {name}", [(float(getattr(row, sweep)), cost(row)) for row in group])
             for (which, surface), group in series(rows).items() if which == sweep for name, cost in costs.items()]
    other = "pixels" if sweep == "triangles" else "triangles"
    held = sorted({getattr(row, other) for row in rows if row.sweep == sweep})
    return LogLogPlot(f"Primary visibility, {' or '.join(map(str, held))} {other}", sweep, "seconds a picture", lines)


def write_report(rows: Sequence[Row], plan: Plan, folder: Path, machine: str) -> list[Path]:
    """Markdown and plots; the paths. Raises InputError where the system refuses."""
    command = " ".join(["python -m wrt bench visibility", *map(str, plan.meshes), f"--size {plan.size}",
                        f"--max-size {plan.max_size}", f"--max-triangles {plan.max_triangles}", f"--runs {plan.runs}"])
    text = f"# Rasterising against ray casting\n\nMachine: {machine}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n"
    return write(folder / REPORT, text + markdown(parts(rows, plots=True)),
                 {name: plot(rows, sweep) for name, sweep in PLOTS.items()})
