"""Reinsertion reduces the cost of trees. tests/kernels/build/test_bvh2.py tests for every builder that trees are valid."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.accel.bvh.builders import BvhOptions, build_binary
from wrt.accel.bvh.reinsertion import EVERY_NODE, LARGEST_NODES, Effort, half_areas, links_of, optimized, scale_of
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


def room() -> Geometry:
    """Return small objects everywhere and large triangles across all of them, as in a model of a building."""
    rng = np.random.default_rng(8)
    ball = icosphere(2)
    places, walls = rng.random((200, 1, 3)), rng.random((40, 3, 3))
    vertices = np.concatenate([(0.01 * ball.vertices + places).reshape(-1, 3), walls.reshape(-1, 3)])
    faces = (ball.faces + len(ball.vertices) * np.arange(200)[:, None, None]).reshape(-1, 3)
    return Geometry.of(Mesh(vertices, np.concatenate([faces, len(vertices) - 120 + np.arange(120).reshape(-1, 3)])))


@pytest.mark.parametrize("accel", ["bvh2", "bvh8"])
def test_the_largest_boxes_bring_much_of_the_gain(accel: str) -> None:
    binned, refined, every = (build(room(), accel, builder=name).stats.sah_cost for name in ("binned", "refined", "reinsertion"))
    assert refined < 0.9 * binned and binned - refined > 0.4 * (binned - every)


@pytest.mark.parametrize("effort", [EVERY_NODE, LARGEST_NODES], ids=["every", "largest"])
def test_what_the_areas_fell_by_is_what_they_fell_by(effort: Effort) -> None:
    """The kernel updates the areas after each move."""
    tree = build_binary(room(), BvhOptions("binned", 1), 1)
    before = links_of(tree)
    links, _, fell = optimized(tree, effort, 1)
    scale = scale_of(before)
    areas = [half_areas(each, scale).sum(dtype=np.float64) for each in (before, links)]
    assert fell == pytest.approx(1.0 - areas[1] / areas[0], rel=1e-4) and fell > 0.05


def test_a_tree_that_cannot_gain_is_left_alone() -> None:
    geometry = Geometry.of(icosphere(4))
    refined, binned = (build_binary(geometry, BvhOptions(name), 1) for name in ("refined", "binned"))
    assert np.array_equal(refined.nodes, binned.nodes) and np.array_equal(refined.order, binned.order)
