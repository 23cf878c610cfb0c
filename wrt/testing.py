"""The hard cases for your own ray library: rays that are hard to get right, and who gets them right, by an exact oracle.

>>> report = wrt.testing.hard_cases(closest_hit)         # closest_hit(vertices, faces, origins, directions) -> t, prim_id
>>> print(report)

It is a pytest plugin, too, for those who name it: `pytest_plugins = ["wrt.testing"]` in the topmost conftest.py, or `pytest -p
wrt.testing`. A test with an argument `hard_case` then runs once a case, and `hard_case.check(closest_hit)` shows what is wrong.
"""

from __future__ import annotations

from typing import Any

from wrt.lab.hard_cases.conformance import Case, Report, Result, case_names, hard_cases

__all__ = ["CASES", "Case", "Report", "Result", "hard_cases"]

CASES = tuple(case_names())
"""The names of the cases, each beginning with the letter of its group; docs/testing.md has the groups."""


def pytest_addoption(parser: Any) -> None:
    """Rays a case, and which."""
    group = parser.getgroup("wrt")
    group.addoption("--hard-case-rays", type=int, default=1000, help="Rays of each hard case  [default: 1000]")
    group.addoption("--hard-case-seed", type=int, default=0, help="Other rays  [default: 0]")


def pytest_generate_tests(metafunc: Any) -> None:
    """A test that has an argument `hard_case` runs once a case."""
    if "hard_case" in metafunc.fixturenames:
        rays, seed = (metafunc.config.getoption(f"hard_case_{what}") for what in ("rays", "seed"))
        metafunc.parametrize("hard_case", [Case(name, rays, seed) for name in CASES], ids=CASES)
