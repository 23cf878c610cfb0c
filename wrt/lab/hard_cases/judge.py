"""Judge an algorithm's answers to a hard case, ray by ray, with the oracle.

Three kinds of answers are wrong. A *miss* reports no hit where one must be found. A *false hit* names a triangle that the ray misses by
more than the algorithm's rounding, or a t outside the segment. A *wrong prim_id* names a primitive although a nearer one must be found.
The derived error bound (wrt.lab.oracle.bounds) cannot settle all answers. Open answers are not wrong, but counted: borderline
misses and hits, ties (exactly equal t) and near ties (t equal within the bound)."""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from wrt.accel.queries.answers import Hits
from wrt.core.types import JsonObject
from wrt.lab.hard_cases.common import HIT, MISS, UNKNOWN, HardCase
from wrt.lab.oracle.oracle import AllHits, Place, Reference, reference_of, sure

RAYS_AT_ONCE = 1 << 16
FACES_AT_ONCE = 4096  # few enough that float64 temporaries stay in the cache
EXAMPLES = 8  # wrong rays that a verdict stores


@dataclass
class Errors:
    """Errors of one quantity. The unit is a float32 ulp at the exact t for t, and 2^-24 for u and v.
    - values: errors of exact hits. largest_ratio: largest error over its derived bound; over: number of errors above the bound. These two
      fields include borderline hits, which may lie far outside the triangle in its plane."""

    values: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    largest_ratio: float = 0.0
    over: int = 0

    def add(self, error: np.ndarray, unit: np.ndarray | float, bound: np.ndarray, exact_hit: np.ndarray) -> np.ndarray:
        """Add absolute errors; NaN counts as infinite. Return flags of errors above `bound`. unit: size of one unit; exact_hit: flags."""
        error = np.where(np.isnan(error), np.inf, error)
        over = (error > bound) | np.isinf(error)
        ratio = np.full(len(error), np.inf)
        np.divide(error, bound, out=ratio, where=np.isfinite(error))
        self.largest_ratio = max(self.largest_ratio, float(ratio.max(initial=0.0)))
        self.over += int(over.sum())
        self.values = np.concatenate([self.values, (error / unit)[exact_hit].astype(np.float32)])
        return over

    @property
    def largest(self) -> float:
        return float(self.values.max(initial=0.0))

    @property
    def p999(self) -> float:
        return float(np.percentile(self.values, 99.9, method="inverted_cdf")) if len(self.values) else float("nan")

    def __add__(self, other: "Errors") -> "Errors":
        return Errors(np.concatenate([self.values, other.values]), max(self.largest_ratio, other.largest_ratio), self.over + other.over)

    def as_dict(self) -> dict[str, float]:
        return {"max": self.largest, "p999": self.p999, "bound_ratio": self.largest_ratio, "over_bound": self.over}


@dataclass
class Verdict:
    """Counts over rays; the module's docstring explains most of them. The verdicts on parts of a case can be added.
    - asked: reported hits that the oracle compared with the closest hit; examples: the first wrong rays.
    - self_hits is counted by judge_next, duplicate_hits by judge_all_hits."""

    rays: int = 0
    hits: int = 0
    misses: int = 0
    false_hits: int = 0
    wrong_prim: int = 0
    self_hits: int = 0
    duplicate_hits: int = 0
    borderline_misses: int = 0
    borderline_hits: int = 0
    ties: int = 0
    near_ties: int = 0
    asked: int = 0
    t: Errors = field(default_factory=Errors)
    u: Errors = field(default_factory=Errors)
    v: Errors = field(default_factory=Errors)
    examples: list[dict[str, Any]] = field(default_factory=list)

    @property
    def borderline(self) -> int:
        return self.borderline_hits + self.borderline_misses

    @property
    def ok(self) -> bool:
        """True if no miss, false hit, wrong prim_id, self hit or duplicate hit was counted, and every error is within its bound."""
        wrong = self.misses + self.false_hits + self.wrong_prim + self.self_hits + self.duplicate_hits
        return wrong + self.t.over + self.u.over + self.v.over == 0

    def __add__(self, other: "Verdict") -> "Verdict":
        out = Verdict(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(Verdict)})
        del out.examples[EXAMPLES:]
        return out

    def as_dict(self) -> JsonObject:
        return {f.name: value.as_dict() if isinstance(value := getattr(self, f.name), Errors) else value for f in fields(Verdict)}

    def wrong(self, count: str, case: HardCase, rows: np.ndarray, why: str, prim_id: np.ndarray | None = None) -> None:
        """Add the number of rays `rows` (indices) to the field `count` ("": to no field), and store the first rays as examples."""
        if count:
            setattr(self, count, getattr(self, count) + len(rows))
        for row in rows[: EXAMPLES - len(self.examples)].tolist():
            self.examples.append({
                "case": case.name, "row": row, "why": why, "prim_id": -1 if prim_id is None else int(prim_id[row]),
                "origin": case.origins[row].tolist(), "direction": case.directions[row].tolist(),
                "t_min": float(case.t_min[row]), "t_max": float(case.t_max[row])})


# A reported hit: index of its ray, its t, prim_id and bound on t; sound: the bounds allow the report; hit: the exact ray hits prim_id.
CLAIM = np.dtype([("row", np.int64), ("t", np.float64), ("prim_id", np.int64), ("t_bound", np.float64), ("sound", bool), ("hit", bool)])


def judge(case: HardCase, hits: Hits, compared: int | None = None, *, lowest: bool = True) -> Verdict:
    """Judge closest hits: t, u, v, prim_id (N,), prim_id -1 on a miss (wrt.accel.queries.answers.Hits).

    - Each reported hit is tested exactly against the primitive that it names. For `compared` hits (None: case.compared), chosen at
      random with a fixed seed, the oracle also looks for nearer hits. It traces each ray that is reported to miss and is UNKNOWN.
    - lowest: True if of identical triangles only the lowest prim_id is right, which is wrt's rule; False if any of them is right.
    - u and v may be None. The error bounds are those of wrt's watertight triangle test and sphere test."""
    reference = reference_of(case.geometry)
    t, u, v, prim_id = (None if value is None else np.asarray(value) for value in (hits.t, hits.u, hits.v, hits.prim_id))
    assert t is not None and prim_id is not None
    reported = prim_id >= 0
    verdict, possible = _obvious_faults(case, t, prim_id, reference.finite)
    rows = np.flatnonzero(possible & (case.expected != MISS))
    parts = [_claims(case, reference, rows[i:i + RAYS_AT_ONCE], (t, u, v, prim_id), verdict) for i in range(0, len(rows), RAYS_AT_ONCE)]
    if parts:
        claims = np.concatenate(parts).view(np.recarray)
        compared = case.compared if compared is None else compared
        chosen = np.flatnonzero(claims.sound)
        if len(chosen) > compared:
            chosen = np.sort(np.random.default_rng(0).choice(chosen, compared, replace=False))
        _judge_closeness(case, reference, claims[chosen], verdict, lowest)
    _judge_misses(case, reference, np.flatnonzero(~reported & (case.expected == UNKNOWN)), verdict)
    return verdict


def check(case: HardCase, hits: Hits) -> Verdict:
    """Judge closest hits without the oracle: test expected hits and misses, and that t is inside the segment.
    Rays with the expectation UNKNOWN may miss. Arguments as for `judge`."""
    every = np.ones(len(case.geometry), bool)
    return _obvious_faults(case, np.asarray(hits.t), np.asarray(hits.prim_id), every)[0]


def _obvious_faults(case: HardCase, t: np.ndarray, prim_id: np.ndarray, finite: np.ndarray) -> tuple[Verdict, np.ndarray]:
    """Count the faults that need no oracle. Also return flags of the reported hits that may be right. finite: flags, by primitive."""
    reported = prim_id >= 0
    verdict = Verdict(rays=len(case), hits=int(reported.sum()))
    verdict.wrong("misses", case, np.flatnonzero(~reported & (case.expected == HIT)), "must hit, is reported to miss")
    verdict.wrong("false_hits", case, np.flatnonzero(reported & (case.expected == MISS)), "must miss", prim_id)
    possible = reported & np.isfinite(t) & (t >= case.t_min) & (t <= case.t_max) & (prim_id < len(finite))
    possible[possible] &= finite[prim_id[possible]]
    possible &= np.isfinite(case.origins).all(axis=1) & np.isfinite(case.directions).all(axis=1)
    verdict.wrong("false_hits", case, np.flatnonzero(reported & ~possible & (case.expected != MISS)),
                  "t is outside the segment, or the ray or primitive is not finite or does not exist", prim_id)
    return verdict, possible


def _claims(case: HardCase, reference: Reference, rows: np.ndarray, hits: tuple[Any, ...], verdict: Verdict) -> Any:
    """Compare the reported hits of the rays `rows` with the primitives that they name; return a CLAIM for each ray.
    Add false hits, borderline hits and errors of t, u and v to `verdict`. hits: t, u, v, prim_id of all rays."""
    u, v = (None if x is None else x[rows].astype(np.float64) for x in hits[1:3])
    t, prim_id = hits[0][rows].astype(np.float64), hits[3][rows]
    exact_t, exact_u, exact_v = np.empty((3, len(rows)))
    bound = np.full((3, len(rows)), np.inf)
    sound, hit = np.zeros((2, len(rows)), bool)
    triangle = prim_id < reference.n_triangles
    i = np.flatnonzero(triangle)
    if len(i):
        exact, limit = reference.against(case.origins[rows[i]], case.directions[rows[i]], prim_id[i])
        exact_t[i], exact_u[i], exact_v[i], hit[i] = exact.t, exact.u, exact.v, exact.hit
        bound[:, i] = limit.t, limit.u, limit.v
        sound[i] = limit.touches & (exact.place != Place.DEGENERATE)
    i = np.flatnonzero(~triangle)
    if len(i):
        ball, t_bound, allowed = reference.against_sphere(case.origins[rows[i]], case.directions[rows[i]], prim_id[i])
        ends = np.abs(ball.t - t[i]) / t_bound
        end = np.where(ends[0] <= ends[1], 0, 1)
        exact_t[i] = np.take_along_axis(ball.t, end[None], axis=0)[0]
        bound[0, i] = np.take_along_axis(t_bound, end[None], axis=0)[0]
        exact_u[i], exact_v[i], bound[1:, i] = 0.0, 0.0, 1e-30
        sound[i], hit[i] = ball.hit | allowed, ball.hit
    verdict.wrong("false_hits", case, rows[~sound], "misses the primitive by more than rounding", hits[3])
    verdict.borderline_hits += int((sound & ~hit).sum())

    known = sound & np.isfinite(exact_t)
    ulp = np.spacing(np.minimum(np.abs(exact_t[known]), 3e38).astype(np.float32)).astype(np.float64)
    over = np.zeros(len(rows), bool)
    over[known] |= verdict.t.add(np.abs(t - exact_t)[known], ulp, bound[0, known], hit[known])
    if u is not None and v is not None:
        over[known] |= verdict.u.add(np.abs(u - exact_u)[known], 2.0**-24, bound[1, known], hit[known])
        over[known] |= verdict.v.add(np.abs(v - exact_v)[known], 2.0**-24, bound[2, known], hit[known])
        verdict.wrong("", case, rows[over], "the error of t, u or v is above the derived bound", hits[3])
    return np.rec.fromarrays([rows, t, prim_id, bound[0], sound, hit], dtype=CLAIM)


def _judge_closeness(case: HardCase, reference: Reference, claims: Any, verdict: Verdict, lowest: bool) -> None:
    """Add to `verdict` the claims for which a nearer hit must be found, the ties and the near ties."""
    n = len(claims.row)
    verdict.asked += n
    o, d = case.origins[claims.row], case.directions[claims.row]
    end = np.minimum(claims.t + claims.t_bound, case.t_max[claims.row])
    found = reference.all_hits(o, d, case.t_min[claims.row], np.maximum(end, claims.t))
    answer = reference.closest_of(found, o, d)
    certain, bound = _certain(case, reference, found, claims.row, o, d)

    passed = claims.t[found.ray] > found.t + bound  # exact hits that are clearly nearer than the claim
    other = found.prim_id != claims.prim_id[found.ray]
    wrong = np.zeros(n, bool)
    wrong[found.ray[passed & certain & other]] = True
    if case.closed:
        skipped = passed & ~certain & other & (claims.t[found.ray] > found.t + bound + claims.t_bound[found.ray])
        wrong |= _leaks(case, found[skipped], bound[skipped], claims.row, claims.t)
    same = claims.prim_id == answer.prim_id
    for ray, tied in answer.ties.items():
        same[ray] |= claims.prim_id[ray] in tied
        wrong[ray] |= lowest and same[ray] and _lower_twin(case, int(claims.prim_id[ray]), tied)
    verdict.ties += int((answer.tie & same & ~wrong).sum())
    verdict.near_ties += int((~same & claims.hit & ~wrong).sum())
    rows = claims.row[wrong]
    prim_id = np.full(len(case), -1)
    prim_id[claims.row] = claims.prim_id
    verdict.wrong("wrong_prim", case, rows, "another primitive is nearer and must be found", prim_id)


def _certain(case: HardCase, reference: Reference, found: AllHits, row: np.ndarray, o: np.ndarray,
             d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return flags of the exact hits `found` that an algorithm within the error bounds must report, and the bounds on these hits' t."""
    certain, bound = np.zeros(len(found), bool), np.full(len(found), np.inf)
    i = np.flatnonzero(found.prim_id < reference.n_triangles)
    if len(i):
        exact, limit = reference.against(o[found.ray[i]], d[found.ray[i]], found.prim_id[i])
        certain[i], bound[i] = sure(exact, limit), limit.t
    i = np.flatnonzero(found.prim_id >= reference.n_triangles)
    if len(i):
        ball, t_bound, _ = reference.against_sphere(o[found.ray[i]], d[found.ray[i]], found.prim_id[i])
        end = np.argmin(np.abs(ball.t - found.t[i]), axis=0)
        bound[i] = np.take_along_axis(t_bound, end[None], axis=0)[0]
        certain[i] = ball.t[1] - ball.t[0] > 4.0 * bound[i]
    ray = row[found.ray]
    certain &= (found.t - bound >= case.t_min[ray]) & (found.t + bound <= case.t_max[ray]) & (found.t + bound < 3.4e38)
    return certain, bound


def _judge_misses(case: HardCase, reference: Reference, rows: np.ndarray, verdict: Verdict) -> None:
    """Add to `verdict` the rays of `rows` that must hit, and the borderline rays, which may hit. All of `rows` are reported to miss."""
    for first in range(0, len(rows), RAYS_AT_ONCE):
        part = rows[first:first + RAYS_AT_ONCE]
        o, d = case.origins[part], case.directions[part]
        found = reference.all_hits(o, d, case.t_min[part], case.t_max[part])
        certain, bound = _certain(case, reference, found, part, o, d)
        missed, border = np.zeros((2, len(part)), bool)
        missed[found.ray[certain]] = True
        border[found.ray] = True
        if case.closed:
            left = ~missed[found.ray] & np.isfinite(bound)
            missed |= _leaks(case, found[left], bound[left], part, np.full(len(part), np.inf))
        verdict.borderline_misses += int((border & ~missed).sum())
        verdict.wrong("misses", case, part[missed], "has a hit that must be found")


def _leaks(case: HardCase, skipped: AllHits, bound: np.ndarray, row: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return flags of the rays `row` that leak through a closed surface at the crossings `skipped`, which were not reported: (n,) bool.
    A ray leaks if the winding number between two of these crossings, or between the last one and t = end[i], is not that at t_min.
    Crossings whose bounds on t overlap count as one, because a ray may cut off a corner by less than the bound."""
    leaks, rays, points = np.zeros(len(row), bool), np.unique(skipped.ray), [np.zeros((0, 3))]
    for i in rays:
        own = skipped.ray == i
        low, high = skipped.t[own] - bound[own], np.maximum.accumulate(skipped.t[own] + bound[own])
        low = np.append(np.minimum.accumulate(low[::-1])[::-1], end[i] if np.isfinite(end[i]) else 2.0 * high[-1] + 1.0)
        gap = np.flatnonzero(high < low[1:])
        at = np.array([float(case.t_min[row[i]]), *(0.5 * (high[gap] + low[gap + 1]))])
        o, d = (x[row[i]].astype(np.float64) for x in (case.origins, case.directions))
        points.append(o + at[:, None] * d)
    winding = np.round(winding_number(case, np.concatenate(points)))
    for i, along_ray in zip(rays, np.split(winding, np.cumsum([len(each) for each in points]))[1:], strict=False):
        leaks[i] = bool((along_ray[1:] != along_ray[0]).any())
    return leaks


def winding_number(case: HardCase, points: np.ndarray) -> np.ndarray:
    """Return the winding number of the surface around each point: signed solid angle over 4 pi (van Oosterom and Strackee 1983)."""
    corners = case.geometry.vertices[case.geometry.faces].astype(np.float64)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any(axis=1)
    corners, out = corners[area], np.zeros(len(points))
    for first in range(0, len(corners), FACES_AT_ONCE):
        part = np.ascontiguousarray(corners[first:first + FACES_AT_ONCE].transpose(1, 2, 0))  # corner, axis, face
        for i, point in enumerate(points):
            a, b, c = part - point[:, None]
            la, lb, lc = (np.sqrt((x * x).sum(axis=0)) for x in (a, b, c))
            below = la * lb * lc + (a * b).sum(axis=0) * lc + (b * c).sum(axis=0) * la + (c * a).sum(axis=0) * lb
            cross = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
            out[i] += np.arctan2(a[0] * cross[0] + a[1] * cross[1] + a[2] * cross[2], below).sum() / (2.0 * np.pi)
    return out


def _lower_twin(case: HardCase, prim_id: int, tied: np.ndarray) -> bool:
    """Return True if a lower prim_id of `tied` has the same corners in the same order, so that its computed t is the same."""
    faces, vertices = case.geometry.faces, case.geometry.vertices
    lower = tied[tied < min(prim_id, len(faces))]
    if prim_id >= len(faces) or not len(lower):
        return False
    return bool((vertices[faces[lower]] == vertices[faces[prim_id]]).all(axis=(1, 2)).any())


def judge_next(case: HardCase, first_prim_id: np.ndarray, next_prim_id: np.ndarray) -> Verdict:
    """Judge case C: a ray that starts at a hit (from a sphere to its outside) must not hit the same primitive.
    Arrays are (N,), -1 on a miss; a ray without a first hit is right. The verdict has only self_hits: add it to the verdict of `judge`."""
    verdict = Verdict()
    again = np.flatnonzero((first_prim_id >= 0) & (next_prim_id == first_prim_id))
    verdict.wrong("self_hits", case, again, "hits the primitive on which it starts", next_prim_id)
    return verdict


def judge_all_hits(case: HardCase, ray: np.ndarray, prim_id: np.ndarray, t: np.ndarray) -> Verdict:
    """Judge an all-hits query over triangles; ray, prim_id and t describe the reported hits, in any order.
    A primitive that a ray reports twice is a duplicate. Crossings of a closed surface alternate between in and out. So two successive
    crossings in the same direction, whose bounds on t overlap, are one crossing of an edge, and also count as a duplicate."""
    reference = reference_of(case.geometry)
    order = np.lexsort((prim_id, t, ray))
    ray, prim_id, t = ray[order], prim_id[order], t[order].astype(np.float64)
    verdict = Verdict()
    exact, limit = reference.against(case.origins[ray], case.directions[ray], prim_id)
    sound = limit.touches & (exact.place != Place.DEGENERATE)
    verdict.wrong("false_hits", case, ray[~sound], "misses the primitive by more than rounding")
    _, first = np.unique(np.stack([ray, prim_id]), axis=1, return_index=True)
    twice = np.ones(len(ray), bool)
    twice[first] = False
    if case.closed and len(ray) > 1:
        pair = (ray[1:] == ray[:-1]) & (np.diff(t) <= limit.t[1:] + limit.t[:-1])
        twice[1:] |= pair & (np.sign(exact.slope[1:]) == np.sign(exact.slope[:-1]))
    verdict.wrong("duplicate_hits", case, ray[twice], "one crossing is reported twice")

    found = reference.all_hits(case.origins, case.directions, case.t_min, case.t_max)
    certain, _ = _certain(case, reference, found, np.arange(len(case)), case.origins, case.directions)
    reported = set(zip(ray.tolist(), prim_id.tolist(), strict=True))
    lost = [r for r, p in zip(found.ray[certain].tolist(), found.prim_id[certain].tolist(), strict=True) if (r, p) not in reported]
    verdict.wrong("misses", case, np.array(lost, dtype=np.int64), "has a hit that must be found")
    return verdict
