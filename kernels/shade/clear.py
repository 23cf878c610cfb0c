"""Which shadow rays can meet a surface that light passes through.

For all others one any-hit query tells as much as the closest hit: dark, or nothing in between. What light passes through is kept in
a few boxes (wrt.renderer.clear_boxes).
"""

import warp as wp

from wrt.kernels.memory import number_at
from wrt.kernels.structs import Lighting, Ray
from wrt.kernels.units.box import FAR_PAD, box_ray

BOXES = wp.constant(16)  # with 32 or 64, which hold less air, pictures of a kitchen take 1.01 to 1.03 times as long


@wp.func
def slab(lo: float, hi: float, origin: float, inverse: float) -> tuple[float, float]:
    """Where a line enters and leaves; NaN where it lies in a face."""
    return (wp.where(inverse < 0.0, hi, lo) - origin) * inverse, (wp.where(inverse < 0.0, lo, hi) - origin) * inverse


@wp.func
def may_pass(lighting: Lighting, ray: Ray) -> bool:
    """Whether a ray meets one of the boxes between t = 0 and t_max: kernels.units.box.ray_aabb, in lanes of boxes. True where they
    are not known."""
    boxes = lighting.clear
    if boxes.shape[0] == 0:
        return True
    line = box_ray(ray)
    met = int(0)
    k = int(0)
    while k < BOXES:
        enter_x, leave_x = slab(number_at(boxes, k), number_at(boxes, 3 * BOXES + k), line.origin[0], line.inv_dir[0])
        enter_y, leave_y = slab(number_at(boxes, BOXES + k), number_at(boxes, 4 * BOXES + k), line.origin[1], line.inv_dir[1])
        enter_z, leave_z = slab(number_at(boxes, 2 * BOXES + k), number_at(boxes, 5 * BOXES + k), line.origin[2], line.inv_dir[2])
        enter = wp.where(enter_x > 0.0, enter_x, 0.0)
        enter = wp.where(enter_y > enter, enter_y, enter)
        enter = wp.where(enter_z > enter, enter_z, enter)
        leave = wp.where(leave_x < wp.inf, leave_x, float(wp.inf))
        leave = wp.where(leave_y < leave, leave_y, leave)
        leave = wp.where(leave_z < leave, leave_z, leave) * FAR_PAD
        met += wp.where(enter <= wp.where(leave < ray.t_max, leave, ray.t_max), 1, 0)
        k += 1
    return met > 0
