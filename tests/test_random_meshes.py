"""A hundred random meshes: every structure has the bits of brute force in every way. Ten thousand:
`python -m tests.random_meshes`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.random_meshes import OVER, Scope, check, options_of
from tests.structures import FAMILIES
from wrt.accel.bvh.builders import BVH_BUILDERS

CASES = {"plain": 55, "with spheres": 15, "instances": 15, "worlds": 15}
# What is not asked here is asked by the command, and by tests of its own.
SCOPES = {"plain": Scope(counting=FAMILIES, listing=("brute_force", *FAMILIES), own=("bvh8",))}
OTHERS = Scope(("brute_force", "bvh8"), ("bvh8",), (), ())


def test_all_that_a_case_can_be_over_is_tried() -> None:
    assert CASES.keys() == OVER.keys()


@pytest.mark.parametrize("name", ["bvh2", "bvh8", "bvh2_kdop"])
def test_every_builder_is_drawn(name: str) -> None:
    rng = np.random.default_rng(0)
    options = [options_of(rng, name) for _ in range(200)]
    assert {each["builder"] for each in options if "builder" in each} == BVH_BUILDERS.keys()
    assert len({each["max_leaf"] for each in options if "max_leaf" in each}) > 10


@pytest.mark.parametrize("over", CASES)
def test_every_way_has_the_bits_of_brute_force(over: str) -> None:
    scope, number = SCOPES.get(over, OTHERS), [*OVER].index(over)
    found = {seed: check(number, seed, scope) for seed in range(CASES[over])}
    assert {seed: what for seed, what in found.items() if what} == {}
