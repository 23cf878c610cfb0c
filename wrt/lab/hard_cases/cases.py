"""The hard cases: random geometry and rays on which intersection tests fail, and the answers that are right.

The first letter of a name is the group of the case:
- A: dense spheres near the origin and far from it. B: a jittered sphere. C: rays that start on a surface. D: bad triangles.
- E: rays along the axes. F: slivers; edge-on and grazing rays. G: close sheets, coincident triangles, a shared vertex.
- H: scale, and the ends of the segment. I: lengths of directions, underflow, and values that are not finite.

A ray from o "aimed at" a point p has the direction p - o, rounded to float32. It meets p exactly only if p - o is a float32 value;
otherwise it passes p by at most 2^-24 of the distance on each axis.

>>> for case in chunks("A_far_vertices", 1_000_000, seed=0):
...     verdict += judge(case, accel.closest_hit(case.origins, case.directions, case.t_min, case.t_max))"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from wrt.core.checks import require_known
from wrt.lab.hard_cases import closed as inside
from wrt.lab.hard_cases import open as outside
from wrt.lab.hard_cases.common import AIMS, HIT, MISS, UNKNOWN, HardCase, Seed
from wrt.lab.hard_cases.judge import Verdict, check, judge, judge_all_hits, judge_next

__all__ = ["HARD_CASES", "HIT", "MISS", "UNKNOWN", "HardCase", "Verdict", "check", "chosen", "chunks", "fewer",
           "generate", "judge", "judge_all_hits", "judge_next"]

HARD_CASES: dict[str, Callable[[np.random.Generator, int], HardCase]] = {
    **{f"A_{place}_{aim}": partial(inside.dense_sphere, position=place, aim=aim)
       for place in inside.POSITIONS for aim in AIMS},
    "B_jittered_uniform": partial(inside.jittered_sphere, aim="uniform"),
    "B_jittered_vertices": partial(inside.jittered_sphere, aim="vertices"),
    "C_triangles": outside.respawned_triangles,
    "C_spheres": outside.respawned_spheres,
    "D_without_area": outside.without_area,
    "D_without_area_wide": partial(outside.without_area, wide=True),
    "D_among_bad": outside.among_bad,
    "D_published": outside.published_bad,
    "D_huge": outside.huge,
    "D_tiny": outside.tiny,
    "E_grid": inside.axis_parallel,
    "E_beside": outside.beside_boxes,
    **{f"F_needles_{aim}": partial(inside.needles, aim=aim) for aim in AIMS},
    "F_slivers": outside.slivers,
    "F_edge_on": outside.edge_on,
    "F_grazing": partial(outside.grazing, turned=False),
    "F_grazing_turned": partial(outside.grazing, turned=True),
    **{f"G_sheets_{aim}": partial(inside.two_sheets, aim=aim) for aim in AIMS},
    "G_coincident_uniform": partial(inside.coincident, aim="uniform"),
    "G_coincident_vertices": partial(inside.coincident, aim="vertices"),
    **{f"G_fan_{aim}": partial(inside.shared_vertex, aim=aim) for aim in AIMS},
    **{f"H_scale_{name}_{aim}": partial(inside.scaled, scale=scale, aim=aim)
       for name, scale in (("1e-6", 1e-6), ("1", 1.0), ("1e6", 1e6)) for aim in ("uniform", "vertices")},
    "H_stadium": inside.stadium,
    "H_exact_ends": outside.exact_ends,
    "I_lengths": inside.lengths,
    "I_underflow": inside.underflowing,
    "I_denormal": inside.denormal,
    "I_tiny_components": outside.tiny_components,
    "I_rays_not_finite": outside.rays_not_finite,
    "I_mesh_not_finite": outside.mesh_not_finite,
}
COSTLY = {"G_fan": 100}  # divisor of the number of rays: a ray tests all 10,000 triangles at one vertex


def generate(name: str, n: int, seed: Seed = 0) -> HardCase:
    """Return one case with n rays. Raise InputError for an unknown name."""
    require_known(name, HARD_CASES, "hard case")
    make = HARD_CASES[name]
    notes = (make.func if isinstance(make, partial) else make).__doc__ or ""
    return replace(make(np.random.default_rng(seed), n), name=name, notes=" ".join(notes.split()))


def chunks(name: str, n: int, seed: int = 0, chunk: int = 2**18) -> Iterator[HardCase]:
    """Yield a case with n rays in parts of at most `chunk` rays. Each part has its own seed, and in some cases its own geometry."""
    for first in range(0, n, chunk):
        yield generate(name, min(chunk, n - first), (seed, first // chunk))


def chosen(cases: Sequence[str]) -> list[str]:
    """Return the names of the selected cases. `cases` has names and letters of groups; () selects all. Raise InputError if unknown."""
    names: list[str] = []
    for case in cases or list(HARD_CASES):
        found = [name for name in HARD_CASES if name == case or name.split("_")[0] == case]
        if not found:
            require_known(case, HARD_CASES, "hard case", "cases")
        names += found
    return names


def fewer(name: str, rays: int) -> int:
    """Return the number of rays for a case: `rays`, or fewer for a costly case."""
    return max(1, rays // next((divisor for start, divisor in COSTLY.items() if name.startswith(start)), 1))
