"""The walk of one ray: its steps give the counters of every structure, its stack is a stack, and its drawings show sections."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests import device
from tests.structures import families_first
from wrt.accel.queries.observed import RecordedSteps, record_steps
from wrt.kernels.traverse import steps as of
from wrt.lab.walk.steps import Entry, Region
from wrt.lab.walk.walk import section_of
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene, Sphere
from wrt.scene.shapes import icosphere

RAY = ([0.1, 0.2, 3.0], [0.15, -0.3, -2.0])


def aimed(mesh: Mesh, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from around a mesh to points near it."""
    rng = np.random.default_rng(seed)
    lo, hi = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = np.linalg.norm(hi - lo)
    origins = 0.5 * (lo + hi) + size * rng.normal(size=(n, 3))
    return origins.astype(np.float32), (lo + (hi - lo) * rng.uniform(-0.1, 1.1, (n, 3)) - origins).astype(np.float32)


def counted(recorded: RecordedSteps) -> dict[str, np.ndarray]:
    """Return the counters of each ray, (N,) int64, counted from the steps."""
    steps, n = recorded.steps, len(recorded)
    kind, ray = steps["kind"], np.repeat(np.arange(n), np.diff(recorded.first))

    def number(mask: np.ndarray) -> np.ndarray:
        return np.bincount(ray[mask], minlength=n)

    nodes, primitives = kind == of.NODE, kind == of.TEST
    tested = (kind == of.BOX) | (kind == of.PLANE) | (kind == of.CELL)
    before = np.maximum.accumulate(np.where(nodes, np.arange(len(steps)), -1))  # the node of each test; a root's box has none
    owned = before >= recorded.first[ray] if len(steps) else np.zeros(0, bool)
    operations = np.zeros(len(steps), bool)
    operations[before[tested & owned]] = True
    leaves_stack = (kind == of.POP) & (steps["result"] & of.STAYS == 0)
    size = np.cumsum((kind == of.PUSH).astype(np.int64) - leaves_stack)
    stack = np.zeros(n, np.int64)
    np.maximum.at(stack, ray, size)  # every stack is empty at the end of its ray
    node_bytes, primitive_bytes = recorded.node_bytes, recorded.primitive_bytes
    return {"nodes": number(nodes), "boxes": number(kind == of.BOX), "box_operations": number(operations | ((kind == of.BOX) & ~owned)),
            "primitives": number(primitives), "leaves": number(kind == of.LEAF), "pushes": number(kind == of.PUSH),
            "pops": number(kind == of.POP), "stack": stack, "node_bytes": node_bytes * number(nodes),
            "primitive_bytes": primitive_bytes * number(primitives)}


def check_counts(mesh: Mesh, name: str, n: int) -> None:
    accel = wrt.build(mesh, name)
    for begin in range(0, n, 2000):
        rays = aimed(mesh, min(2000, n - begin), begin)
        hits, recorded = accel.closest_hit(*rays, counters=True), record_steps(accel, *rays)
        assert hits.counters is not None
        for field, values in counted(recorded).items():
            assert np.array_equal(values, hits.counters.counts[field]), field
        assert np.array_equal(recorded.prim_id, hits.prim_id) and np.array_equal(recorded.t, hits.t)
        assert 0.05 < (hits.prim_id >= 0).mean() < 0.95


@pytest.mark.parametrize("name", families_first())
def test_the_steps_give_the_counters(name: str) -> None:
    check_counts(icosphere(2), name, 500)


@pytest.mark.skipif(device.NAME == "cpu", reason="needs a GPU")
@pytest.mark.parametrize("name", ["bvh2", "bvh6", "bvh8", "bvh8c"])
def test_a_gpu_records_the_steps_of_the_cpu(name: str) -> None:
    rays = aimed(icosphere(2), 200, 0)
    steps = [record_steps(wrt.build(icosphere(2), name, device=where), *rays).steps for where in ("cpu", device.NAME)]
    assert steps[0].tobytes() == steps[1].tobytes()


@pytest.mark.parametrize("name", families_first())
def test_a_walk_is_consistent(name: str) -> None:
    """Popped entries are those on the stack, tests agree with exact geometry, and the closest hit is that of the query."""
    mesh = icosphere(2)
    accel = wrt.build(mesh, name)
    for origin, direction in zip(*aimed(mesh, 12, 5), strict=True):
        walk = wrt.walk(accel, origin, direction)
        hits = accel.closest_hit([origin], [direction])
        best: float = np.inf
        before: tuple[Entry, ...] = ()
        for step, raw in zip(walk.steps, walk.recorded.steps, strict=True):
            if step.kind == "pop":
                kept = bool(raw["result"] & of.STAYS)
                assert step.stack == (before if kept else before[:-1])
                assert kept or name == "octree" or (before[-1].index, before[-1].count, before[-1].t) == (step.index, step.count, step.t)
                assert (step.result == "dropped") <= (step.t > step.best_t * (1 - 1e-5))
            elif step.kind == "push":
                assert len(step.stack) == len(before) + 1
            else:
                assert step.stack == before
            if step.kind == "test":
                a, b, c = mesh.vertices[mesh.faces[step.prim_id]].astype(np.float64) - origin
                volumes = np.array([np.dot(direction, np.cross(*pair)) for pair in ((c, b), (a, c), (b, a))])
                signs = np.sign(step.edges)
                outside = (signs < 0).any() and (signs > 0).any()
                assert (step.result == "missed") >= outside
                if (np.abs(volumes) > 1e-4).all():
                    assert np.array_equal(signs, np.sign(volumes)) or np.array_equal(signs, -np.sign(volumes))
                if step.result == "closest hit":
                    assert step.t <= best and step.best_prim == step.prim_id
                    best = step.t
            elif step.kind in ("box", "part") and step.count != 0:
                assert (step.result == "entered") <= (step.t <= step.t_end + 1e-4)
            before = step.stack
        assert before == () or best < np.inf
        assert (walk.steps[-1].best_prim if walk.steps else -1) == hits.prim_id[0]
        assert walk.counts["primitives"] == sum(step.kind == "test" for step in walk.steps)


def test_a_walk_prints_and_exports(tmp_path: Path) -> None:
    walk = wrt.walk(wrt.build(icosphere(1), "bvh2"), *RAY)
    lines = str(walk).splitlines()
    assert len(lines) == len(walk) + 2 and lines[0].startswith("bvh2: ray from (0.1, 0.2, 3)") and "hits triangle" in lines[-1]
    assert any("pop node" in line and "dropped, because" in line for line in lines) and any("closest hit" in line for line in lines)
    walk.save(tmp_path / "walk.json")
    assert json.loads((tmp_path / "walk.json").read_text())["counts"] == walk.counts
    accel = wrt.build(icosphere(1))
    for given, message in (((walk.geometry, *RAY), "must be a structure"), ((accel, [0, 0], [0, 0, 1]), "three numbers"),
                           ((accel, [0, 0, 3], [0, 0, 0]), "directions"),
                           ((wrt.build([icosphere(1)]), *RAY), "not over instances; wrt.build.mesh. over one of the meshes")):
        with pytest.raises(wrt.InputError, match=message):
            wrt.walk(*given)
    with pytest.raises(wrt.InputError, match="suffix"):
        walk.save(tmp_path / "walk.txtx")


def test_a_walk_draws_itself(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    walk = wrt.walk(wrt.build(icosphere(0), "kdtree"), *RAY)
    step = next(i for i, each in enumerate(walk.steps) if each.kind == "test" and each.result == "closest hit")
    axes = Figure().subplots()
    assert walk.draw(axes, step) is axes and "t times" in axes.get_xlabel()
    x, y = map(np.asarray, axes.lines[-1].get_data())
    assert np.isclose(x[0], walk.steps[step].t * np.linalg.norm(walk.direction)) and y[0] == 0.0
    balls = Scene(spheres=(Sphere((0.0, 0.0, 0.0), 1.0, Material()), Sphere((3.0, 0.0, 0.0), 0.5, Material())))
    of_spheres = wrt.walk(wrt.build(balls), (0.0, 0.0, 5.0), (0.0, 0.0, -1.0)).draw(Figure().subplots())
    assert of_spheres.get_xlim()[0] < 4.0 < 6.0 < of_spheres.get_xlim()[1]  # the hit ball is between
    walk.save(tmp_path / "walk.png")
    assert (tmp_path / "walk.png").stat().st_size > 5000
    with pytest.raises(wrt.InputError, match="must be"):
        walk.draw(axes, len(walk))


def test_a_section_has_the_distances_of_the_ray() -> None:
    """A box's section crosses the x axis where the ray enters and leaves the box."""
    rng = np.random.default_rng(1)
    walk = wrt.walk(wrt.build(icosphere(2), "bvh2"), *RAY)
    section = section_of(walk)
    met = 0
    for _ in range(200):
        lo = rng.uniform(-1.0, 0.5, 3)
        region = Region.box(lo, lo + rng.uniform(0.1, 0.6, 3))
        enter, leave = region.interval(walk.origin, walk.direction)
        corners = section.outline(region)
        crossings = [a[0] + a[1] / (a[1] - b[1]) * (b[0] - a[0]) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
                     if (a[1] > 0.0) != (b[1] > 0.0)]
        assert (len(crossings) == 2) == (enter < leave)
        if crossings:
            met += 1
            assert np.allclose(sorted(crossings), [enter * section.length, leave * section.length])
    assert met > 5


def test_the_command_prints_a_walk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from wrt.cli.main import cli

    ball = icosphere(1)
    (tmp_path / "ball.obj").write_text("\n".join([*(f"v {x} {y} {z}" for x, y, z in ball.vertices),
                                                  *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.faces)]))
    cli.main(["walk", str(tmp_path / "ball.obj"), "--ray", "0.1,0.2,3,0.15,-0.3,-2", "--accel", "bvh2"], standalone_mode=False)
    assert capsys.readouterr().out.rstrip("\n") == str(wrt.walk(wrt.build(tmp_path / "ball.obj", "bvh2"), *RAY))
    with pytest.raises(wrt.InputError, match="six numbers"):
        cli.main(["walk", str(tmp_path / "ball.obj"), "--ray", "1,2,3"], standalone_mode=False)
