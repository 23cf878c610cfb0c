"""Test the closest-hit function of any ray library on the hard cases; the oracle judges each ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.accel.queries.answers import Hits
from wrt.core.checks import as_integer, as_tuple
from wrt.core.errors import InputError
from wrt.core.tables import html_table
from wrt.lab.bench.report import Columns, Row, cells, table
from wrt.lab.hard_cases.cases import HARD_CASES, HardCase, Verdict, chosen, chunks, fewer, generate, judge

ClosestHit = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Any]
EXCLUDED_CASES = ("C_spheres", "H_exact_ends")  # spheres, and t_min > 0, which `closest_hit` does not have
COLUMNS: Columns = {"case": "{case}", "rays": "{rays}", "lost": "{lost}", "invented": "{invented}",
                    "wrong triangle": "{wrong_triangle}", "t ulp": "{t_ulp:.3g}", "": lambda row: row.note}


@dataclass(frozen=True)
class Result:
    """Result of one case.

    - lost: rays that must hit but are reported to miss; wrong_triangle: rays for which another triangle is nearer.
    - invented: reported hits of a triangle that the ray misses by more than float32 rounding, or reported points that are not on the ray.
    - t_ulp: largest error of t, in float32 steps at the exact t. examples: the first wrong rays, each with the reason.
    - raised: the error that the function raised, or None; refused: the input was not finite, so raising was right."""

    case: str
    rays: int
    lost: int = 0
    invented: int = 0
    wrong_triangle: int = 0
    t_ulp: float = 0.0
    raised: Exception | None = None
    refused: bool = False
    examples: tuple[dict[str, Any], ...] = ()

    @property
    def wrong(self) -> int:
        """Number of rays that are lost, invented or have a wrong triangle."""
        return self.lost + self.invented + self.wrong_triangle

    @property
    def ok(self) -> bool:
        """True if no ray is wrong, and no error was raised for finite input."""
        return not self.wrong and (self.raised is None or self.refused)

    @property
    def note(self) -> str:
        """The error that the function raised, "refused" if raising was right, or "" without an error."""
        text = "" if self.raised is None else f"{type(self.raised).__name__}: {self.raised}".splitlines()[0][:100]
        return "refused" if self.refused else text

    def __str__(self) -> str:
        counted = f"{self.lost} lost, {self.invented} invented, {self.wrong_triangle} with a wrong triangle"
        lines = [f"{self.case}: of {self.rays} rays {counted}{f'; {self.note}' if self.note else ''}"]
        lines += ["  ray {row}: {why}; reported triangle: {prim_id}; origin {origin}, direction {direction}".format_map(ray)
                  for ray in self.examples]
        return "\n".join(lines)


@dataclass(frozen=True)
class Report:
    """The results of all cases; `print` shows the table."""

    results: tuple[Result, ...]

    @property
    def ok(self) -> bool:
        """True if all results are ok."""
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
    """One hard case of wrt.testing.CASES. Each access to `parts` generates its meshes and, in all, `rays` rays again."""

    def __init__(self, name: str, rays: int = 1000, seed: int = 0) -> None:
        self.name, *more = case_names([name])
        if more:
            raise InputError(f"is a group of cases: {self.name}, {', '.join(more)}", argument=name)
        self.rays, self.seed = fewer(name, as_integer(rays, "rays", 1, 1 << 40)), as_integer(seed, "seed", 0, 1 << 63)

    @property
    def parts(self) -> Iterator[HardCase]:
        """Yield HardCases (geometry.vertices, geometry.faces, origins, directions): one, or several if the rays exceed 2^18."""
        return chunks(self.name, self.rays, self.seed)

    @property
    def about(self) -> str:
        """The difficulty of this case, in words."""
        return generate(self.name, 1).notes

    def result(self, closest_hit: ClosestHit) -> Result:
        """Test `closest_hit` (see `hard_cases`) on this case. An error that it raises becomes part of the result."""
        verdict = Verdict()
        for part in self.parts:
            geometry = part.geometry
            try:
                answer = closest_hit(geometry.vertices.copy(), geometry.faces.copy(), part.origins.copy(), part.directions.copy())
            except Exception as error:
                return Result(self.name, self.rays, raised=error, refused=part.refused)
            t, prim_id = checked(answer, len(part))
            prim_id = np.where((prim_id >= 0) & (t > part.t_max), -1, prim_id)  # apply t_max, which closest_hit does not have
            verdict += judge(part, Hits(t, None, None, prim_id), lowest=False)  # type: ignore[arg-type]  # judge t without u and v
        return Result(self.name, verdict.rays, verdict.misses, verdict.false_hits, verdict.wrong_prim, verdict.t.largest,
                      examples=tuple(verdict.examples))

    def check(self, closest_hit: ClosestHit) -> None:
        """Raise AssertionError with the wrong rays: lost, invented or with a wrong triangle.
        An error of `closest_hit` passes through, unless the input is not finite: then an error is a right answer."""
        result = self.result(closest_hit)
        if result.raised is not None and not result.refused:
            raise result.raised
        if not result.ok:
            raise AssertionError(f"{result}\n({self.about})")

    def __repr__(self) -> str:
        return self.name


def case_names(cases: str | Sequence[str] = ()) -> list[str]:
    """Return the names of the selected cases. `cases` has names and letters of groups; the default is all but EXCLUDED_CASES."""
    cases = as_tuple(cases, str, "cases")
    for name in set(cases).intersection(EXCLUDED_CASES):
        raise InputError("needs spheres or t_min, which closest_hit does not have", argument=name)
    return [name for name in chosen(cases or list(HARD_CASES)) if name not in EXCLUDED_CASES]


def hard_cases(closest_hit: ClosestHit, cases: str | Sequence[str] = (), rays: int = 1000, seed: int = 0) -> Report:
    """Test a ray library on the hard cases: count rays that are lost, invented or have a wrong triangle.

    Parameters
    ----------
    closest_hit : function of (vertices, faces, origins, directions)
        It receives (V, 3) float32, (F, 3) int32, (N, 3) float32 and (N, 3) float32. Directions have any length. It returns t and prim_id,
        (N,) each, as a pair or as attributes. The distance t is in units of |direction|, and ignored on a miss. The index of the face,
        prim_id, is -1 on a miss. At equal distance any face is right.
    cases : names or letters of groups
        Default: all cases that need no spheres and no t_min.
    rays : int
        Number of rays of each case.
    seed : int
        Seed of the random geometry and rays.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        An unknown name, a case that needs spheres or t_min, or closest_hit returns arrays of other shape or type."""
    return Report(tuple(Case(name, rays, seed).result(closest_hit) for name in case_names(cases)))


def checked(answer: Any, n: int, name: str = "closest_hit") -> tuple[np.ndarray, np.ndarray]:
    """Return t float64 and the index of what was hit int64, (n,) each, of the answer of a function `name`. Raise InputError for others."""
    if hasattr(answer, "prim_id") and hasattr(answer, "t"):
        answer = answer.t, answer.prim_id
    try:
        t, prim_id = (np.asarray(each) for each in answer)
    except (TypeError, ValueError):
        raise InputError(f"must return t and prim_id, got {type(answer).__name__}", argument=name) from None
    if t.shape != (n,) or prim_id.shape != (n,) or t.dtype.kind not in "iuf" or prim_id.dtype.kind not in "iu":
        raise InputError(f"must return t ({n},) of real numbers and prim_id ({n},) of integers, got {t.shape} of "
                         f"{t.dtype} and {prim_id.shape} of {prim_id.dtype}", argument=name)
    return t.astype(np.float64), prim_id.astype(np.int64)
