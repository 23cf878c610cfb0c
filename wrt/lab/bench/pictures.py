"""`python -m wrt bench pictures`: compare rendering by waves of samples with rendering one ray at a time."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from wrt.core.checks import as_size
from wrt.core.device import load_kernel, start
from wrt.io.load import load_scene
from wrt.lab.bench import Pictures as Plan
from wrt.lab.bench.report import Columns, Groups, Part, Row, cells
from wrt.lab.bench.timing import alternate, spread
from wrt.renderer.film import DeviceFilm, Work
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of, render_kernel
from wrt.renderer.prepare import Prepared, prepare

TITLE = "Rendering by waves and one ray at a time"
COLUMNS: Columns = {
    "scene": "{scene}", "triangles": "{triangles}", "rays/sample": "{rays:.2f}",
    "loop ns/sample": lambda row: spread(row.loop), "waves ns/sample": lambda row: spread(row.waves),
    "loop / waves": lambda row: spread(row.ratio), "differ": "{differ}"}
LEGEND = """\
loop: one ray at a time, as on CUDA. waves: many samples share queues of rays, which packets trace (kernels/loops/wave.py). ns/sample:
nanoseconds of CPU time of one thread for a sample: camera ray, tracing, shading and film. Times are medians of alternating runs, with
quartiles in brackets; loop / waves is a ratio run by run. rays/sample includes shadow rays. differ: pixels whose value differs (must be
0)."""


def groups(plan: Plan) -> Groups:
    return (partial(scene_rows, plan, path) for path in plan.scenes)


def scene_rows(plan: Plan, path: Path) -> list[Row]:
    scene = load_scene(path).with_settings(size=as_size(plan.size), spp=plan.spp)
    waves = prepare(plan_of(scene, Options(threads=1, accel=plan.accel, device="cpu")), start("cpu"))
    kernel = render_kernel(waves.plan.features, waves.plan.structure)
    load_kernel(kernel, waves.device)
    return [row_of(Path(path).name, {"loop": replace(waves, waves=None, kernels=[kernel]), "waves": waves}, plan)]


def row_of(name: str, ways: dict[str, Prepared], plan: Plan) -> Row:
    films: dict[str, DeviceFilm] = {}

    def draw(way: str) -> None:
        prepared = ways[way]
        film = films[way] = DeviceFilm(prepared.plan.scene.settings, prepared.plan.crop, prepared.device, seed=0)
        trace: Callable[[Work], int] = prepared.launch(film)
        for rectangle in prepared.tiles(plan.spp):
            trace(Work(rectangle, 0, plan.spp))

    seconds = alternate({way: partial(draw, way) for way in ways}, plan.runs, time.thread_time)
    samples = plan.spp * ways["waves"].plan.area
    loop, waves = (seconds[way] * 1e9 / samples for way in ("loop", "waves"))
    pixels = [np.asarray(films[way].groups[0].mean.numpy()).view(np.int32) for way in ways]
    differ = int((pixels[0] != pixels[1]).reshape(len(pixels[0]), -1).any(axis=1).sum())
    return Row(scene=name, triangles=ways["waves"].facts()["triangles"], rays=films["waves"].count("rays") / samples, loop=loop.tolist(),
               waves=waves.tolist(), ratio=(loop / waves).tolist(), ratio_median=float(np.median(loop / waves)), differ=differ)


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    mean = np.exp(np.mean(np.log([row.ratio_median for row in rows])))
    return [Part(head=list(COLUMNS), lines=[cells(COLUMNS, row) for row in rows]), Part(text=f"Geometric mean of loop / waves: {mean:.2f}")]
