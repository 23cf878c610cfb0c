"""The steps of a walk as records: what was fetched, tested, pushed and popped, with the distances and the result.
The functions here make one `Step` each; the observer of a log stores it (kernels.traverse.observer).

A child is given by `index` and `count`, as in bvh2: the inner node `index` with count = INNER, or a leaf with the `count` primitives from
`index` on. In structures whose leaves are nodes (k-d tree, octree), all children have count = INNER."""

import warp as wp

KINDS = ("node", "box", "plane", "part", "cell", "leaf", "test", "skip", "push", "pop")
NODE = wp.constant(0)  # A node is fetched; in a grid, a cell.
BOX = wp.constant(1)  # The bounding volume of a child is tested: a box, a sphere, a 14-DOP, an octant.
PLANE = wp.constant(2)  # The plane of a k-d or BSP node is tested.
PART = wp.constant(3)  # A child of that node: the half space inside.plane <= 0, and the part of the ray in it.
CELL = wp.constant(4)  # The box of a cell that needs no test: of a grid's cell, or of a whole grid or BSP tree.
LEAF = wp.constant(5)
TEST = wp.constant(6)  # A primitive is fetched and tested.
SKIP = wp.constant(7)  # A primitive is not fetched, because the mailbox remembers its test.
PUSH = wp.constant(8)
POP = wp.constant(9)
INNER = wp.constant(-1)

# Results of a test.
RESULTS = ("missed", "before t_min", "behind the closest hit", "closest hit")
MISSED, BEFORE, BEHIND, CLOSEST = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
# Results of other steps are masks. ENTERED: the ray enters the volume, plane or part, or the walk continues with the popped entry. STAYS:
# the popped entry has further children, and stays on the stack.
ENTERED, STAYS = wp.constant(1), wp.constant(2)


@wp.struct
class Step:
    """A step; fields that the kind does not use are 0."""

    kind: int
    index: int  # Node, primitive, or child; of a push that inserts below the top of the stack, too.
    count: int
    result: int
    prim_id: int  # Test: the primitive's id. Push: number of entries below the new entry.
    t: float  # Box, part, cell, push, pop: where the ray enters; plane: where it crosses; test: of the hit on the line. inf: missed.
    t_end: float  # Part, cell: where the ray leaves.
    u: float  # u, v: of a test's hit.
    v: float
    lo: wp.vec3  # Box, cell: lowest corner. Plane: normal. Part: normal of its half space.
    hi: wp.vec3  # Box, cell: highest corner. Plane, part: the offset, in x.
    edges: wp.vec3d  # Test: the areas of units.triangle.edge_areas, NaN if the test has none. Box: the radius of a sphere, in x.


@wp.func
def make_step(kind: int, index: int, count: int) -> Step:
    out = Step()
    out.kind = kind
    out.index = index
    out.count = count
    return out


@wp.func
def box_step(index: int, count: int, lo: wp.vec3, hi: wp.vec3, t: float) -> Step:
    """Make the step of a bounding volume in the box lo .. hi. t: its entry distance, or inf."""
    out = make_step(BOX, index, count)
    out.result = wp.where(t < wp.inf, ENTERED, 0)
    out.t = t
    out.lo = lo
    out.hi = hi
    return out


@wp.func
def cell_step(index: int, count: int, lo: wp.vec3, hi: wp.vec3, t: float, t_end: float) -> Step:
    out = box_step(index, count, lo, hi, t)
    out.kind = CELL
    out.t_end = t_end
    return out


@wp.func
def plane_step(index: int, normal: wp.vec3, offset: float, t: float) -> Step:
    """Make the step of the plane dot(normal, p) + offset = 0 of node `index`, which the ray crosses at t."""
    out = make_step(PLANE, index, INNER)
    out.t = t
    out.lo = normal
    out.hi = wp.vec3(offset, 0.0, 0.0)
    return out


@wp.func
def part_step(plane: Step, above: bool, index: int, part: wp.vec2, entered: bool) -> Step:
    """Make the step of the child above or below a plane, whose `part` of the ray is (t, t_end). The child is an inner node."""
    sign = wp.where(above, -1.0, 1.0)
    out = make_step(PART, index, INNER)
    out.result = wp.where(entered, ENTERED, 0)
    out.t = part[0]
    out.t_end = part[1]
    out.lo = sign * plane.lo
    out.hi = sign * plane.hi
    return out
