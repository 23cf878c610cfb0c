"""The oracle: exact hits of rays, in NumPy. It is slow and clear, and shares no code with Warp or the tests that it judges.

A ray o + t d, with t in the closed segment [t_min, t_max], hits a triangle if it meets the closed triangle and is not parallel to its
plane. So a ray in the plane does not hit, and a triangle without area or with a coordinate that is not finite is never hit. A sphere is
hit where the ray enters and where it leaves, or once where the ray only touches it. Both sides of a surface count. Coordinates are float32
values, treated as exact. `exact` beside it explains how signs are decided, and `bounds` bounds the errors of float32 tests.

>>> answer = closest(mesh, origins, directions)         # mesh: anything with vertices, faces and perhaps spheres
>>> answer.prim_id[answer.tie]                          # rays that meet several triangles at exactly the same t"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.lab.oracle.bounds import Bounds, sphere_bounds, sure, triangle_bounds
from wrt.lab.oracle.exact import UNIT, Crossings, Place, SphereCrossings, exact_plane, sphere_crossings, triangle_crossings

__all__ = ["AllHits", "Answer", "Bounds", "Crossings", "Place", "Reference", "closest", "reference_of", "sure", "t_bound"]

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from wrt.accel.geometry import Geometry
    from wrt.scene.mesh import Mesh

WIDTH = 4  # children of a node of the tree
RAYS_AT_ONCE = 8192
PAIRS_AT_ONCE = 1_000_000
SLAB = 8.0 * UNIT  # relative error of a slab's distance, which has three float64 roundings, with a margin


# Row of an array of hits; rows are ordered by ray, then t, then prim_id. The relative error of t is at most 1e-14, and t_error bounds
# |t - exact t|. On spheres u = v = 0. A recarray has these names as attributes: hits.ray.
HIT = np.dtype([("ray", np.int64), ("prim_id", np.int32), ("t", np.float64), ("u", np.float64), ("v", np.float64),
                ("t_error", np.float64), ("place", np.int8)])
AllHits = Any  # np.recarray, whose stubs do not know its attributes


@dataclass(frozen=True, eq=False)
class Answer:
    """The closest hit of each ray, arrays (N,).
    - t, u, v: float64, t inf on a miss; prim_id: int32, -1 on a miss, the lowest of an exact tie; place: int8, a Place.
    - tie: flags of rays that hit several primitives at exactly this t; ties: index of such a ray -> the primitives' prim_id, ascending."""

    t: np.ndarray
    prim_id: np.ndarray
    u: np.ndarray
    v: np.ndarray
    place: np.ndarray
    tie: np.ndarray
    ties: dict[int, np.ndarray] = field(default_factory=dict)


def _hits(*columns: np.ndarray) -> AllHits:
    return np.rec.fromarrays(columns, dtype=HIT)


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays as (3, N) float64. inverse: 1 / direction; near: for each axis, the row of boxes (6, nodes) that has the near planes."""

    origin: np.ndarray
    direction: np.ndarray
    t_min: np.ndarray
    t_max: np.ndarray
    inverse: np.ndarray
    near: np.ndarray

    @staticmethod
    def of(origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike, t_max: ArrayLike) -> _Rays:
        o, d = (np.ascontiguousarray(np.asarray(x, dtype=np.float32).astype(np.float64).T) for x in (origins, directions))
        n = o.shape[1]
        ends = [np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)) for x in (t_min, t_max)]
        with np.errstate(divide="ignore"):
            inverse = 1.0 / d
        return _Rays(o, d, ends[0], ends[1], inverse, np.arange(3)[:, None] + 3 * np.signbit(d))

    def chosen(self, rows: np.ndarray) -> _Rays:
        return _Rays(self.origin[:, rows], self.direction[:, rows], self.t_min[rows], self.t_max[rows],
                     self.inverse[:, rows], self.near[:, rows])


class Reference:
    """A geometry prepared for queries: its primitives in a tree of conservative boxes.

    - geometry: vertices (V, 3), faces (F, 3) and perhaps spheres (S, 4) of centre and radius; float32 values.
    - prim_id numbers the faces first, then the spheres. finite: (N,) flags of the primitives with finite coordinates."""

    def __init__(self, geometry: Geometry | Mesh) -> None:
        vertices = np.asarray(geometry.vertices, dtype=np.float32).astype(np.float64)
        faces = np.asarray(geometry.faces, dtype=np.int64)
        spheres = np.asarray(getattr(geometry, "spheres", np.zeros((0, 4))), dtype=np.float32).astype(np.float64)
        self.n_triangles = len(faces)
        self.corners = tuple(np.ascontiguousarray(vertices[faces[:, i]].T) for i in range(3))
        self.center, self.radius = np.ascontiguousarray(spheres[:, :3].T), spheres[:, 3]
        lo = np.concatenate([np.minimum(np.minimum(*self.corners[:2]), self.corners[2]), self.center - self.radius], axis=1)
        hi = np.concatenate([np.maximum(np.maximum(*self.corners[:2]), self.corners[2]), self.center + self.radius], axis=1)
        self.finite = np.isfinite(lo).all(axis=0) & np.isfinite(hi).all(axis=0)
        self.leaf_prim, self.levels = _tree(*_widened(lo, hi, self.n_triangles, self.finite))

    def triangles(self, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the corners of the triangles `prim_id`, three arrays (3, N) float64."""
        a, b, c = (np.take(corner, prim_id, axis=1) for corner in self.corners)
        return a, b, c

    def candidates(self, rays: _Rays) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield two arrays, ray and prim_id, of pairs that may hit. All pairs of one ray come at once."""
        n = len(rays.t_min)
        usable = np.isfinite(rays.origin).all(axis=0) & np.isfinite(rays.direction).all(axis=0) & rays.direction.any(axis=0)
        stack = [np.flatnonzero(usable[i:i + RAYS_AT_ONCE]) + i for i in reversed(range(0, n, RAYS_AT_ONCE))]
        while stack:
            rows = stack.pop()
            pairs = self._descend(rays.chosen(rows), len(rows))
            if pairs is None:
                stack += [rows[len(rows) // 2:], rows[:len(rows) // 2]]
            elif len(pairs[0]):
                yield rows[pairs[0]], pairs[1]

    def _descend(self, rays: _Rays, n: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Trace all rays down the tree, level by level; return pairs (ray, prim_id), or None if a level has too many pairs."""
        ray, node = np.arange(n), np.zeros(n, np.int64)
        for boxes in self.levels:
            keep = _meets(boxes, node, rays, ray)
            ray, node = ray[keep], node[keep]
            if boxes is self.levels[-1]:
                break
            if len(ray) * WIDTH > PAIRS_AT_ONCE and n > 1:
                return None
            ray = np.repeat(ray, WIDTH)
            node = (node[:, None] * WIDTH + np.arange(WIDTH)).reshape(-1)
        return ray, self.leaf_prim[node]

    def all_hits(self, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> AllHits:
        """Return every hit of each ray in its closed segment. Rays that are not finite or have the direction 0 hit nothing.
        origins, directions: (N, 3), rounded to float32; t_min, t_max: numbers or (N,)."""
        rays = _Rays.of(origins, directions, t_min, t_max)
        found = [self._tested(rays, ray, prim_id) for ray, prim_id in self.candidates(rays)]
        hits = np.concatenate([np.recarray(0, HIT), *found]).view(np.recarray)
        return hits[np.lexsort((hits.prim_id, hits.t, hits.ray))]

    def _tested(self, rays: _Rays, ray: np.ndarray, prim_id: np.ndarray) -> AllHits:
        """Test pairs (ray, prim_id) exactly; return the hits."""
        triangle = prim_id < self.n_triangles
        parts = [self._tested_triangles(rays, ray[triangle], prim_id[triangle])]
        if not triangle.all():
            r, p = ray[~triangle], prim_id[~triangle]
            found = sphere_crossings(*self._sphere_columns(rays, r, p))
            for end in range(2):
                t, t_error = found.t[end], found.t_error[end]
                keep = np.flatnonzero(found.hit & (t >= rays.t_min[r]) & (t <= rays.t_max[r]) & ((end == 0) | ~found.touching))
                place = np.where(found.touching[keep], Place.EDGE, Place.INSIDE).astype(np.int8)
                zero = np.zeros(len(keep))
                parts.append(_hits(r[keep], p[keep], t[keep], zero, zero, t_error[keep], place))
        return np.concatenate(parts).view(np.recarray)

    def _tested_triangles(self, rays: _Rays, ray: np.ndarray, prim_id: np.ndarray) -> AllHits:
        o, d = rays.origin[:, ray], rays.direction[:, ray]
        found = triangle_crossings(o, d, self.triangles(prim_id))
        keep = np.flatnonzero(found.hit)
        t, error = found.t[keep], found.t_error[keep]
        low, high = rays.t_min[ray[keep]], rays.t_max[ray[keep]]
        inside = (t - error >= low) & (t + error <= high)
        # Some t are too close to an end of the segment for float64 to decide: compare exact fractions.
        close = np.flatnonzero(~inside & (t + error >= low) & (t - error <= high))
        if len(close):
            rows = keep[close]
            for row, exact in zip(close, _fractions(o[:, rows], d[:, rows], self.triangles(prim_id[rows])), strict=True):
                inside[row] = low[row] <= exact <= high[row]
        keep = keep[inside]
        return _hits(ray[keep], prim_id[keep], found.t[keep], found.u[keep], found.v[keep], found.t_error[keep], found.place[keep])

    def _sphere_columns(self, rays: _Rays, ray: np.ndarray, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        sphere = prim_id - self.n_triangles
        return rays.origin[:, ray], rays.direction[:, ray], self.center[:, sphere], self.radius[sphere]

    def closest(self, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Answer:
        """Return the closest hit of each ray in its closed segment; arguments as for `all_hits`."""
        return self.closest_of(self.all_hits(origins, directions, t_min, t_max), origins, directions)

    def closest_of(self, hits: AllHits, origins: ArrayLike, directions: ArrayLike) -> Answer:
        """Return the closest hit of each ray. hits: result of `all_hits` for these rays."""
        n = len(np.asarray(origins))
        answer = Answer(np.full(n, np.inf), np.full(n, -1, np.int32), np.zeros(n), np.zeros(n), np.zeros(n, np.int8), np.zeros(n, bool))
        if not len(hits):
            return answer
        ray, first, group = np.unique(hits.ray, return_index=True, return_inverse=True)
        reach = np.minimum.reduceat(hits.t + hits.t_error, first)
        close = np.flatnonzero(hits.t - hits.t_error <= reach[group])
        winner = first.copy()
        contested = np.flatnonzero(np.bincount(group[close], minlength=len(ray)) > 1)
        for k, tied in self._first_exactly(hits, close[np.isin(group[close], contested)], group, origins, directions):
            winner[k] = tied[0]
            if len(np.unique(hits.prim_id[tied])) > 1:
                answer.tie[ray[k]] = True
                answer.ties[int(ray[k])] = np.sort(hits.prim_id[tied])
        for name in ("t", "prim_id", "u", "v", "place"):
            getattr(answer, name)[ray] = getattr(hits, name)[winner]
        return answer

    def _first_exactly(self, hits: AllHits, rows: np.ndarray, group: np.ndarray, origins: ArrayLike,
                       directions: ArrayLike) -> Iterator[tuple[int, list[int]]]:
        """Yield the number of each group of the hits `rows`, and its hits of exactly lowest t, by prim_id. For spheres, t is float64."""
        rays = _Rays.of(origins, directions, 0.0, np.inf)
        triangle = hits.prim_id[rows] < self.n_triangles
        exact: dict[int, Any] = {int(row): Fraction(float(hits.t[row])) for row in rows[~triangle]}
        r = rows[triangle]
        if len(r):
            o, d = rays.origin[:, hits.ray[r]], rays.direction[:, hits.ray[r]]
            exact |= dict(zip(r.tolist(), _fractions(o, d, self.triangles(hits.prim_id[r])), strict=True))
        for part in np.split(rows, np.flatnonzero(np.diff(group[rows])) + 1) if len(rows) else []:
            lowest = min(exact[int(row)] for row in part)
            tied = [int(row) for row in part if exact[int(row)] == lowest]
            yield int(group[part[0]]), sorted(tied, key=lambda row: int(hits.prim_id[row]))

    def against(self, origins: ArrayLike, directions: ArrayLike, prim_id: np.ndarray) -> tuple[Crossings, Bounds]:
        """Intersect the whole line of ray i with triangle prim_id[i]; all coordinates must be finite.
        Return the exact crossings, and bounds on the errors of the float32 test."""
        rays = _Rays.of(origins, directions, 0.0, np.inf)
        corners = self.triangles(prim_id)
        found = triangle_crossings(rays.origin, rays.direction, corners, all_rows=True)
        return found, triangle_bounds(rays.origin, rays.direction, corners, found)

    def against_sphere(self, origins: ArrayLike, directions: ArrayLike,
                       prim_id: np.ndarray) -> tuple[SphereCrossings, np.ndarray, np.ndarray]:
        """Return the crossings of ray i with sphere prim_id[i], bounds on both t (2, N), and flags of hits that may be reported."""
        rays = _Rays.of(origins, directions, 0.0, np.inf)
        columns = self._sphere_columns(rays, np.arange(len(prim_id)), prim_id)
        found = sphere_crossings(*columns)
        bounds = [sphere_bounds(*columns, found.t[end]) for end in range(2)]
        return found, np.stack([bounds[0][0], bounds[1][0]]), bounds[0][1]


def _fractions(o: np.ndarray, d: np.ndarray, v: tuple[np.ndarray, ...]) -> list[Fraction]:
    """Return the exact t of hits as fractions; o, d and v have one ray a column."""
    if not o.shape[1]:
        return []
    _, (numerator, slope, _), _, power = exact_plane(o, d, v)
    scale = Fraction(2) ** power
    return [Fraction(p, q) * scale for p, q in zip(numerator.tolist(), slope.tolist(), strict=True)]


def _widened(lo: np.ndarray, hi: np.ndarray, n_triangles: int, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes (3, N) that surely contain their primitives: rounded outwards for spheres, empty if not finite."""
    with np.errstate(invalid="ignore"):
        lo[:, n_triangles:] -= 4.0 * UNIT * np.abs(lo[:, n_triangles:])
        hi[:, n_triangles:] += 4.0 * UNIT * np.abs(hi[:, n_triangles:])
    lo[:, ~finite], hi[:, ~finite] = np.inf, -np.inf
    return lo, hi


def _tree(lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Build a complete tree with WIDTH children a node; return the primitive of each leaf, and the boxes (6, nodes) of each level.
    Halve the primitives of all nodes of a level at once, at the median of the centres along the axis of their largest extent."""
    n = lo.shape[1]
    depth = 0
    while WIDTH**depth < n:
        depth += 1
    size = WIDTH**depth
    prim = np.concatenate([np.arange(n), np.full(size - n, -1)])
    with np.errstate(invalid="ignore"):
        middle = np.where(np.isfinite(lo), 0.5 * lo + 0.5 * hi, 0.0)
    center = np.concatenate([middle, np.repeat(middle[:, -1:] if n else np.zeros((3, 1)), size - n, axis=1)], axis=1)
    order = np.arange(size)
    length = size
    while length > 1:
        ranges = center[:, order].reshape(3, -1, length)
        axis = np.argmax(ranges.max(axis=2) - ranges.min(axis=2), axis=0)
        key = np.take_along_axis(ranges, axis[None, :, None], axis=0)[0]
        order = np.take_along_axis(order.reshape(-1, length), np.argsort(key, axis=1, kind="stable"), axis=1).reshape(-1)
        length //= 2
    prim = prim[order]
    boxes = np.empty((6, size))
    boxes[:3], boxes[3:] = np.inf, -np.inf
    boxes[:3, prim >= 0], boxes[3:, prim >= 0] = lo[:, prim[prim >= 0]], hi[:, prim[prim >= 0]]
    levels = [boxes]
    while levels[0].shape[1] > 1:
        below = levels[0].reshape(6, -1, WIDTH)
        levels.insert(0, np.concatenate([below[:3].min(axis=2), below[3:].max(axis=2)]))
    return prim.astype(np.int32), levels


def _meets(boxes: np.ndarray, node: np.ndarray, rays: _Rays, ray: np.ndarray) -> np.ndarray:
    """Return flags of the pairs (node, ray) in which the ray's segment may meet the node's box. All pairs that meet have the flag.
    For a ray that lies in a plane of the box, 0 * inf is NaN, which fmin and fmax ignore."""
    enter, leave = np.full(len(ray), -np.inf), np.full(len(ray), np.inf)
    flat = boxes.reshape(-1)
    with np.errstate(invalid="ignore", over="ignore"):
        for axis in range(3):
            near = rays.near[axis][ray]
            far = 2 * axis + 3 - near
            o, inverse = rays.origin[axis][ray], rays.inverse[axis][ray]
            enter = np.fmax(enter, (flat[near * boxes.shape[1] + node] - o) * inverse)
            leave = np.fmin(leave, (flat[far * boxes.shape[1] + node] - o) * inverse)
    enter = enter * np.where(enter > 0.0, 1.0 - SLAB, 1.0 + SLAB)
    leave = leave * np.where(leave > 0.0, 1.0 + SLAB, 1.0 - SLAB)
    empty = flat[node] > flat[3 * boxes.shape[1] + node]
    return (np.maximum(enter, rays.t_min[ray]) <= np.minimum(leave, rays.t_max[ray])) & ~empty


@lru_cache(maxsize=4)
def reference_of(geometry: Geometry | Mesh) -> Reference:
    """Return the Reference of a geometry. The References of the last four geometries are cached."""
    return Reference(geometry)


def closest(geometry: Geometry | Mesh, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
            t_max: ArrayLike = np.inf) -> Answer:
    """Return the closest hit of each ray in the closed segment [t_min, t_max]; at exactly equal t the lowest prim_id.

    geometry: as for `Reference`; origins, directions: (N, 3), rounded to float32; t_min, t_max: numbers or (N,). The relative error of t
    and the errors of u and v are at most 1e-14. A ray that is not finite misses."""
    return reference_of(geometry).closest(origins, directions, t_min, t_max)


def t_bound(origins: ArrayLike, directions: ArrayLike, triangles: ArrayLike) -> np.ndarray:
    """Return the bound on the error of the watertight test's t for ray i and triangle i: (N,) float64, inf for no bound.
    `wrt.lab.oracle.bounds` derives the bound. Shape of triangles: (N, 3 corners, 3)."""
    rays = _Rays.of(origins, directions, 0.0, np.inf)
    a, b, c = (np.ascontiguousarray(each.T) for each in np.asarray(triangles, np.float32).astype(np.float64).transpose(1, 0, 2))
    found = triangle_crossings(rays.origin, rays.direction, (a, b, c), all_rows=True)
    return triangle_bounds(rays.origin, rays.direction, (a, b, c), found).t
