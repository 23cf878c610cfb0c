"""The BSP builder's search for a split, on the CPU: planes through faces and edges, and planes across an axis.

Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". One kind of candidates are the planes of triangles in the cell, and the planes
through their edges at right angles to the triangles. The other kind are planes across an axis at the ends of pieces. The surface area
heuristic chooses, with the surface areas of both parts of the convex cell. Triangles are clipped to their cells.

Computations are in float64, but planes are rounded to float32 before they are tried. So a plane is the same here as in the traversal
(kernels.traverse.bsp). The proof there gives the tolerances.
"""

import warp as wp

from wrt.kernels.build.bsp_cell import Cells, plane_side, split_areas
from wrt.kernels.traverse.bsp import PLANE, SMALLEST

EXACT = wp.constant(24)  # In a cell of at most EXACT pieces, planes across an axis are tried at both ends of each piece.
STEPS = wp.constant(32)  # In a larger cell, such planes are tried at STEPS equal steps.
U = wp.constant(wp.float64(2.0**-24))
OUTWARDS = wp.constant(wp.float64(1.0 + 2.0**-20))  # Factor that outweighs rounding down, in float64 or to float32.
FLAT = wp.constant(wp.float64(2.0**-16))  # A piece lies in a plane if its distance is at most this fraction of its cell's size.
NO_SIZE = wp.constant(wp.float64(1e-200))
NO_AREA = wp.constant(wp.float64(1e-30))  # A triangle with a smaller area, relative to its squared extent, gives no planes.


@wp.struct
class Pieces:
    """Primitives clipped to cells: convex polygons, or whole spheres."""

    prim_id: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)  # The polygon of piece i is points[first[i]] .. points[first[i] + count[i] - 1].
    count: wp.array(dtype=wp.int32)  # Number of corners; 0 for a sphere.
    lo: wp.array(dtype=wp.vec3d)  # lo, hi: box of the piece.
    hi: wp.array(dtype=wp.vec3d)
    ball: wp.array(dtype=wp.vec4d)  # A sphere around the piece: (center, radius).
    extent: wp.array(dtype=wp.float64)  # Largest extent of the whole primitive along an axis.
    points: wp.array(dtype=wp.vec3d)


@wp.struct
class BspOptions:
    """Limits and SAH costs of the builder."""

    cost_intersection: wp.float64  # Cost of a primitive.
    cost_axis: wp.float64  # Cost of a node whose plane is across an axis.
    cost_plane: wp.float64  # Cost of a node with any other plane.
    samples: int  # Number of triangles per cell whose planes are tried.
    max_depth: int
    keep: int  # If not 0: cells with at most `keep` pieces are deferred to later launches.
    lo: wp.vec3d  # lo, hi: the root box.
    hi: wp.vec3d


@wp.struct
class BspTools:
    """Arrays and options for the trial of splits."""

    pieces: Pieces
    cells: Cells
    corners: wp.array(dtype=wp.vec3d)  # Triangle i has the corners 3 i, 3 i + 1, 3 i + 2.
    options: BspOptions


@wp.struct
class BspSplit:
    """The plane of the points p with `normal` . p + `offset` = 0, and its SAH cost."""

    normal: wp.vec3d
    offset: wp.float64
    axis: int  # As BspNode.axis.
    pad: wp.float64  # A piece that extends beyond the plane by at most `pad` is not listed on that side.
    low_flat: bool  # True: pieces in the plane are listed below the plane; False: above it.
    cost: wp.float64


@wp.struct
class Scope:
    """A cell to split. It contains the pieces begin .. end - 1."""

    begin: int
    end: int
    lo: wp.vec3d  # lo, hi: box of the pieces.
    hi: wp.vec3d
    far: wp.vec3d  # Largest absolute coordinate of a piece on each axis.
    extent: wp.float64  # Largest extent of a piece's whole primitive along an axis.
    slot: int  # Slot of the cell in `Cells`.
    area: wp.float64  # Surface area of the cell.
    budget: int  # As BspTask.budget.


@wp.func
def plane_noise(split: BspSplit, far: wp.vec3d) -> wp.float64:
    """Return the sum of |normal[i]| far[i] over i, plus |offset|. Rounding errors of the plane and its values are proportional to it."""
    return wp.dot(wp.abs(split.normal), far) + wp.abs(split.offset)


@wp.func
def plane_tolerance(split: BspSplit, scope: Scope) -> float:
    """Return BspNode.tolerance: split.pad + 14 u scope.extent + 4 u plane_noise, rounded up. u = 2^-24; 14 is 8 sqrt(3) rounded up."""
    noise = plane_noise(split, scope.far)
    total = split.pad + wp.float64(14.0) * U * scope.extent + wp.float64(4.0) * U * noise
    return float(total * OUTWARDS) + SMALLEST


@wp.func
def extent_on(pieces: Pieces, i: int, split: BspSplit) -> wp.vec2d:
    """Return the lowest and the highest value of the plane on piece i, as far as `sides_of` needs them: the sphere `ball` may suffice."""
    if split.axis < wp.static(PLANE):
        return wp.vec2d(pieces.lo[i][split.axis] + split.offset, pieces.hi[i][split.axis] + split.offset)
    ball = pieces.ball[i]
    s = plane_side(split.normal, split.offset, wp.vec3d(ball[0], ball[1], ball[2]))
    low = s - ball[3]
    high = s + ball[3]
    count = pieces.count[i]
    if low >= -split.pad or high <= split.pad or count == 0:
        return wp.vec2d(low, high)
    first = pieces.first[i]
    low = plane_side(split.normal, split.offset, pieces.points[first])
    high = low
    for k in range(first + 1, first + count):
        s = plane_side(split.normal, split.offset, pieces.points[k])
        low = wp.min(low, s)
        high = wp.max(high, s)
        if low < -split.pad and high > split.pad:
            break
    return wp.vec2d(low, high)


@wp.func
def sides_of(extent: wp.vec2d, split: BspSplit) -> int:
    """Return the sides on which a piece with this result of extent_on is listed: 1 below, 2 above, 3 both; 0 for a piece in the plane."""
    return wp.where(extent[0] < -split.pad, 1, 0) + wp.where(extent[1] > split.pad, 2, 0)


@wp.func
def cheaper(tools: BspTools, scope: Scope, trial: BspSplit, best: BspSplit) -> BspSplit:
    """Compute the cost of a trial split of a cell, and return the cheaper of `trial` and `best`. Stop once the cost reaches best.cost."""
    if not wp.isfinite(trial.offset):
        return best
    # A ray within a plane's tolerance visits both sides, so cutting off a sliver thinner than the tolerance saves nothing.
    size = scope.hi - scope.lo
    trial.pad = wp.max(FLAT * wp.max(size), wp.float64(2.0) * U * plane_noise(trial, scope.far))
    areas = split_areas(tools.cells, scope.slot, trial.normal, trial.offset, trial.pad)
    below = tools.options.cost_intersection * wp.min(areas[0] / scope.area, wp.float64(1.0))
    above = tools.options.cost_intersection * wp.min(areas[1] / scope.area, wp.float64(1.0))
    least = wp.min(below, above)
    cost = wp.where(trial.axis < wp.static(PLANE), tools.options.cost_axis, tools.options.cost_plane)
    cost += least * wp.float64(scope.end - scope.begin)
    n_below = int(0)
    n_above = int(0)
    n_flat = int(0)
    for i in range(scope.begin, scope.end):
        sides = sides_of(extent_on(tools.pieces, i, trial), trial)
        if sides == 3:
            cost += below + above - least
        elif sides == 1:
            cost += below - least
        elif sides == 2:
            cost += above - least
        else:
            n_flat += 1
        n_below += sides & 1
        n_above += sides / 2
        if cost >= best.cost:
            return best
    trial.low_flat = below <= above
    if trial.low_flat:
        n_below += n_flat
    else:
        n_above += n_flat
    if n_below + n_above > scope.budget:
        return best
    if not cost < best.cost:
        return best
    trial.cost = cost
    return trial


@wp.func
def across_axis(axis: int, position: wp.float64) -> BspSplit:
    split = BspSplit()
    split.normal[axis] = wp.float64(1.0)
    split.offset = wp.float64(float(-position))
    split.axis = axis
    return split


@wp.func
def best_across(tools: BspTools, scope: Scope, best: BspSplit) -> BspSplit:
    """Return the cheapest of `best` and the planes across an axis: at both ends of each piece, or at equal steps (EXACT, STEPS)."""
    for axis in range(3):
        if scope.end - scope.begin <= EXACT:
            for i in range(scope.begin, scope.end):
                low = across_axis(axis, tools.pieces.lo[i][axis])
                high = across_axis(axis, tools.pieces.hi[i][axis])
                best = cheaper(tools, scope, low, best)
                if low.offset != high.offset:
                    best = cheaper(tools, scope, high, best)
        else:
            step = (scope.hi[axis] - scope.lo[axis]) / wp.float64(STEPS)
            for k in range(int(STEPS) + 1):
                best = cheaper(tools, scope, across_axis(axis, scope.lo[axis] + wp.float64(k) * step), best)
    return best


@wp.func
def plane_through(n: wp.vec3d, p: wp.vec3d) -> BspSplit:
    """Make the plane through p with the normal n, which must not be 0; round it to float32."""
    split = BspSplit()
    unit = wp.normalize(n)
    split.normal = wp.vec3d(wp.vec3(unit))
    split.offset = wp.float64(float(-wp.dot(split.normal, p)))
    split.axis = wp.static(PLANE)
    return split


@wp.func
def best_plane(tools: BspTools, scope: Scope, best: BspSplit) -> BspSplit:
    """Return the cheapest of `best` and the planes through face and edges of options.samples triangles, spread evenly over the pieces."""
    n = scope.end - scope.begin
    tried = wp.min(n, tools.options.samples)
    for k in range(tried):
        i = scope.begin + int((wp.int64(k) * wp.int64(n)) / wp.int64(tried))
        if tools.pieces.count[i] == 0:
            continue
        corner = 3 * tools.pieces.prim_id[i]
        # Scale the triangle to extent 1, so that no product over- or underflows.
        scale = wp.float64(1.0) / wp.max(tools.pieces.extent[i], NO_SIZE)
        edge_0 = (tools.corners[corner + 1] - tools.corners[corner]) * scale
        edge_1 = (tools.corners[corner + 2] - tools.corners[corner + 1]) * scale
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
            split = plane_through(n_plane, tools.corners[corner + side % 3])
            if wp.max(wp.abs(split.normal)) < wp.float64(1.0):
                best = cheaper(tools, scope, split, best)
    return best
