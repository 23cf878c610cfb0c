"""Hard cases for ray-tracing libraries: rays whose hits rounding errors easily change, and the true hits from exact arithmetic.

>>> report = wrt.testing.hard_cases(closest_hit)         # closest_hit(vertices, faces, origins, directions) -> t, prim_id
>>> print(report)

The module is also a pytest plugin: write `pytest_plugins = ["wrt.testing"]` in the topmost conftest.py, or run `pytest -p wrt.testing`.
A test with an argument `hard_case` then runs once for each case, and `hard_case.check(closest_hit)` reports wrong hits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from wrt.lab.hard_cases.bodies import Bodies, bodies
from wrt.lab.hard_cases.conformance import Case, Report, Result, case_names, hard_cases

if TYPE_CHECKING:
    import pytest

__all__ = ["CASES", "Bodies", "Case", "Report", "Result", "bodies", "hard_cases"]

CASES = tuple(case_names())
"""Names of the cases, each beginning with the letter of its group (docs/testing.md)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plugin."""
    group = parser.getgroup("wrt")
    group.addoption("--hard-case-rays", type=int, default=1000, help="Number of rays in each hard case  [default: 1000]")
    group.addoption("--hard-case-seed", type=int, default=0, help="Seed of the random rays  [default: 0]")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test with an argument `hard_case` once for each case."""
    if "hard_case" in metafunc.fixturenames:
        rays, seed = (metafunc.config.getoption(f"hard_case_{option}") for option in ("rays", "seed"))
        metafunc.parametrize("hard_case", [Case(name, rays, seed) for name in CASES], ids=CASES)
