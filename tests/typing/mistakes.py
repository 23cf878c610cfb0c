"""Calls that type checkers refuse: each line with `error` has one, whatever its text; never run."""

from __future__ import annotations

import numpy as np
import warp as wp

import wrt
from wrt.scene.shapes import box

rays = np.zeros((1, 3))
mesh = box()
wrt.build(mesh, bulder="sbvh")  # error: no such option
wrt.build(mesh, "bvh8", max_leaf="four")  # error: a number
wrt.build(mesh, 8)  # error: a name
wrt.build(3.0)  # error: no mesh
wrt.build(mesh).move(0, np.eye(4))  # error: only Instances can be moved
accel = wrt.build(mesh)
accel.closest_hit(rays)  # error: no directions
accel.closest_hit(rays, rays, tmax=1.0)  # error: t_max
accel.closest_hit(rays, rays).distance  # error: no such property
accel.closest_hit(rays, rays, threads="all")  # error: a number
accel.any_hit(rays, rays, counters=True)  # error: closest_hit counts
accel.any_hit(rays, rays).point  # error: an array of bool
accel.refit(mesh.vertices, inplace=True)  # error: in_place
accel.save(3)  # error: a path
wrt.contains(mesh, rays)  # error: a structure, not a mesh
wrt.first_hits(accel, rays, rays)  # error: k comes first
wrt.all_hits(accel, rays, rays).distance  # error: t
wrt.DeviceGeometry(rays, wp.zeros(3, dtype=wp.int32))  # error: Warp arrays
wrt.render("scenes/whitted.toml", ssp=64)  # error: spp
wrt.render("scenes/whitted.toml", spp="many")  # error: a number
wrt.profile("scenes/whitted.toml", acel="bvh4")  # error: accel
wrt.Film().save(3)  # error: a film comes from render
