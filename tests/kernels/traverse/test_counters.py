"""The counters equal those of a walk in plain Python, or obey the laws of every walk, and leave no code when they are off."""

import inspect
import sys

import numpy as np
import pytest
import warp as wp

from tests.kernel_tools import machine_code, rounded
from tests.rewalk import PRIMITIVE_BYTES, PRIMITIVES, REWALK, prim_ids, rays
from tests.structures import STRUCTURES, families_first
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.kernels.query import make_closest_hit_kernel
from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.traverse import bvh2 as traverse_bvh2
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.observer import Observer, Recorder
from wrt.kernels.traverse.steps import Step
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

NAMES = ("nodes", "boxes", "box_operations", "primitives", "leaves", "pushes", "pops", "stack")


def aimed(geometry, n, seed):
    """Return rays towards points in the geometry's box; half start inside the box, half outside."""
    rng = np.random.default_rng(seed)
    lo, hi = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
    center, half = 0.5 * (lo + hi), 0.5 * (hi - lo)
    reach = np.where(np.arange(n) % 2, 1.0, 4.0)[:, None]
    origins = rounded(center + half * reach * rng.uniform(-1.0, 1.0, (n, 3)))
    return origins, rounded(center + half * rng.uniform(-1.0, 1.0, (n, 3)) - origins)


def check(geometry, name, n, seed, **options):
    """Check that every counter and every fetch of n rays equals that of the walk in Python."""
    structure = build(geometry, name, **options)
    origins, directions = aimed(geometry, n, seed)
    hits = structure.closest_hit(origins, directions, trace=True)
    counters = hits.counters
    assert len(counters.address) == counters.first[-1]
    for i, ray in enumerate(rays(geometry, origins, directions)):
        walk = REWALK[name](structure, ray)
        assert (ray.best[1] if ray.best[1] < 1 << 31 else -1) == hits.prim_id[i]
        assert {k: int(counters.counts[k][i]) for k in NAMES} == {k: getattr(walk, k) for k in NAMES}, f"ray {i}"
        part = slice(counters.first[i], counters.first[i + 1])
        assert list(zip(counters.address[part].tolist(), counters.size[part].tolist(), strict=True)) == walk.trace
        assert counters.node_bytes[i] + counters.primitive_bytes[i] == sum(size for _, size in walk.trace)
    assert (counters.probes == 1).all()
    assert (counters.primitive_bytes == PRIMITIVE_BYTES * counters.primitives).all()
    return counters


def soup():
    rng = np.random.default_rng(5)
    corners = rng.uniform(-1.0, 1.0, (300, 1, 3)) + 0.2 * rng.normal(size=(300, 3, 3))
    return Geometry.of(Mesh(rounded(corners.reshape(-1, 3)), np.arange(900, dtype=np.int32).reshape(-1, 3)))


@pytest.mark.parametrize("name", REWALK)
def test_counters_equal_a_walk_in_python(name):
    counters = check(soup(), name, 60, 1)
    assert counters.primitives.sum() > 0
    check(Geometry.of(icosphere(2)), name, 60, 2)


@pytest.mark.parametrize("name", STRUCTURES)
def test_counters_are_those_of_some_walk(name):
    """A ray has as many fetches as nodes and primitives, its closest hit is among them, and it never pops an empty stack."""
    structure = build(soup(), name)
    hits = structure.closest_hit(*aimed(structure.geometry, 500, 6), trace=True)
    counters = hits.counters
    of_primitives = counters.address >= PRIMITIVES
    tested = prim_ids(structure)[(counters.address[of_primitives] - PRIMITIVES) // PRIMITIVE_BYTES]
    ray = np.repeat(np.arange(500), np.diff(counters.first))
    assert np.array_equal(np.bincount(ray[of_primitives], minlength=500), counters.primitives)
    assert np.array_equal(np.bincount(ray[~of_primitives], minlength=500), counters.nodes)
    assert np.array_equal(np.bincount(ray, counters.size, 500), counters.node_bytes + counters.primitive_bytes)
    assert (counters.primitive_bytes == PRIMITIVE_BYTES * counters.primitives).all() and (counters.probes == 1).all()
    hit = np.flatnonzero(hits.prim_id >= 0)
    assert set(zip(hit, hits.prim_id[hit], strict=True)) <= set(zip(ray[of_primitives], tested, strict=True))
    assert 50 < len(hit) < 450
    assert ((counters.pops > 0) <= (counters.pushes > 0)).all() and (counters.stack <= counters.pushes).all()
    assert name == "brute_force" or counters.primitives.mean() < 0.4 * len(structure.geometry)


@pytest.mark.parametrize("name", STRUCTURES)
def test_counting_changes_no_hit(name):
    structure = build(icosphere(2), name)
    origins, directions = aimed(structure.geometry, 500, 4)
    plain, counted = structure.closest_hit(origins, directions), structure.closest_hit(origins, directions, counters=True)
    assert plain.counters is None and "probes 1.00" in repr(counted.counters)
    for field in ("t", "u", "v", "prim_id"):
        np.testing.assert_array_equal(getattr(plain, field), getattr(counted, field))
    with pytest.raises(AttributeError):
        counted.counters.nonsense  # noqa: B018


@pytest.mark.parametrize("name", STRUCTURES)
def test_no_rays_cost_nothing(name):
    counters = build(icosphere(1), name).closest_hit(np.zeros((0, 3)), np.zeros((0, 3)), trace=True).counters
    assert len(counters.counts) == len(counters.address) == 0


@pytest.mark.parametrize("name", families_first())
def test_counting_off_leaves_nothing_in_the_machine_code(name, monkeypatch, tmp_path):
    """The code for Turing has the same bytes as code compiled from a source whose counters do nothing."""

    @wp.func
    def node(recorder: Recorder, ray: Ray, index: int, boxes: int, operations: int):
        pass

    @wp.func
    def step(recorder: Recorder, ray: Ray, step: Step):
        pass

    @wp.func
    def root(recorder: Recorder, ray: Ray, lo: wp.vec3, hi: wp.vec3, t: float):
        pass

    @wp.func
    def leaf(recorder: Recorder, ray: Ray, first: int, count: int):
        pass

    @wp.func
    def primitive(recorder: Recorder, ray: Ray, index: int):
        pass

    @wp.func
    def push(recorder: Recorder, ray: Ray, index: int, count: int, t: float, below: int, size: int):
        pass

    @wp.func
    def pop(recorder: Recorder, ray: Ray, index: int, count: int, t: float, result: int):
        pass

    @wp.func
    def finish(recorder: Recorder, ray: Ray, best: Hit) -> Hit:
        if best.prim_id == NO_HIT:
            best.t = float(wp.inf)
            best.prim_id = -1
        return best

    empty = Observer(node, step, root, leaf, primitive, push, pop, finish)
    structure = Structure(ACCELERATORS[name])
    codes = []
    for i, observer in enumerate(("", "", "sum") if name == "bvh2" else ("", "")):
        units = Structure(ACCELERATORS[name], Units(observer=observer))
        kernel = make_closest_hit_kernel(structure.struct, units.traversal(any_hit=False))
        codes.append(machine_code(kernel, tmp_path / str(i)))
        if i == 0:
            unit = structure.accel.kernels
            module = unit if inspect.ismodule(unit) else sys.modules[type(unit).__module__]
            walk = module if hasattr(module, "make_observer") else traverse_bvh2  # Trees with other bounding volumes share this module.
            monkeypatch.setattr(walk, "make_observer", lambda *_: empty)
        else:
            monkeypatch.undo()
    assert len(codes[0][0]) > 1000 and codes[0] == codes[1] and (len(codes) == 2 or codes[2] != codes[0])
