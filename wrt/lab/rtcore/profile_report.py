"""Report of `profile`: tables, the model of the RT core, heat maps and EXR layers."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from wrt.accel.queries.answers import Counters
from wrt.core.errors import InputError
from wrt.core.files import check_writable, write_bytes
from wrt.core.tables import Rows
from wrt.lab.bench.report import Columns, Part, Row, markdown, tabled
from wrt.lab.rtcore.model import LEGEND, MODEL_COLUMNS, SIMT_COLUMNS, WARP, Work, blocks, model_page, model_row, simt
from wrt.lab.rtcore.parameters import Gpu
from wrt.lab.rtcore.profiler import KINDS, PICTURES, Profile
from wrt.picture.image import write_codes, write_exr

GROUPS = {"primary": ("primary",), "shadow": ("shadow",), "secondary": ("reflection", "refraction", "straight"), "all": KINDS}


def warp_order(profile: Profile, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays `rows` in the order of warps and lanes, and the warp of each ray, from 0 on.
    A warp has the n-th ray of one kind and depth from each pixel of a block of 8 x 4 pixels."""
    rays = profile.rays
    pixel, kind, depth = rays.pixel[rows].astype(np.int64), rays.kind[rows].astype(np.int64), rays.depth[rows].astype(np.int64)
    deepest = int(depth.max(initial=0)) + 1
    group = (pixel * deepest + depth) * len(KINDS) + kind
    order = np.argsort(group, kind="stable")
    fresh = np.ones(len(rows), bool)
    fresh[1:] = group[order][1:] != group[order][:-1]
    begin = np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), 0))
    turn = np.empty(len(rows), np.int64)  # number of earlier rays of the same kind and depth of the pixel
    turn[order] = np.arange(len(rows)) - begin
    warp, lane = blocks(*profile.size)
    step = ((warp[pixel] * deepest + depth) * len(KINDS) + kind) * (int(turn.max(initial=0)) + 1) + turn
    order = np.argsort(step * WARP + lane[pixel], kind="stable")
    return rows[order], np.unique(step[order], return_inverse=True)[1]


def work_of(profile: Profile, group: str) -> Work | None:
    """Return the rays of a group of GROUPS whose fetches were recorded, or None if there is no such ray."""
    rays = profile.rays
    kinds = [KINDS.index(name) for name in GROUPS[group]]
    at = np.flatnonzero(np.isin(rays.kind[rays.trace_rows], kinds))
    if not len(at):
        return None
    position = np.full(len(rays), -1)
    position[rays.trace_rows] = np.arange(len(rays.trace_rows))
    rows, warp = warp_order(profile, rays.trace_rows[at])
    which = position[rows]
    first, length = rays.trace_first[which], np.diff(rays.trace_first)[which]
    begin = np.concatenate([[0], np.cumsum(length)])
    fetch = np.repeat(first - begin[:-1], length) + np.arange(begin[-1])
    return Work(group, Counters(rays.counts[rows], begin, rays.address[fetch], rays.size[fetch]), warp)


LAYERS, REPORT = "counters.exr", "profile.md"
DEPTHS: Columns = {
    "depth": "{depth}", "kind": "{kind}", "rays": "{probes}", "hits": lambda row: f"{row.hits / row.probes:.0%}",
    **{head: partial(lambda row, name: f"{getattr(row, name) / row.probes:.1f}", name=name) for head, name in
       {"nodes": "nodes", "boxes": "boxes", "triangles": "primitives", "leaves": "leaves"}.items()},
    "bytes": lambda row: f"{(row.node_bytes + row.primitive_bytes) / row.probes:.0f}",
    "lines": lambda row: f"{row.lines / row.probes:.1f}", "largest stack": "{stack}"}


def model_rows(profile: Profile, gpu: Gpu) -> Rows[Row]:
    """Apply the model to the recorded rays of each group; SIMT efficiency includes all rays of the group."""
    rows = []
    for group in GROUPS:
        work = work_of(profile, group)
        if work is None:
            continue
        every = np.flatnonzero(np.isin(profile.rays.kind, [KINDS.index(name) for name in GROUPS[group]]))  # recorded or not
        order, warp = warp_order(profile, every)
        chosen = profile.rays.rays[order]
        rows.append(model_row(work, gpu, simt(profile.rays.counts[order], warp, chosen["origin"], chosen["direction"])))
    return Rows(rows, model_page)


def summary(profile: Profile, rows: Sequence[Row], gpu: Gpu) -> str:
    rays, stats = profile.rays, profile.accel.stats
    seconds = ", ".join(f"{name} {value:.1f}" for name, value in profile.seconds.items())
    head = (f"{profile.scene}: {profile.size[0]}x{profile.size[1]}, {profile.spp} spp, {len(rays)} rays; {profile.accel.name} over"
            f" {len(profile.accel.geometry)} primitives, {stats.nodes} nodes, {stats.bytes / 1e6:.1f} MB; seconds: {seconds}")
    recorded = f"{len(rays.trace_rows) / max(len(rays), 1):.0%} of the rays, in whole tiles"
    return markdown([
        Part("", head), tabled(DEPTHS, [Row(**row) for row in profile.by_depth()], "Rays by depth and kind (means over the rays)"),
        tabled(MODEL_COLUMNS, rows, f"Model of {gpu.name} ({recorded})"), Part("", LEGEND),
        tabled(SIMT_COLUMNS, rows, "SIMT efficiency",
               "As they come: warps of 8 x 4 pixels. Packed: full warps. Sorted: full warps of rays sorted by origin and direction.")])


def check_folder(folder: Path) -> None:
    """Create the folder if it is missing. Raise InputError if write_report cannot write to it."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be used as the output folder: {error.strerror}", path=folder) from error
    check_writable(folder / LAYERS)


def write_report(profile: Profile, text: str, folder: Path) -> list[Path]:
    """Write heat maps, EXR layers and the report `text`; return their paths. Raise InputError if a file cannot be written."""
    heat_maps = {folder / f"{name}.png": name for name in PICTURES if profile.maps[name].any()}
    for path, name in heat_maps.items():
        write_codes(path, np.asarray(profile.heatmap(name)))
    write_exr(folder / LAYERS, {name: profile.maps[name].astype(np.float32) for name in PICTURES},
              {"scene": profile.scene, "spp": profile.spp})
    write_bytes(folder / REPORT, f"# Profile of {text}".encode())
    return [*heat_maps, folder / LAYERS, folder / REPORT]
