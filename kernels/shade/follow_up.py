"""The follow-up of a hit, for both loops: decides which new paths are followed or cut, and how much light the cuts lose.

A new path is cut after max_depth bounces, after MAX_TRANSPARENT surfaces passed straight in a row, or below min_throughput. All new
paths of a sample are cut after MAX_RAYS rays: with min_throughput = 0, a tree of 64 levels would never end. The loops push the
FOLLOWED paths in the order onward, coated, reflected, refracted, and trace the path pushed last first."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.paths import Path
from wrt.kernels.shade.shadows import MAX_TRANSPARENT
from wrt.kernels.shade.step import PendingLight, Sample, Shaded, mean3
from wrt.kernels.structs import Limits, Surfaces

MAX_RAYS = wp.constant(1 << 16)  # Rays of one sample, without shadow rays: as many as a full binary tree of 15 bounces.
# Verdicts on a new path.
NONE = wp.constant(0)  # Its throughput is 0.
FOLLOWED = wp.constant(1)
CUT_BY_DEPTH = wp.constant(2)  # Cut by max_depth, MAX_TRANSPARENT or MAX_RAYS.
CUT_BY_THROUGHPUT = wp.constant(3)


@wp.struct
class FollowUp:
    """The verdicts on the four new paths that begin at a hit, and the light that cut paths lose.
    A verdict is NONE (no path), FOLLOWED, CUT_BY_DEPTH (too many bounces, surfaces or rays) or CUT_BY_THROUGHPUT (too little light)."""

    onward: int  # Verdict on the path straight through a partly transparent surface.
    reflected: int  # Verdict on the reflected path.
    refracted: int  # Verdict on the refracted path.
    coated: int  # Verdict on the path reflected by a clear coat.
    cut_depth: int  # Number of these paths that have the verdict CUT_BY_DEPTH.
    cut_throughput: int  # Number of these paths that have the verdict CUT_BY_THROUGHPUT.
    lost: float  # If the onward path is cut: the radiance that it would have added in surroundings of radiance 1. Else 0.
    pending_light: PendingLight  # The surface's own light and the losses of the other paths, added after the shadow rays.


@wp.func
def add_cuts(before: Sample, next: FollowUp) -> Sample:
    """Add the numbers of a hit's cut paths to the sample, and the light that is lost if its onward path was cut."""
    out = before
    out.cut_depth += next.cut_depth
    out.cut_throughput += next.cut_throughput
    out.lost += next.lost
    return out


def make_follow_up(features: Features) -> Any:
    """Return follow_up(surfaces, shaded, limits, traced) -> FollowUp. traced: number of the sample's rays without shadow rays."""

    @wp.func
    def lost(surfaces: Surfaces, path: Path, verdict: int) -> float:
        """Return the radiance that a cut path would have added in surroundings of radiance 1; 0 for a path that is not cut."""
        if verdict < CUT_BY_DEPTH:
            return 0.0
        lost = mean3(path.throughput)
        if wp.static(features.refraction):
            if path.medium >= 0:  # Inside glass the radiance is ior^2 times as high, and `scatter` divided by ior^2.
                medium = path.medium
                lost = lost * surfaces.materials[medium].ior * surfaces.materials[medium].ior
        return lost

    @wp.func
    def verdict_of(path: Path, limits: Limits, traced: int) -> int:
        largest = wp.max(path.throughput)
        if largest <= 0.0:
            return NONE
        if path.depth > limits.max_depth or path.passed > MAX_TRANSPARENT or traced >= MAX_RAYS:
            return CUT_BY_DEPTH
        return wp.where(largest < limits.min_throughput, CUT_BY_THROUGHPUT, FOLLOWED)

    @wp.func
    def add_verdict(before: FollowUp, verdict: int) -> FollowUp:
        out = before
        out.cut_depth += wp.where(verdict == CUT_BY_DEPTH, 1, 0)
        out.cut_throughput += wp.where(verdict == CUT_BY_THROUGHPUT, 1, 0)
        return out

    @wp.func
    def follow_up(surfaces: Surfaces, shaded: Shaded, limits: Limits, traced: int) -> FollowUp:
        out = FollowUp()
        out.pending_light.light = shaded.light
        out.pending_light.throughput = shaded.throughput
        if wp.static(features.blend):
            out.onward = verdict_of(shaded.onward, limits, traced)
            out.lost = lost(surfaces, shaded.onward, out.onward)
            out = add_verdict(out, out.onward)
        if wp.static(features.reflection):
            out.reflected = verdict_of(shaded.reflected, limits, traced)
            out.pending_light.lost_reflected = lost(surfaces, shaded.reflected, out.reflected)
            out = add_verdict(out, out.reflected)
        if wp.static(features.refraction):
            out.refracted = verdict_of(shaded.refracted, limits, traced)
            out.pending_light.lost_refracted = lost(surfaces, shaded.refracted, out.refracted)
            out = add_verdict(out, out.refracted)
        if wp.static(features.clearcoat):
            out.coated = verdict_of(shaded.coated, limits, traced)
            out.pending_light.lost_reflected += lost(surfaces, shaded.coated, out.coated)
            out = add_verdict(out, out.coated)
        return out

    return follow_up
