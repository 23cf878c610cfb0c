"""A hundred random meshes: every structure has the bits of brute force in every way. Ten thousand:
`python -m tests.random_meshes`."""

from __future__ import annotations

import pytest

from tests.random_meshes import OVER, Scope, check
from tests.structures import FAMILIES

CASES = {"plain": 55, "with spheres": 15, "instances": 15, "worlds": 15}
# What is not asked here is asked by the command, and by tests of its own.
SCOPES = {"plain": Scope(counting=FAMILIES, listing=("brute_force", *FAMILIES), own=("bvh8",))}
OTHERS = Scope(("brute_force", "bvh8"), ("bvh8",), (), ())


def test_all_that_a_case_can_be_over_is_tried() -> None:
    assert CASES.keys() == OVER.keys()


@pytest.mark.parametrize("over", CASES)
def test_every_way_has_the_bits_of_brute_force(over: str) -> None:
    scope, number = SCOPES.get(over, OTHERS), [*OVER].index(over)
    found = {seed: check(number, seed, scope) for seed in range(CASES[over])}
    assert {seed: what for seed, what in found.items() if what} == {}
