"""The tables of docs/compat.md, row by row beside the real libraries. A library that is not installed is skipped."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.test_documentation import calls, value_of
from wrt.scene import shapes

MESHES = [shapes.icosphere(2), shapes.box((2, -1, -1), (4, 1, 1))]
RNG = np.random.default_rng(3)
ORIGINS = (RNG.normal(size=(500, 3)) * 4).astype(np.float32)
RAYS = np.concatenate([ORIGINS, RNG.uniform((-1, -1, -1), (4, 1, 1), (500, 3)).astype(np.float32) - ORIGINS], axis=1)
POINTS = RNG.uniform((-2, -2, -2), (5, 2, 2), (500, 3)).astype(np.float32)


def same(ours: Any, theirs: Any) -> None:
    """Compare two answers of the same shape. Floats may differ by rounding."""
    a, b = np.asarray(ours), theirs.numpy() if hasattr(theirs, "numpy") else np.asarray(theirs)
    assert a.shape == b.shape
    if a.dtype.kind == "f":
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-5)
    else:
        np.testing.assert_array_equal(a, b)


def test_rows_for_open3d() -> None:
    """Every row, with tensors of Open3D on both sides, over a scene of two meshes."""
    o3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    theirs = o3d.t.geometry.RaycastingScene()
    for mesh in MESHES:
        theirs.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    tensor = o3d.core.Tensor(RAYS)
    names = {"wrt": wrt, "scene": theirs, "rays": tensor, "points": o3d.core.Tensor(POINTS), "accel": wrt.build(wrt.Scene.of(MESHES))}
    own = {**names, "rays": tensor, "mesh": MESHES[0], "vertices": MESHES[0].vertices, "faces": MESHES[0].faces, "K": np.eye(3),
           "pose": np.eye(4)}
    compared = []
    for call, ours in calls("Open3D"):
        first = call.splitlines()[0]
        if first.startswith(("scene.add_triangles", "create_rays")):  # a mesh; matrices: the tests below
            continue
        lines = [line for line in ours.splitlines() if line not in ("t_min", "tnear")]
        answer = [value_of(line, names) for line in call.splitlines()]
        if "geometry_ids" in call:  # over both meshes
            lines = ["accel.closest_hit(rays).object"]
        found = [value_of(line, own) for line in lines]
        hit = own["hits"].hit if "hits" in own else None
        if first.startswith("answer["):
            columns = [each.numpy() for each in answer]
            columns = [*columns[0].T, columns[1]] if "uvs" in call else columns
            for mine, other in zip(found, columns, strict=False):
                chosen = hit if "ids" in call or "normals" in call else slice(None)
                same(np.asarray(mine)[chosen], np.asarray(other)[chosen].astype(np.int32) if other.dtype == np.uint32 else other[chosen])
        elif first.startswith("scene.list"):
            same(found[-1].counts, np.diff(answer[-1]["ray_splits"].numpy().astype(np.int64)))
            order = np.lexsort([answer[-1]["t_hit"].numpy(), answer[-1]["ray_ids"].numpy()])
            same(found[-1].t, answer[-1]["t_hit"].numpy()[order])
            same(found[-1].face, answer[-1]["primitive_ids"].numpy()[order].astype(np.int32))
            same(found[-1].object, answer[-1]["geometry_ids"].numpy()[order].astype(np.int32))
        elif first.startswith("scene.compute_closest"):
            same(found[-1].point, answer[-1]["points"])
            assert (found[-1].face == answer[-1]["primitive_ids"].numpy()).mean() > 0.5  # at an edge either face is right
            same(found[-1].object, answer[-1]["geometry_ids"].numpy().astype(np.int32))
        elif answer[-1] is not None:
            same(found[-1], answer[-1])
        compared.append(first)
    assert len(compared) == 11 and 0.3 < own["hits"].hit.mean() < 1.0
    misses = ~own["hits"].hit
    assert np.isnan(own["hits"].normal[misses]).all() and not names["answer"]["primitive_normals"].numpy()[misses].any()


def test_meshes_of_open3d() -> None:
    o3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    old = o3d.geometry.TriangleMesh.create_box()
    new = o3d.t.geometry.TriangleMesh.from_legacy(old)
    for arrays in ((old.vertices, old.triangles), (new.vertex.positions, new.triangle.indices)):
        assert wrt.build(arrays).closest_hit(np.float32([[0.3, 0.4, 5, 0, 0, -1]])).t.tolist() == [4.0]


def test_rows_for_pyvista() -> None:
    pv = pytest.importorskip("pyvista", reason="PyVista is not installed")
    from wrt.compat.pyvista import RayTracer, to_polydata

    ball, plate, ends = to_polydata(MESHES[0]), pv.Plane(i_resolution=1, j_resolution=1).triangulate(), ([-2, 0.1, 0.2], [2, 0.1, 0.2])
    first = [each.ray_trace(*ends, first_point=True)[0][0] for each in (RayTracer(ball), ball)]
    assert first[0] < 0 < first[1]
    assert [len(each.ray_trace([-1, 0.1, 0], [1, 0.1, 0])[1]) for each in (plate, RayTracer(plate))] == [2, 0]  # in the plane of a face


def test_rows_for_embree() -> None:
    pytest.importorskip("embreex", reason="embreex is not installed")
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene, rays = EmbreeScene(), [np.ascontiguousarray(half) for half in (RAYS[:, :3], RAYS[:, 3:])]
    for mesh in MESHES:
        TriangleMesh(scene, mesh.vertices[mesh.faces])
    theirs, hits = scene.run(*rays, output=True), wrt.build(wrt.Scene.of(MESHES)).closest_hit(*rays)
    hit = theirs["primID"] >= 0
    assert np.array_equal(hits.hit, hit) and np.array_equal(hit, scene.run(*rays, query="OCCLUDED") >= 0)
    for ours, name in ((hits.face, "primID"), (hits.object, "geomID"), (hits.t, "tfar"), (hits.u, "u"), (hits.v, "v")):
        same(ours[hit], theirs[name][hit])
    same(hits.normal[hit], theirs["Ng"][hit] / np.linalg.norm(theirs["Ng"][hit], axis=1, keepdims=True))


def test_rows_for_mitsuba() -> None:
    mi = pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    mi.set_variant("scalar_rgb")
    parts: dict[str, Any] = {"type": "scene"}
    for i, mesh in enumerate(MESHES):
        parts[f"m{i}"] = mi.Mesh(f"m{i}", len(mesh.vertices), len(mesh.faces))
        of = mi.traverse(parts[f"m{i}"])
        of["vertex_positions"], of["faces"] = mesh.vertices.ravel(), mesh.faces.ravel()
        of.update()
    scene, hits = mi.load_dict(parts), wrt.build(wrt.Scene.of(MESHES)).closest_hit(RAYS)
    for i, row in enumerate(RAYS[:100].tolist()):
        ray = mi.Ray3f(mi.Point3f(*row[:3]), mi.Vector3f(*row[3:]))
        si = scene.ray_intersect(ray)
        assert si.is_valid() == scene.ray_test(ray) == hits.hit[i] and (not hits.hit[i] or si.prim_index == hits.face[i])
        if hits.hit[i]:
            same(np.float32([si.t, *si.p, *si.n]), np.float32([hits.t[i], *hits.point[i], *hits.normal[i]]))


def test_rows_for_trimesh_with_rtree() -> None:
    """Points, distances and sides agree; at edges and corners the faces differ, and a face's normal is no side."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("rtree", reason="trimesh's closest points need rtree")
    wedge = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0.2, -1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    wedge.fix_normals()
    points, accel = RNG.normal(size=(500, 3)), wrt.build(wedge)
    where, distance, face = trimesh.proximity.closest_point(wedge, points)
    near = wrt.closest_points(accel, points)
    same(near.point, where.astype(np.float32))
    same(near.distance, distance.astype(np.float32))
    assert 0.1 < (near.prim_id != face).mean() < 0.8
    signed = trimesh.proximity.signed_distance(wedge, points)
    same(-wrt.signed_distance(accel, points), signed.astype(np.float32))
    same(wrt.contains(accel, points), signed > 0)


MODEL = """<mujoco><asset><mesh name="a" file="a.obj" scale="1 2 1"/><mesh name="b" file="b.obj"/></asset><worldbody>
<body pos="0 0 1" euler="20 30 40"><freejoint/><geom type="mesh" mesh="a"/></body>
<geom type="mesh" mesh="b" pos="1 0 0" euler="0 50 0"/></worldbody></mujoco>"""


def obj(mesh: wrt.Mesh) -> bytes:
    rows = [f"v {x} {y} {z}" for x, y, z in mesh.vertices.tolist()] + [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(rows).encode()


def test_rows_for_mujoco() -> None:
    """The meshes of the page have the hits of mj_ray: t in units of the vector, the geom's id, -1 on a miss."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    assert int(mujoco.mjtGeom.mjGEOM_MESH) == 7
    page = (ROOT / "docs" / "compat.md").read_text(encoding="utf-8").partition("## MuJoCo and Newton")[2]
    names: dict[str, Any] = {"np": np, "wrt": wrt}
    block = re.search(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert block
    exec(block[1], names)
    model = mujoco.MjModel.from_xml_string(MODEL, {"a.obj": obj(shapes.torus(0.5, 0.2, 24, 16)), "b.obj": obj(MESHES[1])})
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    accel = wrt.build(wrt.Scene.of(list(names["meshes"](model, data))))
    origins = RNG.normal(size=(600, 3)) * 4
    vectors = 2.0 * (RNG.uniform((-1, -1, 0), (4, 1, 2), (600, 3)) - origins)
    t, geom = np.empty(600), np.empty((600, 1), np.int32)
    for i in range(600):
        t[i] = mujoco.mj_ray(model, data, origins[i], vectors[i], None, 1, -1, geom[i])
    hits = accel.closest_hit(origins, vectors)
    assert np.array_equal(hits.hit, t >= 0) and (t[~hits.hit] == -1).all() and 0.2 < hits.hit.mean() < 1.0
    assert np.abs(hits.t - t)[hits.hit].max() < 1e-5
    mesh_geoms = np.flatnonzero(model.geom_type == 7)
    assert np.array_equal(mesh_geoms[hits.object[hits.hit]], geom[hits.hit, 0])
