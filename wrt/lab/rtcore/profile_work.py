"""From a profile to the model's work: rays of a picture in the warps that would trace them."""

from __future__ import annotations

import numpy as np

from wrt.accel.answers import Counters
from wrt.lab.rtcore.model import Work
from wrt.lab.rtcore.profiler import KINDS, Profile
from wrt.lab.rtcore.warps import WARP, blocks

GROUPS = {"primary": ("primary",), "shadow": ("shadow",), "secondary": ("reflection", "refraction", "straight"), "all": KINDS}


def warp_order(profile: Profile, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows in the order of warps and lanes, and the warp of each, from 0 on.

    A warp is a block of 8 x 4 pixels; those of its pixels that trace a ray of the same kind and depth, the first of them, the
    second ..., trace it together, and the lanes of the others wait.
    """
    rays = profile.rays
    pixel, kind, depth = rays.pixel[rows].astype(np.int64), rays.kind[rows].astype(np.int64), rays.depth[rows].astype(np.int64)
    deepest = int(depth.max(initial=0)) + 1
    group = (pixel * deepest + depth) * len(KINDS) + kind
    order = np.argsort(group, kind="stable")
    fresh = np.ones(len(rows), bool)
    fresh[1:] = group[order][1:] != group[order][:-1]
    begin = np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), 0))
    turn = np.empty(len(rows), np.int64)  # how many such rays the pixel traced before
    turn[order] = np.arange(len(rows)) - begin
    warp, lane = blocks(*profile.size)
    step = ((warp[pixel] * deepest + depth) * len(KINDS) + kind) * (int(turn.max(initial=0)) + 1) + turn
    order = np.argsort(step * WARP + lane[pixel], kind="stable")
    return rows[order], np.unique(step[order], return_inverse=True)[1]


def work_of(profile: Profile, group: str) -> Work | None:
    """The traced rays of a group (in GROUPS) as the model's work; None where there are none."""
    rays = profile.rays
    kinds = [KINDS.index(name) for name in GROUPS[group]]
    at = np.flatnonzero(np.isin(rays.kind[rays.trace_rows], kinds))
    if not len(at):
        return None
    place = np.full(len(rays), -1)
    place[rays.trace_rows] = np.arange(len(rays.trace_rows))
    rows, warp = warp_order(profile, rays.trace_rows[at])
    which = place[rows]
    first, length = rays.trace_first[which], np.diff(rays.trace_first)[which]
    begin = np.concatenate([[0], np.cumsum(length)])
    fetch = np.repeat(first - begin[:-1], length) + np.arange(begin[-1])
    return Work(group, Counters(rays.counts[rows], begin, rays.address[fetch], rays.size[fetch]), warp)


def efficiency_rows(profile: Profile, group: str) -> np.ndarray:
    """All rays of a group, traced or not, in the order of the log."""
    return np.flatnonzero(np.isin(profile.rays.kind, [KINDS.index(name) for name in GROUPS[group]]))
