"""A triangle test with its own record in memory: Moeller-Trumbore with a stored normal, which saves a cross product per test.

docs/extending.md links to this file, and tests/test_extending.py builds structures with this test.
"""

import numpy as np
import warp as wp

from wrt.accel.geometry import LAYOUTS
from wrt.kernels.structs import Hit, Ray
from wrt.kernels.units.box import BoxRay
from wrt.kernels.units.triangle import RAY_TRIANGLE, TriangleRay, TriangleTest, no_triangle


@wp.struct
class NormalPrimitive:
    prim_id: int
    corner: wp.vec3
    edge_1: wp.vec3
    edge_2: wp.vec3
    normal: wp.vec3


@wp.func
def stored_normal(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: NormalPrimitive) -> Hit:
    slope = -wp.dot(ray.direction, triangle.normal)
    if slope == 0.0:
        return no_triangle()
    inverse = 1.0 / slope
    s = ray.origin - triangle.corner
    r = wp.cross(s, ray.direction)
    hit = Hit()
    hit.t = wp.dot(s, triangle.normal) * inverse
    hit.u = wp.dot(triangle.edge_2, r) * inverse
    hit.v = -wp.dot(triangle.edge_1, r) * inverse
    if not (hit.u >= 0.0 and hit.v >= 0.0 and hit.u + hit.v <= 1.0):
        return no_triangle()
    return hit


def with_normal(record, v0, v1, v2):
    record["corner"], record["edge_1"], record["edge_2"] = v0, v1 - v0, v2 - v0
    record["normal"] = np.cross(record["edge_1"], record["edge_2"])


LAYOUTS["with_normal"] = with_normal
RAY_TRIANGLE["stored_normal"] = TriangleTest(stored_normal, NormalPrimitive, "with_normal")
