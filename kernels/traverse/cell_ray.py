"""Margins of a walk through cells that list a triangle only where the triangle itself is.

The point at the triangle unit's t is on the triangle, but for its pad and a few roundings: it is in a cell that lists the triangle. Then t
is clamped to the interval of the triangle's box (kernels.units.triangle.within_bounds). That moves it by up to the pad across the
direction, which on a grazing ray is a long way along it. So a reported hit lies up to `cell_slack` before or behind the cells that list
it. The walk begins as far before t_min, and goes on as far behind its best hit.
"""

import warp as wp

from wrt.kernels.units.box import FAR_PAD, BoxRay


@wp.func
def later(t: float) -> float:
    """Upper bound of t over the rounding of plane distances (kernels.units.box.FAR_PAD), for any sign. Monotone; NaN stays."""
    return wp.max(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def earlier(t: float) -> float:
    """Lower bound of t over the same rounding."""
    return wp.min(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def cell_slack(ray: BoxRay, pad: float, extent: float) -> float:
    """Distance along this ray by which the clamp may move t: across the largest pad of any triangle, within the largest box of any. A
    component of the direction whose reciprocal is infinite moves nothing."""
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
    """Test whether the ray crosses no plane across this axis."""
    return wp.isinf(ray.inv_dir[axis])
