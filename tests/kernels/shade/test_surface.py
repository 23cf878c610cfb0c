"""Points, normals and coordinates at a hit against float64. A new ray must not hit the surface that it leaves."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, floats, ints, launch, rounded, unit, vec3s, zeros  # isort: skip
import warp as wp

from wrt.accel.scenes.build import build
from wrt.accel.scenes.flatten import flatten_joined
from wrt.kernels.shade.surface import Surface, make_surface_at, next_away, spawn_point
from wrt.kernels.structs import Hit, Ray, Surfaces, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere


@cache
def surface_kernel(smooth):
    surface_at = make_surface_at(True, smooth, True, True)

    @kernel
    def at(
        surfaces: Surfaces,
        origin: wp.array(dtype=wp.vec3),
        direction: wp.array(dtype=wp.vec3),
        t: wp.array(dtype=wp.float32),
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        prim_id: wp.array(dtype=wp.int32),
        onward: wp.array(dtype=wp.vec3),
        out: wp.array(dtype=Surface),
        start: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        ray = Ray()
        ray.origin = origin[i]
        ray.direction = direction[i]
        hit = Hit()
        hit.t = t[i]
        hit.u = u[i]
        hit.v = v[i]
        hit.prim_id = prim_id[i]
        s = surface_at(surfaces, ray, hit)
        out[i] = s
        start[i] = spawn_point(s.point, s.error, s.geometric, onward[i])

    return at


@kernel
def away_kernel(x: wp.array(dtype=wp.float32), side: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = next_away(x[i], side[i])


def surfaces_at(scene, origin, direction, hits, onward=None):
    """Return the surfaces of hits, and the origins of new rays in the `onward` directions."""
    n = len(origin)
    out, start = zeros(n, Surface), zeros(n, wp.vec3)
    onward = direction if onward is None else onward
    smooth = any(thing.mesh.normals is not None for thing in scene.objects)
    launch(surface_kernel(smooth), n, upload_scene(scene, DEVICE).surfaces, vec3s(origin), vec3s(direction), floats(hits.t),
           floats(hits.u), floats(hits.v), ints(hits.prim_id), vec3s(onward), out, start)
    return out.numpy(), start.numpy()


def scene_of(mesh=None, spheres=()):
    objects = () if mesh is None else (Object(mesh, (Material(),)),)
    return Scene(objects=objects, spheres=tuple(Sphere(tuple(s[:3]), float(s[3]), Material()) for s in spheres))


def hit_rays(scene, rng, n, target, scale=1.0):
    """Return rays that are aimed at the points `target` and hit, and their hits."""
    direction = rounded(rng.normal(size=(n, 3)))
    origin = rounded(target - direction * scale * 10.0 ** rng.uniform(-0.5, 2, (n, 1)))
    structure = build(flatten_joined(scene).geometry, "bvh")
    hits = structure.closest_hit(origin, direction)
    on = hits.prim_id >= 0
    hits = type(hits)(hits.t[on], hits.u[on], hits.v[on], hits.prim_id[on])
    return structure, origin[on], direction[on], hits


def random_triangles(rng, n, scale=1.0, offset=0.0):
    corners = rounded(scale * rng.normal(size=(n, 3, 3)) + offset * rng.normal(size=(n, 1, 3)))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def inside(mesh, rng, n):
    chosen = rng.integers(0, len(mesh.faces), n)
    return np.einsum("ni,nij->nj", rng.dirichlet([1, 1, 1], n), mesh.vertices[mesh.faces[chosen]].astype(np.float64))


@pytest.mark.parametrize("scale", [1e-18, 1e-6, 1.0, 1e6, 1e15])
def test_flat_normals_and_points_at_any_scale(scale):
    rng = np.random.default_rng(1)
    mesh = random_triangles(rng, 300, scale)
    _, origin, direction, hits = hit_rays(scene_of(mesh), rng, 5000, inside(mesh, rng, 5000), scale)
    assert len(origin) > 4000
    found, _ = surfaces_at(scene_of(mesh), origin, direction, hits)
    corner = mesh.vertices[mesh.faces[hits.prim_id]].astype(np.float64) / scale
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    sound = np.linalg.norm(normal, axis=1) > 0.05
    normal = unit(normal)
    front = (normal * direction).sum(axis=1) < 0.0
    assert np.array_equal(found["front"][sound] != 0, front[sound])
    facing = np.where(front[:, None], normal, -normal)
    assert np.abs(found["geometric"] - facing)[sound].max() < 1e-4
    assert np.array_equal(found["geometric"], found["shading"])
    assert ((found["geometric"] * direction).sum(axis=1) <= 0.0).all()
    assert np.array_equal(found["exclude_plus_one"], hits.prim_id + 1)
    w = np.stack([1.0 - hits.u.astype(np.float64) - hits.v, hits.u, hits.v], axis=1)
    point = np.einsum("ni,nij->nj", w, corner)
    assert (np.abs(found["point"].astype(np.float64) / scale - point) <= found["error"].astype(np.float64) / scale).all()
    away = np.abs(((found["point"].astype(np.float64) / scale - corner[:, 0]) * normal).sum(axis=1))
    assert (away <= (np.abs(normal) * found["error"] / scale).sum(axis=1) * 1.01)[sound].all()
    assert (found["error"] <= 40.0 * 2.0**-24 * np.abs(corner).max(axis=(1, 2))[:, None] * scale).all()  # The bound is tight.


def test_smooth_normals_are_interpolated_and_turned_together():
    rng = np.random.default_rng(2)
    ball = icosphere(2)
    scene = scene_of(ball)
    _, origin, direction, hits = hit_rays(scene, rng, 5000, inside(ball, rng, 5000))
    found, _ = surfaces_at(scene, origin, direction, hits)
    w = np.stack([1.0 - hits.u.astype(np.float64) - hits.v, hits.u, hits.v], axis=1)
    normal = unit(np.einsum("ni,nij->nj", w, ball.normals[ball.faces[hits.prim_id]].astype(np.float64)))
    outward = np.where(found["front"][:, None] != 0, 1.0, -1.0)
    assert (found["front"] == 0).any() and (found["front"] == 1).any()
    assert np.abs(found["shading"] - outward * normal).max() < 1e-5
    assert ((found["shading"] * found["geometric"]).sum(axis=1) > 0.9).all()


def test_normals_that_point_inwards_are_brought_to_the_windings_side():
    rng = np.random.default_rng(3)
    ball = icosphere(1)
    inverted = Mesh(ball.vertices, ball.faces, normals=-ball.normals)
    _, origin, direction, hits = hit_rays(scene_of(ball), rng, 2000, inside(ball, rng, 2000))
    found, _ = surfaces_at(scene_of(inverted), origin, direction, hits)
    expected, _ = surfaces_at(scene_of(ball), origin, direction, hits)
    assert np.allclose(found["shading"], expected["shading"], atol=1e-6)


def test_corners_without_a_normal_are_flat():
    ball = icosphere(1)
    normals = ball.normals.copy()
    bare = np.unique(ball.faces[:20])
    normals[bare] = 0.0
    mesh = Mesh(ball.vertices, ball.faces, normals=normals)
    rng = np.random.default_rng(4)
    _, origin, direction, hits = hit_rays(scene_of(mesh), rng, 4000, inside(mesh, rng, 4000))
    found, _ = surfaces_at(scene_of(mesh), origin, direction, hits)
    flat = np.isin(ball.faces[hits.prim_id], bare).all(axis=1)
    assert flat.sum() > 100
    assert np.array_equal(found["shading"][flat], found["geometric"][flat])
    assert np.abs(np.linalg.norm(found["shading"], axis=1) - 1.0).max() < 1e-6


def uv_of(found):
    """Return the texture coordinates, (N, 2)."""
    return np.stack([found["u"], found["v"]], axis=1)


def textured_triangles(rng, n):
    mesh = random_triangles(rng, n)
    return Mesh(mesh.vertices, mesh.faces, uvs=rounded(rng.normal(size=(3 * n, 2))))


def test_uv_and_tangent():
    rng = np.random.default_rng(5)
    mesh = textured_triangles(rng, 200)
    scene = scene_of(mesh)
    _, origin, direction, hits = hit_rays(scene, rng, 4000, inside(mesh, rng, 4000))
    found, _ = surfaces_at(scene, origin, direction, hits)
    face = mesh.faces[hits.prim_id]
    w = np.stack([1.0 - hits.u.astype(np.float64) - hits.v, hits.u, hits.v], axis=1)
    uv = mesh.uvs[face].astype(np.float64)
    assert np.abs(uv_of(found) - np.einsum("ni,nij->nj", w, uv)).max() < 1e-5
    # dp/du and dp/dv solve the equations edge_k = du_k dp/du + dv_k dp/dv.
    edges = (mesh.vertices[face[:, 1:]] - mesh.vertices[face[:, :1]]).astype(np.float64)
    changes = uv[:, 1:] - uv[:, :1]
    determinant = np.linalg.det(changes)
    sound = np.abs(determinant) > 0.05
    solved = np.linalg.solve(np.where(sound[:, None, None], changes, np.eye(2)), edges)
    assert np.abs(found["tangent"] - unit(solved[:, 0]))[sound].max() < 1e-3
    # In glTF, bitangent = cross(normal, tangent) * sign points up in the picture, towards decreasing v.
    normal = unit(np.cross(edges[:, 0], edges[:, 1]))
    bitangent = np.cross(normal, found["tangent"]) * found["bitangent_sign"][:, None]
    assert ((bitangent * solved[:, 1]).sum(axis=1) < 0.0)[sound].all()


def test_uv_without_area_has_a_tangent_all_the_same():
    rng = np.random.default_rng(6)
    mesh = random_triangles(rng, 50)
    scene = scene_of(Mesh(mesh.vertices, mesh.faces, uvs=np.zeros((150, 2))))
    _, origin, direction, hits = hit_rays(scene, rng, 1000, inside(mesh, rng, 1000))
    found, _ = surfaces_at(scene, origin, direction, hits)
    assert np.abs(np.linalg.norm(found["tangent"], axis=1) - 1.0).max() < 1e-5
    assert np.abs((found["tangent"] * found["geometric"]).sum(axis=1)).max() < 1e-5


BALLS = {"unit": [0.0, 0.0, 0.0, 1.0], "far": [1000.0, -20.0, 3.0, 0.5], "small": [0.1, 0.2, 0.3, 1e-6],
         "ground": [0.0, -1e5, 0.0, 1e5], "tiny": [0.0, 0.0, 0.0, 1e-15], "huge": [1e12, 0.0, 0.0, 1e13]}


@pytest.mark.parametrize("ball", BALLS)
def test_spheres(ball):
    rng = np.random.default_rng(7)
    n = 5000
    sphere = rounded(BALLS[ball])
    center, radius = sphere[:3], sphere[3]
    on = directions(rng, n)
    if ball == "ground":
        on = unit(on * [1e-4, 0.0, 1e-4] + [0.0, 1.0, 0.0])
    scene = scene_of(spheres=[sphere])
    near = 1e-5 * radius if ball == "ground" else radius
    _, origin, direction, hits = hit_rays(scene, rng, n, center + 0.999999 * radius * on, near)
    assert len(origin) > 0.5 * n and (hits.prim_id == 0).all()
    found, _ = surfaces_at(scene, origin, direction, hits)
    from_center = (found["point"].astype(np.float64) - center) / radius
    reach = 16.0 * 2.0**-24 * (1.0 + np.abs(center).max() / radius)
    assert np.abs(np.linalg.norm(from_center, axis=1) - 1.0).max() < reach
    outward = np.where(found["front"][:, None] != 0, found["geometric"], -found["geometric"])
    assert np.abs(outward - unit(from_center)).max() < max(reach, 1e-6)
    assert ((found["geometric"] * direction).sum(axis=1) <= 1e-6 * np.linalg.norm(direction, axis=1)).all()
    assert (found["exclude_plus_one"] == 0).all()


def test_sphere_coordinates():
    # u runs around +y from -x, and v from the top down, as documented in wrt.scene.model.Sphere.
    scene = scene_of(spheres=[[0.0, 0.0, 0.0, 2.0]])
    where = np.array([[1, 0, 0], [0, 0, 1], [0, 0, -1], [0.6, 0.8, 0.0], [0.6, -0.8, 0.0], [-0.6, 0.0, 0.8], [0, 1, 0]], float)
    hits = build(upload_scene(scene, DEVICE).world.geometry, "bvh").closest_hit(4.0 * where, -where)
    found, _ = surfaces_at(scene, 4.0 * where, -where, hits)
    assert np.allclose(uv_of(found)[:, 1], np.arccos(where[:, 1]) / np.pi, atol=1e-5)
    # u grows from the seam at -x over +z, +x and -z: to the right, seen from outside with +y up.
    assert np.allclose(uv_of(found)[[1, 0, 2], 0], [0.25, 0.5, 0.75], atol=1e-6)
    around = np.mod(np.arctan2(where[:, 2], -where[:, 0]) / (2.0 * np.pi), 1.0)
    assert np.allclose(uv_of(found)[:6, 0], around[:6], atol=1e-6)
    tangent = found["tangent"]
    step = 1e-3
    moved = unit(where[:6] + step * tangent[:6])
    hits = build(upload_scene(scene, DEVICE).world.geometry, "bvh").closest_hit(4.0 * moved, -moved)
    further, _ = surfaces_at(scene, 4.0 * moved, -moved, hits)
    assert (uv_of(further)[:6, 0] > uv_of(found)[:6, 0]).all()  # The tangent points along growing u.
    assert np.allclose(uv_of(further)[:3, 1], uv_of(found)[:3, 1], atol=1e-5)


# --- new rays ---------------------------------------------------------------------------------------------------------


def test_next_away_moves_every_float():
    rng = np.random.default_rng(8)
    special = [0.0, -0.0, 1.0, -1.0, 2.0**-126, 1e-45, 3e38]
    x = np.concatenate([rng.normal(size=500) * 10.0 ** rng.uniform(-44, 37, 500), special])
    x = x.astype(np.float32)
    for side in (1.0, -1.0):
        out = zeros(len(x))
        launch(away_kernel, len(x), floats(x), floats(np.full(len(x), side)), out)
        assert (out.numpy() * side >= np.nextafter(x, np.float32(side * np.inf)) * side).all()
        assert (np.abs(out.numpy() - x.astype(np.float64)) <= np.abs(x.astype(np.float64)) * 2.0**-22 + 3e-45).all()
    still = zeros(len(x))
    launch(away_kernel, len(x), floats(x), floats(np.zeros(len(x))), still)
    assert np.array_equal(still.numpy(), x)


def onward_directions(rng, normal, grazing):
    """Return directions to both sides of a surface, with slopes down to `grazing`."""
    d = directions(rng, len(normal))
    d = d - (d * normal).sum(axis=1, keepdims=True) * normal * (1.0 if grazing else 0.0)
    d = unit(d) + (grazing * normal if grazing else 0.0)
    side = np.sign((d * normal).sum(axis=1, keepdims=True)) * rng.choice([-1.0, 1.0], (len(normal), 1))
    return rounded(d * side)


@pytest.mark.parametrize("grazing", [None, 1e-2, 1e-4])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 1000.0), (1e-3, 100.0), (1e-15, 0.0)])
def test_a_new_ray_does_not_meet_its_own_triangle(scale, offset, grazing):
    # As in pbrt-v4, shapes_test, Reintersect: no triangle is excluded, so that only the offset prevents the hit.
    rng = np.random.default_rng(9)
    mesh = random_triangles(rng, 100, scale, offset)
    scene = scene_of(mesh)
    _, origin, direction, hits = hit_rays(scene, rng, 4000, inside(mesh, rng, 4000), scale)
    corner = mesh.vertices[mesh.faces[hits.prim_id]].astype(np.float64)
    normal = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / scale**2)
    onward = onward_directions(rng, normal, grazing)
    _, start = surfaces_at(scene, origin, direction, hits, onward)
    for prim_id in range(0, 100, 5):
        chosen = hits.prim_id == prim_id
        alone = Mesh(mesh.vertices, mesh.faces[prim_id : prim_id + 1])
        assert not build(alone, "brute_force").any_hit(start[chosen], onward[chosen]).any()


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1.0, 2.0), (0.25, -0.5)])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (128.0, 0.0), (2.0**-10, 0.0), (1.0, 1024.0)])
def test_a_new_ray_does_not_meet_its_neighbours_in_a_plane(scale, offset, tilt):
    # Coordinates have few digits, so that all triangles are exactly in one plane. Any second hit is an artefact.
    i, j = np.meshgrid(np.arange(-4.0, 5.0), np.arange(-4.0, 5.0), indexing="ij")
    vertices = np.stack([i, j, tilt[0] * i + tilt[1] * j], axis=-1).reshape(-1, 3) * scale + offset
    first = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1, 1)
    mesh = Mesh(np.float32(vertices), np.concatenate([first + np.array([0, 9, 10]), first + np.array([0, 10, 1])]))
    assert np.array_equal(mesh.vertices, vertices)
    scene = scene_of(mesh)
    rng = np.random.default_rng(10)
    structure, origin, direction, hits = hit_rays(scene, rng, 20_000, inside(mesh, rng, 20_000), scale)
    assert len(origin) > 19_000
    normal = np.broadcast_to(unit(np.array([-tilt[0], -tilt[1], 1.0])), origin.shape)
    for grazing in (None, 1e-2, 1e-4):
        onward = onward_directions(rng, normal, grazing)
        _, start = surfaces_at(scene, origin, direction, hits, onward)
        assert not structure.any_hit(start, onward).any()
        step = np.linalg.norm(start - origin - hits.t[:, None].astype(np.float64) * direction, axis=1)
        assert step.max() < 1e-4 * (scale + offset)  # The offset is small.


@pytest.mark.parametrize("ball", BALLS)
def test_a_new_ray_does_not_meet_its_own_sphere(ball):
    rng = np.random.default_rng(11)
    n = 5000
    sphere = rounded(BALLS[ball])
    center, radius = sphere[:3], sphere[3]
    on = directions(rng, n)
    if ball == "ground":
        on = unit(on * [1e-4, 0.0, 1e-4] + [0.0, 1.0, 0.0])
    scene = scene_of(spheres=[sphere])
    near = 1e-5 * radius if ball == "ground" else radius
    structure, origin, direction, hits = hit_rays(scene, rng, n, center + 0.999999 * radius * on, near)
    found, _ = surfaces_at(scene, origin, direction, hits)
    # The normal tells to which side a direction goes: for a radius of 1e-6, the rounding of the point is 3 % of the radius.
    outward = unit(np.where(found["front"][:, None] != 0, 1.0, -1.0) * found["geometric"])
    for grazing in (None, 1e-2):
        onward = onward_directions(rng, outward, grazing)
        _, start = surfaces_at(scene, origin, direction, hits, onward)
        leaves = (onward * outward).sum(axis=1) > 0.0
        assert not structure.any_hit(start[leaves], onward[leaves]).any()
        # A ray through the sphere hits the far side, at the length of the chord, not the near side again.
        through = structure.closest_hit(start[~leaves], onward[~leaves])
        assert (through.prim_id == 0).all()
        f, d = (start[~leaves].astype(np.longdouble) - center), onward[~leaves].astype(np.longdouble)
        a, b = (d * d).sum(axis=1), (f * d).sum(axis=1)
        nearest = f - (b / a)[:, None] * d
        half = np.sqrt((np.longdouble(radius) ** 2 - (nearest * nearest).sum(axis=1)) / a)
        # t is clamped to the sphere's box, whose corners are rounded like all coordinates.
        slack = 8.0 * 2.0**-24 * np.abs(center).max()
        assert np.allclose(through.t, (half - b / a).astype(np.float64), rtol=1e-6, atol=slack)
        assert (half > 0.0).all()
