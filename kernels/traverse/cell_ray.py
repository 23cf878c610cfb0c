"""Margins of a walk through the cells of a grid or octree. A cell lists triangles that meet it, not all triangles whose boxes meet it.

Before clamping, a hit is on its triangle, except for the triangle's pad and a few roundings. So it is in a cell that lists the triangle.
Then t is clamped to the interval of the triangle's box (kernels.units.triangle.within_bounds). This moves the hit by up to the pad at right
angles to a face of the box. On a grazing ray, that is a long way along the ray. So the final hit lies up to `cell_slack` before or behind
the cells that list its triangle. The walk begins by cell_slack before t_min, and continues by cell_slack behind its best hit.
"""

import warp as wp

from wrt.kernels.units.box import FAR_PAD, BoxRay


@wp.func
def later(t: float) -> float:
    """Return an upper bound of the exact distance whose rounded value is t (see kernels.units.box.FAR_PAD). Any sign; monotone."""
    return wp.max(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def earlier(t: float) -> float:
    """Return a lower bound of the exact distance whose rounded value is t; see `later`."""
    return wp.min(t * FAR_PAD, t * wp.static(2.0 - float(FAR_PAD)))


@wp.func
def cell_slack(ray: BoxRay, pad: float, extent: float) -> float:
    """Return a bound on the change of t by clamping. pad: largest pad of a triangle's box; extent: largest extent of a triangle's box.
    Axes with an infinite reciprocal direction do not change t."""
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
