"""Verdicts on the answers of an algorithm to a hard case, ray by ray, by the oracle.

Three kinds of answers are wrong. A *miss*: a hit that must be found is not. A *false hit*: the ray passes the triangle by more than the
algorithm's rounding, or t is outside of the segment. A *wrong prim_id*: a nearer hit had to be found. Answers that the derived error
bound (wrt.lab.oracle.bounds) cannot settle are not wrong, but counted: borderline misses and hits, ties (exactly equal t) and near ties
(within the bound)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from wrt.accel.queries.answers import Hits
from wrt.core.types import JsonObject
from wrt.lab.hard_cases.common import ASK, HIT, MISS, HardCase
from wrt.lab.oracle.oracle import AllHits, Place, Reference, reference_of, sure

RAYS_AT_ONCE = 1 << 16
FACES_AT_ONCE = 4096  # whose float64 temporaries stay in the cache
EXAMPLES = 8
BINS_PER_OCTAVE, LOWEST_OCTAVE, N_BINS = 8, -12, 8 * 160


@dataclass
class Errors:
    """Errors of one quantity, in float32 ulp of the exact t, or of u and v in 2^-24.
    - largest, histogram (for percentiles): over hits that are exact ones.
    - largest_ratio to the derived bound, over (the bound): also over borderline hits, whose plane may be met far outside of the
    triangle."""

    largest: float = 0.0
    largest_ratio: float = 0.0
    over: int = 0
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(N_BINS, np.int64))

    def add(self, error: np.ndarray, unit: np.ndarray | float, bound: np.ndarray, exact_hit: np.ndarray) -> np.ndarray:
        """Count absolute errors (NaN counts as infinite); return where they exceed the bound."""
        error = np.where(np.isnan(error), np.inf, error)
        over = (error > bound) | np.isinf(error)
        ratio = np.full(len(error), np.inf)
        np.divide(error, bound, out=ratio, where=np.isfinite(error))
        self.largest_ratio = max(self.largest_ratio, float(ratio.max(initial=0.0)))
        self.over += int(over.sum())
        scaled = (error / unit)[exact_hit]
        self.largest = max(self.largest, float(scaled.max(initial=0.0)))
        octave = np.log2(np.maximum(scaled, 2.0**LOWEST_OCTAVE)) - LOWEST_OCTAVE
        index = np.minimum(np.ceil(octave * BINS_PER_OCTAVE), N_BINS - 1).astype(np.int64)
        self.histogram += np.bincount(index, minlength=N_BINS)
        return over

    def percentile(self, q: float) -> float:
        """Return an upper bound, within a ninth, on the q-th percentile; NaN if nothing was counted."""
        total = int(self.histogram.sum())
        if not total:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self.histogram), q / 100.0 * total))
        return min(2.0 ** (LOWEST_OCTAVE + index / BINS_PER_OCTAVE), self.largest)

    @property
    def p999(self) -> float:
        return self.percentile(99.9)

    def __add__(self, other: Errors) -> Errors:
        return Errors(max(self.largest, other.largest), max(self.largest_ratio, other.largest_ratio),
                      self.over + other.over, self.histogram + other.histogram)

    def as_dict(self) -> dict[str, float]:
        return {"max": self.largest, "p999": self.p999, "bound_ratio": self.largest_ratio, "over_bound": self.over}


@dataclass
class Verdict:
    """Counts over rays; verdicts of parts of a case can be added.
    - asked: reported hits that the oracle compared with the closest one; examples: the first few wrong rays.
    - self_hits, duplicate_hits: from judge_next and judge_all_hits."""

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
        """True if no ray is lost, invented or given to a wrong primitive, and every error is within its bound."""
        wrong = self.misses + self.false_hits + self.wrong_prim + self.self_hits + self.duplicate_hits
        return wrong + self.t.over + self.u.over + self.v.over == 0

    def __add__(self, other: Verdict) -> Verdict:
        out = Verdict(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(Verdict)})
        del out.examples[EXAMPLES:]
        return out

    def as_dict(self) -> JsonObject:
        return {f.name: value.as_dict() if isinstance(value := getattr(self, f.name), Errors) else value for f in fields(Verdict)}

    def wrong(self, count: str, case: HardCase, rows: np.ndarray, why: str, prim_id: np.ndarray | None = None) -> None:
        """Count these rays under the name `count`, and keep some as examples."""
        if count:
            setattr(self, count, getattr(self, count) + len(rows))
        for row in rows[: EXAMPLES - len(self.examples)].tolist():
            self.examples.append({
                "case": case.name, "row": row, "why": why, "prim_id": -1 if prim_id is None else int(prim_id[row]),
                "origin": case.origins[row].tolist(), "direction": case.directions[row].tolist(),
                "t_min": float(case.t_min[row]), "t_max": float(case.t_max[row])})


# What a unit says of the rays `row`, and what is exact for the primitive that it names.
CLAIM = np.dtype([("row", np.int64), ("t", np.float64), ("prim_id", np.int64), ("t_bound", np.float64), ("sound", bool), ("hit", bool)])


def judge(case: HardCase, hits: Hits, asked: int | None = None, *, lowest: bool = True) -> Verdict:
    """Judge closest hits: t, u, v, prim_id (N,), prim_id -1 on a miss (wrt.accel.queries.answers.Hits).

    - Each reported hit is compared with its own primitive, exactly. The oracle looks for nearer hits of `asked` of them (None: case.asked),
      chosen at random, always the same. It traces each ray that is reported to miss, unless the ray is known to hit.
    - lowest: of identical triangles the lowest prim_id must be reported, which is wrt's rule. Without u and v, errors of t are only
      measured: the bounds are those of wrt's test."""
    reference = reference_of(case.geometry)
    t, u, v, prim_id = (None if value is None else np.asarray(value) for value in (hits.t, hits.u, hits.v, hits.prim_id))
    assert t is not None and prim_id is not None
    reported = prim_id >= 0
    verdict, possible = _plain_faults(case, t, prim_id, reference.finite)
    rows = np.flatnonzero(possible & (case.expected != MISS))
    parts = [_claims(case, reference, rows[i:i + RAYS_AT_ONCE], (t, u, v, prim_id), verdict) for i in range(0, len(rows), RAYS_AT_ONCE)]
    if parts:
        claims = np.concatenate(parts).view(np.recarray)
        asked = case.asked if asked is None else asked
        chosen = np.flatnonzero(claims.sound)
        if len(chosen) > asked:
            chosen = np.sort(np.random.default_rng(0).choice(chosen, asked, replace=False))
        _judge_closeness(case, reference, claims[chosen], verdict, lowest)
    _judge_misses(case, reference, np.flatnonzero(~reported & (case.expected == ASK)), verdict)
    return verdict


def check(case: HardCase, hits: Hits) -> Verdict:
    """Judge without the oracle, for any number of rays: expected hits and misses, and t inside of the segment.
    Rays whose answer only the oracle knows (ASK) may miss. Arguments as for `judge`."""
    every = np.ones(len(case.geometry), bool)
    return _plain_faults(case, np.asarray(hits.t), np.asarray(hits.prim_id), every)[0]


def _plain_faults(case: HardCase, t: np.ndarray, prim_id: np.ndarray, finite: np.ndarray) -> tuple[Verdict, np.ndarray]:
    """Find what is wrong whatever the oracle says, and the rays whose reported hit may be one. finite: flags of the primitives."""
    reported = prim_id >= 0
    verdict = Verdict(rays=len(case), hits=int(reported.sum()))
    verdict.wrong("misses", case, np.flatnonzero(~reported & (case.expected == HIT)), "must hit, is reported to miss")
    verdict.wrong("false_hits", case, np.flatnonzero(reported & (case.expected == MISS)), "must miss", prim_id)
    possible = reported & np.isfinite(t) & (t >= case.t_min) & (t <= case.t_max) & (prim_id < len(finite))
    possible[possible] &= finite[prim_id[possible]]
    possible &= np.isfinite(case.origins).all(axis=1) & np.isfinite(case.directions).all(axis=1)
    verdict.wrong("false_hits", case, np.flatnonzero(reported & ~possible & (case.expected != MISS)),
                  "t outside of the segment, or nothing that can be hit", prim_id)
    return verdict, possible


def _claims(case: HardCase, reference: Reference, rows: np.ndarray, said: tuple[Any, ...], verdict: Verdict) -> Any:
    """Compare reported hits with the primitives that they name: false hits, and errors of t, u and v."""
    u, v = (None if x is None else x[rows].astype(np.float64) for x in said[1:3])
    t, prim_id = said[0][rows].astype(np.float64), said[3][rows]
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
    verdict.wrong("false_hits", case, rows[~sound], "passes the primitive by more than rounding", said[3])
    verdict.borderline_hits += int((sound & ~hit).sum())

    known = sound & np.isfinite(exact_t)
    ulp = np.spacing(np.minimum(np.abs(exact_t[known]), 3e38).astype(np.float32)).astype(np.float64)
    over = np.zeros(len(rows), bool)
    over[known] |= verdict.t.add(np.abs(t - exact_t)[known], ulp, bound[0, known], hit[known])
    if u is not None and v is not None:
        over[known] |= verdict.u.add(np.abs(u - exact_u)[known], 2.0**-24, bound[1, known], hit[known])
        over[known] |= verdict.v.add(np.abs(v - exact_v)[known], 2.0**-24, bound[2, known], hit[known])
        verdict.wrong("", case, rows[over], "t, u or v is off by more than the derived bound", said[3])
    return np.rec.fromarrays([rows, t, prim_id, bound[0], sound, hit], dtype=CLAIM)


def _judge_closeness(case: HardCase, reference: Reference, claims: Any, verdict: Verdict, lowest: bool) -> None:
    """Find hits nearer than the reported ones, and ties."""
    n = len(claims.row)
    verdict.asked += n
    o, d = case.origins[claims.row], case.directions[claims.row]
    end = np.minimum(claims.t + claims.t_bound, case.t_max[claims.row])
    found = reference.all_hits(o, d, case.t_min[claims.row], np.maximum(end, claims.t))
    answer = reference.closest_of(found, o, d)
    certain, bound = _certain(case, reference, found, claims.row, o, d)

    passed = claims.t[found.ray] > found.t + bound  # exact hits that the claimed one is clearly behind
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
    verdict.wrong("wrong_prim", case, rows, "something nearer had to be found", prim_id)


def _certain(case: HardCase, reference: Reference, found: AllHits, row: np.ndarray, o: np.ndarray,
             d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which exact hits an algorithm within its bounds must report, and the bounds on their t."""
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
    """Find rays that are reported to miss although a hit had to be found."""
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
        verdict.wrong("misses", case, part[missed], "has a hit that had to be found")


def _leaks(case: HardCase, skipped: AllHits, bound: np.ndarray, row: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return which of the rays `row` pass through a closed surface by crossings that were left out, (n,) bool.
    The winding number behind such a crossing, before the next one or before end[i], differs from that at the segment's start. Crossings
    whose
    bounds on t overlap are taken together: a ray may cut off a corner by less than the bound."""
    leaks, rays, points = np.zeros(len(row), bool), np.unique(skipped.ray), [np.zeros((0, 3))]
    for i in rays:
        mine = skipped.ray == i
        low, high = skipped.t[mine] - bound[mine], np.maximum.accumulate(skipped.t[mine] + bound[mine])
        low = np.append(np.minimum.accumulate(low[::-1])[::-1], end[i] if np.isfinite(end[i]) else 2.0 * high[-1] + 1.0)
        gap = np.flatnonzero(high < low[1:])
        at = np.array([float(case.t_min[row[i]]), *(0.5 * (high[gap] + low[gap + 1]))])
        o, d = (x[row[i]].astype(np.float64) for x in (case.origins, case.directions))
        points.append(o + at[:, None] * d)
    winding = np.round(winding_number(case, np.concatenate(points)))
    for i, mine in zip(rays, np.split(winding, np.cumsum([len(each) for each in points]))[1:], strict=False):
        leaks[i] = bool((mine[1:] != mine[0]).any())
    return leaks


def winding_number(case: HardCase, points: np.ndarray) -> np.ndarray:
    """Return how often the surface winds round each point: the signed solid angle over 4 pi (van Oosterom and Strackee 1983)."""
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
    """Return True if a lower prim_id of the tie has the same corners in the same order: then t is the same, and the lower one wins."""
    faces, vertices = case.geometry.faces, case.geometry.vertices
    lower = tied[tied < min(prim_id, len(faces))]
    if prim_id >= len(faces) or not len(lower):
        return False
    return bool((vertices[faces[lower]] == vertices[faces[prim_id]]).all(axis=(1, 2)).any())


def judge_next(case: HardCase, first_prim_id: np.ndarray, next_prim_id: np.ndarray) -> Verdict:
    """Judge case C: rays that start at the first hits (on a sphere: to its outside) must not hit the same primitive.
    - prim_id: (N,) each, -1 on a miss. A miss of the first ray is ignored.
    - Add the verdict to judge's, which counts rays and hits."""
    verdict = Verdict()
    again = np.flatnonzero((first_prim_id >= 0) & (next_prim_id == first_prim_id))
    verdict.wrong("self_hits", case, again, "hits the primitive that it starts on", next_prim_id)
    return verdict


def judge_all_hits(case: HardCase, ray: np.ndarray, prim_id: np.ndarray, t: np.ndarray) -> Verdict:
    """Judge all-hits queries over triangles: one row a reported hit, in any order. Add the result to judge's verdict.
    A duplicate is a primitive twice on a ray. Crossings of a closed surface alternate between in and out. So two in a row in the same
    direction, whose bounds on t overlap, are one crossing of an edge that was reported twice."""
    reference = reference_of(case.geometry)
    order = np.lexsort((prim_id, t, ray))
    ray, prim_id, t = ray[order], prim_id[order], t[order].astype(np.float64)
    verdict = Verdict()
    exact, limit = reference.against(case.origins[ray], case.directions[ray], prim_id)
    sound = limit.touches & (exact.place != Place.DEGENERATE)
    verdict.wrong("false_hits", case, ray[~sound], "passes the primitive by more than rounding")
    _, first = np.unique(np.stack([ray, prim_id]), axis=1, return_index=True)
    twice = np.ones(len(ray), bool)
    twice[first] = False
    if case.closed and len(ray) > 1:
        pair = (ray[1:] == ray[:-1]) & (np.diff(t) <= limit.t[1:] + limit.t[:-1])
        twice[1:] |= pair & (np.sign(exact.slope[1:]) == np.sign(exact.slope[:-1]))
    verdict.wrong("duplicate_hits", case, ray[twice], "one crossing, reported twice")

    found = reference.all_hits(case.origins, case.directions, case.t_min, case.t_max)
    certain, _ = _certain(case, reference, found, np.arange(len(case)), case.origins, case.directions)
    reported = set(zip(ray.tolist(), prim_id.tolist(), strict=True))
    lost = [r for r, p in zip(found.ray[certain].tolist(), found.prim_id[certain].tolist(), strict=True) if (r, p) not in reported]
    verdict.wrong("misses", case, np.array(lost, dtype=np.int64), "has a hit that had to be found")
    return verdict
