"""Winding numbers of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.hit_points import surroundings
from wrt.accel.queries.rays import vectors
from wrt.core.arrays import returned
from wrt.core.device import launch_on, upload
from wrt.core.threads import thread_count
from wrt.kernels.query import FARTHEST
from wrt.kernels.winding import wind

POINTS_PER_LAUNCH = 256


def winding_number(accel: Accelerator, points: Any, threads: int | None = None) -> Any:
    """How often the mesh winds around each of `points`, (N,) float64: the solid angles of its triangles together, over 4 pi.

    points: (N, 3) real numbers, taken as float32. Around a closed mesh whose triangles face outwards it is 1 inside and 0 outside,
    to 1e-9, more where parts overlap, and -1 where they face inwards; of an open one it goes over from one to the other, so that
    above 0.5 is mostly inside (Jacobson, Kavan and Sorkine-Hornung 2013, "Robust Inside-Outside Segmentation Using Generalized
    Winding Numbers"). On a triangle it is between its two sides. Every triangle is looked at: a point takes as long as the mesh is
    large, some 40 ns a triangle. Raises InputError as closest_points does.
    """
    snapshot = snapshot_of(accel)
    rows, give, device = vectors(points, "points", FARTHEST), returned(points), snapshot.device
    turns = wp.empty(len(rows), dtype=wp.vec3d, device=device)
    launch_on(device, wind, len(rows), surroundings(snapshot).surfaces, upload(rows, wp.vec3, device), turns, None,
              threads=thread_count(threads), step=POINTS_PER_LAUNCH)
    re, im, whole = turns.numpy().reshape(-1, 3).T
    out = whole + np.arctan2(im, re) / (2.0 * np.pi)
    return out if give is None else give(upload(out, wp.float64, device))
