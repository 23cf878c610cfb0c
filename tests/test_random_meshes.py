"""A hundred random meshes: every structure returns the bits of brute force. `python -m tests.random_meshes` checks ten thousand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.random_meshes import KINDS, Scope, check, options_of
from tests.structures import FAMILIES
from wrt.accel.bvh.builders import BVH_BUILDERS

CASES = {"plain": 55, "with spheres": 15, "instances": 15, "worlds": 15}
# Structures that these scopes leave out are checked by the command, and by their own tests.
SCOPES = {"plain": Scope(counting=FAMILIES, listing=("brute_force", *FAMILIES), own=("bvh8",))}
OTHERS = Scope(("brute_force", "bvh8"), ("bvh8",), (), ())


def test_every_kind_of_geometry_is_checked() -> None:
    assert CASES.keys() == KINDS.keys()


@pytest.mark.parametrize("name", ["bvh2", "bvh8", "bvh2_kdop"])
def test_every_builder_is_drawn(name: str) -> None:
    rng = np.random.default_rng(0)
    options = [options_of(rng, name) for _ in range(200)]
    assert {each["builder"] for each in options if "builder" in each} == BVH_BUILDERS.keys()
    assert len({each["max_leaf"] for each in options if "max_leaf" in each}) > 10


@pytest.mark.parametrize("kind", CASES)
def test_every_way_has_the_bits_of_brute_force(kind: str) -> None:
    scope, number = SCOPES.get(kind, OTHERS), [*KINDS].index(kind)
    found = {seed: check(number, seed, scope) for seed in range(CASES[kind])}
    assert {seed: what for seed, what in found.items() if what} == {}
