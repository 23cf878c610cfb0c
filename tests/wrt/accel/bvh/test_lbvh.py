"""The LBVH builder makes the same tree on every device, and no tree is deeper than the traversal stack."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)

from wrt.accel.bvh.builders import BvhOptions, build_binary, sah_cost
from wrt.accel.bvh.lbvh import build_on
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.accel.store import check_binary
from wrt.kernels.build.lbvh import KEY_BITS, bits_of
from wrt.kernels.traverse.bvh2 import STACK_SIZE
from wrt.scene.shapes import torus

FIELDS = "t", "u", "v", "prim_id"


def geometry_at(places: np.ndarray, size: float = 0.1) -> Geometry:
    """Return a geometry with a triangle at each place, (N, 3)."""
    corners = places[:, None] + size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]])
    vertices = corners.astype(np.float32).reshape(-1, 3)
    return Geometry(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), np.zeros((0, 4), np.float32))


def places(name: str, n: int = 1500) -> np.ndarray:
    rng = np.random.default_rng(0)
    return {"anywhere": rng.normal(size=(n, 3)), "one place": np.zeros((n, 3)), "a line": rng.random((n, 1)) * [1.0, 0.0, 0.0],
            "ever nearer": (0.5 ** np.arange(n) % 100)[:, None] * [1.0, 1.0, 1.0] * 1e9,
            "few places": rng.integers(0, 3, size=(n, 3)).astype(float)}[name]


@pytest.mark.parametrize("name", ["anywhere", "one place", "a line", "ever nearer", "few places"])
@pytest.mark.parametrize("max_leaf", [1, 4])
def test_the_tree_is_one_and_fits_the_stack(name: str, max_leaf: int) -> None:
    geometry = geometry_at(places(name))
    options = BvhOptions("lbvh", max_leaf=max_leaf)
    nodes, parents, order, root = build_on(DEVICE, geometry.on(DEVICE), options)
    assert nodes.device == parents.device == order.device == DEVICE
    rows = nodes.numpy()
    assert len(rows) == root.inner_nodes and root.height <= sum((bits_of(len(geometry))[0], 3 * bits_of(len(geometry))[1]))
    check_binary(rows, len(geometry), root.height)  # parents come before their children
    assert np.array_equal(np.sort(order.numpy()), np.arange(len(geometry)))
    above = parents.numpy()
    for side in "01":
        inner = rows["count_" + side] == 0
        assert np.array_equal(above[rows["first_" + side][inner]], np.flatnonzero(inner))
        assert rows["count_" + side].max() <= max_leaf
    assert above[0] == -1
    assert root.sah_cost == pytest.approx(sah_cost(rows), rel=1e-9)
    lo, hi = geometry.bounds()
    assert (np.minimum(rows["lo_0"][0], rows["lo_1"][0]) == lo.min(axis=0)).all()
    assert (np.maximum(rows["hi_0"][0], rows["hi_1"][0]) == hi.max(axis=0)).all()


def test_the_device_builds_the_cpus_tree() -> None:
    mesh = torus(1.0, 0.4, 40, 20)
    tree = build_binary(Geometry.of(mesh), BvhOptions("lbvh"), 1)
    built = build(mesh, "bvh2", builder="lbvh").built
    assert built.arrays["nodes"].tobytes() == tree.nodes.tobytes() and np.array_equal(built.order, tree.order)
    assert built.depth == tree.depth


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
@pytest.mark.parametrize("accel", ["bvh2", "bvh8", "bvh2_sphere", "bvh2_kdop"])
def test_few_triangles(accel: str, n: int) -> None:
    geometry = geometry_at(places("anywhere", n), 3.0)
    origins = geometry.vertices.reshape(-1, 3, 3).mean(axis=1) + np.float32([0.0, 1.0, -1.0])
    directions = np.tile(np.float32([0.0, -1.0, 1.0]), (n, 1))
    hits, truth = (build(geometry, *kind, **more).closest_hit(origins, directions)
                   for kind, more in (((accel,), {"builder": "lbvh"}), (("brute_force",), {})))
    assert (truth.prim_id >= 0).all()
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(hits, name), getattr(truth, name))


def test_keys_leave_room_for_every_number() -> None:
    for n in (1, 2, 3, 1000, 1 << 20, (1 << 20) + 1, 1 << 30, (1 << 31) - 1):
        number, bits = bits_of(n)
        assert (n - 1) >> number == 0 and 1 <= bits <= 21 and number + 3 * bits <= KEY_BITS < STACK_SIZE
    assert bits_of(1_000_000) == (20, 14)
