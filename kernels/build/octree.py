"""The octree builder's inner loops, on the CPU: find the octants that each reference meets, one level of the tree at a time.
Kernel find_octants runs on all cores, each on a range of references. The references of a cell are counted and copied in their order, so
the tree does not depend on the number of threads."""

import warp as wp

from wrt.kernels.build.triangle_cell import CellSource, meets_cell, triangle_cell
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.octree import OctreeLayout, octant_corner, octree_planes


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


@wp.struct
class SplitCells:
    """The cells of one level that are to be split."""

    half: int  # Half the edge of these cells, in finest cells.
    corners: wp.array(dtype=wp.vec3i)  # Lowest corner of each cell.
    cell_of: wp.array(dtype=wp.int32)  # Index of each reference's cell.


@kernel
def find_octants(source: CellSource, layout: OctreeLayout, first: int, cells: SplitCells, references: wp.array(dtype=wp.int32),
                 masks: wp.array(dtype=wp.int32)):
    """Store masks[r] for reference r = first + tid: the mask of the octants of the reference's cell that its primitive meets."""
    half = cells.half
    r = first + wp.tid()
    i = references[r]
    corner = cells.corners[cells.cell_of[r]]
    lo = source.lo[i]
    hi = source.hi[i]
    mask = octants_of_box(lo, hi, octree_planes(layout, corner + wp.vec3i(half, half, half)), layout.hi)
    if i < source.faces.shape[0] and (mask & (mask - 1)) != 0:
        face = source.faces[i]
        triangle = triangle_cell(source.vertices[face[0]], source.vertices[face[1]], source.vertices[face[2]], lo, hi)
        exact = int(0)
        for octant in range(8):
            if (mask & (1 << octant)) != 0:
                low = corner + octant_corner(octant, half)
                if meets_cell(triangle, octree_planes(layout, low), octree_planes(layout, low + wp.vec3i(half, half, half))):
                    exact = exact | (1 << octant)
        mask = exact
    masks[r] = mask


@kernel
def count_octants(first: int, begin: wp.array(dtype=wp.int32), masks: wp.array(dtype=wp.int32), count: wp.array2d(dtype=wp.int32)):
    """Add to count[cell, k] the number of references begin[cell] .. begin[cell + 1] - 1 that meet octant k of `cell` = first + tid."""
    cell = first + wp.tid()
    for r in range(begin[cell], begin[cell + 1]):
        for octant in range(8):
            count[cell, octant] += (masks[r] >> octant) & 1


@kernel
def fill_octants(first: int, begin: wp.array(dtype=wp.int32), masks: wp.array(dtype=wp.int32), references: wp.array(dtype=wp.int32),
                 next_place: wp.array2d(dtype=wp.int32), out: wp.array(dtype=wp.int32)):
    """Copy the references of each octant k of `cell` = first + tid to `out`, from index next_place[cell, k] on; masks: of find_octants.
    If next_place[cell, 0] < 0, the cell is not split, and nothing is copied."""
    cell = first + wp.tid()
    if next_place[cell, 0] < 0:
        return
    for r in range(begin[cell], begin[cell + 1]):
        for octant in range(8):
            if ((masks[r] >> octant) & 1) != 0:
                out[next_place[cell, octant]] = references[r]
                next_place[cell, octant] += 1
