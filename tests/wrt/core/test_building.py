"""`wrt.build(progress=...)`: every structure reports the finished share of its build, from 0 to 1; and the seconds of a render's stages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.refused import refused
from wrt.accel.instances import Instances
from wrt.accel.structures import ACCELERATORS
from wrt.scene.shapes import icosphere, torus

SCENE = ROOT / "scenes" / "conductor.toml"
RAYS = np.float32([[0, 0, 5], [0.3, 0.2, 5], [5, 5, 5]]), np.float32([[0, 0, -1]] * 3)


def shares(mesh: Any, accel: str = "bvh", **options: Any) -> tuple[list[float], Any]:
    """Return what a build reports, and the structure."""
    seen: list[float] = []
    return seen, wrt.build(mesh, accel, progress=seen.append, **options)


@pytest.mark.parametrize("accel", ACCELERATORS)
def test_every_structure_reports_from_0_to_1_and_is_the_same(accel: str) -> None:
    mesh = icosphere(3)
    seen, structure = shares(mesh, accel)
    assert seen[0] == 0.0 and seen[-1] == 1.0 and seen == sorted(seen)
    assert np.array_equal(structure.closest_hit(*RAYS).t, wrt.build(mesh, accel).closest_hit(*RAYS).t)


def test_a_list_of_meshes_reports_each_mesh() -> None:
    seen, structure = shares([torus(segments=6 + i) for i in range(5)], builder="binned")
    assert isinstance(structure, Instances) and seen == sorted(seen)
    assert len({round(done, 6) for done in seen}) >= 5 + 2  # a value for each mesh, 0 and 1


def test_subtrees_are_reported_while_they_are_built() -> None:
    seen, _ = shares(icosphere(4), "kdtree")
    assert len(seen) > 4 and seen == sorted(seen)


def test_what_cannot_be_called_is_refused_and_an_error_ends_the_build() -> None:
    with refused("progress", "function of one number"):
        wrt.build(icosphere(1), progress="bar")  # type: ignore[call-overload]
    with pytest.raises(KeyboardInterrupt):
        wrt.build(icosphere(1), progress=lambda done: (_ for _ in ()).throw(KeyboardInterrupt))
