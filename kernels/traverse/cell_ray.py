"""What a ray must allow for in a structure that lists a triangle only in the cells that the triangle itself meets.

The point at the t of the triangle unit is on the triangle, but for its pad and a few roundings of t: it is in a cell that lists
the triangle. Only then is t moved into the interval of the triangle's box (kernels.units.triangle.within_bounds), by up to the
pad across the direction, which on a grazing ray is a long way along it. So a hit may be told to lie up to `cell_slack` before
or behind the cells that list it, and a walk goes on so far behind its best hit, and begins so far before t_min.
"""

import warp as wp

from wrt.kernels.units.box import FAR_PAD, BoxRay


@wp.func
def later(t: float) -> float:
    """t, not smaller for any rounding of plane distances (kernels.units.box.FAR_PAD), whatever its sign. Monotone; NaN stays."""
    return wp.max(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def earlier(t: float) -> float:
    """t, not larger, in the same way."""
    return wp.min(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def cell_slack(ray: BoxRay, pad: float, extent: float) -> float:
    """How far t may be moved along this ray: across the largest pad of any triangle, but within the largest box of any.

    A component of the direction whose reciprocal is infinite moves nothing.
    """
    steep = float(wp.inf)
    grazing = float(0.0)
    for axis in range(3):
        inverse = wp.abs(ray.inv_dir[axis])
        steep = wp.min(steep, inverse)
        if inverse < wp.inf:
            grazing = wp.max(grazing, inverse)
    return wp.min(2.0 * pad * grazing, 2.0 * extent * steep)


@wp.func
def parallel(ray: BoxRay, axis: int) -> bool:
    """Whether no plane across this axis is ever crossed."""
    return wp.isinf(ray.inv_dir[axis])
