"""The grid builder's inner loops, on the CPU: count the cells of each primitive, list the cells, sort primitives by cell.
Counting and listing run on all cores, each on a range of primitives. The sort is one pass in the order of the primitives, so the result
does not depend on the number of threads."""

import warp as wp

from wrt.kernels.build.clip import Shapes, TriangleCell, meets_cell, triangle_cell
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.grid import GridCell, GridLayout, grid_plane, slab_of


@wp.func
def slabs_of(layout: GridLayout, lo: wp.vec3, hi: wp.vec3, axis: int) -> wp.vec2i:
    """Return the first and the last slab of an axis that the interval [lo[axis], hi[axis]] meets. Slabs are closed intervals."""
    first = slab_of(layout, axis, lo[axis])
    last = slab_of(layout, axis, hi[axis])
    if last < layout.n[axis] - 1 and grid_plane(layout, axis, last + 1) <= hi[axis]:
        last += 1
    return wp.vec2i(first, last)


@wp.func
def slab_lo(layout: GridLayout, x: int, y: int, z: int) -> wp.vec3:
    return wp.vec3(grid_plane(layout, 0, x), grid_plane(layout, 1, y), grid_plane(layout, 2, z))


@kernel
def list_cells(shapes: Shapes, layout: GridLayout, first: int, begin: wp.array(dtype=wp.int64), count: wp.array(dtype=wp.int32),
               cells: wp.array(dtype=wp.int32)):
    """Write the indices of the cells that primitive i = first + tid meets to `cells`, from begin[i] on. If `cells` is empty, only count the
    cells, in count[i]."""
    i = first + wp.tid()
    lo = shapes.lo[i]
    hi = shapes.hi[i]
    x = slabs_of(layout, lo, hi, 0)
    y = slabs_of(layout, lo, hi, 1)
    z = slabs_of(layout, lo, hi, 2)
    exact = i < shapes.faces.shape[0] and (x[0] != x[1] or y[0] != y[1] or z[0] != z[1])
    triangle = TriangleCell()
    if exact:
        triangle = triangle_cell(shapes, i)
    writes = cells.shape[0] > 0
    n = int(0)
    for k in range(z[0], z[1] + 1):
        for j in range(y[0], y[1] + 1):
            # Skip a row of cells that the triangle misses: these are most rows in the box of a large triangle.
            if exact and x[1] - x[0] > 1:
                if not meets_cell(triangle, slab_lo(layout, x[0], j, k), slab_lo(layout, x[1] + 1, j + 1, k + 1)):
                    continue
            for m in range(x[0], x[1] + 1):
                if exact:
                    if not meets_cell(triangle, slab_lo(layout, m, j, k), slab_lo(layout, m + 1, j + 1, k + 1)):
                        continue
                if writes:
                    cells[int(begin[i]) + n] = m + layout.n[0] * (j + layout.n[1] * k)
                n += 1
    if not writes:
        count[i] = n


@kernel
def sort_by_cell(begin: wp.array(dtype=wp.int64), cell_of: wp.array(dtype=wp.int32), cells: wp.array(dtype=GridCell),
                 references: wp.array(dtype=wp.int32)):
    """Sort the primitives by cell, and within a cell by index: a counting sort in one thread. On entry, all `cells` must be 0.
    Primitive i meets the cells cell_of[begin[i]] .. cell_of[begin[i + 1] - 1]."""
    for r in range(cell_of.shape[0]):
        cell = cell_of[r]
        cells[cell].count += 1
    total = int(0)
    for c in range(cells.shape[0]):
        cells[c].first = total
        total += cells[c].count
        cells[c].count = 0
    for i in range(begin.shape[0] - 1):
        for r in range(int(begin[i]), int(begin[i + 1])):
            c = cell_of[r]
            references[cells[c].first + cells[c].count] = i
            cells[c].count += 1
