"""Rays of simulators on wrt.testing.bodies: `python -m tests.simulators [--rays 10000]` prints a table of each that is installed."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
import warp as wp

import wrt
import wrt.testing
from wrt.testing import Bodies

Answer = tuple[np.ndarray, np.ndarray]


def unit(case: Bodies) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions float32, and the lengths by which they were divided."""
    length = np.linalg.norm(case.directions.astype(np.float64), axis=1)
    return (case.directions / length[:, None]).astype(np.float32), length


def with_wrt(case: Bodies, move: bool = True, exclude: bool = True) -> Answer:
    worlds = [wrt.Scene(tuple(wrt.Object(wrt.Mesh(case.meshes[case.mesh[body]].vertices, case.meshes[case.mesh[body]].faces),
                                         transform=np.vstack([np.column_stack([np.eye(3), case.before[body]]), [0, 0, 0, 1]]))
                              for body in np.flatnonzero(case.world == world))) for world in range(case.world.max() + 1)]
    accel = wrt.build(worlds)
    if move:
        accel.move(np.arange(len(case.mesh)), case.to_world)
    first = np.searchsorted(case.world, np.arange(len(worlds)))
    options: dict[str, Any] = {}
    if exclude and (case.exclude >= 0).any():
        options["exclude"] = np.where(case.exclude >= 0, case.exclude - first[case.ray_world], -1)
    hits = accel.closest_hit(case.origins, case.directions, t_max=case.t_max, world=case.ray_world, **options)
    return hits.t, np.where(hits.prim_id >= 0, hits.object + first[case.ray_world], -1)


def newton_model(case: Bodies) -> tuple[Any, Any]:
    """Return a model and its state after the move: a body and a shape for each body, in the order of the case."""
    import newton

    builder = newton.ModelBuilder()
    for world in range(case.world.max() + 1):
        builder.begin_world()
        for body in np.flatnonzero(case.world == world):
            mesh, sign = case.meshes[case.mesh[body]], -1.0 if case.mirrored[body] else 1.0
            link = builder.add_body(xform=wp.transform(wp.vec3(*case.before[body]), wp.quat_identity()))
            builder.add_shape_mesh(link, mesh=newton.Mesh(mesh.vertices, mesh.faces.reshape(-1), compute_inertia=False), scale=(sign,) * 3)
        builder.end_world()
    model = builder.finalize(device="cpu")
    state = model.state()
    state.body_q.assign(np.column_stack([case.position, case.quaternion]).astype(np.float32))
    return model, state


def with_newton(case: Bodies) -> Answer:
    import newton

    if (case.exclude >= 0).any():
        raise NotImplementedError("intersect_ray cannot leave out a body")
    model, state = newton_model(case)
    model.bvh_refit_shapes(state)
    directions, length = unit(case)
    t, shape = wp.zeros(len(length), dtype=float, device="cpu"), wp.zeros(len(length), dtype=int, device="cpu")
    newton.intersect_ray(model, ray_origins=wp.array(case.origins, dtype=wp.vec3, device="cpu"),
                         ray_directions=wp.array(directions, dtype=wp.vec3, device="cpu"),
                         ray_worlds=wp.array(case.ray_world, dtype=int, device="cpu"), out_dist=t, out_shape_id=shape)
    return t.numpy() / length, shape.numpy()


def mujoco_model(case: Bodies, world: int) -> Any:
    """Return a model of one world: a body with a free joint and one mesh geom for each body, and its data after the move."""
    import mujoco

    spec = mujoco.MjSpec()
    bodies = np.flatnonzero(case.world == world)
    for body in bodies:
        mesh, sign = case.meshes[case.mesh[body]], -1.0 if case.mirrored[body] else 1.0
        spec.add_mesh(name=f"m{body}", uservert=mesh.vertices.reshape(-1).tolist(), userface=mesh.faces.reshape(-1).tolist(),
                      scale=[sign] * 3, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        part = spec.worldbody.add_body(pos=case.before[body])
        part.add_freejoint()
        part.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{body}", contype=0, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = np.column_stack([case.position, case.quaternion[:, [3, 0, 1, 2]]])[bodies].reshape(-1)
    mujoco.mj_forward(model, data)
    return model, data


def with_mujoco(case: Bodies) -> Answer:
    import mujoco

    directions, length = unit(case)
    t, found, first = np.full(len(length), -1.0), np.full(len(length), -1), np.searchsorted(case.world, np.arange(case.world.max() + 1))
    for world in range(case.world.max() + 1):
        model, data = mujoco_model(case, world)
        geom = np.zeros(1, np.int32)
        for ray in np.flatnonzero(case.ray_world == world):
            left_out = int(case.exclude[ray] - first[world] + 1) if case.exclude[ray] >= 0 else -1
            ends = case.origins[ray].astype(np.float64), directions[ray].astype(np.float64)
            t[ray] = mujoco.mj_ray(model, data, *ends, None, 1, left_out, geom)
            found[ray] = geom[0] + first[world] if geom[0] >= 0 else -1
    return t / length, found


def with_mujoco_warp(case: Bodies) -> Answer:
    import mujoco_warp as mjw

    count = int(case.world.max()) + 1
    (model, data), per_world = mujoco_model(case, 0), len(case.mesh) // count  # worlds have the same meshes, in other poses
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=count)
    d.qpos.assign(np.column_stack([case.position, case.quaternion[:, [3, 0, 1, 2]]]).astype(np.float32).reshape(count, -1))
    mjw.kinematics(m, d)
    directions, length = unit(case)
    n = len(length)
    dist, geom = wp.zeros((count, n), dtype=float), wp.zeros((count, n), dtype=int)
    first = case.ray_world * per_world
    rays = [wp.array(np.tile(each, (count, 1, 1)), dtype=wp.vec3) for each in (case.origins, directions)]
    left_out = wp.array(np.where(case.exclude >= 0, case.exclude - first + 1, -1), dtype=int)
    mjw.rays(m, d, *rays, mjw._src.types.vec6f(*[-1.0] * 6), True, left_out, dist, geom, wp.zeros((count, n), dtype=wp.vec3))
    own = case.ray_world, np.arange(n)
    return dist.numpy()[own] / length, np.where(geom.numpy()[own] >= 0, geom.numpy()[own] + first, -1)


@wp.kernel(enable_backward=False)
def query_meshes(ids: wp.array(dtype=wp.uint64), world: wp.array(dtype=int), to_local: wp.array(dtype=wp.mat44),
                 rays: wp.array2d(dtype=wp.vec3), ray_world: wp.array(dtype=int), exclude: wp.array(dtype=int),
                 t: wp.array(dtype=float), found: wp.array(dtype=int)):
    i = wp.tid()
    t[i] = wp.inf
    found[i] = -1
    for body in range(ids.shape[0]):
        if world[body] == ray_world[i] and body != exclude[i]:
            origin = wp.transform_point(to_local[body], rays[0, i])
            hit = wp.mesh_query_ray(ids[body], origin, wp.transform_vector(to_local[body], rays[1, i]), 1.0e6)
            if hit.result and hit.t < t[i]:
                t[i] = hit.t
                found[i] = body


def with_warp(case: Bodies) -> Answer:
    """A loop over wp.Mesh, which people write who need ids of bodies."""
    meshes = [wp.Mesh(wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"), wp.array(mesh.faces.reshape(-1), dtype=int, device="cpu"))
              for mesh in case.meshes]
    to_local = np.linalg.inv(np.concatenate([case.to_world, np.tile([[[0.0, 0, 0, 1]]], (len(case.mesh), 1, 1))], axis=1))
    n = len(case.origins)
    given = [np.array([meshes[each].id for each in case.mesh]), case.world, to_local, np.stack([case.origins, case.directions]),
             case.ray_world, case.exclude, np.zeros(n), np.zeros(n)]
    kinds = wp.uint64, int, wp.mat44, wp.vec3, int, int, float, int
    arrays = [wp.array(each, dtype=kind, device="cpu") for each, kind in zip(given, kinds, strict=True)]
    wp.launch(query_meshes, n, arrays, device="cpu")
    return arrays[-2].numpy(), arrays[-1].numpy()


CONTESTANTS: dict[str, tuple[str, Callable[[Bodies], Answer]]] = {
    "wrt": ("wrt", with_wrt), "newton.intersect_ray": ("newton", with_newton), "mujoco.mj_ray": ("mujoco", with_mujoco),
    "mujoco_warp.rays": ("mujoco-warp", with_mujoco_warp), "wp.Mesh in a loop": ("warp-lang", with_warp)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=10_000)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    for name, (package, trace) in CONTESTANTS.items():
        if options.only in name:
            try:
                print(f"{name} ({package} {version(package)})")
            except ImportError:
                print(f"{name}: not installed\n")
                continue
            print(wrt.testing.bodies(trace, rays=options.rays), flush=True)


if __name__ == "__main__":
    main()
