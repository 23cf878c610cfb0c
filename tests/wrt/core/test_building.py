"""`wrt.build(progress=...)`: every structure reports the finished share of its build, from 0 to 1; and the seconds of a render's stages."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.refused import refused
from wrt.accel.instances import Instances
from wrt.accel.structures import ACCELERATORS
from wrt.core.building import build_clock, loading
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
    seen, _ = shares(icosphere(4), "kdtree", perfect_below=1024)
    assert len(seen) > 4 and seen == sorted(seen)


def test_a_build_reports_to_its_own_caller_only() -> None:
    inner: list[float] = []

    def nested(done: float) -> None:
        if not inner:
            wrt.build(icosphere(1), "grid", progress=inner.append)

    wrt.build(icosphere(3), "octree", progress=nested)
    assert inner == [0.0, 1.0]
    wrt.build(icosphere(3), "octree")
    assert inner == [0.0, 1.0]


def test_what_cannot_be_called_is_refused_and_an_error_ends_the_build() -> None:
    with refused("progress", "function of one number"):
        wrt.build(icosphere(1), progress="bar")  # type: ignore[call-overload]
    with pytest.raises(KeyboardInterrupt):
        wrt.build(icosphere(1), progress=lambda done: (_ for _ in ()).throw(KeyboardInterrupt))


@pytest.mark.parametrize("accel", ["bvh", "octree"])
def test_after_an_error_in_the_function_later_builds_do_not_call_it(accel: str) -> None:
    calls = 0

    def stop(done: float) -> None:
        nonlocal calls
        calls += 1
        if done > 0.0:
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError) as kept:  # keeps the frames of the build alive
        wrt.build([icosphere(1), icosphere(2)], accel, progress=stop)
    before = calls
    del kept
    wrt.build([icosphere(1), icosphere(2)], accel)
    assert calls == before


@pytest.mark.parametrize("aov", [(), "depth"])
def test_the_seconds_of_a_render_are_no_more_than_it_took(aov: str | tuple[str, ...]) -> None:
    for _ in range(2):  # compiled, or from the cache of an earlier run; then kept by this process
        begin = time.perf_counter()
        film = wrt.render(SCENE, spp=1, size=(16, 9), aov=aov, tile_size=3)
        whole = time.perf_counter() - begin
        parts = film.stats["seconds"]
        assert parts.keys() >= {"compile", "upload", "build", "trace"} and min(parts.values()) >= 0.0
        assert max(parts.values()) <= whole and film.stats["accel"]["build_seconds"] <= parts["build"]
        assert sum(parts[name] for name in parts if name != "compile") <= whole  # which runs beside upload and build


def test_loading_of_kernels_does_not_count_as_building() -> None:
    begin = build_clock()
    with loading():
        time.sleep(0.3)
    assert 0.0 <= build_clock() - begin < 0.25
