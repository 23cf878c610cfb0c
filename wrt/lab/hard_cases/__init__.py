"""Rays on which intersection tests fail, and judgement by exact arithmetic."""

from collections.abc import Sequence
from dataclasses import dataclass

from wrt.lab import Plan, option, the_seed


@dataclass(frozen=True)
class Stability(Plan):
    """Run the hard cases on intersection tests and ray libraries. Count wrong rays, and measure errors and speed.

    CASES: names such as E_grid, or letters of groups such as E; default: all."""

    COMMAND, STUDY, QUICK = "stability", "wrt.lab.hard_cases.stability", {"rays": 300, "runs": 3}
    cases: Sequence[str] = option((), check="wrt.lab.hard_cases.cases:chosen")
    contestants: Sequence[str] = option((), "Contestants, as in `bench queries`  [default: bvh8 with every triangle and box test]",
                                        check="wrt.lab.bench.contestants:check_names")
    peers: bool = option(False, "Also test the installed libraries: Embree (robust and fast), Warp, Open3D, Mitsuba")
    rays: int = option(10_000, "Number of rays of each case for the first contestant", (1, 2**40))
    sample: int = option(10_000, "Number of these rays that the oracle judges, and that the other contestants trace", (1, 2**40))
    seed: int = the_seed()
    runs: int = option(7, "Timed runs of each contestant, alternating", (1, 1000))
