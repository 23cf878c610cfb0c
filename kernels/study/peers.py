"""Kernels with the ray queries of Warp (wp.mesh_query_ray), for comparison with wrt."""

import warp as wp

from wrt.kernels.structs import kernel


@kernel
def warp_mesh_query(mesh: wp.uint64, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
                    t: wp.array(dtype=wp.float32), prim_id: wp.array(dtype=wp.int32), u: wp.array(dtype=wp.float32),
                    v: wp.array(dtype=wp.float32)):
    """Store the closest hit of each ray; a miss has prim_id = -1. Directions must have unit length."""
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e38)
    prim_id[i] = -1
    t[i] = float(wp.inf)
    if query.result:
        prim_id[i] = query.face
        t[i] = query.t
        u[i] = query.u
        v[i] = query.v


@kernel
def warp_mesh_any(mesh: wp.uint64, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
                  t_max: wp.array(dtype=wp.float32), occluded: wp.array(dtype=wp.bool)):
    """Store whether each ray hits anything at t <= t_max. Directions must have unit length."""
    i = wp.tid()
    occluded[i] = wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], t_max[i])


@kernel
def warp_worlds_query(meshes: wp.array(dtype=wp.uint64), world: wp.array(dtype=wp.int32), origins: wp.array(dtype=wp.vec3),
                      directions: wp.array(dtype=wp.vec3), t: wp.array(dtype=wp.float32), prim_id: wp.array(dtype=wp.int32)):
    """Store the closest hit of each ray in the mesh of its world; a miss has prim_id = -1. Directions must have unit length."""
    i = wp.tid()
    query = wp.mesh_query_ray(meshes[world[i]], origins[i], directions[i], 1.0e38)
    t[i] = wp.where(query.result, query.t, float(wp.inf))
    prim_id[i] = wp.where(query.result, query.face, -1)
