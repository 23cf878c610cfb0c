"""Files of structures: the same hits after a round trip, and a clear message for every other file."""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
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
from wrt.accel.scene_arrays import arrays_of, scene_of
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


def test_a_scene_goes_through_pickle() -> None:
    material = wrt.Material()
    scene = wrt.Scene((wrt.Object(BALL, (material,)),), spheres=(wrt.Sphere((0.0, 0.0, 3.0), 1.0, material),))
    before = build(scene)
    hits = pickle.loads(pickle.dumps(before)).closest_hit(*rays())
    assert np.array_equal(hits.object, before.closest_hit(*rays()).object) and set(hits.object) == {-1, 0, 1}


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
    """Pickle, and a file with the scene: hits and their ids and normals are those of the structure."""
    scene = crowd(spheres=kind == "flat")
    before: wrt.accel.base.OneMesh | Instances
    if kind == "scene":
        flat = flatten(crowd(spheres=True), instanced_meshes(crowd(spheres=True), "always"))
        before = Instances(ACCELERATORS[accel], flat.geometry, flat)
    elif kind in ("worlds", "moved"):
        before = build([BALL, scene] if kind == "worlds" else [scene], accel)
    else:
        before = build(BALL if kind == "mesh" else scene, accel)
    if kind == "moved":
        before.move(object="a", matrix=np.diag([2.0, 2.0, 2.0, 1.0]))
    more = {} if isinstance(before, Instances) else {"mesh": True}
    before.save(tmp_path / "x.accel", **more)
    world = np.arange(500) % 2 if kind == "worlds" else None
    hits = before.closest_hit(*rays(), world=world)
    for after in (pickle.loads(pickle.dumps(before)), load_accel(tmp_path / "x.accel")):
        again = after.closest_hit(*rays(), world=world)
        assert after.structure == before.structure
        for name in ("t", "u", "v", "prim_id", "normal", "shading_normal", *(("object", "material") if kind != "mesh" else ())):
            assert getattr(hits, name).tobytes() == getattr(again, name).tobytes(), name
    if kind == "moved":
        after.move(object="ring", matrix=np.eye(4))
    if isinstance(before, Instances):
        with refused("mesh", path="x.accel"):
            load_accel(tmp_path / "x.accel", BALL)


def _hits_in_process(accel: object) -> bytes:
    return accel.closest_hit(*rays()).t.tobytes()  # type: ignore[attr-defined]


def test_structures_reach_spawned_processes() -> None:
    accel = build([BALL])
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(_hits_in_process, [accel]) == [_hits_in_process(accel)]


@pytest.mark.parametrize(("name", "value"), [("faces", 10**6), ("part", 7), ("first_prim", -1), ("placed", 10**6), ("to_world", np.nan),
                                            ("part_sizes", 3), ("worlds", 9)])
def test_a_scene_in_a_file_leads_no_ray_out_of_bounds(name: str, value: float, tmp_path: Path) -> None:
    arrays = arrays_of(build([crowd(spheres=False)]).snapshot)
    scene_of(arrays)
    arrays[name] = arrays[name].copy()
    arrays[name].reshape(-1)[-1] = value
    with refused(what="damaged"):
        scene_of(arrays)


NAMES = ("a\0b", "c", "", "caf\udce9.obj", "d", "\n", "日本", "c\0")


@pytest.mark.parametrize("names", [("",), ("a",), ("", ""), ("a\0",), NAMES])
@pytest.mark.parametrize("worlds", [0, 1, 2])
def test_a_file_keeps_every_name_of_its_objects(names: tuple[str, ...], worlds: int, tmp_path: Path) -> None:
    """A name may hold any character: NUL, and the bytes of a file's name that are no text, as os.fsdecode gives them."""
    places = [np.array([[1, 0, 0, 10.0 * i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) for i in range(len(names) + 1)]
    scene = wrt.Scene(tuple(wrt.Object(BALL, transform=place, name=name) for place, name in zip(places, names, strict=False)))
    accel = build([scene] * worlds, accel="bvh2") if worlds else build(scene, movable=True)
    accel.save(tmp_path / "x.accel")
    again = load_accel(tmp_path / "x.accel")
    assert again.snapshot.attributes.names == names * max(worlds, 1)
    for name in set(names):
        if names.count(name) == 1:
            again.move(object=name, matrix=places[-1], world=worlds - 1 if worlds else None)
            hits = again.closest_hit([10.0 * names.index(name), 0.0, 5.0], [0.0, 0.0, -1.0], world=worlds - 1 if worlds else None)
            assert hits.t == np.inf, name
            again.move(object=name, matrix=places[names.index(name)], world=worlds - 1 if worlds else None)


def small_worlds() -> list[wrt.Scene]:
    """Worlds whose objects have one material or several, shared and their own; one world is empty."""
    red, grey, own = wrt.Material(albedo=(1.0, 0.0, 0.0)), wrt.Material(), wrt.Material(albedo=(0.0, 0.0, 1.0))
    square = Mesh(np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]])
    pattern = wrt.Object(square, (red, grey), face_material=np.array([1, 0]), name="pattern")
    return [wrt.Scene((pattern,)), wrt.Scene(()), wrt.Scene((wrt.Object(square, (own,), name="own"), pattern)), wrt.Scene((pattern,))]


def everything(accel: Any) -> list[np.ndarray]:
    """Ask a structure over any scene for all that its arrays decide."""
    out: list[np.ndarray] = []
    rays = [[0.3, 0.2, 5.0], [0.2, 0.3, 5.0], [9.0, 0.0, 5.0], [0.0, 0.0, -5.0]], [[0.0, 0.0, -1.0]] * 3 + [[0.0, 0.0, 1.0]]
    for world in range(accel.geometry.n_worlds) if isinstance(accel, Instances) else [None]:
        hits = accel.closest_hit(*rays, world=None if world == 0 and accel.geometry.n_worlds == 1 else world)
        for name in ("point", "normal", "shading_normal", "uv", "object", "instance", "material", "face"):
            with contextlib.suppress(InputError):  # the scene has none
                out.append(getattr(hits, name))
    if isinstance(accel, Instances):
        names = {name for name in accel.snapshot.attributes.names if accel.snapshot.attributes.names.count(name) == 1}
        for name in names:
            with contextlib.suppress(InputError):
                accel.move(object=name, matrix=np.eye(4), world=None if accel.geometry.n_worlds == 1 else 0)
    return out


@pytest.mark.parametrize("kind", ["worlds", "scene", "mesh", "geometry"])
def test_a_forged_array_of_a_scene_is_refused_or_harmless(kind: str, tmp_path: Path) -> None:
    """Every number of every array, one at a time: an InputError when the file is read, or answers without any other error."""
    before: Any
    if kind == "worlds":
        before = build(small_worlds())
    elif kind == "scene":
        flat = flatten(crowd(spheres=True), instanced_meshes(crowd(spheres=True), "always"))
        before = Instances(ACCELERATORS["bvh"], flat.geometry, flat)
    else:
        before = build(small_worlds()[2] if kind == "mesh" else Geometry.of(BALL), "bvh2")
    path, rng, refused_count = tmp_path / "x.accel", np.random.default_rng(0), 0
    before.save(path, **({} if isinstance(before, Instances) else {"mesh": True}))
    arrays = arrays_in(path)
    good = everything(load_accel(path))
    assert [each.tobytes() for each in good] == [each.tobytes() for each in everything(before)]
    for name, array in arrays.items():
        if not name.startswith("scene."):
            continue
        dtype, count = array.dtype, array.size
        places = range(count) if count <= 12 else rng.integers(0, count, 12).tolist()
        values = [-1, 0, 1, 2, 7, 10**6] if dtype.kind == "i" else [0, 34, 93, 255] if dtype.kind == "u" else [0.0, np.nan, 3e38]
        if dtype == np.int64:
            values += [2**31, 2**40, -2**63]
        for place in places:
            for value in values:
                forged = array.copy()
                forged.reshape(-1)[place] = value
                rewritten(path, arrays | {name: forged})
                try:
                    accel = load_accel(path)
                except InputError:
                    refused_count += 1
                else:
                    everything(accel)
    assert refused_count > 50


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


def test_public_names_take_paths(saved: Path, tmp_path: Path) -> None:
    same(wrt.load_accel(saved, BALL), build(BALL))
    with refused("mesh"):
        wrt.load_accel(saved, 7)  # type: ignore[arg-type]


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
    rewritten(path, arrays | {"0.nodes": nodes.view(np.uint8), "0.order": order}, header)


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
        ("accel", "brute_force"), ("accel", ["bvh2"]), ("accel", "x"), ("triangle", "x"), ("version", 2), ("parts", []),
        ("parts", [["deep", 0, 0, 0.0]]), ("parts", [[float("inf"), 0, 0, 0.0]]), ("parts", [[1, 1, 1, 1.0]] * 2))),
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


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ["octree", "grid", "instances"])
def test_numbers_of_any_size_are_read_without_a_word(name: str, tmp_path: Path) -> None:
    path = tmp_path / "x.accel"
    (build([BALL]) if name == "instances" else build(BALL, name)).save(path)
    arrays = arrays_in(path)
    for key, array in arrays.items():
        if array.dtype.kind == "f" or key.startswith("0."):
            for value in (3.4e38, -3.4e38, np.inf, np.nan):
                changed = array.copy()
                numbers = changed.reshape(-1).view(array.dtype if array.dtype.kind == "f" else np.float32)
                numbers[:1] = value
                rewritten(path, arrays | {key: changed})
                with contextlib.suppress(InputError):
                    load_accel(path, *([] if name == "instances" else [BALL]))


@pytest.mark.parametrize("value", [1.8e38, -1.8e38, np.inf, np.nan])
def test_an_instance_in_a_file_is_within_reach(value: float, tmp_path: Path) -> None:
    """Else the widened boxes of the upper level are not finite, and rays enter children that do not exist."""
    path = tmp_path / "x.accel"
    build([BALL]).save(path)
    arrays = arrays_in(path)
    arrays["scene.vertices"][0, 0] = value
    rewritten(path, arrays)
    with refused(what="farther than 1e+18", path=path):
        load_accel(path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10**6), value=st.integers(0, 255))
def test_any_byte_may_be_changed(saved: Path, at: int, value: int) -> None:
    """A byte of the nodes or of the order changes. If the file is accepted, queries stay within its arrays."""
    arrays = arrays_in(saved)
    data = [arrays[name].reshape(-1).view(np.uint8) for name in ("0.nodes", "0.order")]
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
