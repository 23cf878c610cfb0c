"""The lines that stand for a sample's rays in a drawing, and their colours."""

import math
from typing import NamedTuple

import numpy as np

from wrt.renderer.inspector.tree import AMBIENT, Light, Ray, Sample

COLORS = {"camera": "#202020", "reflected": "#1668c4", "coated": "#0b8f9c", "refracted": "#d1342b", "transmitted": "#c2378f",
          "onward": "#2b8a3e", "shadow ray": "#e59a00", "blocked": "#8a7f70"}
# A marker of matplotlib for each end of a ray, and its description.
ENDS = {"absorbed": ("o", "ends at a surface"), "emission": ("*", "ends at a light"), "missed": (">", "leaves the scene"),
        "cut by depth": ("s", "cut by depth"), "cut by throughput": ("X", "cut by throughput"), "blocked": ("x", "shadow ray blocked")}
LEAVES, STUB = 0.22, 0.1  # Length of a ray that leaves the scene, and of a ray that was cut, over the extent of the drawing.
FAR = 3.5  # A hit farther than this, over the distance of the first hit, does not widen the drawing.
NEAR = 0.8  # Longest part of the camera ray that is shown, over the largest distance between the first hit and another one.
WIDEST, THINNEST = 2.6, 0.8  # Of the lines, in points: throughput 1, and 0.


class Stroke(NamedTuple):
    """A line from start to end, (3,) float64 each. weight: 0 to 1. mark: a key of ENDS, or "". goes_on: the ray is longer.

    light: name of the light that the line reaches, or ""."""

    kind: str
    start: np.ndarray
    end: np.ndarray
    weight: float
    mark: str
    goes_on: bool
    light: str = ""

    @property
    def is_shadow(self) -> bool:
        return self.kind in ("shadow ray", "blocked")

    @property
    def width(self) -> float:
        return THINNEST + (WIDEST - THINNEST) * math.sqrt(self.weight)


def frame_points(sample: Sample) -> np.ndarray:
    """Return the points that a drawing must show, (N, 3) float64: a point of the camera ray, and the hits that are not too far.

    The point is the camera, unless the camera is so far from the first hit that the other rays would be small in the drawing."""
    rays = sample.rays
    eye = rays[0].origin.astype(np.float64)
    if not math.isfinite(rays[0].t):
        return np.array([eye, eye + rays[0].direction])
    hits = np.array([ray.end for ray in rays if math.isfinite(ray.t)], np.float64)
    hits = hits[np.linalg.norm(hits - eye, axis=1) <= FAR * np.linalg.norm(hits[0] - eye)]
    reach = NEAR * float(np.linalg.norm(hits - hits[0], axis=1).max()) / float(np.linalg.norm(hits[0] - eye))
    return np.concatenate([[hits[0] + (min(reach, 1.0) if reach else 1.0) * (eye - hits[0])], hits])


def strokes_of(sample: Sample, extent: float) -> list[Stroke]:
    """Return the lines of all rays, shadow rays first, so that paths are drawn over them. extent: of the drawing, in scene units."""
    paths, shadows = [], []
    for ray in sample.rays:
        start, weight = ray.origin.astype(np.float64), float(np.clip(ray.throughput.max(), 0.0, 1.0))
        length = {"missed": LEAVES, "cut by depth": STUB, "cut by throughput": STUB}.get(ray.ended)
        goes_on = length is not None
        end = ray.end.astype(np.float64) if length is None else start + length * extent * _unit(ray.direction)
        paths.append(Stroke(ray.kind, start, end, weight, "" if ray.ended == "continued" else ray.ended, goes_on))
        shadows += [_shadow(ray, light, weight, extent) for light in ray.lights if light.parts]
    return shadows + paths


def _shadow(ray: Ray, light: Light, weight: float, extent: float) -> Stroke:
    last = light.parts[-1]
    blocked = light.state in ("blocked", "cut")
    start, end = light.parts[0].origin.astype(np.float64), last.end.astype(np.float64)
    goes_on = not np.isfinite(end).all()
    if goes_on:  # the background, or a directional light
        end = last.origin + LEAVES * extent * _unit(last.direction)
    return Stroke("blocked" if blocked else "shadow ray", start, end, weight * (1.0 if light.radiance.any() else 0.3),
                  "blocked" if blocked else "", goes_on, "" if blocked or goes_on or light.light == AMBIENT else light.light)


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector.astype(np.float64))
