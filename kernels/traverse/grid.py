"""Traversal of the uniform grid: a step from cell to cell along the ray (3D-DDA).
Amanatides and Woo 1987, "A Fast Voxel Traversal Algorithm for Ray Tracing", changed to lose no ray. The distance to each plane is computed
from the plane's coordinate, so that errors do not accumulate. A ray that leaves a cell near an edge or corner, within rounding, also visits
the other cells at the edge or corner. The walk visits exactly the cells that the conservative box test would enter, once each.

**Margins.** A cell lists the triangles that meet it, not all triangles whose boxes meet it. Before clamping, a hit is on its triangle,
except for the triangle's pad and a few roundings. So it is in a cell that lists the triangle. Then t is clamped to the interval of the
triangle's box (kernels.units.triangle.within_bounds). This moves the hit by up to the pad at right angles to a face of the box. That is far
along a grazing ray. So the final hit lies up to `cell_slack` before or behind the cells that list its triangle. The walk begins by
cell_slack before t_min, and continues by cell_slack behind its best hit."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import Mailbox, make_mailbox_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer
from wrt.kernels.traverse.steps import INNER, cell_step
from wrt.kernels.units.box import FAR_PAD, BoxRay, slab_interval


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


@wp.struct
class GridCell:
    """A cell. It lists the primitives references[first] .. references[first + count - 1]."""

    first: int
    count: int


@wp.struct
class GridLayout:
    """A grid of cells from lo to hi with n cells along each axis. Except for rounding, each cell has the edges `size`."""

    lo: wp.vec3
    hi: wp.vec3
    size: wp.vec3
    n: wp.vec3i


@wp.func
def grid_plane(layout: GridLayout, axis: int, i: int) -> float:
    """Return the coordinate of plane i (0 .. n) across an axis; monotone in i. Builder and traversal share this function."""
    return wp.where(i >= layout.n[axis], layout.hi[axis], layout.lo[axis] + float(i) * layout.size[axis])


@wp.func
def guessed_slab(layout: GridLayout, axis: int, x: float) -> int:
    """Return the approximate index of the slab (layer of cells) that contains x. An exact search can begin there."""
    guess = (x - layout.lo[axis]) / layout.size[axis]
    return int(wp.where(guess > 0.0, wp.min(guess, float(layout.n[axis] - 1)), 0.0))


@wp.func
def slab_of(layout: GridLayout, axis: int, x: float) -> int:
    """Return the index of the lowest slab that contains x. Slabs are closed: the plane between two slabs belongs to both."""
    slab = guessed_slab(layout, axis, x)
    while slab < layout.n[axis] - 1 and grid_plane(layout, axis, slab + 1) < x:
        slab += 1
    while slab > 0 and grid_plane(layout, axis, slab) >= x:
        slab -= 1
    return slab


@wp.func
def exit_distance(layout: GridLayout, ray: BoxRay, axis: int, cell: int) -> float:
    """Return t where the ray leaves slab `cell` of an axis; inf if the ray is parallel to the slab."""
    plane = grid_plane(layout, axis, wp.where(ray.inv_dir[axis] < 0.0, cell, cell + 1))
    return wp.where(parallel(ray, axis), float(wp.inf), (plane - ray.origin[axis]) * ray.inv_dir[axis])


@wp.func
def first_slab(layout: GridLayout, ray: BoxRay, direction: wp.vec3, axis: int, t: float) -> int:
    """Return the first slab along the ray that the ray may not have left at t. For a ray parallel to the slabs: slab_of its origin."""
    last = layout.n[axis] - 1
    if parallel(ray, axis):
        return slab_of(layout, axis, ray.origin[axis])
    slab = guessed_slab(layout, axis, ray.origin[axis] + t * direction[axis])
    step = wp.where(ray.inv_dir[axis] < 0.0, -1, 1)
    begin = wp.where(step < 0, last, 0)
    while slab != last - begin and later(exit_distance(layout, ray, axis, slab)) < t:
        slab += step
    while slab != begin and later(exit_distance(layout, ray, axis, slab - step)) >= t:
        slab -= step
    return slab


@wp.func
def slabs_left(layout: GridLayout, ray: BoxRay, axis: int, slab: int, t_exit: float, limit: float) -> int:
    """Return the number of slabs behind `slab` that the ray enters at t <= limit. t_exit: t where the ray leaves `slab`."""
    n = int(0)
    step = wp.where(ray.inv_dir[axis] < 0.0, -1, 1)
    while t_exit <= limit and slab + step >= 0 and slab + step < layout.n[axis]:
        slab += step
        n += 1
        t_exit = exit_distance(layout, ray, axis, slab)
    return n


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type, for primitives stored as `record` in the order of prim_id."""

    @wp.struct
    class Grid:
        lo: wp.vec3  # lo, hi, size, n: the GridLayout.
        hi: wp.vec3
        size: wp.vec3
        n: wp.vec3i
        pad: float  # Largest pad of a triangle's box.
        extent: float  # Largest extent of a triangle's box.
        mailbox: int  # 1: use a mailbox (kernels.traverse.leaf); 0: do not.
        cells: wp.array(dtype=GridCell)  # Cell (x, y, z) has the index x + n[0] * (y + n[1] * z).
        references: wp.array(dtype=wp.int32)  # Indices into `primitives`.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Grid


@wp.func
def layout_of(accel: Any) -> GridLayout:
    layout = GridLayout()
    layout.lo = accel.lo
    layout.hi = accel.hi
    layout.size = accel.size
    layout.n = accel.n
    return layout


def make_observe_cell(units: Units) -> Any:
    """Make observe_cell(recorder, ray, layout, index, t, t_end): the ray is in cell `index` from t to t_end."""
    observe = make_observer(units, size_of(GridCell))

    @wp.func
    def observe_cell(recorder: Recorder, ray: Ray, layout: GridLayout, index: int, t: float, t_end: float):
        observe.node(recorder, ray, index, 0, 1)
        if wp.static(units.observer == "log"):
            cell = wp.vec3i(index % layout.n[0], (index / layout.n[0]) % layout.n[1], index / (layout.n[0] * layout.n[1]))
            lo = wp.vec3()
            hi = wp.vec3()
            for axis in range(3):
                lo[axis] = grid_plane(layout, axis, cell[axis])
                hi[axis] = grid_plane(layout, axis, cell[axis] + 1)
            observe.step(recorder, ray, cell_step(index, INNER, lo, hi, t, t_end))

    return observe_cell


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
    probe_of = make_probe(units)
    visit_leaf = make_mailbox_leaf(units, any_hit, accepts)
    observe, observe_cell = make_observer(units, 0), make_observe_cell(units)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        layout = layout_of(accel)
        slack = cell_slack(probe.box, accel.pad, accel.extent)
        interval = slab_interval(probe.box, layout.lo, layout.hi)
        t_in = wp.max(interval[0], earlier(ray.t_min) - slack)
        observe.step(accel.recorder, ray, cell_step(INNER, INNER, layout.lo, layout.hi, t_in, later(interval[1])))
        if not (t_in <= later(interval[1]) and t_in < wp.inf):
            return observe.finish(accel.recorder, ray, best)
        slab = wp.vec3i()
        step = wp.vec3i()
        t_next = wp.vec3()
        for axis in range(3):
            slab[axis] = first_slab(layout, probe.box, ray.direction, axis, t_in)
            step[axis] = wp.where(probe.box.inv_dir[axis] < 0.0, -1, 1)
            t_next[axis] = exit_distance(layout, probe.box, axis, slab[axis])
        stride = wp.vec3i(1, layout.n[0], layout.n[0] * layout.n[1])
        mailbox = Mailbox()

        while t_in <= later(best.t) + slack:
            axis = wp.where(t_next[0] <= t_next[1], wp.where(t_next[0] <= t_next[2], 0, 2), wp.where(t_next[1] <= t_next[2], 1, 2))
            side = wp.where(axis == 2, 0, axis + 1)
            other = wp.where(axis == 0, 2, axis - 1)
            t_out = t_next[axis]
            # If the ray may leave slabs of the other two axes at the same t, the next cells on these axes are visited with this cell.
            limit = wp.where(t_out < wp.inf, later(t_out), float(-wp.inf))
            side_slabs = slabs_left(layout, probe.box, side, slab[side], t_next[side], limit)
            other_slabs = slabs_left(layout, probe.box, other, slab[other], t_next[other], limit)
            corner = slab[0] + slab[1] * stride[1] + slab[2] * stride[2]
            for k in range((side_slabs + 1) * (other_slabs + 1)):
                index = (corner + (k % (side_slabs + 1)) * step[side] * stride[side]
                         + (k / (side_slabs + 1)) * step[other] * stride[other])
                cell = accel.cells[index]
                observe_cell(accel.recorder, ray, layout, index, t_in, t_out)
                mailbox, best = visit_leaf(accel, surfaces, probe, cell, mailbox, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        return observe.finish(accel.recorder, ray, best)
            slab[axis] = slab[axis] + step[axis]
            if slab[axis] < 0 or slab[axis] >= layout.n[axis]:
                break
            t_in = t_out
            t_next[axis] = exit_distance(layout, probe.box, axis, slab[axis])
        return observe.finish(accel.recorder, ray, best)

    return traverse
