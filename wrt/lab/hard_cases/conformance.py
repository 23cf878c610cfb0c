"""The hard cases for any library's closest hit, as a function of arrays, judged ray by ray by the oracle."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.accel.queries.answers import Hits
from wrt.core.checks import as_integer, as_tuple
from wrt.core.errors import InputError
from wrt.core.html import html_table
from wrt.lab.bench.report import Columns, Row, cells, table
from wrt.lab.hard_cases.cases import HARD_CASES, HardCase, Verdict, chosen, chunks, fewer, generate, judge

ClosestHit = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Any]
NOT_ASKED = ("C_spheres", "H_exact_ends")  # not of triangles, and rays that begin after their origin
COLUMNS: Columns = {"case": "{case}", "rays": "{rays}", "lost": "{lost}", "invented": "{invented}",
                    "wrong triangle": "{wrong_triangle}", "t ulp": "{t_ulp:.3g}", "": lambda row: row.note}


@dataclass(frozen=True)
class Result:
    """Result of one case.

    - lost: rays that must hit and are reported to miss; wrong_triangle: a nearer hit was left out.
    - invented: hits of a triangle that the ray passes by more than float32's rounding, or that are not on the ray.
    - t_ulp: the largest error of t, in float32 steps of the exact one. examples: the first wrong rays, and why.
    - raised: the error that the function raised; refused: it was raised for input that is not finite, which is right."""

    case: str
    rays: int
    lost: int = 0
    invented: int = 0
    wrong_triangle: int = 0
    t_ulp: float = 0.0
    raised: str = ""
    refused: bool = False
    examples: tuple[dict[str, Any], ...] = ()

    @property
    def wrong(self) -> int:
        """Number of rays lost, invented or given to a wrong triangle."""
        return self.lost + self.invented + self.wrong_triangle

    @property
    def ok(self) -> bool:
        """True if no ray is wrong and nothing was raised, but for input that is not finite."""
        return not (self.wrong or (self.raised and not self.refused))

    @property
    def note(self) -> str:
        """The error that was raised, or "refused" if that was right; "" without an error."""
        return "refused" if self.refused else self.raised

    def __str__(self) -> str:
        counted = f"{self.lost} lost, {self.invented} invented, {self.wrong_triangle} of a wrong triangle"
        lines = [f"{self.case}: of {self.rays} rays {counted}{f'; {self.note}' if self.note else ''}"]
        lines += ["  ray {row}: {why}; said: triangle {prim_id}; origin {origin}, direction {direction}".format_map(ray)
                  for ray in self.examples]
        return "\n".join(lines)


@dataclass(frozen=True)
class Report:
    """The results of all cases; `print` shows the table."""

    results: tuple[Result, ...]

    @property
    def ok(self) -> bool:
        """True if all results are."""
        return all(result.ok for result in self.results)

    @property
    def total(self) -> Result:
        """The sums over all cases, and the largest error of t."""
        counts = {name: sum(getattr(result, name) for result in self.results) for name in ("rays", "lost", "invented", "wrong_triangle")}
        return Result("all", **counts, t_ulp=max((result.t_ulp for result in self.results), default=0.0))

    def _lines(self) -> list[list[str]]:
        return [cells(COLUMNS, Row(**vars(result), note=result.note)) for result in (*self.results, self.total)]

    def __str__(self) -> str:
        return table(tuple(COLUMNS), self._lines())

    def _repr_html_(self) -> str:
        return html_table("Hard cases", tuple(COLUMNS), self._lines(), most=None)


class Case:
    """One hard case of wrt.testing.CASES: meshes with `rays` rays in all, made anew at each access."""

    def __init__(self, name: str, rays: int = 1000, seed: int = 0) -> None:
        self.name, *more = case_names([name])
        if more:
            raise InputError(f"is a group of cases: {self.name}, {', '.join(more)}", argument=name)
        self.rays, self.seed = fewer(name, as_integer(rays, "rays", 1, 1 << 40)), as_integer(seed, "seed", 0, 1 << 63)

    @property
    def parts(self) -> Iterator[HardCase]:
        """Yield the meshes with their rays: geometry.vertices, geometry.faces, origins, directions. Only very many rays take several."""
        return chunks(self.name, self.rays, self.seed)

    @property
    def about(self) -> str:
        """The difficulty of this case, in words."""
        return generate(self.name, 1).notes

    def result(self, closest_hit: ClosestHit) -> Result:
        """Judge `closest_hit` (see `hard_cases`). An error that it raises is part of the result."""
        return self._judged(closest_hit, keep_errors=True)

    def check(self, closest_hit: ClosestHit) -> None:
        """Raise AssertionError that shows the rays that `closest_hit` loses, invents or gives to a wrong triangle.
        Its own errors pass through, except for input that is not finite, which it may refuse."""
        result = self._judged(closest_hit, keep_errors=False)
        if not result.ok:
            raise AssertionError(f"{result}\n({self.about})")

    def _judged(self, closest_hit: ClosestHit, keep_errors: bool) -> Result:
        verdict = Verdict()
        for part in self.parts:
            geometry = part.geometry
            try:
                said = closest_hit(geometry.vertices.copy(), geometry.faces.copy(), part.origins.copy(), part.directions.copy())
            except Exception as error:
                if not (part.refused or keep_errors):
                    raise
                said = f"{type(error).__name__}: {error}".splitlines()[0][:100]
                return Result(self.name, self.rays, raised=said, refused=part.refused)
            t, prim_id = _answer(said, len(part))
            prim_id = np.where((prim_id >= 0) & (t > part.t_max), -1, prim_id)  # as a query with the case's t_max would report it
            verdict += judge(part, Hits(t, None, None, prim_id), lowest=False)  # type: ignore[arg-type]  # None: t alone is measured
        return Result(self.name, verdict.rays, verdict.misses, verdict.false_hits, verdict.wrong_prim, verdict.t.largest,
                      examples=tuple(verdict.examples))

    def __repr__(self) -> str:
        return self.name


def case_names(cases: str | Sequence[str] = ()) -> list[str]:
    """Return the cases of names and letters of groups; by default all that a closest hit on triangles can answer."""
    cases = as_tuple(cases, str, "cases")
    for name in set(cases).intersection(NOT_ASKED):
        raise InputError("is not for a closest hit on triangles without t_min", argument=name)
    return [name for name in chosen(cases or list(HARD_CASES)) if name not in NOT_ASKED]


def results(closest_hit: ClosestHit, cases: str | Sequence[str] = (), rays: int = 1000, seed: int = 0) -> Iterator[Result]:
    """Yield the results of `hard_cases` one by one."""
    for name in case_names(cases):
        yield Case(name, rays, seed).result(closest_hit)


def hard_cases(closest_hit: ClosestHit, cases: str | Sequence[str] = (), rays: int = 1000, seed: int = 0) -> Report:
    """Put the hard cases to a ray library: count the rays that it loses, invents and gives to a wrong triangle.

    Parameters
    ----------
    closest_hit : function of (vertices, faces, origins, directions)
        It gets (V, 3) float32, (F, 3) int32, (N, 3) float32 and (N, 3) float32; directions have any length. It returns t and prim_id, (N,)
        each, as a pair or as attributes. t is the distance in units of |direction| and counts for hits only. A prim_id is the index of a
        face, -1 on a miss. Any of several faces at the same distance is right.
    cases : names, or letters of groups
        All cases by default.
    rays, seed : int
        Number of rays of each case. Another seed gives other rays.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        An unknown name, or closest_hit returns something else."""
    return Report(tuple(results(closest_hit, cases, rays, seed)))


def _answer(said: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    if hasattr(said, "prim_id") and hasattr(said, "t"):
        said = said.t, said.prim_id
    try:
        t, prim_id = (np.asarray(each) for each in said)
    except (TypeError, ValueError):
        raise InputError(f"must return t and prim_id, got {type(said).__name__}", argument="closest_hit") from None
    if t.shape != (n,) or prim_id.shape != (n,) or t.dtype.kind not in "iuf" or prim_id.dtype.kind not in "iu":
        raise InputError(f"must return t ({n},) of real numbers and prim_id ({n},) of integers, got {t.shape} of "
                         f"{t.dtype} and {prim_id.shape} of {prim_id.dtype}", argument="closest_hit")
    return t.astype(np.float64), prim_id.astype(np.int64)
