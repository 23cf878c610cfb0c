"""Classify watertight triangle tests by the arithmetic that decides them on a GPU: float32, float-float or float64."""

import warp as wp

from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.structs import NO_HIT, Primitive, kernel
from wrt.kernels.units.triangle import edge_areas, outside, sure_crossing, to_ray_space, triangle_ray

REFUSED, SURE, HARD = 0, 1, 2  # rejected in float32; hit computed in float-float arithmetic; decided in float64


@kernel
def classify(primitives: wp.array(dtype=Primitive), rays: RayArrays, ray: wp.array(dtype=wp.int32),
             primitive: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)):
    """Store how the test of ray ray[i] against record primitive[i] is decided: REFUSED, SURE or HARD."""
    i = wp.tid()
    tested = load_ray(rays, ray[i])
    shear = triangle_ray(tested)
    corners = primitives[primitive[i]]
    a = to_ray_space(corners.v0 - tested.origin, shear)
    b = to_ray_space(corners.v1 - tested.origin, shear)
    c = to_ray_space(corners.v2 - tested.origin, shear)
    answer = int(HARD)
    if outside(edge_areas(a, b, c)):
        answer = int(REFUSED)
    elif sure_crossing(a, b, c, shear.shear_z).prim_id != NO_HIT:
        answer = int(SURE)
    out[i] = answer
