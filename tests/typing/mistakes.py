"""Wrong calls: type checkers must report an error in exactly the lines with `# Error`, which say what would be right. Never run."""

from __future__ import annotations

import numpy as np
import warp as wp

import wrt
from wrt.scene.shapes import box

rays = np.zeros((1, 3))
mesh = box()
wrt.build(mesh, bulder="sbvh")  # Error: builder.
wrt.build(mesh, "bvh8", max_leaf="four")  # Error: a number.
wrt.build(mesh, 8)  # Error: a name.
wrt.build(3.0)  # Error: a mesh.
wrt.build(mesh).move(0, np.eye(4))  # Error: only Instances can be moved.
accel = wrt.build(mesh)
accel.closest_hit()  # Error: rays.
accel.closest_hit(rays, rays, tmax=1.0)  # Error: t_max.
accel.closest_hit(rays, rays).normls  # Error: normals.
accel.closest_hit(rays, rays, threads="all")  # Error: a number.
accel.any_hit(rays, rays, counters=True)  # Error: only closest_hit has counters.
accel.any_hit(rays, rays).point  # Error: the result is an array of bool.
accel.refit(mesh.vertices, inplace=True)  # Error: in_place.
accel.save(3)  # Error: a path.
wrt.contains(mesh, rays)  # Error: a structure, not a mesh.
wrt.first_hits(accel, rays, rays)  # Error: k before the rays.
wrt.all_hits(accel, rays, rays).distance  # Error: t.
wrt.DeviceGeometry(rays, wp.zeros(3, dtype=wp.int32))  # Error: Warp arrays.
wrt.render("scenes/whitted.toml", ssp=64)  # Error: spp.
wrt.Camera.look_at((0, 1, 5), (0, 0, 0), fov=0.7)  # Error: fov_y.
wrt.render("scenes/whitted.toml", spp="many")  # Error: a number.
wrt.profile("scenes/whitted.toml", acel="bvh4")  # Error: accel.
wrt.Film().save(3)  # Error: wrt.render makes films.
