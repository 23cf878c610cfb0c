"""What-if studies: every variant finds the same hits, costs what it must, and planes of few bits cut nothing off."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.kernel_tools import rounded
from wrt.accel.bvh.binary import Bvh2
from wrt.accel.geometry import Geometry
from wrt.kernels.study.bvh2_study import Study, child_0_first
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.bench.report import text
from wrt.lab.rtcore.whatif import STUDIES, Plan, quantised, resized, run, with_planes, with_traversal
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

BITS = ("prim_id", "t", "u", "v")


@pytest.fixture(scope="module")
def soup() -> Geometry:
    rng = np.random.default_rng(7)
    corners = rng.uniform(-1.0, 1.0, (2000, 1, 3)) + 0.1 * rng.normal(size=(2000, 3, 3))
    return Geometry.of(Mesh(rounded(corners.reshape(-1, 3)), np.arange(6000, dtype=np.int32).reshape(-1, 3)))


@pytest.fixture(scope="module")
def rays() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    origins = 2.0 * rng.normal(size=(3000, 3))
    return origins, rng.uniform(-1.0, 1.0, (3000, 3)) - origins


@pytest.mark.parametrize("entries", [0, 1, 4])  # of ENTRIES: kernels that the study has too
def test_a_short_stack_finds_the_same_with_more_nodes(entries: int, soup: Geometry, rays: tuple[np.ndarray, np.ndarray]) -> None:
    tree = Bvh2(soup)
    full = tree.closest_hit(*rays, counters=True)
    short = with_traversal(tree, Study(entries)).closest_hit(*rays, counters=True)
    for name in BITS:
        np.testing.assert_array_equal(getattr(full, name), getattr(short, name))
    a, b = full.counters, short.counters
    assert a is not None and b is not None
    assert b.stack.max() == min(entries, a.stack.max())
    enough = a.stack <= entries  # a ray that needs no more entries goes the very same way
    np.testing.assert_array_equal(a.counts[enough], b.counts[enough])
    assert (b.nodes[~enough] >= a.nodes[~enough]).all() and b.nodes[~enough].sum() > a.nodes[~enough].sum()
    if entries == 0:  # every pop of the full stack that comes to something is a walk from the root
        assert (b.pushes == 0).all() and b.nodes.sum() > 1.5 * a.nodes.sum()
    if entries == 1:
        np.testing.assert_array_equal(tree.any_hit(*rays), with_traversal(tree, Study(entries)).any_hit(*rays))


def test_order_and_early_stop_save_work_and_change_nothing(soup: Geometry, rays: tuple[np.ndarray, np.ndarray]) -> None:
    tree = Bvh2(soup)
    found = {study: with_traversal(tree, study).closest_hit(*rays, counters=True)
             for study in (Study(), Study(choose=child_0_first), Study(early=False), Study(choose=child_0_first, early=False))}
    plain = tree.closest_hit(*rays, counters=True)
    nodes = []
    for hits in found.values():
        for name in BITS:
            np.testing.assert_array_equal(getattr(hits, name), getattr(plain, name))
        assert hits.counters is not None
        nodes.append(hits.counters.nodes)
    assert plain.counters is not None
    np.testing.assert_array_equal(nodes[0], plain.counters.nodes)
    np.testing.assert_array_equal(nodes[2], nodes[3])  # who never stops visits the same in any order
    assert (nodes[1] <= nodes[3]).all() and nodes[0].sum() < nodes[1].sum() < nodes[3].sum()


def test_planes_of_few_bits_contain_the_box_that_they_stand_for() -> None:
    rng = np.random.default_rng(9)
    for scale, offset in ((1.0, 0.0), (1e-20, 0.0), (1e20, 1e21), (1e-3, 1e4)):
        lo = (offset + scale * rng.normal(size=(500, 4, 3))).astype(np.float32)
        hi = lo + np.abs(scale * rng.normal(size=(500, 4, 3)) * rng.integers(0, 2, (500, 4, 1))).astype(np.float32)
        lo[::7, 2], hi[::7, 2] = np.inf, -np.inf
        empty = lo[..., 0] == np.inf
        for bits, size in ((16, 48 + 16 + 16), (8, 24 + 16 + 16), (4, 12 + 16 + 16)):
            below, above, node_bytes = quantised(lo, hi, bits)
            assert node_bytes == size
            assert (below <= lo).all() and (above >= hi).all()
            assert (below[empty] == np.inf).all() and (above[empty] == -np.inf).all()
            extent = np.where(empty[..., None], -np.inf, hi).max(axis=1) - np.where(empty[..., None], np.inf, lo).min(axis=1)
            ulp = np.spacing(np.abs(lo[~empty]).max())
            room = 4.0 * extent[:, None, :] / ((1 << bits) - 2) + 4.0 * ulp + 2.0**-99
            assert (lo[~empty] - below[~empty] <= np.broadcast_to(room, lo.shape)[~empty]).all()


@pytest.mark.parametrize("bits", [16, 8, 4])
def test_quantised_planes_lose_no_ray(bits: int, soup: Geometry, rays: tuple[np.ndarray, np.ndarray]) -> None:
    tree = Bvh2(soup)
    few, size = with_planes(tree, bits)
    a, b = tree.closest_hit(*rays, counters=True), few.closest_hit(*rays, trace=True)
    for name in BITS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.counters is not None and b.counters is not None
    assert (b.counters.boxes >= a.counters.boxes).mean() > 0.95 and b.counters.boxes.sum() >= a.counters.boxes.sum()
    smaller = resized(b.counters, 64, size)
    node = b.counters.address < int(PRIMITIVE_SPACE)
    np.testing.assert_array_equal(smaller.address[node], b.counters.address[node] // 64 * size)
    np.testing.assert_array_equal(smaller.address[~node], b.counters.address[~node])
    assert (smaller.size[node] == size).all() and (smaller.node_bytes == size * b.counters.nodes).all()


@pytest.mark.parametrize("study", [name for name in STUDIES if name != "width"])
def test_a_study_has_a_row_for_each_variant_and_no_ray_differs(study: str) -> None:
    rows = run(Plan(study, icosphere(3), ("primary",), 1024))
    assert len(rows) >= 3 and all(row.differ == 0 for row in rows)
    assert rows._repr_html_().count("<tr>") == 1 + len(rows)
    assert len({row.variant for row in rows}) == len(rows) and rows[0].variant in text(rows, Plan(study, icosphere(3)), "")
    for row in rows:
        assert row.few_warps.rays_per_second <= 1.0001 * row.many_warps.rays_per_second
        assert row.boxes == pytest.approx(2.0 * row.nodes) and row.bytes > row.node_bytes
    by_name = {row.variant: row for row in rows}
    if study == "sorting":
        assert by_name["shuffled"].lines > by_name["as they come"].lines and by_name["shuffled"].nodes == rows[0].nodes
    if study == "planes":
        assert by_name["8 bits"].bytes < rows[0].bytes and by_name["8 bits"].nodes >= rows[0].nodes


def test_the_command(tmp_path: Path) -> None:
    mesh, report = tmp_path / "box.obj", tmp_path / "order.md"
    mesh.write_text(BOX_OBJ)
    result = command("whatif", "order", str(mesh), "--rays", "1024", "--kinds", "primary", "-q", "--json", "-o", str(report))
    told = json.loads(result.out)
    assert [row["differ"] for row in told["rows"]] == [0] * 4 and told["rows"][0]["few_warps"]["rays_per_second"] > 0.0
    assert "early stop alone" in report.read_text()
    assert command("whatif", "nonsense", str(mesh)).code == 2
