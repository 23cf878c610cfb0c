"""Boxes around all that light passes through, for kernels.shade.clear: shadow rays elsewhere need no closest hit."""

from __future__ import annotations

import numpy as np
import warp as wp

from wrt.accel.bvh.tree import half_areas
from wrt.accel.flatten import World
from wrt.accel.geometry import Geometry
from wrt.core.device import upload
from wrt.kernels.shade.clear import BOXES
from wrt.renderer.plan import Plan
from wrt.renderer.upload import DeviceScene
from wrt.scene.materials import Material

MOST_MET = 0.5  # share of the rays through a scene that meet a box: beyond, it is not worth asking


def put_clear_boxes(arrays: DeviceScene, plan: Plan) -> None:
    """To arrays.lighting, where the plan's kernels ask for them. Of other triangle tests than the watertight one it is not known
    that no hit is outside its padded box."""
    if plan.by_waves:
        boxes = np.empty((6, 0), np.float32)
        if plan.features.transparent_shadows and plan.options.triangle == "watertight":
            boxes = clear_boxes(arrays.world, np.array([lets_through(material) for material in plan.scene.materials]))
        arrays.lighting.clear = upload(boxes.ravel(), wp.float32, "cpu")


def lets_through(material: Material) -> bool:
    """Whether light may go straight through: what kernels.shade.shadows.is_opaque is not."""
    return material.is_clear or material.alpha_mode == "blend"


def clear_boxes(world: World, clear: np.ndarray) -> np.ndarray:
    """(6, BOXES) float32: x, y and z of the lowest corners, then of the highest; those that are not needed are empty (inf, -inf).
    clear: (M,) bool, the materials that light passes through.

    (6, 0), which says nothing, where none does, where meshes are instances, or where most rays would meet a box. A ray that meets a
    box by kernels.units.box.ray_aabb is found; primitives' boxes are padded as a structure's are.
    """
    nothing = np.empty((6, 0), np.float32)
    if not isinstance(world.geometry, Geometry):
        return nothing
    prim_id, n = np.flatnonzero(clear[world.prim_material]), world.geometry.n_triangles
    if len(prim_id) == 0:
        return nothing
    spheres = world.geometry.spheres
    low, high = Geometry(world.vertices, world.faces[prim_id[prim_id < n]], spheres[prim_id[prim_id >= n] - n]).bounds()
    out = np.concatenate([np.full((3, BOXES), np.inf, np.float32), np.full((3, BOXES), -np.inf, np.float32)])
    for i, rows in enumerate(split(low, high)):
        out[:3, i], out[3:, i] = low[rows].min(axis=0), high[rows].max(axis=0)
    ends = [low, high, world.vertices, spheres[:, :3] - spheres[:, 3:], spheres[:, :3] + spheres[:, 3:]]
    lowest, highest = (np.array([end([end(points[:, axis]) for points in ends if len(points)]) for axis in range(3)])
                       for end in (np.min, np.max))  # of rows of three, axis=0 is slow
    return nothing if half_areas(out[:3].T, out[3:].T).sum() > MOST_MET * half_areas(lowest, highest) else out


def split(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Rows of the boxes (N, 3) in at most BOXES groups: that with the largest box is halved at the middle of its longest axis, over
    and over."""
    middle = 0.5 * low.astype(np.float64) + 0.5 * high
    groups = [np.arange(len(low))]
    sizes = [1.0]
    while len(groups) < BOXES and max(sizes) > 0.0:
        largest = int(np.argmax(sizes))
        rows = groups[largest]
        extent = np.ptp(middle[rows], axis=0)
        along = middle[rows, int(np.argmax(extent))]
        left = along < 0.5 * (along.min() + along.max())
        if not left.any() or left.all():
            sizes[largest] = 0.0
            continue
        halves = [rows[left], rows[~left]]
        groups[largest : largest + 1] = halves
        sizes[largest : largest + 1] = [float(half_areas(low[half].min(axis=0), high[half].max(axis=0))) for half in halves]
    return groups
