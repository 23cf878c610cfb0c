"""Traces equal the counters of a query, survive a file, and give the model of a changed trace; docs/rt_core.md can be followed."""

from __future__ import annotations

import ast
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import fields, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT, data_path
from tests.refused import refused
from tests.structures import families_first
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.rtcore.model import trace_rays
from wrt.lab.rtcore.trace import BOX, PRIMITIVE, Trace
from wrt.scene.shapes import icosphere

BLOCK = re.compile(r"^```python\n# (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(n, 3))
    origins *= 3.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    return origins.astype(np.float32), (0.5 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


@pytest.fixture(scope="module")
def recorded() -> Trace:
    return wrt.trace(wrt.build(icosphere(3), "bvh2"), *rays(400))


@pytest.mark.parametrize("name", families_first())
def test_a_trace_has_the_counters_and_fetches_of_a_query(name: str) -> None:
    accel = wrt.build(icosphere(2), name)
    trace, work = wrt.trace(accel, *rays(300)), trace_rays(accel, name, *rays(300))
    for field in ("counts", "first", "address", "size"):
        assert np.array_equal(getattr(trace.counters, field), getattr(work.counters, field)), field
    hits = accel.closest_hit(*rays(300))
    assert np.array_equal(trace.t, hits.t) and np.array_equal(trace.prim_id, hits.prim_id)
    best = (trace.test == PRIMITIVE) & (trace.result == 3)
    assert set(trace.ray[best]) == set(np.flatnonzero(hits.prim_id >= 0))
    assert trace.depth.min() == 0 and trace.depth.max() <= accel.stats.depth
    # The model sees the same rays, whether they come from the trace or from the query.
    assert trace.model().clocks == wrt.lab.rtcore.model.predict(work, wrt.lab.rtcore.parameters.GPUS["rtx2080ti"]).clocks


def test_fetches_are_children_of_earlier_fetches(recorded: Trace) -> None:
    """Every node but the root, and every first primitive of a leaf, is an entered child of a node that the ray fetched before."""
    for i in range(0, len(recorded), 20):
        rows = range(recorded.first[i], recorded.first[i + 1])
        known = {(0, 0)}
        for j in rows:
            children = slice(recorded.child_first[j], recorded.child_first[j + 1])
            address, depth = int(recorded.address[j]), int(recorded.depth[j])
            if recorded.test[j] == BOX:
                assert (address, depth) in known
                entered = np.isfinite(recorded.child_t[children])
                assert recorded.result[j] == entered.sum() and recorded.tests[j] == len(entered) == 2
                known |= {(int(each), depth + 1) for each in recorded.child_address[children][entered]}
            else:
                assert any(depth == below and int(PRIMITIVE_SPACE) <= leaf <= address for leaf, below in known)


def test_a_file_keeps_a_trace_and_damage_is_reported(recorded: Trace, tmp_path: Path) -> None:
    trace = recorded.with_prefetches([5, 3], [128, 0], [64, 64])
    assert trace.prefetch_after.tolist() == [3, 5] and trace.prefetch_address.tolist() == [0, 128]
    trace.save(tmp_path / "trace.npz")
    again = Trace.load(tmp_path / "trace.npz")
    assert all(np.array_equal(getattr(again, each.name), getattr(trace, each.name)) for each in fields(Trace))
    with pytest.raises(wrt.InputError, match=r"suffix \.npz"):
        trace.save(tmp_path / "trace.txt")
    data = (tmp_path / "trace.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    arrays: dict[str, Any] = {each.name: getattr(recorded, each.name) for each in fields(Trace)}
    np.savez(tmp_path / "short.npz", **(arrays | {"address": recorded.address[1:]}))
    for name in ("cut", "short", "none"):
        with pytest.raises(wrt.InputError, match=name):
            Trace.load(tmp_path / f"{name}.npz")
    for argument, value in (("first", recorded.first[::-1]), ("address", -recorded.address), ("test", recorded.test + 9)):
        with refused(argument):
            replace(recorded, **{argument: value})
    assert len(wrt.trace(wrt.build(icosphere(1), "bvh2"), np.zeros((0, 3)), np.zeros((0, 3)))) == 0


def test_the_model_follows_a_changed_trace(recorded: Trace) -> None:
    """A dropped fetch, a smaller node and a perfect prefetch change the terms that they should change, and no other term."""
    before = recorded.model().clocks
    node = recorded.test == BOX
    small = replace(recorded, address=np.where(node, recorded.address // 2, recorded.address),
                    size=np.where(node, recorded.size // 2, recorded.size)).model().clocks
    assert small["DRAM"] < before["DRAM"] and small["box"] == before["box"]
    last = np.zeros(len(recorded.address), bool)
    last[recorded.first[1:] - 1] = True
    dropped = recorded.keep(~last)
    assert len(dropped.address) == len(recorded.address) - len(recorded)
    assert dropped.counters.nodes.sum() + dropped.counters.primitives.sum() == len(dropped.address)
    # Each fetch prefetches the next one: nearly no lane waits for the L2, and no test is saved.
    inside = np.flatnonzero(np.diff(recorded.ray) == 0)
    ahead = recorded.with_prefetches(inside, recorded.address[inside + 1], recorded.size[inside + 1]).model().clocks
    assert ahead["latency"] < 0.7 * before["latency"] and ahead["box"] == before["box"] and ahead["DRAM"] >= before["DRAM"]


def test_the_page_can_be_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The programs of docs/rt_core.md run word by word, and the idea for hardware changes what it should."""
    ball = icosphere(4)
    lines = [*(f"v {x} {y} {z}" for x, y, z in ball.vertices), *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.faces)]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    blocks = dict(BLOCK.findall((ROOT / "docs" / "rt_core.md").read_text()))
    assert list(blocks) == ["record_trace.py", "read_trace.py", "second_child.py", "left_first.py"]
    assert len(blocks["read_trace.py"].splitlines()) <= 10 and len(blocks["second_child.py"].splitlines()) <= 30
    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {}
    out = {}
    for name, text in blocks.items():
        (tmp_path / name).write_text(text.replace("bunny.ply", "ball.obj"))  # Warp reads the source of kernels
        with redirect_stdout(StringIO()) as written:
            exec(compile((tmp_path / name).read_text(), str(tmp_path / name), "exec"), scope)
        out[name] = written.getvalue().splitlines()
    recorded = Trace.load(tmp_path / "trace.npz")
    assert len(out["read_trace.py"]) == recorded.first[3] and out["read_trace.py"][0].startswith("0 node 0 64 0 1 2 ")
    changed = scope["prefetch_second_child"](recorded)
    two = (recorded.test == BOX) & (recorded.result == 2)
    assert np.array_equal(changed.prefetch_after, np.flatnonzero(two))
    for j in np.flatnonzero(two)[::500]:
        first = recorded.child_first[j]
        farther = first + int(recorded.child_t[first + 1] >= recorded.child_t[first])
        assert changed.prefetch_address[changed.prefetch_after == j] == recorded.child_address[farther]
    before, after = recorded.model().clocks, changed.model().clocks
    assert after["latency"] < before["latency"] and after["L1"] > before["L1"] and after["box"] == before["box"]
    assert "0 prefetches" in out["second_child.py"][0] and f"{two.sum()} prefetches" in out["second_child.py"][1]
    assert len(out["left_first.py"]) == 2 and all(line.startswith("Trace(bvh2, 1 rays, ") for line in out["left_first.py"])


def test_kept_fetches_keep_their_children_and_prefetches(recorded: Trace) -> None:
    """Fetches that `keep` leaves have the same children and prefetches as before; the others are gone."""
    after = np.arange(0, len(recorded.address), 3)
    trace = recorded.with_prefetches(after, 64 * after, np.full(len(after), 64))
    mask = np.random.default_rng(0).random(len(trace.address)) < 0.6
    kept = trace.keep(mask)
    assert np.array_equal(kept.ray, trace.ray[mask]) and np.array_equal(kept.address, trace.address[mask])
    rows = np.flatnonzero(mask)
    for j in range(0, len(rows), 97):
        mine, old = (slice(*each) for each in (kept.child_first[j : j + 2], trace.child_first[rows[j] : rows[j] + 2]))
        assert np.array_equal(kept.child_t[mine], trace.child_t[old]) and np.array_equal(kept.child_address[mine], trace.child_address[old])
    assert np.array_equal(rows[kept.prefetch_after], rows[rows % 3 == 0])
    assert len(trace.keep(np.zeros(len(mask), bool)).address) == 0 and len(trace.keep(~np.zeros(len(mask), bool)).address) == len(mask)
    for wrong in (mask[1:], rows):
        with pytest.raises(wrt.InputError, match="must have a bool for each"):
            trace.keep(wrong)


def test_the_page_shows_the_numbers_of_the_bunny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clocks and fetches that docs/rt_core.md prints come from its programs."""
    shutil.copy(data_path("meshes/medium/stanford_bunny.ply"), tmp_path / "bunny.ply")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "rt_core.md").read_text()
    scope: dict[str, Any] = {}
    written = {}
    for name, text in BLOCK.findall(page):
        (tmp_path / name).write_text(text)
        with redirect_stdout(StringIO()) as out:
            exec(compile(text, str(tmp_path / name), "exec"), scope)
        written[name] = out.getvalue().splitlines()
    before, after = (ast.literal_eval(line[line.index("{"):]) for line in written["second_child.py"])
    said = f"latency falls from {before['latency']:.1f} to {after['latency']:.1f}, then DRAM ({after['DRAM']:.1f}) is the limit"
    assert said in " ".join(page.split()) and max(before.values()) == before["latency"] and max(after.values()) == after["DRAM"]
    plain, changed = (re.search(r"(\d+) fetches", line) for line in written["left_first.py"])
    assert plain and changed and f"costs {changed[1]} fetches instead of {plain[1]}" in page
