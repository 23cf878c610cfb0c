"""The section of a scene by the plane that holds most of a sample's rays, in 2D."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from wrt.renderer.inspector.strokes import frame_points
from wrt.renderer.inspector.tree import Sample
from wrt.scene.cameras import CameraKind
from wrt.scene.materials import Material
from wrt.scene.model import Scene

MARGIN = 0.58  # half the size of the drawing over the extent of its points
UPRIGHT = 0.3  # smallest share of the camera's up vector in the plane that is drawn upwards


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane through `origin`, with the unit vectors `across` and `up` in it. (3,) float64 each."""

    origin: np.ndarray
    across: np.ndarray
    up: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        return np.cross(self.across, self.up)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the coordinates of points (..., 3) in the plane, (..., 2), and so project them along the normal."""
        away = points - self.origin
        return np.stack([away @ self.across, away @ self.up], axis=-1)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances of points (..., 3) from the plane."""
        return np.asarray((points - self.origin) @ self.normal)


class Outline(NamedTuple):
    """The section of a shape: curves, (N, 2) each; a curve whose ends are equal is closed."""

    name: str
    material: Material
    curves: list[np.ndarray]


def plane_of(sample: Sample, camera: CameraKind) -> Plane:
    """Return the plane of the camera ray that is nearest to the sample's other hits, weighted by their throughput."""
    rays = sample.rays
    along = rays[0].direction.astype(np.float64)
    along /= np.linalg.norm(along)
    first = rays[0].end if np.isfinite(rays[0].t) else rays[0].origin
    kept = [ray for ray in rays[1:] if np.isfinite(ray.t)] or [ray for ray in rays[1:] if ray.ended == "missed"]
    ends = [ray.end if np.isfinite(ray.t) else ray.origin + ray.direction for ray in kept]
    right, upward = camera.camera_to_world[:3, :2].T
    # Without other hits, the plane is upright: the camera's axes have a small weight.
    away = np.array([*(end - first for end in ends), 1e-3 * upward, 1e-4 * right], np.float64)
    away -= np.outer(away @ along, along)
    away *= np.sqrt([*(ray.throughput.max() for ray in kept), 1.0, 1.0])[:, None]
    side = np.linalg.svd(away)[2][0]
    side -= (side @ along) * along
    side /= np.linalg.norm(side)
    normal = np.cross(along, side)
    up = upward - (upward @ normal) * normal
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > UPRIGHT else side
    across = np.cross(up, normal)
    return Plane(np.asarray(first, np.float64), across * (1.0 if across @ along >= 0.0 else -1.0), up)


def outlines(scene: Scene, plane: Plane) -> list[Outline]:
    """Return the outlines of all shapes that the plane cuts."""
    found = []
    for i, thing in enumerate(scene.objects):
        vertices = thing.mesh.vertices.astype(np.float64) @ thing.placement[:3, :3].T + thing.placement[:3, 3]
        segments = cut(vertices[thing.mesh.faces], plane)
        if len(segments):
            found.append(Outline(thing.name or f"object {i}", thing.materials[0], chains(segments)))
    for i, sphere in enumerate(scene.spheres):
        distance = float(plane.distance(np.array(sphere.center)))
        if abs(distance) < sphere.radius:
            angle = np.linspace(0.0, 2.0 * np.pi, 181)
            circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sqrt(sphere.radius**2 - distance**2)
            circle[-1] = circle[0]
            found.append(Outline(sphere.name or f"sphere {i}", sphere.material, [circle + plane.project(np.array(sphere.center))]))
    return found


def cut(corners: np.ndarray, plane: Plane) -> np.ndarray:
    """Return the lines in which triangles, (N, 3, 3), cross the plane: (M, 2, 2) in the plane's coordinates."""
    distance = plane.distance(corners)
    above = distance > 0.0
    crossing = above.any(axis=1) & ~above.all(axis=1)
    corners, distance, above = corners[crossing], distance[crossing], above[crossing]
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))  # the corner alone on its side
    row, ends = np.arange(len(corners)), []
    for step in (1, 2):
        other = (lone + step) % 3
        share = distance[row, lone] / (distance[row, lone] - distance[row, other])
        ends.append(corners[row, lone] + share[:, None] * (corners[row, other] - corners[row, lone]))
    return plane.project(np.stack(ends, axis=1)) if len(corners) else np.zeros((0, 2, 2))


def chains(segments: np.ndarray) -> list[np.ndarray]:
    """Join segments (M, 2, 2) whose ends meet to curves, (N, 2) each."""
    extent = float(np.ptp(segments.reshape(-1, 2), axis=0).max()) or 1.0
    keys = [tuple(map(tuple, pair)) for pair in np.round(segments / extent * 1e6).astype(np.int64).tolist()]
    at: dict[tuple[int, ...], list[int]] = {}
    for i, pair in enumerate(keys):
        for end in pair:
            at.setdefault(end, []).append(i)
    left, curves = dict.fromkeys(range(len(keys))), []
    # Open curves begin at an end that no other segment shares.
    for first in sorted(left, key=lambda i: min(len(at[end]) for end in keys[i])):
        if first not in left:
            continue
        del left[first]
        turn = 0 if len(at[keys[first][0]]) <= len(at[keys[first][1]]) else 1
        curve, end = [segments[first][turn], segments[first][1 - turn]], keys[first][1 - turn]
        while (following := next((i for i in at[end] if i in left), None)) is not None:
            del left[following]
            turn = 1 if keys[following][0] == end else 0
            curve.append(segments[following][turn])
            end = keys[following][turn]
        curves.append(np.array(curve))
    return curves


def frame(sample: Sample, plane: Plane, ratio: float) -> np.ndarray:
    """Return the lowest and the highest corner of the drawing, (2, 2): its points with a margin. ratio: width over height."""
    points = plane.project(frame_points(sample))
    low, high = points.min(axis=0), points.max(axis=0)
    half = MARGIN * max(high[0] - low[0], ratio * (high[1] - low[1])) * np.array([1.0, 1.0 / ratio])
    return 0.5 * (low + high) + np.array([-half, half])
