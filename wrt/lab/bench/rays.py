"""Meshes and rays of measurements. Meshes are hills, a mesh in a large stadium, and many small worlds. Rays are the primary, shadow and
diffuse rays of a picture, incoherent rays, points, and many small pictures."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Counters
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, merged

RAY_KINDS = ("primary", "shadow", "diffuse", "random")
TAN_HALF_FOV = 0.55  # a field of view of 58 degrees
POINTS_OF_RAYS = 50  # rays for each point: trimesh takes milliseconds a point
TILE = 64  # pixels of a side of a picture in a small world
OFFSET = 1e-4  # start of shadow and diffuse rays above the surface, over the radius of the mesh's bounding sphere
BALLS = 10  # in a small world


@dataclass(frozen=True, eq=False)
class RaySet:
    """Rays of one kind. origins, directions: (N, 3) float32; t_max: (N,) float32; any_hit: trace for any hit (shadow rays).
    world: (N,) int32, the world of each ray, or None. The kind "points" has points in `origins`, and no directions."""

    kind: str
    origins: np.ndarray
    directions: np.ndarray
    t_max: np.ndarray
    any_hit: bool = False
    world: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, rows: slice | np.ndarray) -> "RaySet":
        return RaySet(self.kind, self.origins[rows], self.directions[rows], self.t_max[rows], self.any_hit,
                      None if self.world is None else self.world[rows])


def counters_of(accel: Accelerator, rays: Any, trace: bool = False) -> Counters:
    """Trace closest hits; return their counters. rays: origins, directions and t_max, such as a RaySet. trace: also record fetches."""
    counters = accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, counters=True, trace=trace).counters
    assert counters is not None
    return counters


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ball_around(geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the lowest and highest corner of the geometry's box, and the centre and radius of that box's bounding sphere."""
    lo, hi = (bound.astype(np.float64) for bound in geometry.bounds())
    lo, hi = lo.min(axis=0), hi.max(axis=0)
    return lo, hi, 0.5 * (lo + hi), 0.5 * float(np.linalg.norm(hi - lo))


def endless(n: int) -> np.ndarray:
    return np.full(n, np.inf, np.float32)


def shadow(origins: np.ndarray, outward: np.ndarray, center: np.ndarray, radius: float) -> RaySet:
    """Return any-hit rays from surface points to one point light above the mesh, at t_max = 1. outward: unit normals of the surface."""
    light = center + radius * np.array([0.8, 1.7, 0.6])
    directions = light - origins
    backfacing = (directions * outward).sum(axis=1) < 0.0
    origins = np.where(backfacing[:, None], origins - 2.0 * OFFSET * radius * outward, origins)
    return RaySet("shadow", origins.astype(np.float32), (light - origins).astype(np.float32), np.ones(len(origins), np.float32),
                  any_hit=True)


def diffuse(origins: np.ndarray, outward: np.ndarray, rng: np.random.Generator) -> RaySet:
    """Return rays from surface points into the hemisphere around the normal `outward`, with a cosine distribution."""
    directions = unit(outward + 0.999 * unit(rng.normal(size=origins.shape)))
    return RaySet("diffuse", origins.astype(np.float32), directions.astype(np.float32), endless(len(origins)))


def random(n: int, center: np.ndarray, radius: float, rng: np.random.Generator) -> RaySet:
    """Return n rays between random points on the mesh's bounding sphere; their lines are uniformly distributed."""
    a, b = (center + radius * unit(rng.normal(size=(n, 3))) for _ in range(2))
    return RaySet("random", a.astype(np.float32), unit(b - a).astype(np.float32), endless(n))


def inward(geometry: Geometry, n: int, seed: int = 0) -> RaySet:
    """Return n rays along uniformly distributed lines that meet the geometry's box. They start on its bounding sphere and go inwards."""
    lo, hi, center, radius = ball_around(geometry)
    rng = np.random.default_rng(seed)
    origins, directions = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
    while len(origins) < n:
        normal = unit(rng.normal(size=(n, 3)))
        o, d = (center + radius * normal).astype(np.float32), unit(unit(rng.normal(size=(n, 3))) - normal).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sort([(lo - o) / d, (hi - o) / d], axis=0)
        meets = t[0].max(axis=1) <= t[1].min(axis=1)
        origins, directions = np.concatenate([origins, o[meets]]), np.concatenate([directions, d[meets]])
    return RaySet("inward", origins[:n], directions[:n], endless(n))


def points_around(geometry: Geometry, rays: int, seed: int) -> RaySet:
    """Return a point for each POINTS_OF_RAYS of so many rays, in the box of the geometry, enlarged by a half."""
    low, high, center, _ = ball_around(geometry)
    shape = max(rays // POINTS_OF_RAYS, 1), 3
    points = (center + 0.75 * (high - low) * np.random.default_rng(seed).uniform(-1.0, 1.0, shape)).astype(np.float32)
    return RaySet("points", points, np.zeros_like(points), endless(len(points)))


def tiles(worlds: int) -> RaySet:
    """Return the rays of a camera that looks down on the middle of each world: TILE x TILE pixels, world by world."""
    x, y = np.meshgrid(*[(np.arange(TILE) + 0.5) / TILE * 2.0 - 1.0] * 2)
    one = unit(np.stack([0.5 * x, -0.5 * y - 0.5, np.full_like(x, -1.0)], axis=-1).reshape(-1, 3)).astype(np.float32)
    n = worlds * len(one)
    return RaySet("tiles", np.tile(np.array([0.0, 2.5, 4.0], np.float32), (n, 1)), np.tile(one, (worlds, 1)), endless(n),
                  world=np.repeat(np.arange(worlds, dtype=np.int32), len(one)))


def ray_sets(accel: Accelerator, n: int, seed: int = 0, inside: bool = False) -> dict[str, RaySet]:
    """Return a RaySet of every kind, each with the largest square number of rays up to n; equal arguments give equal rays.
    Shadow and diffuse rays start at the primary rays' hits in `accel`. inside: put the camera at the centre of the mesh's box."""
    g: Any = accel.geometry  # a Geometry: the structure is over one mesh
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

    def starts() -> tuple[np.ndarray, np.ndarray]:
        """Return a point just above a visible surface for each pixel, and the surface's unit normals towards the camera, (N, 3) each."""
        if not len(points):  # no primary ray hits: start on the bounding sphere, inwards
            inwards = -unit(rng.normal(size=(len(seen), 3)))
            return center - radius * inwards, inwards
        row = np.arange(len(seen)) * len(points) // len(seen)
        return points[row] + OFFSET * radius * normals[row], normals[row]

    return {"primary": seen, "shadow": shadow(*starts(), center, radius), "diffuse": diffuse(*starts(), rng),
            "random": random(len(seen), center, radius, rng)}


def _camera(eye: np.ndarray, target: np.ndarray, n: int) -> RaySet:
    """Return a camera's rays through the centres of a square of at most n pixels, row by row."""
    origins, directions = through_pixels(eye, target, max(int(np.sqrt(n)), 1))
    return RaySet("primary", origins.astype(np.float32), directions.astype(np.float32), endless(len(directions)))


def through_pixels(eye: np.ndarray, target: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions through the centres of side x side pixels, (side^2, 3) float64 each, row by row."""
    forward = unit(target - eye)
    right = unit(np.cross(forward, [0.0, 1.0, 0.0]))
    up = np.cross(right, forward)
    x, y = np.meshgrid((np.arange(side) + 0.5) / side * 2.0 - 1.0, 1.0 - (np.arange(side) + 0.5) / side * 2.0)
    directions = unit(forward + TAN_HALF_FOV * (x[..., None] * right + y[..., None] * up)).reshape(-1, 3)
    return np.broadcast_to(eye, directions.shape), directions


def terrain(cells: int) -> Mesh:
    """Return hills of a fixed shape over the square [-1, 1]^2 in x and z, with `2 * cells**2` triangles."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    y = sum(0.3 / k * np.sin(k * (2.1 * x + 0.7 * z) + k * k) * np.cos(k * (1.9 * z - 0.6 * x) + 2.0 * k) for k in (1, 2, 4, 8))
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = (i * (cells + 1) + j).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, name="terrain")


def stands(tiers: int = 50, seats: int = 400) -> Mesh:
    """Return a stadium of `2 + 4 * tiers * seats` triangles: a pitch at y = 0, and steps from radius 0.6 to 1 that rise to y = 0.25."""
    radius, height = np.linspace(0.6, 1.0, tiers + 1), np.linspace(0.0, 0.25, tiers + 1)
    r, y = np.repeat(radius, 2)[:-1], np.repeat(height, 2)[1:]
    angle = 2.0 * np.pi * np.arange(seats) / seats
    ring = np.stack([np.outer(r, np.cos(angle)), np.repeat(y[:, None], seats, axis=1), np.outer(r, np.sin(angle))], axis=-1)
    i, j = np.meshgrid(np.arange(len(r) - 1), np.arange(seats), indexing="ij")
    a, b = (i * seats + j).ravel(), (i * seats + (j + 1) % seats).ravel()
    faces = np.stack([a, b, b + seats, a, b + seats, a + seats], axis=1).reshape(-1, 3)
    pitch = np.array([[-0.6, 0.0, -0.6], [-0.6, 0.0, 0.6], [0.6, 0.0, 0.6], [0.6, 0.0, -0.6]])
    last = len(r) * seats
    return Mesh(np.concatenate([ring.reshape(-1, 3), pitch]),
                np.concatenate([faces, last + np.array([[0, 1, 2], [0, 2, 3]])]).astype(np.int32), name="stadium")


def in_stadium(mesh: Mesh) -> Mesh:
    """Return the mesh on the pitch of a stadium that is 1000 times as large; the mesh's faces come first. No single cell size of a uniform
    grid suits both (Haines 1988, "Spline Surface Rendering, and What's Wrong with Octrees", Ray Tracing News 1(2))."""
    lo, hi = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    around = stands()
    scale = 500.0 * float(np.linalg.norm(hi - lo))
    place = np.array([0.5 * (lo[0] + hi[0]), lo[1], 0.5 * (lo[2] + hi[2])])
    return merged([mesh, Mesh(around.vertices * scale + place, around.faces)], f"{mesh.name} in a stadium")


def small_worlds(count: int, seed: int) -> list[Mesh]:
    """Return worlds of BALLS balls of 320 triangles above a floor, as robots and games have. Every world has other balls."""
    rng, ball = np.random.default_rng(seed), icosphere(2)
    floor = np.array([[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]], np.float32)
    faces = np.concatenate([ball.faces + i * len(ball.vertices) for i in range(BALLS)])
    faces = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + BALLS * len(ball.vertices)])
    out = []
    for _ in range(count):
        centers, radii = rng.uniform((-1.5, 0.2, -1.5), (1.5, 1.5, 1.5), (BALLS, 3)), rng.uniform(0.1, 0.4, (BALLS, 1, 1))
        out.append(Mesh(np.concatenate([(centers[:, None] + radii * ball.vertices).reshape(-1, 3), floor]), faces))
    return out
