"""What `profile` reports and writes: tables, heat maps with their scale, EXR layers, histograms, and the model's summary."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.html import Rows
from wrt.lab.bench.plot import histograms
from wrt.lab.bench.report import table
from wrt.lab.rtcore.model import simt
from wrt.lab.rtcore.parameters import Gpu
from wrt.lab.rtcore.profile_work import GROUPS, efficiency_rows, warp_order, work_of
from wrt.lab.rtcore.profiler import KINDS, PICTURES, TITLES, Profile
from wrt.lab.rtcore.report import LEGEND, ModelRow, model_page, model_row, model_table, simt_table
from wrt.picture.image import write_codes, write_exr

PER_RAY = ("nodes", "boxes", "primitives", "leaves", "stack", "lines")
LAYERS, HISTOGRAMS, REPORT = "counters.exr", "histograms.png", "profile.md"


def ray_values(profile: Profile, name: str) -> np.ndarray:
    return profile.rays.lines if name == "lines" else profile.rays.counts[name]


def depth_table(profile: Profile) -> str:
    columns = ("depth", "kind", "rays", "hit", "nodes", "boxes", "triangles", "leaves", "bytes", "lines", "stack (most)")
    rows = []
    for row in profile.by_depth():
        n = row["probes"]
        means = [f"{row[name] / n:.1f}" for name in ("nodes", "boxes", "primitives", "leaves")]
        size = (row["node_bytes"] + row["primitive_bytes"]) / n
        rows.append((f"{row['depth']}", row["kind"], f"{n}", f"{row['hits'] / n:.0%}", *means, f"{size:.0f}",
                     f"{row['lines'] / n:.1f}", f"{row['stack']}"))
    return table(columns, rows)


def percentile_table(profile: Profile) -> str:
    """Of each counter a ray, by kind."""
    columns = ("counter", "kind", "mean", "50%", "90%", "99%", "99.9%", "largest")
    rows = []
    for name in PER_RAY:
        values = ray_values(profile, name)
        for i, kind in enumerate(KINDS):
            chosen = values[profile.rays.kind == i]
            if len(chosen):
                shares = np.percentile(chosen, (50, 90, 99, 99.9))
                rows.append((TITLES[name], kind, f"{chosen.mean():.1f}", *(f"{x:.0f}" for x in shares), f"{chosen.max()}"))
    return table(columns, rows)


def model_rows(profile: Profile, gpu: Gpu) -> Rows[ModelRow]:
    """The model on the rays that were traced, by group; SIMT efficiency on all of them."""
    rows = []
    for group in GROUPS:
        work = work_of(profile, group)
        if work is None:
            continue
        order, warp = warp_order(profile, efficiency_rows(profile, group))
        chosen = profile.rays.rays[order]
        rows.append(model_row(work, gpu, simt(profile.rays.counts[order], warp, chosen["origin"], chosen["direction"])))
    return Rows(rows, model_page)


def summary(profile: Profile, rows: Sequence[ModelRow], gpu: Gpu) -> str:
    rays = profile.rays
    traced = len(rays.trace_rows) / max(len(rays), 1)
    seconds = ", ".join(f"{name} {value:.1f}" for name, value in profile.seconds.items())
    stats = profile.accel.stats
    return "\n\n".join([
        f"{profile.scene}: {profile.size[0]}x{profile.size[1]}, {profile.spp} spp, {len(rays)} rays; {profile.accel.name} over"
        f" {len(profile.accel.geometry)} primitives, {stats.nodes} nodes, {stats.bytes / 1e6:.1f} MB; seconds: {seconds}",
        "## Rays by depth and kind (means a ray)", depth_table(profile), "## What a ray costs", percentile_table(profile),
        f"## Model of {gpu.name} ({traced:.0%} of the rays, in whole tiles)", model_table(rows), LEGEND,
        "## SIMT efficiency: warps of 8 x 4 pixels as they come, without gaps, and sorted by origin and direction",
        simt_table(rows)])


def write_report(profile: Profile, text: str, folder: Path) -> list[Path]:
    """Everything that there is to see; the paths. Raises InputError where the system refuses."""
    paths = []
    for name in PICTURES:
        if profile.maps[name].any():
            paths.append(folder / f"{name}.png")
            write_codes(paths[-1], np.asarray(profile.heatmap(name)))
    write_exr(folder / LAYERS, {name: profile.maps[name].astype(np.float32) for name in PICTURES},
              {"scene": profile.scene, "spp": profile.spp})
    kinds: dict[str, Any] = {TITLES[name]: {kind: ray_values(profile, name)[profile.rays.kind == i] for i, kind in enumerate(KINDS)
                                            if (profile.rays.kind == i).any()} for name in PER_RAY}
    write_codes(folder / HISTOGRAMS, histograms(kinds, f"{profile.scene}: what a ray costs, and the share of rays that cost it"))
    (folder / REPORT).write_text(f"# Profile of {text}\n", encoding="utf-8")
    return [*paths, folder / LAYERS, folder / HISTOGRAMS, folder / REPORT]
