"""How the builder of kernels.build.cells splits a cell: RULES is the table of the trees. On the CPU.

- k-d tree: the plane across an axis of least cost by the surface area heuristic (SAH). Wald and Havran 2006, "On building fast kd-Trees for
  Ray Tracing, and on doing that in O(N log N)". The candidates are all faces of the references' boxes; a sweep over the sorted faces finds
  the best. In a cell with more than options.sampled references, only evenly spread ones propose planes and are counted.
- octree: a cell with many primitives is split into eight octants, if that lowers the SAH cost.
- BSP tree: Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". Candidates are the best plane across an axis, as in a k-d tree, the
  planes of options.triangles triangles in the cell, and the planes through their edges at right angles to them. The SAH takes the surface
  areas of both parts of the cell's box, and counts at most COUNTED references.

Computations are in float64, but planes are rounded to float32 before they are tried. So a plane is the same here as in the traversal
(kernels.traverse.planes). The proof there gives the tolerances.
"""

import warp as wp

from wrt.kernels.build.cells import OCTANTS, Cell, CellOptions, CellWork, Rule, Split
from wrt.kernels.build.clip import ZERO, Box, Shapes, areas_of_parts, clip_to_cell, corner_of, meets_cell, triangle_cell
from wrt.kernels.build.records import BuildRecord
from wrt.kernels.structs import bit_count
from wrt.kernels.traverse.plane_layouts import LEAF, PLANE, octant_corner, octree_planes
from wrt.kernels.traverse.planes import SMALLEST
from wrt.kernels.units.box import half_area

LOW = wp.constant(1)  # Bits of CellWork.sides.
HIGH = wp.constant(2)
COUNTED = wp.constant(64)  # BSP tree: largest number of references that a trial of a plane counts, evenly spread.
U = wp.constant(wp.float64(2.0**-24))
OUTWARDS = wp.constant(wp.float64(1.0 + 2.0**-20))  # Factor that outweighs rounding down, in float64 or to float32.
FLAT = wp.constant(wp.float64(2.0**-16))  # A reference lies in a plane if its distance is at most this fraction of its cell's size.
NO_SIZE = wp.constant(wp.float64(1e-200))
NO_AREA = wp.constant(wp.float64(1e-30))  # A triangle with a smaller area, relative to its squared extent, gives no planes.
ALIKE = wp.constant(0.9)  # BSP tree: two planes whose unit normals have a larger dot product cut off nearly the same.


@wp.func
def across_axis(axis: int, position: wp.float64) -> Split:
    """Make a plane across an axis, rounded to float32."""
    split = Split()
    split.normal[axis] = wp.float64(1.0)
    split.offset = wp.float64(float(-position))
    split.axis = axis
    return split


@wp.func
def half_cell(cell: Cell, split: Split, options: CellOptions, k: int) -> Cell:
    """Return the part of a cell below (k = 0) or above a plane, with the box around that part of the cell's box."""
    out = cell
    if split.axis < PLANE:
        if k == 0:
            out.hi[split.axis] = float(-split.offset)
        else:
            out.lo[split.axis] = float(-split.offset)
        out.area = cell.area * (half_area(wp.vec3d(out.hi) - wp.vec3d(out.lo)) / half_area(wp.vec3d(cell.hi) - wp.vec3d(cell.lo)))
        return out
    out.area = cell.area * areas_of_parts(wp.vec3d(cell.lo), wp.vec3d(cell.hi), split.normal, split.offset)[k]
    out.wall_1 = cell.wall_0
    out.wall_0 = wp.vec3(wp.where(k == 0, -split.normal, split.normal))
    # On the side where n . p + d >= 0, coordinate i has n_i p_i >= -(d + the largest sum of the other terms).
    sign = wp.where(k == 0, wp.float64(-1.0), wp.float64(1.0))
    n = sign * split.normal
    lo = wp.vec3d(cell.lo)
    hi = wp.vec3d(cell.hi)
    most = wp.max(wp.cw_mul(n, lo), wp.cw_mul(n, hi))
    total = most[0] + most[1] + most[2] + sign * split.offset + split.pad
    for axis in range(3):
        if wp.abs(n[axis]) > wp.float64(1e-6):
            end = (most[axis] - total) / n[axis]
            if n[axis] > ZERO and end > lo[axis]:
                out.lo[axis] = float(end)
            elif n[axis] < ZERO and end < hi[axis]:
                out.hi[axis] = float(end)
    return out


@wp.func
def clip_to_half(shapes: Shapes, reference: BuildRecord, split: Split, k: int, straddles: bool) -> Box:
    """Return the box of a reference's part below (k = 0) or above a plane."""
    box = Box()
    box.lo = reference.lo
    box.hi = reference.hi
    if straddles:
        normal = wp.vec3d()
        offset = wp.where(k == 0, -split.offset, split.offset)
        if split.axis == PLANE:
            normal = wp.where(k == 0, -split.normal, split.normal)
        elif k == 0:
            box.hi[split.axis] = wp.min(box.hi[split.axis], float(-split.offset))
        else:
            box.lo[split.axis] = wp.max(box.lo[split.axis], float(-split.offset))
        box = clip_to_cell(shapes, reference.prim_id, box.lo, box.hi, normal, offset)
    return box


@wp.func
def extent_on(shapes: Shapes, reference: BuildRecord, split: Split) -> wp.vec2d:
    """Return bounds of the plane's values on a reference: on its box, and on its triangle."""
    if split.axis < PLANE:
        return wp.vec2d(wp.float64(reference.lo[split.axis]) + split.offset, wp.float64(reference.hi[split.axis]) + split.offset)
    lo = wp.vec3d(reference.lo)
    hi = wp.vec3d(reference.hi)
    middle = wp.float64(0.5) * (wp.dot(split.normal, lo) + wp.dot(split.normal, hi)) + split.offset
    reach = wp.float64(0.5) * wp.dot(wp.abs(split.normal), hi - lo)
    out = wp.vec2d(middle - reach, middle + reach)
    if reference.prim_id < shapes.faces.shape[0] and out[0] < -split.pad and out[1] > split.pad:
        a = wp.dot(split.normal, wp.vec3d(corner_of(shapes, reference.prim_id, 0))) + split.offset
        b = wp.dot(split.normal, wp.vec3d(corner_of(shapes, reference.prim_id, 1))) + split.offset
        c = wp.dot(split.normal, wp.vec3d(corner_of(shapes, reference.prim_id, 2))) + split.offset
        out = wp.vec2d(wp.max(out[0], wp.min(wp.min(a, b), c)), wp.min(out[1], wp.max(wp.max(a, b), c)))
    return out


@wp.func
def sides_of(extent: wp.vec2d, split: Split) -> int:
    """Return the sides on which a reference with this result of extent_on is listed; 0: it is in the plane."""
    return wp.where(extent[0] < -split.pad, LOW, 0) | wp.where(extent[1] > split.pad, HIGH, 0)


@wp.func
def marked(shapes: Shapes, work: CellWork, cell: Cell, split: Split) -> Split:
    """Write work.sides of a cell, and return its split; no split, if there would be more than cell.budget references."""
    out = split
    if split.axis == LEAF:
        return out
    n_low = int(0)
    n_high = int(0)
    for i in range(cell.first, cell.first + cell.count):
        sides = sides_of(extent_on(shapes, work.references[i], split), split)
        if sides == 0:
            sides = wp.where(split.low_flat, LOW, HIGH)
        work.sides[i] = wp.uint8(sides)
        n_low += sides & LOW
        n_high += sides >> 1
    if wp.max(n_low, 1) + wp.max(n_high, 1) > cell.budget:
        out.axis = LEAF
    return out


# --- k-d tree ---------------------------------------------------------------------------------------------------------


# Native, because each access to a Warp array would read the array's stride from memory.
@wp.func_native("""
    float* const v = values.data;
    int gap = 1;
    while (gap < n) gap = 9 * gap / 4 + 1;
    while (gap > 1) {
        gap = gap < 6 ? 1 : 4 * gap / 9;
        for (int i = gap; i < n; ++i) {
            const float value = v[i];
            int j = i;
            for (; j >= gap && v[j - gap] > value; j -= gap) v[j] = v[j - gap];
            v[j] = value;
        }
    }
""")
def sort(values: wp.array(dtype=wp.float32), n: int) -> None:
    """Sort values[0] .. values[n - 1]: Shell 1959, "A High-Speed Sorting Procedure", with gaps of a factor 2.25 (Tokuda 1992)."""


@wp.func
def best_across(work: CellWork, cell: Cell, options: CellOptions, limit: wp.float64) -> Split:
    """Return the plane across an axis of least SAH cost, if it costs less than `limit`."""
    best = Split()
    best.axis = LEAF
    best.cost = limit
    e = wp.vec3d(cell.hi) - wp.vec3d(cell.lo)
    step = (cell.count + options.sampled - 1) / options.sampled
    n = (cell.count + step - 1) / step
    scale = options.cost_intersection / half_area(e)
    for axis in range(3):
        for i in range(n):
            reference = work.references[cell.first + i * step]
            work.lows[i] = reference.lo[axis]
            work.highs[i] = reference.hi[axis]
        sort(work.lows, n)
        sort(work.highs, n)
        caps = e[(axis + 1) % 3] * e[(axis + 2) % 3]
        rim = e[(axis + 1) % 3] + e[(axis + 2) % 3]
        left = int(0)  # number of boxes that begin before the plane
        ended = int(0)  # number of boxes that end at the plane or before
        while left < n or ended < n:
            position = work.highs[wp.min(ended, n - 1)]
            if left < n and (ended == n or work.lows[wp.min(left, n - 1)] < position):
                position = work.lows[left]
            while ended < n and work.highs[wp.min(ended, n - 1)] == position:
                ended = ended + 1
            if position > cell.lo[axis] and position < cell.hi[axis]:
                below = wp.float64(position) - wp.float64(cell.lo[axis])
                above = wp.float64(cell.hi[axis]) - wp.float64(position)
                counts = wp.float64(step) * ((below * rim + caps) * wp.float64(left) + (above * rim + caps) * wp.float64(n - ended))
                cost = options.cost_node + scale * counts
                if left == 0 or ended == n:
                    cost = cost * (wp.float64(1.0) - options.empty_bonus)
                if cost < best.cost and step * (wp.max(left, 1) + wp.max(n - ended, 1)) <= cell.budget:
                    best = across_axis(axis, wp.float64(position))
                    best.cost = cost
            while left < n and work.lows[wp.min(left, n - 1)] == position:
                left = left + 1
    return best


@wp.func
def choose_axis(shapes: Shapes, work: CellWork, cell: Cell, options: CellOptions) -> Split:
    """Choose the split of a cell of a k-d tree."""
    best = best_across(work, cell, options, options.cost_intersection * wp.float64(cell.count))
    return marked(shapes, work, cell, best)


# --- octree -----------------------------------------------------------------------------------------------------------


@wp.func
def octants_of_box(lo: wp.vec3, hi: wp.vec3, middle: wp.vec3, end: wp.vec3) -> int:
    """Return the mask of a cell's octants, closed boxes, that the box lo .. hi meets. The box meets the cell; `middle` divides the cell.
    The root's cell ends at `end`, so an upper half that begins there is empty."""
    mask = int(0xFF)
    for axis in range(3):
        upper = wp.where(axis == 0, 0xAA, wp.where(axis == 1, 0xCC, 0xF0))
        if lo[axis] > middle[axis]:
            mask = mask & upper
        elif hi[axis] < middle[axis] or middle[axis] >= end[axis]:
            mask = mask & ~upper
    return mask


@wp.func
def octant(cell: Cell, split: Split, options: CellOptions, k: int) -> Cell:
    """Return octant k of a cell."""
    half = (1 << options.layout.levels) >> (cell.depth + 1)
    out = cell
    out.corner = cell.corner + octant_corner(k, half)
    out.lo = octree_planes(options.layout, out.corner)
    out.hi = octree_planes(options.layout, out.corner + wp.vec3i(half, half, half))
    out.area = half_area(wp.vec3d(out.hi) - wp.vec3d(out.lo))
    return out


@wp.func
def whole_reference(shapes: Shapes, reference: BuildRecord, split: Split, k: int, straddles: bool) -> Box:
    box = Box()
    box.lo = reference.lo
    box.hi = reference.hi
    return box


@wp.func
def choose_octants(shapes: Shapes, work: CellWork, cell: Cell, options: CellOptions) -> Split:
    """List each reference in the octants that its primitive meets. With by_cost, octants must cost a ray less than the cell as a leaf."""
    split = Split()
    split.axis = OCTANTS
    half = (1 << options.layout.levels) >> (cell.depth + 1)
    middle = octree_planes(options.layout, cell.corner + wp.vec3i(half, half, half))
    total = int(0)
    cost = ZERO
    for i in range(cell.first, cell.first + cell.count):
        reference = work.references[i]
        mask = octants_of_box(reference.lo, reference.hi, middle, options.layout.hi)
        if reference.prim_id < shapes.faces.shape[0] and (mask & (mask - 1)) != 0:
            triangle = triangle_cell(shapes, reference.prim_id)
            met = int(0)
            for k in range(8):
                if (mask >> k) & 1 != 0:
                    part = octant(cell, split, options, k)
                    if meets_cell(triangle, part.lo, part.hi):
                        met = met | (1 << k)
            mask = met
        work.sides[i] = wp.uint8(mask)
        total += bit_count(mask)
    for k in range(8):
        count = int(0)
        for i in range(cell.first, cell.first + cell.count):
            count += (int(work.sides[i]) >> k) & 1
        if count > 0:
            cost += octant(cell, split, options, k).area * wp.float64(count + 1)
    if total > cell.budget or (options.by_cost != 0 and not cost < cell.area * wp.float64(cell.count)):
        split.axis = LEAF
    return split


# --- BSP tree ---------------------------------------------------------------------------------------------------------


@wp.func
def plane_noise(split: Split, cell: Cell) -> wp.float64:
    """Return the sum of |normal[i]| times the largest |coordinate i|, plus |offset|: rounding errors are proportional to it."""
    far = wp.max(wp.abs(wp.vec3d(cell.lo)), wp.abs(wp.vec3d(cell.hi)))
    return wp.dot(wp.abs(split.normal), far) + wp.abs(split.offset)


@wp.func
def pad_of(cell: Cell, split: Split) -> wp.float64:
    """Return Split.pad. A ray within a plane's tolerance visits both sides, so cutting off a thinner sliver saves nothing."""
    return wp.max(FLAT * wp.float64(wp.max(cell.hi - cell.lo)), wp.float64(2.0) * U * plane_noise(split, cell))


@wp.func
def cheaper(shapes: Shapes, work: CellWork, cell: Cell, options: CellOptions, trial: Split, best: Split) -> Split:
    """Compute the cost of a trial split of a cell, and return the cheaper of `trial` and `best`. Stop once the cost reaches best.cost."""
    shares = areas_of_parts(wp.vec3d(cell.lo), wp.vec3d(cell.hi), trial.normal, trial.offset)
    if shares[0] == ZERO:
        return best
    trial.pad = pad_of(cell, trial)
    step = (cell.count + COUNTED - 1) / COUNTED
    below = options.cost_intersection * wp.float64(step) * shares[0]
    above = options.cost_intersection * wp.float64(step) * shares[1]
    least = wp.min(below, above)
    cost = options.cost_node + least * wp.float64((cell.count + step - 1) / step)
    only_low = int(0)
    only_high = int(0)
    for i in range(cell.first, cell.first + cell.count, step):
        sides = sides_of(extent_on(shapes, work.references[i], trial), trial)
        if sides == LOW | HIGH:
            cost += below + above - least
        elif sides == LOW:
            cost += below - least
            only_low += 1
        elif sides == HIGH:
            cost += above - least
            only_high += 1
        if cost >= best.cost:
            return best
    trial.low_flat = below <= above
    # The box does not show what an earlier plane has cut off, so such a plane cuts off nothing more.
    n = wp.vec3(trial.normal)
    nearest = wp.dot(n, cell.wall_0)
    other = wp.dot(n, cell.wall_1)
    if (only_low == 0 and wp.max(nearest, other) > ALIKE) or (only_high == 0 and wp.min(nearest, other) < -ALIKE):
        return best
    trial.cost = cost
    return trial


@wp.func
def plane_through(n: wp.vec3d, p: wp.vec3d) -> Split:
    """Make the plane through p with the normal n, which must not be 0; round it to float32."""
    split = Split()
    unit = wp.normalize(n)
    split.normal = wp.vec3d(wp.vec3(unit))
    split.offset = wp.float64(float(-wp.dot(split.normal, p)))
    split.axis = PLANE
    return split


@wp.func
def best_plane(shapes: Shapes, work: CellWork, cell: Cell, options: CellOptions, best: Split) -> Split:
    """Return the cheapest of `best` and the planes through face and edges of options.triangles triangles, spread evenly over the cell."""
    out = best
    tried = wp.min(cell.count, options.triangles)
    for k in range(tried):
        prim_id = work.references[cell.first + int((wp.int64(k) * wp.int64(cell.count)) / wp.int64(tried))].prim_id
        if prim_id >= shapes.faces.shape[0]:
            continue
        a = wp.vec3d(corner_of(shapes, prim_id, 0))
        b = wp.vec3d(corner_of(shapes, prim_id, 1))
        c = wp.vec3d(corner_of(shapes, prim_id, 2))
        # Scale the triangle to extent 1, so that no product over- or underflows.
        scale = wp.float64(1.0) / wp.max(wp.max(wp.max(wp.max(a, b), c) - wp.min(wp.min(a, b), c)), NO_SIZE)
        edge_0 = (b - a) * scale
        edge_1 = (c - b) * scale
        normal = wp.cross(edge_0, edge_1)
        length = wp.length(normal)
        if not length > NO_AREA:
            continue
        normal = normal / length
        for side in range(4):
            n_plane = normal
            if side > 0:
                edge = wp.where(side == 1, edge_0, wp.where(side == 2, edge_1, -edge_0 - edge_1))
                if not wp.dot(edge, edge) > NO_AREA:
                    continue
                n_plane = wp.cross(normal, edge)
            trial = plane_through(n_plane, wp.where(side == 2, b, wp.where(side == 3, c, a)))
            if wp.max(wp.abs(trial.normal)) < wp.float64(1.0):
                out = cheaper(shapes, work, cell, options, trial, out)
    return out


@wp.func
def choose_plane(shapes: Shapes, work: CellWork, cell: Cell, options: CellOptions) -> Split:
    """Choose the split of a cell of a BSP tree."""
    best = best_across(work, cell, options, options.cost_intersection * wp.float64(cell.count))
    best.pad = pad_of(cell, best)
    best = best_plane(shapes, work, cell, options, best)
    # BspNode.tolerance: the builder's share, and the terms without D of the proof. 14 is 8 sqrt(3) rounded up.
    extent = wp.vec3()
    for i in range(cell.first, cell.first + cell.count):
        prim_id = work.references[i].prim_id
        extent = wp.max(extent, shapes.hi[prim_id] - shapes.lo[prim_id])
    noise = wp.float64(14.0) * wp.float64(wp.max(extent)) + wp.float64(4.0) * plane_noise(best, cell)
    best.tolerance = float((best.pad + U * noise) * OUTWARDS) + SMALLEST
    return marked(shapes, work, cell, best)


RULES = {
    "kdtree": Rule(2, True, choose_axis, half_cell, clip_to_half),
    "octree": Rule(8, False, choose_octants, octant, whole_reference),
    "bsp": Rule(2, False, choose_plane, half_cell, clip_to_half),
}
