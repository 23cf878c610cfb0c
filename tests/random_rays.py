"""Random rays at triangles: through their interior, corners and edges, along the axes, from their surfaces, and as bundles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Rng = np.random.Generator
RAYS = 64
FARTHEST = 1e37  # largest absolute coordinate of an origin


@dataclass(frozen=True)
class Rays:
    """origins, directions: (N, 3) float32; t_min, t_max: (N,) float32 in units of |direction|."""

    origins: np.ndarray
    directions: np.ndarray
    t_min: np.ndarray
    t_max: np.ndarray

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class Target:
    """corners: (T, 3, 3) float64, finite, T >= 1; low, size: (3,) least corner and extent of the box around them, slightly padded."""

    corners: np.ndarray
    low: np.ndarray
    size: np.ndarray

    @staticmethod
    def of(corners: np.ndarray) -> Target:
        good = corners[np.isfinite(corners).all(axis=(1, 2))].astype(np.float64)
        good = good if len(good) else np.eye(3)[None]
        low, high = good.min(axis=(0, 1)), good.max(axis=(0, 1))
        return Target(good, low, np.maximum(high - low, 1e-3 * np.max(high - low) + 1e-30))

    def inside(self, rng: Rng, n: int) -> np.ndarray:
        return self.low + self.size * rng.random((n, 3))

    def outside(self, rng: Rng, n: int) -> np.ndarray:
        return self.low + 0.5 * self.size + 2.0 * np.max(self.size) * unit(rng.normal(size=(n, 3)))

    def some(self, rng: Rng, n: int) -> np.ndarray:
        return self.corners[rng.integers(0, len(self.corners), n)]

    def corner(self, rng: Rng, n: int) -> np.ndarray:
        return self.some(rng, n)[np.arange(n), rng.integers(0, 3, n)]

    def on_edge(self, rng: Rng, n: int) -> np.ndarray:
        triangles, share = self.some(rng, n), rng.choice([0.25, 0.5, 0.3, 0.9], (n, 1))
        return share * triangles[:, 0] + (1.0 - share) * triangles[:, 1]

    def on_surface(self, rng: Rng, n: int) -> np.ndarray:
        return np.einsum("nk,nkj->nj", rng.dirichlet((1.0, 1.0, 1.0), n), self.some(rng, n))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


Bundle = tuple[np.ndarray, np.ndarray]  # origins and directions, (n, 3) float64


def inwards(rng: Rng, target: Target, n: int) -> Bundle:
    origins = target.outside(rng, n)
    return origins, target.inside(rng, n) - origins


def from_within(rng: Rng, target: Target, n: int) -> Bundle:
    return target.inside(rng, n), rng.normal(size=(n, 3))


def at_corners(rng: Rng, target: Target, n: int) -> Bundle:
    origins = target.outside(rng, n)
    return origins, target.corner(rng, n) - origins.astype(np.float32)


def at_edges(rng: Rng, target: Target, n: int) -> Bundle:
    origins = target.outside(rng, n)
    return origins, target.on_edge(rng, n) - origins.astype(np.float32)


def along_axes(rng: Rng, target: Target, n: int) -> Bundle:
    """Return axis-parallel rays through corners; the zeros of their directions have random signs."""
    axes = np.zeros((n, 3)) * rng.choice([-1.0, 1.0], (n, 3))
    axes[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1.0, 1.0], n)
    origins = np.where(axes == 0.0, target.corner(rng, n), target.low + 0.5 * target.size - 2.0 * np.max(target.size) * axes)
    return origins, axes


def in_a_plane(rng: Rng, target: Target, n: int) -> Bundle:
    """Return rays at edges, moved into an axis-parallel plane through a corner: one component of their direction is 0 or -0."""
    origins, directions = at_edges(rng, target, n)
    axis, rows = rng.integers(0, 3, n), np.arange(n)
    origins[rows, axis], directions[rows, axis] = target.corner(rng, n)[rows, axis], rng.choice([-0.0, 0.0], n)
    return origins, directions


def nearly_along_axes(rng: Rng, target: Target, n: int) -> Bundle:
    """Return rays along an axis through surfaces, with other components so small that products of them underflow."""
    origins, axes = along_axes(rng, target, n)
    origins = np.where(axes == 0.0, target.on_surface(rng, n), origins)
    return origins, np.where(axes == 0.0, rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-46.0, -20.0, (n, 3)), axes)


def from_surfaces(rng: Rng, target: Target, n: int) -> Bundle:
    origins = np.where(rng.random((n, 1)) < 0.3, target.corner(rng, n), target.on_surface(rng, n))
    return origins, np.where(rng.random((n, 1)) < 0.5, rng.normal(size=(n, 3)), target.inside(rng, n) - origins)


def edge_on(rng: Rng, target: Target, n: int) -> Bundle:
    """Return rays along edges, and other rays in the planes of triangles."""
    triangles = target.some(rng, n)
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    directions = a + rng.choice([0.0, 0.0, 1.0, -0.5], (n, 1)) * b
    return triangles[:, 0] - rng.choice([0.0, 1.0, 2.0], (n, 1)) * directions, directions


def camera(rng: Rng, target: Target, n: int) -> Bundle:
    """Return coherent rays from one point."""
    origin, aim = target.outside(rng, 1), target.inside(rng, 1)
    spread = np.max(target.size) * 10.0 ** rng.uniform(-3.0, 0.0)
    return np.repeat(origin, n, axis=0), aim - origin + spread * rng.uniform(-1.0, 1.0, (n, 3))


def parallel(rng: Rng, target: Target, n: int) -> Bundle:
    direction = unit(rng.normal(size=3)) if rng.random() < 0.7 else np.eye(3)[rng.integers(3)]
    return target.inside(rng, n) - 2.0 * np.max(target.size) * direction, np.repeat(direction[None], n, axis=0)


BUNDLES: dict[str, Callable[[Rng, Target, int], Bundle]] = {
    each.__name__: each for each in (inwards, from_within, at_corners, at_edges, along_axes, nearly_along_axes, in_a_plane,
                                     from_surfaces, edge_on, camera, parallel)}


def rays_of(rng: Rng, corners: np.ndarray) -> Rays:
    """Return RAYS rays of one to four kinds at triangles (T, 3, 3); their directions have any length, often 1."""
    target = Target.of(corners)
    kinds = rng.choice([*BUNDLES], rng.integers(1, 5))
    parts = [BUNDLES[kind](rng, target, len(part)) for kind, part in
             zip(kinds, np.array_split(np.arange(RAYS), len(kinds)), strict=True)]
    origins, directions = (np.concatenate(each) for each in zip(*parts, strict=True))
    lengths = rng.random()
    if lengths < 0.2:
        directions = directions * 10.0 ** rng.uniform(-25.0, 25.0, (RAYS, 1))
    elif lengths < 0.4:
        directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
    order = rng.permutation(RAYS) if rng.random() < 0.5 else np.arange(RAYS)
    with np.errstate(over="ignore", under="ignore"):
        origins, directions = origins[order].astype(np.float32), directions[order].astype(np.float32)
    most = np.finfo(np.float32).max
    origins, directions = np.clip(origins, -FARTHEST, FARTHEST), np.clip(directions, -most, most)
    directions[~directions.any(axis=1)] = 1.0
    return Rays(origins, directions, np.zeros(RAYS, np.float32), np.full(RAYS, np.inf, np.float32))


def at_their_hits(rng: Rng, rays: Rays, hits: Any) -> Rays:
    """Return the rays as segments that begin or end at, before or behind their hits; a miss counts as a hit at t = 1."""
    n = len(rays)
    t = np.where(hits.prim_id >= 0, hits.t, np.float32(1.0))
    with np.errstate(over="ignore"):
        near = (t * rng.choice(np.float32([1.0, 1.0, 1.0 - 2.0**-24, 1.0 + 2.0**-23, 0.5, 2.0]), n)).astype(np.float32)
    begins = rng.random(n) < 0.4
    t_min = np.where(begins, np.maximum(near, 0.0), 0.0).astype(np.float32)
    t_max = np.where(begins, rng.choice(np.float32([np.inf, 1.0, 3.4e38]), n), near).astype(np.float32)
    return Rays(rays.origins, rays.directions, t_min, t_max)
