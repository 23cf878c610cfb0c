# %% [markdown]
# # Queries in your own kernels
# `accel.closest_hit` takes arrays of rays. If new rays depend on earlier hits, a kernel of your own is simpler. It queries the structure
# itself, on the CPU or on CUDA. The function `wrt.ray_query` returns the query functions, and the kernel gets `accel.world` as an
# argument. The decorator `wrt.kernel` compiles without fused multiply-add, with which rays could be lost at edges. The hits equal those
# of `accel.closest_hit` to the last bit.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller. The outputs below were made without it.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np
import warp as wp

import wrt
from wrt.scene import shapes

QUICK = "WRT_QUICK" in os.environ
SIZE = (96, 54) if QUICK else (480, 270)
SAMPLES = 16 if QUICK else 128

floor = shapes.quad((-8.0, 0.0, 8.0), (16.0, 0.0, 0.0), (0.0, 0.0, -16.0))
accel = wrt.build(shapes.merged([shapes.teapot(), floor], "teapot on a floor"))
query = wrt.ray_query(accel)
camera = wrt.Camera.look_at((1.4, 1.3, 2.1), (0.0, 0.35, 0.0))
print(accel)

# %% [markdown]
# ## Ambient occlusion
# How much of the sky is visible from a point? The kernel traces one camera ray, then many short rays around the normal at its hit. A ray
# from `query.ray` has t from 0 to infinity; set `t_min` and `t_max` to change that. The short rays begin a little above the surface.

# %%
@wrt.kernel
def ambient_occlusion(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
                      normals: wp.array(dtype=wp.vec3), samples: int, reach: float, open: wp.array(dtype=float)):
    i = wp.tid()
    hit = query.closest_hit(world, query.ray(origins[i], directions[i]))
    if hit.prim_id >= 0:
        random = wp.rand_init(7, i)
        n = normals[hit.prim_id]
        n = wp.where(wp.dot(n, directions[i]) > 0.0, -n, n)
        point = origins[i] + hit.t * directions[i] + 1.0e-4 * n
        for _ in range(samples):
            ray = query.ray(point, n + wp.sample_unit_sphere_surface(random))  # density: the cosine
            ray.t_max = reach / wp.length(ray.direction)
            if not query.any_hit(world, ray):
                open[i] += 1.0 / float(samples)


def face_normals(geometry):
    a, b, c = np.moveaxis(geometry.vertices[geometry.faces], 1, 0)
    n = np.cross(b - a, c - a)
    return np.float32(n / np.linalg.norm(n, axis=1, keepdims=True))


origins, directions = (wp.array(rays, dtype=wp.vec3, device="cpu") for rays in wrt.camera_rays(camera, SIZE))
normals = wp.array(face_normals(accel.geometry), dtype=wp.vec3, device="cpu")
open_sky = wp.zeros(len(origins), dtype=float, device="cpu")
wp.launch(ambient_occlusion, dim=len(origins), device="cpu",
          inputs=[accel.world, origins, directions, normals, SAMPLES, 2.0, open_sky])
plt.figure(figsize=(7.0, 4.0), dpi=80)
plt.imshow(open_sky.numpy().reshape(SIZE[::-1]), cmap="gray", vmin=0.0, vmax=1.0)
plt.axis("off")
plt.show()

# %% [markdown]
# ## A LiDAR
# A LiDAR at a fixed point turns once; its 64 rings have different elevations. Each thread makes one ray, and stores the distance with the
# error of the instrument. No array of rays is needed.

# %%
@wrt.kernel
def scan(world: query.World, place: wp.vec3, rings: int, steps: int, error: float, distance: wp.array2d(dtype=float)):
    ring, step = wp.tid()
    azimuth = 2.0 * wp.pi * float(step) / float(steps)
    height = wp.radians(-40.0 + 50.0 * float(ring) / float(rings - 1))
    direction = wp.vec3(wp.cos(height) * wp.cos(azimuth), wp.sin(height), wp.cos(height) * wp.sin(azimuth))
    hit = query.closest_hit(world, query.ray(place, direction))
    distance[ring, step] = hit.t + error * wp.randn(wp.rand_init(3, ring * steps + step))


rings, steps = (16, 256) if QUICK else (64, 1440)
distance = wp.zeros((rings, steps), dtype=float, device="cpu")
wp.launch(scan, dim=(rings, steps), inputs=[accel.world, wp.vec3(0.0, 1.2, 3.0), rings, steps, 0.01, distance], device="cpu")
seen = np.where(np.isfinite(distance.numpy()), distance.numpy(), np.nan)
plt.figure(figsize=(9.0, 2.2), dpi=80)
plt.imshow(seen, cmap="viridis", aspect="auto", origin="lower", extent=(0.0, 360.0, -40.0, 10.0))
plt.colorbar(label="distance, scene units")
plt.xlabel("azimuth in degrees")
plt.ylabel("elevation in degrees")
plt.show()
print(f"{np.isfinite(seen).mean():.0%} of the rays hit")

# %% [markdown]
# ## Hit after hit
# `query.next_hit` returns the next hit of the same ray, in the order of distance. Hits at the same distance are in the order of
# `prim_id`, so that no hit is lost or repeated. Here the kernel adds up the length of each ray inside the ring.

# %%
@wrt.kernel
def thickness(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
              inside: wp.array(dtype=float), walls: wp.array(dtype=int)):
    i = wp.tid()
    ray = query.ray(origins[i], directions[i])
    hit = query.closest_hit(world, ray)
    begin = hit.t
    while hit.prim_id >= 0:
        walls[i] += 1
        if walls[i] % 2 == 0:
            inside[i] += hit.t - begin
        begin = hit.t
        hit = query.next_hit(world, ray, hit)


ring = wrt.build(shapes.torus(1.0, 0.45, 256, 128))
aslant = wrt.Camera.look_at((2.0, 1.3, 2.4), (0.0, 0.0, 0.0))
rays = wrt.camera_rays(aslant, SIZE)
origins, directions = (wp.array(array, dtype=wp.vec3, device="cpu") for array in rays)
inside, walls = (wp.zeros(len(origins), dtype=kind, device="cpu") for kind in (float, int))
wp.launch(thickness, dim=len(origins), inputs=[ring.world, origins, directions, inside, walls], device="cpu")
plt.figure(figsize=(7.0, 4.0), dpi=80)
plt.imshow(inside.numpy().reshape(SIZE[::-1]), cmap="bone")
plt.colorbar(label="length in the ring, scene units")
plt.axis("off")
plt.show()

# %% [markdown]
# From NumPy, `wrt.all_hits` returns every hit of every ray, `wrt.first_hits` the first k hits, and `wrt.count_hits` only the number of
# hits.

# %%
found = wrt.all_hits(ring, *rays)
assert np.array_equal(found.counts, walls.numpy())
print(found)
for number, rays_with in zip(*np.unique(found.counts, return_counts=True), strict=True):
    print(f"{number} hits: {rays_with} rays")
