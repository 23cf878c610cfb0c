"""Hard cases for simulators: rays among moved bodies in several worlds. The oracle judges each ray against the bodies that it may see.

Poses are exact in float32, as matrices and as quaternions: each is one of the twelve rotations of a tetrahedron, perhaps mirrored, and a
translation by multiples of 2^-6. Corners are multiples of 2^-14. So the vertices of a placed body are float32 numbers, and the oracle's
geometry has no error. All bodies are closed, so that rays that leak through an edge are seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.core.checks import as_integer, as_tuple, require_known
from wrt.io.gltf.meshes import compose
from wrt.lab.hard_cases.common import UNKNOWN, HardCase, cube, hard_case, joined, sphere, surface, targets
from wrt.lab.hard_cases.conformance import Report, Result, checked
from wrt.lab.hard_cases.judge import Verdict, judge
from wrt.lab.oracle.oracle import reference_of

ClosestBody = Callable[["Bodies"], Any]
FAR_OFF = 1e-4  # distance of a reported point from its face that is wrong; bodies have a size of 2, and rounding moves points by 1e-6
TILES = 6  # along an axis
BODIES = 8  # in a world
SIGNS = np.array([[x, y, z, 1] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
QUATERNIONS = np.concatenate([np.eye(4)[[3, 0, 1, 2]], 0.5 * SIGNS])  # the first is the identity


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies that have moved, and rays that see some of them. B bodies, N rays.

    - meshes: vertices (V, 3) float32 and faces (F, 3) int32 of each mesh. mesh: (B,), the mesh of each body; world: (B,), its world.
    - position, quaternion, mirrored: (B, 3), (B, 4) with w last, and (B,) bool of its pose, from the mesh's space to its world. A mirrored
      mesh is first multiplied by -1. before: (B, 3) position before the move. to_world: (B, 3, 4), the pose as matrices.
    - origins, directions: (N, 3) float32; t_max: (N,) float32; ray_world: (N,); exclude: (N,), a body that the ray does not see, or -1."""

    meshes: tuple[Geometry, ...]
    mesh: np.ndarray
    world: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    mirrored: np.ndarray
    before: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    t_max: np.ndarray
    ray_world: np.ndarray
    exclude: np.ndarray

    @property
    def to_world(self) -> np.ndarray:
        """The poses after the move, (B, 3, 4) float64."""
        signs = np.where(self.mirrored, -1.0, 1.0)[:, None]
        return compose(self.position, self.quaternion, np.tile(signs, 3))[:, :3]

    def placed(self, body: int) -> Geometry:
        """Return a body's mesh in its world."""
        mesh, pose = self.meshes[self.mesh[body]], self.to_world[body]
        return surface(mesh.vertices @ pose[:, :3].T + pose[:, 3], mesh.faces)


def _bodies(rng: np.random.Generator, worlds: int, mirrored: bool = False) -> dict[str, Any]:
    """Return fields of Bodies: `worlds` times BODIES closed bodies in places of a grid, so that none touch."""
    n = worlds * BODIES
    ball = sphere(48, 24)
    vertices = np.round(2.0**14 * ball.vertices * (0.9 + 0.2 * rng.random((len(ball.vertices), 1)))) / 2.0**14
    meshes = surface(vertices, ball.faces), surface(*cube(np.array([-1.0, -0.5, -0.25]), np.array([1.0, 0.5, 0.75])))
    grid = np.stack(np.meshgrid(*3 * [[-2.0, 2.0]]), axis=-1).reshape(-1, 3)
    return {"meshes": meshes, "mesh": np.arange(n) % 2, "world": np.arange(n) // BODIES,
            "position": np.tile(grid, (worlds, 1)) + rng.integers(-16, 17, (n, 3)) / 64.0, "before": np.tile(grid[::-1], (worlds, 1)),
            "quaternion": QUATERNIONS[rng.integers(12, size=n)], "mirrored": np.full(n, mirrored) & (rng.random(n) < 0.75)}


def _origins(rng: np.random.Generator, origins: np.ndarray) -> np.ndarray:
    """Round half of the origins to odd multiples of 2^-7, from which rays meet corners of bodies exactly, and the others to float32."""
    return np.where(rng.random((len(origins), 1)) < 0.5, (np.floor(64.0 * origins) + 0.5) / 64.0, origins).astype(np.float32)


def _aimed(rng: np.random.Generator, n: int, fields: dict[str, Any], exclude: bool = False, ends: bool = False) -> Bodies:
    """Aim rays at corners and edges of random bodies, half of them from within the body."""
    count = len(fields["mesh"])
    no_rays: dict[str, Any] = {
        "origins": np.zeros((n, 3), np.float32), "directions": np.zeros((n, 3), np.float32), "t_max": np.full(n, np.inf, np.float32),
        "exclude": np.full(n, -1), "ray_world": np.zeros(n, np.int64)}
    case, body = Bodies(**fields, **no_rays), rng.integers(count, size=n)
    for each in range(count):
        rows, geometry = np.flatnonzero(body == each), case.placed(each)
        beside = rng.random((len(rows), 1)) < 0.5
        within = case.position[each] + rng.uniform(-0.2, 0.2, (len(rows), 3))
        origins = _origins(rng, np.where(beside, rng.uniform(-6.0, 6.0, (len(rows), 3)), within))
        goal = np.where(np.arange(len(rows))[:, None] % 2, *(targets(geometry, rng, len(rows), aim) for aim in ("vertices", "edges")))
        case.origins[rows], case.directions[rows] = origins, goal - origins
        case.ray_world[rows], case.exclude[rows] = case.world[each], each if exclude else -1
        if ends:  # the segment ends at its goal, or a little before or behind it
            case.t_max[rows] = 1.0 + rng.integers(-2, 3, len(rows)) * 2.0**-10
    return case


def moved(rng: np.random.Generator, n: int) -> Bodies:
    """Bodies of one world after a move."""
    return _aimed(rng, n, _bodies(rng, 1))


def mirrored(rng: np.random.Generator, n: int) -> Bodies:
    """Bodies of one world after a move, three of four mirrored."""
    return _aimed(rng, n, _bodies(rng, 1, mirrored=True))


def worlds(rng: np.random.Generator, n: int) -> Bodies:
    """Four worlds of the same bodies in other poses; each ray sees one world."""
    return _aimed(rng, n, _bodies(rng, 4))


def excluded(rng: np.random.Generator, n: int) -> Bodies:
    """Four worlds; each ray leaves out the body at which it is aimed."""
    return _aimed(rng, n, _bodies(rng, 4), exclude=True)


def ends(rng: np.random.Generator, n: int) -> Bodies:
    """Segments that end at their goal, or at 2^-10 or 2^-9 of their length before or behind it."""
    return _aimed(rng, n, _bodies(rng, 1), ends=True)


def tiles(rng: np.random.Generator, n: int) -> Bodies:
    """Terrain of tiles that touch: each is the same closed block, moved by its width. Rays from above are aimed at corners and edges, half
    of them along a seam: in the plane of walls between tiles, or nearly."""
    count = TILES * TILES
    place = np.stack(np.divmod(np.arange(count), TILES), axis=1) - 0.5 * TILES
    fields = {"meshes": (surface(*cube(np.zeros(3), np.array([1.0, 1.0, 0.5]))),), "mesh": np.zeros(count, np.int64),
              "world": np.zeros(count, np.int64), "position": np.concatenate([place, np.zeros((count, 1))], axis=1),
              "before": np.concatenate([place[::-1], np.ones((count, 1))], axis=1), "quaternion": np.tile(QUATERNIONS[0], (count, 1)),
              "mirrored": np.zeros(count, bool)}
    case = _aimed(rng, n, fields)
    axis, row = rng.integers(2, size=n), np.arange(n)
    goal = np.concatenate([rng.integers(-128, 129, (n, 2)) / 64.0, np.full((n, 1), 0.5)], axis=1)
    goal[row, axis] = rng.integers(-2, 3, n)
    origins = _origins(rng, np.concatenate([rng.uniform(-2.0, 2.0, (n, 2)), rng.uniform(1.0, 4.0, (n, 1))], axis=1))
    within = rng.random(n) < 0.5
    origins[row[within], axis[within]] = goal[row[within], axis[within]]
    case.origins[:], case.directions[:] = origins, goal - origins
    case.directions[row, axis] += (rng.random(n) < 0.5) * rng.normal(size=n).astype(np.float32) * 1e-7
    return case


CASES: dict[str, Callable[[np.random.Generator, int], Bodies]] = {
    "J_moved": moved, "J_mirrored": mirrored, "J_worlds": worlds, "J_excluded": excluded, "J_ends": ends, "J_tiles": tiles}


def result(name: str, closest_body: ClosestBody, rays: int = 1000, seed: int = 0) -> Result:
    """Test `closest_body` (see `bodies`) on one case. An error that it raises becomes part of the result."""
    case, verdict, t_ulp = CASES[name](np.random.default_rng(seed), rays), Verdict(), 0.0
    try:
        answer = closest_body(case)
    except Exception as error:
        return Result(name, rays, raised=error)
    t, body = checked(answer, rays, "closest_body")
    body = np.where((body >= 0) & (t > case.t_max), -1, body)  # for libraries that have no t_max
    groups, group = np.unique(np.stack([case.ray_world, case.exclude], axis=1), axis=0, return_inverse=True)
    for index, (world, left_out) in enumerate(groups):
        rows = np.flatnonzero(group.reshape(-1) == index)
        seen = np.flatnonzero((case.world == world) & (np.arange(len(case.mesh)) != left_out))
        parts = [case.placed(int(each)) for each in seen]
        first = np.cumsum([0, *(len(part.faces) for part in parts)])
        part_of = np.full(len(case.mesh) + 1, -1)
        part_of[seen] = np.arange(len(seen))
        flat = hard_case(joined(*parts), case.origins[rows], case.directions[rows], UNKNOWN,
                         t_max=case.t_max[rows], closed=bool(np.isinf(case.t_max).all()))
        prim_id, exact = _faces(flat, t[rows], part_of[body[rows]], first)
        off = np.where(np.isfinite(exact), np.abs(t[rows] - exact), 0.0)
        t_ulp = max(t_ulp, float((off / np.spacing(np.minimum(exact, 1e30).astype(np.float32))).max(initial=0.0)))
        same = np.isfinite(exact) & (off * np.linalg.norm(flat.directions, axis=1) <= FAR_OFF)
        placed = np.where(same, np.minimum(exact, flat.t_max), t[rows])
        prim_id[(body[rows] >= 0) & (part_of[body[rows]] < 0)] = first[-1]  # a body that the ray does not see
        verdict += judge(flat, Hits(placed, None, None, prim_id), lowest=False)  # type: ignore[arg-type]  # without u and v
    return Result(name, verdict.rays, verdict.misses, verdict.false_hits, verdict.wrong_prim, t_ulp,
                  examples=tuple(verdict.examples))


def _faces(case: HardCase, t: np.ndarray, part: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a face of the reported part that the ray meets, or touches within rounding, at t, (N,). It is -1 for a miss, and the number of
    faces where the ray meets none. Also return the exact t, (N,): inf if the ray meets no face of the part there."""
    reference, found = reference_of(case.geometry), np.where(part >= 0, first[-1], -1)
    every = reference.all_hits(case.origins, case.directions)
    own = every[(part[every.ray] >= 0) & (np.searchsorted(first, every.prim_id, "right") - 1 == part[every.ray])]
    order = np.lexsort((-np.abs(own.t - t[own.ray]), own.ray))  # of a ray's hits the nearest to t is last
    near, exact = np.full(len(t), -1), np.full(len(t), np.inf)
    near[own.ray[order]], exact[own.ray[order]] = own.prim_id[order], own.t[order]
    good = (near >= 0) & (_distance(case, t, near) <= FAR_OFF)
    found[good] = near[good]
    for ray in np.flatnonzero((part >= 0) & ~good):
        faces = np.arange(first[part[ray]], first[part[ray] + 1])
        origins, directions = (np.repeat(each[ray:ray + 1], len(faces), axis=0) for each in (case.origins, case.directions))
        _, limit = reference.against(origins, directions, faces)
        one = replace(case, origins=origins, directions=directions)
        close = limit.touches & (_distance(one, np.full(len(faces), t[ray]), faces) <= FAR_OFF)
        if close.any():
            found[ray] = faces[np.argmax(close)]
    return found, np.where(good, exact, np.inf)


def _distance(case: HardCase, t: np.ndarray, prim_id: np.ndarray) -> np.ndarray:
    """Return the distance of each reported point from the plane of its face, (N,); 0 for a miss."""
    hit, corners = prim_id >= 0, case.geometry.vertices.astype(np.float64)[case.geometry.faces[prim_id]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    points = case.origins + np.where(hit, t, 0.0)[:, None] * case.directions.astype(np.float64)
    heights = np.einsum("ij,ij->i", points - corners[:, 0], normals) / np.linalg.norm(normals, axis=1)
    return np.where(hit, np.abs(heights), 0.0)


def bodies(closest_body: ClosestBody, cases: str | Sequence[str] = (), rays: int = 1000, seed: int = 0) -> Report:
    """Test a simulator's rays: moved and mirrored bodies, worlds, excluded bodies, ends of segments, tiles that touch.

    Parameters
    ----------
    closest_body : function of a Bodies
        It places the bodies at `before`, moves them to their poses, and traces the rays. It returns t in units of |direction|, and the
        index of the nearest body, -1 on a miss: (N,) each. If it cannot exclude bodies, it raises an error, which becomes the note.
    cases : names
        Default: all.
    rays : int
        Number of rays of each case.
    seed : int
        Seed of the random bodies and rays.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        An unknown name, or closest_body returns arrays of other shape or type."""
    names = as_tuple(cases, str, "cases") or tuple(CASES)
    rays, seed = as_integer(rays, "rays", 1, 1 << 24), as_integer(seed, "seed", 0, 1 << 63)
    for name in names:
        require_known(name, CASES, "hard case", "cases")
    return Report(tuple(result(name, closest_body, rays, seed) for name in names))
