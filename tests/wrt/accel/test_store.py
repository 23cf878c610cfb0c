"""Files of structures: the same hits after a round trip, and a clear message for every other file."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import wrt
from tests import device
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.refused import refused
from tests.structures import STRUCTURES
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.build import build, load_accel
from wrt.accel.scenes.flatten import flatten
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.store import check_binary
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, torus

BALL = icosphere(2)


def rays(n: int = 500) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(n, 3)).astype(np.float32), rng.normal(size=(n, 3)).astype(np.float32)


def same(a, b) -> None:
    one, other = a.closest_hit(*rays()), b.closest_hit(*rays())
    for field in ("t", "u", "v", "prim_id"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


def arrays_in(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return dict(file)


def rewritten(path: Path, arrays: dict[str, np.ndarray], header: dict[str, Any] | None = None) -> None:
    """Write a file with valid checksums, as an attacker would."""
    if header is not None:
        arrays = arrays | {"header": np.array(json.dumps(header))}
    with open(path, "wb") as file:
        np.savez(file, **arrays)


def header_of(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return json.loads(str(arrays["header"]))


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_structure_goes_through_pickle(name: str) -> None:
    """Pickled and deep copies have the same options and hits, also after a refit."""
    ball = Mesh(BALL.vertices, BALL.faces, normals=BALL.vertices)
    before = build(ball, name, **({"triangle": "moeller_trumbore", "max_leaf": 2} if name == "bvh2" else {}))
    for after in (pickle.loads(pickle.dumps(before)), deepcopy(before)):
        same(before, after)
        assert after.structure == before.structure and after.built_with == before.built_with
        hits, again = before.closest_hit(*rays()), after.closest_hit(*rays())
        assert np.array_equal(hits.shading_normal, again.shading_normal, equal_nan=True)
    if name == "bvh2":
        before.refit(2.0 * BALL.vertices)
        after = pickle.loads(pickle.dumps(before))
        same(before, after)
        before.refit(3.0 * BALL.vertices)
        after.refit(3.0 * BALL.vertices)
        same(before, after)


def test_a_structure_over_arrays_of_a_device_goes_through_pickle(saved: Path) -> None:
    """The copy is over a Geometry, also if load_accel got Warp arrays."""
    points, faces = (wp.array(rows, dtype=kind, device=device.NAME) for rows, kind in ((BALL.vertices, wp.vec3), (BALL.faces, wp.vec3i)))
    over = DeviceGeometry(points, faces)
    for before in (build(over, "bvh2"), load_accel(saved, over)):
        for after in (pickle.loads(pickle.dumps(before)), deepcopy(before)):
            same(before, after)
            assert type(after.geometry) is Geometry and after.geometry.checksum() == before.geometry.checksum()
            after.refit(wp.array(2.0 * BALL.vertices, dtype=wp.vec3, device=device.NAME), in_place=True)
            same(after, build((2.0 * BALL.vertices, BALL.faces), "bvh2"))


def crowd(spheres: bool) -> wrt.Scene:
    """A joined object between instances of one mesh, two materials, and a sphere."""
    red, grey, ring = wrt.Material(albedo=(1.0, 0.0, 0.0)), wrt.Material(), torus()
    ball = Mesh(BALL.vertices, BALL.faces, normals=BALL.vertices)
    places = [np.diag([s, s, s, 1.0]) for s in (0.5, 1.0, 0.25)]
    objects = [wrt.Object(ball, (grey,), places[0], name="a"), wrt.Object(ring, (red,), name="ring"),
               *(wrt.Object(ball, (red,), place, name="b") for place in places[1:])]
    return wrt.Scene(tuple(objects), spheres=(wrt.Sphere((0.0, 0.0, 3.0), 1.0, grey),) if spheres else ())


@pytest.mark.parametrize("accel", ["bvh", "bvh2", "kdtree"])
@pytest.mark.parametrize("kind", ["scene", "worlds", "moved", "mesh", "flat"])
def test_copies_with_their_scene(kind: str, accel: str, tmp_path: Path) -> None:
    """Pickle, and a file with the mesh: hits and their ids and normals are those of the structure."""
    scene, before = crowd(spheres=kind == "flat"), None
    if kind == "scene":
        flat = flatten(crowd(spheres=True), instanced_meshes(crowd(spheres=True), "always"))
        before = Instances(ACCELERATORS[accel], flat.geometry, flat)
    elif kind in ("worlds", "moved"):
        before = build([BALL, scene] if kind == "worlds" else [scene], accel)
    else:
        before = build(BALL if kind == "mesh" else scene, accel)
        before.save(tmp_path / "x.accel", mesh=True)
    if kind == "moved":
        before.move(object="a", matrix=np.diag([2.0, 2.0, 2.0, 1.0]))
    world = np.arange(500) % 2 if kind == "worlds" else None
    hits = before.closest_hit(*rays(), world=world)
    for after in (pickle.loads(pickle.dumps(before)), *([load_accel(tmp_path / "x.accel")] if kind in ("mesh", "flat") else [])):
        again = after.closest_hit(*rays(), world=world)
        assert after.structure == before.structure
        for name in ("t", "u", "v", "prim_id", "normal", "shading_normal", *(("object", "material") if kind != "mesh" else ())):
            assert getattr(hits, name).tobytes() == getattr(again, name).tobytes(), name
    if kind == "moved":
        after.move(object="ring", matrix=np.eye(4))


@pytest.mark.parametrize("kind", ["scene", "geometry"])
def test_a_forged_array_of_a_mesh_is_refused_or_harmless(kind: str, tmp_path: Path) -> None:
    """Numbers of every array, one at a time: an InputError when the file is read, or answers without any other error."""
    before = build(crowd(spheres=True) if kind == "scene" else Geometry.of(BALL), "bvh2")
    path, rng, refused_count = tmp_path / "x.accel", np.random.default_rng(0), 0
    before.save(path, mesh=True)
    arrays = arrays_in(path)
    for name, array in arrays.items():
        if name.startswith("mesh."):
            for place in rng.integers(0, array.size, 6).tolist() if array.size else ():
                for value in [-1, 0, 7, 10**6, 2**31 - 1] if array.dtype.kind == "i" else [0.0, np.nan, 3e38]:
                    forged = array.copy()
                    forged.reshape(-1)[place] = value
                    rewritten(path, arrays | {name: forged}, header_of(arrays) | {"geometry": checksum_of(arrays | {name: forged})})
                    try:
                        hits = load_accel(path).closest_hit(*rays(50))
                    except InputError:
                        refused_count += 1
                    else:
                        for attribute in ("point", "normal", "shading_normal", "uv", "object", "material"):
                            with contextlib.suppress(InputError):  # the scene has none
                                getattr(hits, attribute)
    assert refused_count > 10


def checksum_of(arrays: dict[str, np.ndarray]) -> Any:
    return Geometry(*(arrays[f"mesh.{name}"] for name in ("vertices", "faces", "spheres"))).checksum()


def test_a_file_without_its_mesh(saved: Path) -> None:
    with refused("mesh", path="ball.accel", hint="mesh=True"):
        load_accel(saved)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    build(BALL, "bvh2").save(tmp_path / "ball.accel")
    return tmp_path / "ball.accel"


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("geometry", ["triangles", "spheres", "one", "none"])
def test_a_round_trip_changes_nothing(name: str, geometry: str, tmp_path: Path) -> None:
    g = {"triangles": Geometry.of(BALL), "spheres": Geometry(BALL.vertices, BALL.faces, np.array([[0, 0, 2, 0.5]], np.float32)),
         "one": Geometry(BALL.vertices, BALL.faces[:1], np.zeros((0, 4), np.float32)),
         "none": Geometry(BALL.vertices, BALL.faces[:0], np.zeros((0, 4), np.float32))}[geometry]
    before = build(g, name, **({"triangle": "moeller_trumbore"} if name == "bvh2" else {}))
    before.save(tmp_path / "x.accel")
    after = load_accel(tmp_path / "x.accel", g)
    assert type(after) is type(before) and after.structure == before.structure
    assert (after.stats.nodes, after.stats.depth, after.stats.bytes) == (before.stats.nodes, before.stats.depth, before.stats.bytes)
    same(before, after)


@pytest.mark.parametrize("threads", [1, 2])
def test_another_mesh_is_refused(saved: Path, threads: int) -> None:
    """Also a smaller one, which the indices of the file lead out of."""
    for mesh in (icosphere(3), icosphere(1)):
        with refused(what="built over another mesh", path="ball.accel"):
            load_accel(saved, mesh, threads=threads)


def zipped_anew(data: bytes) -> bytes:
    file = io.BytesIO()
    with np.load(io.BytesIO(data)) as arrays:
        np.savez_compressed(file, **arrays)
    return file.getvalue()


@pytest.mark.parametrize("spoil", [
    lambda data: data[:-1], lambda data: data[:200], lambda data: b"", lambda data: b"PK\3\4" + data[:100],
    lambda data: b"wrt acceleration structure 2\n" + data[:100],  # of an older version
    lambda data: data[:5000] + bytes([data[5000] ^ 1]) + data[5001:], zipped_anew,
])
def test_a_damaged_or_foreign_file_is_refused(saved: Path, spoil) -> None:
    saved.write_bytes(spoil(saved.read_bytes()))
    with refused(what="not a structure of this version", path=saved):
        load_accel(saved, BALL)


def test_missing_files_and_wrong_suffixes(tmp_path: Path) -> None:
    with refused(what="cannot be read", path="nothing.accel") as caught:
        load_accel(tmp_path / "nothing.accel", BALL)
    assert str(caught.value).count("nothing.accel") == 1
    with refused(what="suffix .accel"):
        build(BALL).save(tmp_path / "x.npz")
    with refused(what="does not exist"):
        build(BALL).save(tmp_path / "no" / "x.accel")


def edited(path: Path, change) -> None:
    """Change the nodes, the order and the header in a file."""
    arrays, tree = arrays_in(path), build(BALL, "bvh2").built
    nodes, order, header = tree.arrays["nodes"].copy(), tree.order.copy(), header_of(arrays)
    change(nodes, order, header)
    rewritten(path, arrays | {"nodes": nodes.view(np.uint8), "order": order}, header)


def set_child(i: int, first: int, count: int):
    def change(nodes, order, header) -> None:
        nodes["first_0"][i], nodes["count_0"][i] = first, count

    return change


@pytest.mark.parametrize("change", [
    set_child(0, 0, 0), set_child(3, 1, 0), set_child(3, 10**9, 0), set_child(3, -5, 0), set_child(3, 10**6, 4),
    set_child(3, 0, 2**31 - 1), set_child(3, 0, -1), set_child(0, 5, 0),
    lambda nodes, order, header: order.__setitem__(0, 10**6), lambda nodes, order, header: order.__setitem__(0, -1),
    lambda nodes, order, header: order.__setitem__(0, order[1]),
    *(lambda nodes, order, header, key=key, value=value: header.update({key: value}) for key, value in (
        ("accel", "brute_force"), ("accel", ["bvh2"]), ("accel", "x"), ("triangle", "x"), ("version", 2), ("stats", []),
        ("stats", ["deep", 0, 0, 0.0]), ("stats", [float("inf"), 0, 0, 0.0]))),
    lambda nodes, order, header: header.pop("box"),
])
def test_indices_are_checked_before_a_ray_follows_them(saved: Path, change) -> None:
    edited(saved, change)
    with refused(path="ball.accel"):
        load_accel(saved, BALL)


def test_a_child_that_does_not_exist_leads_nowhere() -> None:
    """A refit on a device reads `first` and `count`, not the box."""
    nodes = build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "bvh2").built.arrays["nodes"].copy()
    check_binary(nodes, 1, 64)
    nodes["first_1"][0] = 10**8
    with refused(what="does not exist"):
        check_binary(nodes, 1, 64)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10**6), value=st.integers(0, 255))
def test_any_byte_may_be_changed(saved: Path, at: int, value: int) -> None:
    """A byte of the nodes or of the order changes. If the file is accepted, queries stay within its arrays."""
    arrays = arrays_in(saved)
    data = [arrays[name].reshape(-1).view(np.uint8) for name in ("nodes", "order")]
    bytes_of = data[at % 2]
    bytes_of[at // 2 % len(bytes_of)] = value
    path = saved.with_name("changed.accel")
    rewritten(path, arrays)
    try:
        load_accel(path, BALL).closest_hit(*rays(50))
    except InputError as error:
        assert error.path == path


def test_the_command(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    out = command("build", "box.obj", "-o", "box.accel", "--accel", "bvh2", "--set", "max_leaf=2", "--set", "builder=median",
                  "--json")
    assert out.code == 0 and json.loads(out.out)["accel"] == "bvh2"
    assert wrt.load_accel("box.accel", "box.obj").stats.references == 12
    for arguments, message in (
            (("box.obj", "-o", "box.npz"), "suffix .accel"), (("none.obj", "-o", "a.accel"), "none.obj"),
            (("box.obj", "-o", "a.accel", "--accel", "x"), "no structure 'x'"),
            (("box.obj", "-o", "a.accel", "--set", "leaf=2"), "leaf is no option"),
            (("box.obj", "-o", "a.accel", "--set", "max_leaf=2", "--set", "max_leaf=3"), "has two values"),
            (("box.obj", "-o", "a.accel", "--set", "max_leaf=many"), "max_leaf"),
            (("box.obj", "-o", "a.accel", "--set", "max_leaf"), "NAME=VALUE")):
        out = command("build", *arguments)
        assert out.code == 2 and len(out.errors) == 1 and message in out.errors[0], arguments
        assert not Path("a.accel").exists()
