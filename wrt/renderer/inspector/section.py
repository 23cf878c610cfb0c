"""Planes through rays: the plane of a sample's rays, and the lines in which a plane cuts triangles."""

from dataclasses import dataclass

import numpy as np

from wrt.renderer.inspector.tree import Sample
from wrt.scene.cameras import CameraKind

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
