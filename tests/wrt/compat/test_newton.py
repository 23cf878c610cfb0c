"""wrt.compat.newton against newton.intersect_ray and Newton's SensorCamera; where they differ, float64 judges."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.refused import refused
from wrt.compat.newton import ModelScene, from_newton
from wrt.core.errors import SceneWarning
from wrt.io.gltf.meshes import compose
from wrt.scene import shapes

newton = pytest.importorskip("newton", reason="Newton is not installed")

SAGITTA = 6e-4  # of the radius, that a curved shape's mesh is below its surface
CURVED = ("sphere", "capsule", "cylinder", "cone", "ellipsoid", "barrel")
WORLDS = 3


def add(builder: Any, kind: str, body: int) -> None:
    """Add a shape of a kind to a body."""
    if kind == "mesh":
        mesh = shapes.torus(0.3, 0.1, 24, 12)
        builder.add_shape_mesh(body, mesh=newton.Mesh(mesh.vertices, mesh.faces.reshape(-1)), scale=(1.0, -1.2, 0.8))  # mirrored
    elif kind == "hull":
        mesh = shapes.prism(5, 0.3, 0.4)
        builder.add_shape_convex_hull(body, mesh=newton.Mesh(mesh.vertices, mesh.faces.reshape(-1)))
    elif kind == "barrel":
        builder.add_shape_cylinder(body, radius=0.2, half_height=0.3, barrel_radius=0.5)
    elif kind == "ellipsoid":
        builder.add_shape_ellipsoid(body, rx=0.2, ry=0.3, rz=0.4)
    else:
        size = {"box": {"hx": 0.2, "hy": 0.3, "hz": 0.15}, "sphere": {"radius": 0.3}}.get(kind, {"radius": 0.2, "half_height": 0.3})
        getattr(builder, f"add_shape_{kind}")(body, **size)


def model_of(kinds: tuple[str, ...], worlds: int = WORLDS) -> Any:
    """Return a model whose worlds have a body of each kind, above a floor, a terrain and a plate that all worlds share."""
    rng = np.random.default_rng(1)
    robot, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for kind in kinds:
        body = robot.add_body(xform=wp.transform(rng.uniform(-1.0, 1.0, 3) + [0.0, 0.0, 1.5], unit(rng.normal(size=4))))
        add(robot, kind, body)
    builder.add_ground_plane()
    field = newton.Heightfield(rng.uniform(0.0, 0.5, (6, 7)), 6, 7, 1.5, 2.0)
    builder.add_shape_heightfield(heightfield=field, xform=wp.transform((0.5, 0.0, 0.1), wp.quat_identity()))
    builder.add_shape_plane(xform=wp.transform((0.0, 2.5, 1.0), wp.quat(*unit(np.array([1.0, 0.2, 0.1, 1.0])))), width=1.0, length=2.0)
    builder.replicate(robot, worlds)
    return builder.finalize()


def unit(row: np.ndarray) -> np.ndarray:
    return row / np.linalg.norm(row, axis=-1, keepdims=True)


def stirred(model: Any, seed: int) -> Any:
    """Return a state with other poses of all bodies."""
    rng, state = np.random.default_rng(seed), model.state()
    poses = state.body_q.numpy()
    poses[:, :3] += rng.uniform(-0.3, 0.3, (len(poses), 3))
    poses[:, 3:] = unit(rng.normal(size=(len(poses), 4)))
    state.body_q.assign(poses)
    return state


def rays_of(n: int, worlds: int = WORLDS) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(2)
    origins = rng.uniform(-3.0, 3.0, (n, 3)) + [0.0, 0.0, 3.2]
    directions = unit(rng.uniform(-1.0, 1.0, (n, 3)) + [0.0, 0.0, 1.2] - origins)
    return (wp.array(origins, dtype=wp.vec3), wp.array(directions, dtype=wp.vec3),
            wp.array(rng.integers(-1, worlds, n), dtype=wp.int32))


def cast(caster: Any, rays: tuple[Any, Any, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distances, shapes and normals of rays by newton.intersect_ray, or of a ModelScene."""
    out = wp.zeros(len(rays[0]), dtype=float), wp.zeros(len(rays[0]), dtype=wp.int32), wp.zeros(len(rays[0]), dtype=wp.vec3)
    names = dict(zip(("ray_origins", "ray_directions", "ray_worlds", "out_dist", "out_shape_id", "out_normal"), (*rays, *out), strict=True))
    if isinstance(caster, ModelScene):
        caster.intersect_ray(**names)
    else:
        newton.intersect_ray(caster, fast_math=False, **names)
    return tuple(each.numpy() for each in out)


def poses_of(model: Any, state: Any) -> np.ndarray:
    """Return the matrix of each shape, (S, 4, 4) float64."""
    own, bodies, body = (array.numpy().astype(np.float64) for array in (model.shape_transform, state.body_q, model.shape_body))
    place = compose(own[:, :3], own[:, 3:], np.ones((len(own), 3)))
    of_body = compose(bodies[:, :3], bodies[:, 3:], np.ones((len(bodies), 3)))
    return np.array([of_body[int(b)] @ m if b >= 0 else m for m, b in zip(place, body, strict=True)])


def below(kind: str, p: np.ndarray) -> np.ndarray:
    """Return how far points (N, 3) are below the surface of a curved shape of `add`, in its own space, to first order at the surface."""
    rho, z = np.hypot(p[:, 0], p[:, 1]), np.abs(p[:, 2])
    if kind == "sphere":
        return 0.3 - np.linalg.norm(p, axis=1)
    if kind == "ellipsoid":
        q = p / [0.2, 0.3, 0.4]
        return (1.0 - (q * q).sum(axis=1)) / (2.0 * np.linalg.norm(q / [0.2, 0.3, 0.4], axis=1))
    if kind == "capsule":
        return 0.2 - np.hypot(rho, np.maximum(z - 0.3, 0.0))
    if kind == "cone":
        slope = np.hypot(0.2, 0.6)
        return np.minimum(p[:, 2] + 0.3, (0.2 * (0.3 - p[:, 2]) - 0.6 * rho) / slope)
    bulge = np.sqrt(np.maximum(0.25 - z * z, 0.0)) - 0.4 if kind == "barrel" else 0.0
    return np.minimum(0.3 - z, 0.2 + bulge - rho)


def test_intersect_ray_beside_newton() -> None:
    model = model_of(CURVED)
    found, rays = from_newton(model), rays_of(20_000)
    for seed in (0, 1):
        state = stirred(model, seed)
        model.bvh_refit_shapes(state)
        found.follow(state)
        (t, shape, normal), (t0, shape0, normal0) = cast(found, rays), cast(model, rays)
        matrices, kinds = poses_of(model, state), ["", "", "", *CURVED * WORLDS]
        origins, directions = (array.numpy().astype(np.float64) for array in rays[:2])
        same, rims = shape == shape0, np.flatnonzero((shape != shape0) & (t < 1000.0))  # Newton's endless planes end at 1,000 m
        assert len(rims) < 0.002 * len(t)
        for ray in rims:  # float64 says whether the ray meets the nearer shape: Newton's cones have no inside, its barrels are too thick
            missed = shape[ray] < 0 or (0.0 <= t0[ray] < t[ray])
            near, at = (t0[ray], shape0[ray]) if missed else (t[ray], shape[ray])
            points = origins[ray] + (near + np.linspace(-0.2, 0.2, 4001) * missed)[:, None] * directions[ray]
            depth = below(kinds[at], (points - matrices[at, :3, 3]) @ matrices[at, :3, :3]).max()
            assert depth < 0.3 * SAGITTA and (missed or depth > -2e-6)
        assert same.sum() > 15_000 and set(shape) >= set(range(-1, len(kinds)))
        cosine = np.abs((directions * normal0).sum(axis=1))
        curved = np.array([bool(kinds[each]) for each in shape])  # a miss is any
        error = np.abs(t - t0)
        assert (error * cosine <= 2e-6 * (3.0 + t))[same & ~curved].all()
        for number, kind in enumerate(kinds):  # below the surface by the sagitta at most
            rows = np.flatnonzero(shape == number) if kind else []
            own = (origins[rows] + t[rows, None] * directions[rows] - matrices[number, :3, 3]) @ matrices[number, :3, :3]
            assert (np.abs(below(kind, own) - 0.3 * SAGITTA) < 0.3 * SAGITTA + 2e-6).all() if kind else True
        hit = same & (shape >= 0) & (cosine > 0.1)
        far = np.linalg.norm(normal - normal0, axis=1)[hit]
        assert (far < 0.05).mean() > 0.998  # the others are at edges


def test_flat_shapes_have_the_hits_of_float64() -> None:
    model = model_of(("box", "mesh", "hull"))
    found, rays, state = from_newton(model), rays_of(3000), stirred(model, 3)
    found.follow(state)
    t, shape, normal = cast(found, rays)
    matrices, scale = poses_of(model, state), model.shape_scale.numpy().astype(np.float64)
    origins, directions, world = (array.numpy() for array in rays)
    best, at, side = np.full(len(t), np.inf), np.full(len(t), -1), np.zeros((len(t), 3))
    for number, (matrix, of_world) in enumerate(zip(matrices, model.shape_world.numpy(), strict=True)):
        source = model.shape_source[number]
        if isinstance(source, newton.Mesh):
            corners = (source.vertices.astype(np.float64) * scale[number])[source.indices.reshape(-1, 3)]
        elif source is not None:
            mesh = model.heightfield_meshes[0]
            corners = mesh.points.numpy().astype(np.float64)[mesh.indices.numpy().reshape(-1, 3)]
        elif scale[number].any() and scale[number][2] > 0.0:
            box = shapes.box()
            corners = (2.0 * box.vertices * scale[number])[box.faces]
        else:
            x, y = np.where(scale[number][:2] > 0.0, 0.5 * scale[number][:2], 1e4)
            a, b, c, d = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
            corners = np.array([[a, b, c], [a, c, d]])
        if np.prod(np.sign(scale[number])) < 0.0:
            corners = corners[:, ::-1]
        rows = np.flatnonzero((world == of_world) | (of_world < 0))
        distance, face = nearest(corners @ matrix[:3, :3].T + matrix[:3, 3], origins[rows], directions[rows])
        closer = rows[distance < best[rows]]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ matrix[:3, :3].T
        side[closer] = unit(outward)[face[distance < best[rows]]]
        at[closer], best[closer] = number, distance[distance < best[rows]]
    assert np.array_equal(shape, at) and set(at) == set(range(-1, len(matrices)))
    hit = at >= 0
    off = np.abs(t - best)[hit] * np.abs((directions * side).sum(axis=1))[hit]
    assert (off < 5e-7 * (2.0 + t[hit])).all() and (t[~hit] == -1.0).all()
    assert np.abs(normal - side).max() < 2e-6


def nearest(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return t and face of the closest hit of each ray by brute force in float64 (Moeller-Trumbore)."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    o, d = origins[:, None].astype(np.float64), directions[:, None].astype(np.float64)
    p = np.cross(d, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (p * e1).sum(axis=2)
        q = np.cross(o - a, e1)
        u, v, t = ((o - a) * p).sum(axis=2) * inverse, (d * q).sum(axis=2) * inverse, (e2 * q).sum(axis=2) * inverse
        t = np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0), t, np.inf)
    return t.min(axis=1), t.argmin(axis=1)


def test_pictures_of_a_sensor_beside_newtons_camera() -> None:
    """The rows of docs/compat.md on SensorCamera."""
    model, width, height, fov = model_of(CURVED), 48, 32, 1.0
    camera, found, state = newton.sensors.SensorCamera(model), from_newton(model), stirred(model, 5)
    found.follow(state)
    model.bvh_refit_shapes(state)
    pose = wp.transform((0.3, -3.5, 2.0), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.4))
    kinds = {"depth_image": wp.float32, "forward_depth_image": wp.float32, "shape_index_image": wp.uint32, "normal_image": wp.vec3}
    images = {name: wp.zeros((WORLDS, height, width), dtype=kind) for name, kind in kinds.items()}
    camera.update(state, wp.array([pose] * WORLDS, dtype=wp.transformf), camera.compute_camera_rays_pinhole(width, height, camera_fov=fov),
                  render_config=camera.RenderConfig(enable_backface_culling=False, enable_fast_math=False), **images)
    theirs = {name: image.numpy() for name, image in images.items()}
    f, numbers = 0.5 * height / np.tan(0.5 * fov), np.array([pose])
    turned = compose(numbers[:, :3], numbers[:, 3:], np.ones((1, 3))) @ np.diag([1.0, -1.0, -1.0, 1.0])
    sensor = wrt.sensors.pinhole([[f, 0, 0.5 * width - 0.5], [0, f, 0.5 * height - 0.5], [0, 0, 1]], (width, height),
                                 np.repeat(turned, WORLDS, axis=0))
    world = np.repeat(np.arange(WORLDS), width * height)
    hits = found.accel.closest_hit(sensor.origins, sensor.directions, world=world)
    shape = np.where(hits.hit, found.shape[hits.instance], -1).reshape(WORLDS, height, width)
    same = shape == theirs["shape_index_image"].view(np.int32)
    assert (~same).sum() <= 6 and len(np.unique(shape)) > 15  # rims, and barrels
    seen = same & (shape >= 0)
    for name, own in (("depth_image", sensor.range(hits)), ("forward_depth_image", sensor.depth(hits))):
        error = np.abs(theirs[name] - own)[seen]
        assert error.max() < 0.05 and (error < 2e-3).mean() > 0.995
    body = model.shape_body.numpy()[found.shape]
    passed = found.accel.closest_hit(sensor.origins, sensor.directions, world=world, exclude=1)  # the capsule of world 0
    was = hits.hit & (body[hits.instance] == 1)
    assert was.any() and not (body[passed.instance[passed.hit]] == 1).any() and np.array_equal(hits.t[~was], passed.t[~was])
    normal = hits.shading_normal.reshape(WORLDS, height, width, 3)
    assert (np.linalg.norm(theirs["normal_image"] - normal, axis=3)[seen] < 0.05).mean() > 0.998


def test_a_graph_follows_bodies() -> None:
    model = model_of(("box",))
    found, state, rays = from_newton(model), stirred(model, 7), rays_of(2000)
    with wp.ScopedCapture("cpu") as capture:
        found.follow(state)
    for seed in (8, 9):
        state.body_q.assign(stirred(model, seed).body_q)
        wp.capture_launch(capture.graph)
        replayed = cast(found, rays)
        fresh = from_newton(model)
        fresh.follow(state)
        assert all(np.array_equal(a, b) for a, b in zip(replayed, cast(fresh, rays), strict=True))
    poses = state.body_q.numpy()
    poses[0] = np.nan
    state.body_q.assign(poses)
    found.follow(state)
    t, shape, _ = cast(found, rays)
    assert 3 not in shape and {4, 5} <= set(shape) and np.isfinite(t).all()
    assert found.shape[found.accel.invalid_moves.numpy() > 0].tolist() == [3]


def test_flags_and_what_is_left_out() -> None:
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, label="seen")
    builder.add_shape_box(-1, opacity=0.0, label="clear")
    builder.add_shape_box(-1, cfg=builder.ShapeConfig(is_visible=False), label="collider")
    builder.add_shape_sphere(-1, radius=0.0, label="point")
    builder.add_particle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
    model = builder.finalize()
    with pytest.warns(SceneWarning, match=r"rays miss what cannot be traced: shape 3 'point' \(SPHERE\), 1 particles") as caught:
        found = from_newton(model)
    assert len(caught) == 1 and found.shape.tolist() == [0, 0]  # world 0, which has no shape of its own, and world -1
    with pytest.warns(SceneWarning):
        assert sorted(set(from_newton(model, shape_flags=2).shape.tolist())) == [0, 1, 2]
    only = newton.ModelBuilder()
    only.add_shape_box(-1, opacity=0.0)
    with refused("model", "has no shape that can be traced"):
        from_newton(only.finalize())


def test_bad_input() -> None:
    class Model:
        shape_type = shape_flags = None

    with refused("model", "must be a newton.Model, got"):
        from_newton(SimpleNamespace())
    with refused("model", f"is a Model of newton {newton.__version__} without shape_body; wrt reads those of newton 1.8"):
        from_newton(Model())
    model = model_of(("box",), 1)
    with refused("segments"):
        from_newton(model, segments=4)
    found, (origins, directions, worlds) = from_newton(model), rays_of(5, 1)
    rays = {"ray_origins": origins, "ray_directions": directions, "ray_worlds": worlds}
    with refused("enable_global_world"):
        found.intersect_ray(**rays, enable_global_world=False)
    for name, bad in (("ray_worlds", worlds[:4]), ("ray_directions", directions.numpy()), ("out_dist", wp.zeros(5, dtype=wp.int32)),
                      ("ray_origins", wp.zeros((10, 3))[::2]), ("out_normal", wp.zeros(6, dtype=wp.vec3))):
        with refused(name, "must be a contiguous Warp array"):
            found.intersect_ray(**{**rays, name: bad})
    poses = model.state().body_q
    for bad in (None, poses[:0], wp.clone(poses).numpy(), wp.zeros(len(poses), dtype=wp.vec3)):
        with refused("body_q", "must be a contiguous Warp array (1,) of transformf"):
            found.follow(SimpleNamespace(body_q=bad))
    none = wp.zeros(0, dtype=wp.vec3)
    found.intersect_ray(ray_origins=none, ray_directions=none, ray_worlds=wp.zeros(0, dtype=wp.int32), out_dist=wp.zeros(0, dtype=float))
    away = wp.array([9, -2, 0], dtype=wp.int32)  # worlds that do not exist; a direction that is NaN
    toward = wp.array([[0.0, 0.0, -1.0]] * 2 + [[np.nan, 0.0, -1.0]], dtype=wp.vec3)
    t, shape, normal = cast(found, (wp.array([[0.0, 0.0, 3.0]] * 3, dtype=wp.vec3), toward, away))
    assert (t == -1.0).all() and (shape == -1).all() and not normal.any()
