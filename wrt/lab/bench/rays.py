"""The kinds of ray that structures are measured with: what a picture asks (primary, shadow, diffuse), and what nothing prepares
for (random)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry

SEEN = 0.55  # half of the picture's height, over distance: a field of view of 58 degrees


@dataclass(frozen=True, eq=False)
class RaySet:
    """origins, directions: (N, 3) float32; t_max: (N,) float32; any_hit: ask for any hit (a shadow ray) instead of the closest."""

    kind: str
    origins: np.ndarray
    directions: np.ndarray
    t_max: np.ndarray
    any_hit: bool = False

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, rows: slice) -> RaySet:
        return RaySet(self.kind, self.origins[rows], self.directions[rows], self.t_max[rows], self.any_hit)


@dataclass(frozen=True, eq=False)
class _View:
    """What all kinds start from: the sphere around the mesh, and the hits of rays from a camera outside or inside of it."""

    center: np.ndarray
    radius: float
    primary: RaySet
    points: np.ndarray
    normals: np.ndarray
    rng: np.random.Generator


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ball_around(geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The lowest and highest corner of the geometry's box, float64, and the centre and radius of the sphere around it."""
    lo, hi = (bound.astype(np.float64) for bound in geometry.bounds())
    lo, hi = lo.min(axis=0), hi.max(axis=0)
    return lo, hi, 0.5 * (lo + hi), 0.5 * float(np.linalg.norm(hi - lo))


def endless(n: int) -> np.ndarray:
    return np.full(n, np.inf, np.float32)


def primary(view: _View, n: int) -> RaySet:
    """From a camera through a square of pixels, in rows: neighbours in the array are neighbours in the picture."""
    return view.primary


def shadow(view: _View, n: int) -> RaySet:
    """From what the camera sees towards one point above the mesh, as far as that point: any hit."""
    light = view.center + view.radius * np.array([0.8, 1.7, 0.6])
    origins, outward = _starts(view, n)
    directions = light - origins
    turned = (directions * outward).sum(axis=1) < 0.0
    origins = np.where(turned[:, None], origins - 2.0 * _offset(view) * outward, origins)
    return RaySet("shadow", origins.astype(np.float32), (light - origins).astype(np.float32), np.ones(n, np.float32), any_hit=True)


def diffuse(view: _View, n: int) -> RaySet:
    """From what the camera sees into all directions above the surface, more of them near its normal (cosine)."""
    origins, outward = _starts(view, n)
    directions = unit(outward + 0.999 * unit(view.rng.normal(size=(n, 3))))
    return RaySet("diffuse", origins.astype(np.float32), directions.astype(np.float32), endless(n))


def random(view: _View, n: int) -> RaySet:
    """Between two random points on the sphere around the mesh: uniform lines."""
    a, b = (view.center + view.radius * unit(view.rng.normal(size=(n, 3))) for _ in range(2))
    return RaySet("random", a.astype(np.float32), unit(b - a).astype(np.float32), endless(n))


def _offset(view: _View) -> float:
    return 1e-4 * view.radius


def _starts(view: _View, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points just above what is seen, repeated to n in their order, and the normals towards the camera."""
    if not len(view.points):  # nothing is seen: the sphere's surface, inwards
        normals = -unit(view.rng.normal(size=(n, 3)))
        return view.center - view.radius * normals, normals
    row = np.arange(n) * len(view.points) // n
    return view.points[row] + _offset(view) * view.normals[row], view.normals[row]


RAY_KINDS: dict[str, Callable[[_View, int], RaySet]] = {
    "primary": primary, "shadow": shadow, "diffuse": diffuse, "random": random}


def ray_sets(accel: Accelerator, n: int, seed: int = 0, inside: bool = False) -> dict[str, RaySet]:
    """About n rays of every kind (the square number below it for primary ones) through the geometry of a structure, which
    finds what the camera sees. The same for the same geometry, n and seed. inside: the camera stands in the middle of the
    mesh's box, as in a room, and not before it."""
    g = accel.geometry
    _, _, center, radius = ball_around(g)
    rng = np.random.default_rng(seed)
    eye = center + 1.5 * radius * unit(np.array([0.6, 0.35, 0.8]))
    seen = _camera(eye, center, n)
    hits = accel.closest_hit(seen.origins, seen.directions)
    if inside or not (hits.prim_id >= 0).any():
        eye = center
        seen = _camera(eye, center + np.array([0.3, 0.0, 1.0]), n)
        hits = accel.closest_hit(seen.origins, seen.directions)
    hit = (hits.prim_id >= 0) & (hits.prim_id < len(g.faces))
    points = seen.origins[hit].astype(np.float64) + hits.t[hit, None].astype(np.float64) * seen.directions[hit]
    corners = g.vertices[g.faces[hits.prim_id[hit]]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    points, normals = points[length > 0.0], normals[length > 0.0] / length[length > 0.0, None]
    normals = np.where(((points - eye) * normals).sum(axis=1, keepdims=True) > 0.0, -normals, normals)
    view = _View(center, radius, seen, points, normals, rng)
    return {kind: make(view, len(seen)) for kind, make in RAY_KINDS.items()}


def _camera(eye: np.ndarray, target: np.ndarray, n: int) -> RaySet:
    side = max(int(np.sqrt(n)), 1)
    forward = unit(target - eye)
    right = unit(np.cross(forward, [0.0, 1.0, 0.0]))
    up = np.cross(right, forward)
    x, y = np.meshgrid((np.arange(side) + 0.5) / side * 2.0 - 1.0, 1.0 - (np.arange(side) + 0.5) / side * 2.0)
    directions = unit(forward + SEEN * (x[..., None] * right + y[..., None] * up)).reshape(-1, 3)
    origins = np.broadcast_to(eye, directions.shape)
    return RaySet("primary", origins.astype(np.float32), directions.astype(np.float32), endless(len(directions)))
