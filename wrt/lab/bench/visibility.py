"""`python -m wrt bench visibility`: compare rasterising with ray casting as the numbers of triangles and pixels grow."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.device import launch_on, load_kernel, start, upload
from wrt.core.errors import InputError
from wrt.kernels.study.rasterize import rasterize
from wrt.lab.bench import Visibility as Plan
from wrt.lab.bench.rays import terrain
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, tabled
from wrt.lab.bench.timing import alternate, spread
from wrt.renderer.upload import camera_rays, camera_struct
from wrt.scene.cameras import Camera
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

Picture = tuple[np.ndarray, np.ndarray]  # depth along the ray (inf on a miss), and prim_id (-1): (pixels,) each
NOTHING = np.uint64(0x7F800000_FFFFFFFF)  # key of a pixel without a triangle: depth inf, prim_id -1
SAME_DEPTH = 1e-5  # largest relative difference of depth at which two triangles are a tie
MIN_SIDE = 64  # pixels; the sweep over picture sizes starts here and doubles the side
SWEEP_TRIANGLES = 80_000  # about the triangles of the mesh in the sweep over picture sizes
# Surface -> its meshes of growing numbers of triangles, as functions, and the camera of square pictures.
SURFACES: dict[str, tuple[list[Callable[[], Mesh]], Camera]] = {
    "sphere": ([partial(icosphere, n) for n in range(3, 10)], Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))),
    "terrain": ([partial(terrain, 22 * 2**n) for n in range(8)],
                Camera.look_at((0.0, 0.9, 1.2), (0.0, -0.3, -0.2), fov_y=math.radians(60.0)))}
TITLE = "Rasterising against ray casting"
COLUMNS: Columns = {
    "surface": "{surface}", "triangles": "{triangles}", "pixels": "{pixels}", "covered": lambda row: f"{row.covered / row.pixels:.1%}",
    "raster ms": lambda row: spread(row.raster, 1e3), "cast ms": lambda row: spread(row.cast, 1e3),
    "build ms": lambda row: f"{1e3 * row.build:.3g}",
    "cast / raster": lambda row: spread(np.array(row.cast) / np.array(row.raster)), "differ": "{differ}", "ties": "{ties}"}
LEGEND = f"""\
covered: pixels with a triangle. raster: time of a z-buffer over all triangles. cast: time of one ray a pixel; rays and structure are made
beforehand. build: time to build that structure. Both on one thread of a CPU. Medians of alternating runs, quartiles in brackets, ratios
run by run. cast / raster: above 1 rasterising is faster. differ: pixels whose prim_id differs. ties: pixels among them at the same depth,
within {SAME_DEPTH:g} relative; at the others the centre lies on an outline, within a rounding error."""


def rasterizer(geometry: Geometry, camera: Camera, side: int) -> Callable[[], Picture]:
    """Return a function that draws the triangles with a z-buffer: `side` x `side` pixels, seen from the centre of the lens."""
    if not isinstance(camera, Camera):
        raise InputError(f"is {camera.kind}; the rasterizer needs a perspective camera", place=f"camera {camera.name!r}")
    place, c = start("cpu"), camera_struct(camera, (side, side))
    right, up, forward = (np.array(list(axis), np.float64) for axis in (c.right, c.up, c.forward))
    tan_x, tan_y = (float(np.float32(value)) for value in (c.tan_x, c.tan_y))  # as in the float32 camera of the rays
    from_pixels = np.column_stack([2.0 * tan_x / side * right, -2.0 * tan_y / side * up, forward - tan_x * right + tan_y * up])
    inputs = [wp.vec3d(*list(c.origin)), wp.mat33d(np.linalg.inv(from_pixels)), wp.mat33d(from_pixels), wp.vec2i(side, side),
              upload(geometry.vertices, wp.vec3, place), upload(geometry.faces, wp.vec3i, place)]
    keys = wp.empty(side * side, dtype=wp.uint64, device=place)
    load_kernel(rasterize, place)

    def draw() -> Picture:
        keys.fill_(NOTHING)
        launch_on(place, rasterize, len(geometry.faces), *inputs, keys)
        halves = keys.numpy().astype("<u8", copy=False).view("<u4").reshape(-1, 2)
        return halves[:, 1].view(np.float32), halves[:, 0].view(np.int32)

    return draw


def ray_caster(geometry: Geometry, camera: Camera, side: int, accel: str = "bvh") -> tuple[Callable[[], Picture], float]:
    """Return a function that casts a ray through the centre of each pixel, and the seconds to build its structure."""
    structure = build(geometry, accel)
    origins, directions = (wp.array(rows, dtype=wp.vec3, device=structure.device) for rows in camera_rays(camera, (side, side)))

    def draw() -> Picture:
        hits = structure.closest_hit(origins, directions, threads=1)
        return hits.t.numpy(), hits.prim_id.numpy()

    return draw, structure.stats.build_seconds


def compared(raster: Picture, cast: Picture) -> dict[str, int]:
    """Count pixels: covered by a triangle, with another prim_id in the two pictures, and of the latter those at the same depth."""
    differ = raster[1] != cast[1]
    with np.errstate(invalid="ignore"):  # inf - inf, of two misses
        close = np.abs(raster[0] - cast[0]) <= SAME_DEPTH * cast[0]
    return {"covered": int((raster[1] >= 0).sum()), "differ": int(differ.sum()), "ties": int((differ & close & np.isfinite(cast[0])).sum())}


def groups(plan: Plan) -> Groups:
    """Yield a group for each surface and size. The coarsest mesh may have more than plan.max_triangles triangles."""
    sides = [MIN_SIDE * 2**k for k in range(int(math.log2(plan.max_size / MIN_SIDE)) + 1)]
    for name, (makers, camera) in SURFACES.items():
        meshes = list(growing(makers, plan.max_triangles))
        swept = min(meshes, key=lambda mesh: abs(math.log(len(mesh.faces) / SWEEP_TRIANGLES)))
        for mesh in meshes:
            for sweep, side in [("triangles", plan.size), *(("pixels", side) for side in sides if mesh is swept)]:
                yield partial(picture_rows, plan, name, mesh, camera, sweep, side)


def growing(makers: Sequence[Callable[[], Mesh]], most: int) -> Iterator[Mesh]:
    """Yield the first mesh, and the next ones of at most so many triangles."""
    for i, make in enumerate(makers):
        mesh = make()
        if i and len(mesh.faces) > most:
            return
        yield mesh


def picture_rows(plan: Plan, surface: str, mesh: Mesh, camera: Camera, sweep: str, side: int) -> list[Row]:
    geometry = Geometry.of(mesh)
    raster, (cast, build_seconds) = rasterizer(geometry, camera, side), ray_caster(geometry, camera, side, plan.accel)
    seconds = alternate({"raster": raster, "cast": cast}, plan.runs)
    return [Row(sweep=sweep, surface=surface, triangles=len(mesh.faces), pixels=side * side, build=build_seconds,
                **{name: each.tolist() for name, each in seconds.items()}, **compared(raster(), cast()))]


def machine(plan: Plan) -> str:
    return machine_line("one thread used", f"structure {plan.accel}, {plan.runs} runs")


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    return [tabled(COLUMNS, group, f"As {sweep} grow") for (sweep,), group in grouped(rows, "sweep").items()]
