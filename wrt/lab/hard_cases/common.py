"""The type HardCase, aimed rays, and meshes that several cases share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.arguments import rays_of
from wrt.accel.queries.rays import rays_on
from wrt.core.types import Device
from wrt.kernels.query import RayArrays

HIT, UNKNOWN, MISS = 1, 0, -1  # exact answer of a ray; for UNKNOWN only the oracle can tell
AIMS = ("uniform", "vertices", "edges")
NO_SPHERES = np.zeros((0, 4), np.float32)

Seed = int | Sequence[int]


@dataclass(frozen=True, eq=False)
class HardCase:
    """A geometry, rays that are hard to intersect with it, and what is known of the right answers.

    - origins, directions: (N, 3) float32; t_min, t_max: (N,) float32.
    - expected: (N,) int8 of HIT, MISS, UNKNOWN; HIT and MISS follow from the way the rays are generated.
    - closed: each edge has two faces of opposite directions. So no ray may pass through. `judge` then tests by the winding
      number whether a ray leaks through crossings that were not reported.
    - next_directions: (N, 3) directions of any length in which rays continue from their hits (case C), or None. On a sphere they are
      first turned to the outside.
    - refused: Mesh or the query must refuse these NumPy arrays with an InputError. In device arrays, rays that are not finite miss.
    - compared: largest number of reported hits that `judge` compares with the oracle's closest hit. notes: description of the case."""

    geometry: Geometry
    origins: np.ndarray
    directions: np.ndarray
    t_min: np.ndarray
    t_max: np.ndarray
    expected: np.ndarray
    closed: bool = False
    next_directions: np.ndarray | None = None
    refused: bool = False
    compared: int = 20_000
    name: str = ""
    notes: str = ""

    def __len__(self) -> int:
        return len(self.origins)

    def on(self, device: Device) -> RayArrays:
        return rays_on(device, rays_of(self.origins, self.directions, self.t_min, self.t_max)[0])


def hard_case(geometry: Geometry, origins: np.ndarray, directions: np.ndarray, expected: int | np.ndarray, *,
              t_min: float | np.ndarray = 0.0, t_max: float | np.ndarray = np.inf, closed: bool = False) -> HardCase:
    """Return a HardCase with arrays of the right types. A direction that rounds to 0 becomes (1, 0, 0)."""
    n = len(origins)
    with np.errstate(over="ignore"):
        origins, directions = (np.ascontiguousarray(x, dtype=np.float32) for x in (origins, directions))
    directions[~directions.any(axis=1), 0] = 1.0
    low, high = (np.broadcast_to(np.asarray(x, np.float32), (n,)).copy() for x in (t_min, t_max))
    return HardCase(geometry, origins, directions, low, high, np.broadcast_to(np.asarray(expected, np.int8), (n,)).copy(), closed=closed)


def surface(vertices: np.ndarray, faces: np.ndarray, spheres: np.ndarray = NO_SPHERES) -> Geometry:
    with np.errstate(over="ignore"):
        return Geometry(np.ascontiguousarray(vertices, dtype=np.float32), np.ascontiguousarray(faces, dtype=np.int32),
                        np.ascontiguousarray(spheres, dtype=np.float32).reshape(-1, 4))


def soup(corners: np.ndarray) -> Geometry:
    """Return the geometry of triangles (N, 3, 3) that share no vertex."""
    return surface(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def joined(*parts: Geometry) -> Geometry:
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return surface(np.concatenate([part.vertices for part in parts]),
                   np.concatenate([part.faces + first for part, first in zip(parts, start, strict=False)]))


def unit_vectors(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return (n, 3) float64 vectors, uniform over the sphere."""
    x = rng.normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def in_ball(rng: np.random.Generator, n: int, radius: float = 1.0) -> np.ndarray:
    """Return (n, 3) float64 points, uniform in the ball around 0."""
    return radius * rng.random((n, 1)) ** (1.0 / 3.0) * unit_vectors(rng, n)


def targets(geometry: Geometry, rng: np.random.Generator, n: int, aim: str) -> np.ndarray:
    """Return (n, 3) float64 targets on random faces: corners if `aim` is "vertices", else points on edges."""
    face = geometry.faces[rng.integers(len(geometry.faces), size=n)]
    corner = rng.integers(3, size=n)
    row = np.arange(n)
    a, b = (geometry.vertices[face[row, (corner + i) % 3]].astype(np.float64) for i in (0, 1))
    return a if aim == "vertices" else a + rng.random((n, 1)) * (b - a)


def aimed(geometry: Geometry, rng: np.random.Generator, origins: np.ndarray, aim: str) -> np.ndarray:
    """Return (n, 3) float64 directions from origins (n, 3) float32: unit vectors if `aim` is "uniform", else target - origin.
    Rounding to float32 moves the ray off its target by up to 2^-24 of the distance on each axis, which makes the case hard."""
    if aim == "uniform":
        return unit_vectors(rng, len(origins))
    return targets(geometry, rng, len(origins), aim) - origins.astype(np.float64)


def lat_long(slices: int, stacks: int, radii: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) float64 and faces of a closed sphere around 0: `2 * slices * (stacks - 1)` triangles, poles on z.
    Faces are counter-clockwise from outside. radii: one number, or one for each of `2 + slices * (stacks - 1)` vertices, poles first."""
    theta = np.pi * np.arange(1, stacks) / stacks
    phi = 2.0 * np.pi * np.arange(slices) / slices
    ring = np.stack([np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi),
                     np.repeat(np.cos(theta)[:, None], slices, axis=1)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], ring]) * np.reshape(radii, (-1, 1))
    i, j = np.arange(slices), (np.arange(slices) + 1) % slices
    last = 2 + slices * (stacks - 2)
    faces = [np.stack([np.zeros_like(i), 2 + i, 2 + j], axis=1), np.stack([np.ones_like(i), last + j, last + i], axis=1)]
    for row in range(stacks - 2):
        a = 2 + slices * row
        b = a + slices
        faces += [np.stack([a + i, b + i, b + j], axis=1), np.stack([a + i, b + j, a + j], axis=1)]
    return vertices, np.concatenate(faces)


@cache
def sphere(slices: int, stacks: int, radius: float = 1.0, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Geometry:
    """Return a closed latitude-longitude sphere around `center`, rounded to float32."""
    vertices, faces = lat_long(slices, stacks)
    return surface(radius * vertices + np.array(center), faces)


def cube(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eight vertices and twelve faces of a box, counter-clockwise from outside."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
