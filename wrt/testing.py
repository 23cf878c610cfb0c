"""Hard cases for ray libraries: rays that are hard to get right, with the answers of an exact oracle.

>>> report = wrt.testing.hard_cases(closest_hit)         # closest_hit(vertices, faces, origins, directions) -> t, prim_id
>>> print(report)

It is also a pytest plugin: `pytest_plugins = ["wrt.testing"]` in the topmost conftest.py, or `pytest -p wrt.testing`. A test with an
argument `hard_case` then runs once a case, and `hard_case.check(closest_hit)` reports wrong answers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from wrt.lab.hard_cases.conformance import Case, Report, Result, case_names, hard_cases

if TYPE_CHECKING:
    import pytest

__all__ = ["CASES", "Case", "Report", "Result", "hard_cases"]

CASES = tuple(case_names())
"""Names of the cases, each beginning with the letter of its group (docs/testing.md)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plugin."""
    group = parser.getgroup("wrt")
    group.addoption("--hard-case-rays", type=int, default=1000, help="Rays of each hard case  [default: 1000]")
    group.addoption("--hard-case-seed", type=int, default=0, help="Other rays  [default: 0]")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with an argument `hard_case` once a case."""
    if "hard_case" in metafunc.fixturenames:
        rays, seed = (metafunc.config.getoption(f"hard_case_{what}") for what in ("rays", "seed"))
        metafunc.parametrize("hard_case", [Case(name, rays, seed) for name in CASES], ids=CASES)
