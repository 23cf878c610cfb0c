"""Build a binary BVH along a Morton curve, with one thread per node, on the CPU and on CUDA.
Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees". Primitives are sorted by the Morton code of
their boxes' middles. Each inner node computes its range of primitives and its split. Then `fit.fit` makes boxes and leaves from the bottom
up, and `write_nodes` writes the remaining nodes in depth-first order. A launch of size dim processes the
items first .. first + dim - 1."""

import warp as wp

from wrt.kernels.build.fit import NO_PARENT, SubtreeSummary, Tree
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node

PARTS = 1024  # number of threads of `measure`
MOST_BITS = 21  # largest number of bits of a coordinate in a Morton code
KEY_BITS = 63  # largest number of bits of a key


def bits_of(n: int) -> tuple[int, int]:
    """Return the numbers of bits that a primitive's index and a coordinate have in the keys of n primitives.
    A key contains the index, so all keys differ, and no path has more nodes than a key has bits. A path of KEY_BITS nodes fits on the stack
    of the traversal. The more primitives, the fewer bits remain for a coordinate: 14 for a million."""
    index_bits = max(n - 1, 1).bit_length()
    return index_bits, min(MOST_BITS, (KEY_BITS - index_bits) // 3)


@wp.func
def middle_of(low: wp.vec3, high: wp.vec3) -> wp.vec3:
    """Return the middle of a box; (0, 0, 0) if the middle is not finite."""
    middle = 0.5 * low + 0.5 * high
    return wp.where(wp.isfinite(middle), middle, wp.vec3(0.0, 0.0, 0.0))


@kernel
def measure(low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), ends: wp.array(dtype=wp.vec3)):
    """Store the bounds of the middles of all boxes in ends[0] and ends[1], which must be (inf, -inf) before. Launch PARTS threads."""
    i = wp.tid()
    a = wp.vec3(wp.inf, wp.inf, wp.inf)
    b = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for j in range(i, low.shape[0], PARTS):
        middle = middle_of(low[j], high[j])
        a = wp.min(a, middle)
        b = wp.max(b, middle)
    wp.atomic_min(ends, 0, a)
    wp.atomic_max(ends, 1, b)


@wp.func
def spread(x: wp.uint64) -> wp.uint64:
    """Spread the lowest 21 bits of x: bit k moves to bit 3 k."""
    x = (x | (x << wp.uint64(32))) & wp.uint64(0x1F00000000FFFF)
    x = (x | (x << wp.uint64(16))) & wp.uint64(0x1F0000FF0000FF)
    x = (x | (x << wp.uint64(8))) & wp.uint64(0x100F00F00F00F00F)
    x = (x | (x << wp.uint64(4))) & wp.uint64(0x10C30C30C30C30C3)
    return (x | (x << wp.uint64(2))) & wp.uint64(0x1249249249249249)


@wp.func
def cell_of(x: float, begin: float, end: float, bits: int) -> wp.uint64:
    extent = wp.float64(end) - wp.float64(begin)
    last = wp.float64((1 << bits) - 1)
    if extent <= wp.float64(0.0):
        return wp.uint64(0)
    return wp.uint64((wp.float64(x) - wp.float64(begin)) / extent * last)


@kernel
def write_keys(low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), ends: wp.array(dtype=wp.vec3), bits: wp.vec2i,
               keys: wp.array(dtype=wp.uint64), order: wp.array(dtype=wp.int32), first: int):
    """Write the keys of primitives first .. first + dim - 1. A key's high bits are the Morton code of the middle, its low bits the index.
    The numbers of bits are `bits` (see bits_of)."""
    i = first + wp.tid()
    middle = middle_of(low[i], high[i])
    a = ends[0]
    b = ends[1]
    code = (spread(cell_of(middle[0], a[0], b[0], bits[1])) << wp.uint64(2)) | (
        spread(cell_of(middle[1], a[1], b[1], bits[1])) << wp.uint64(1)) | spread(cell_of(middle[2], a[2], b[2], bits[1]))
    keys[i] = (code << wp.uint64(bits[0])) | wp.uint64(i)
    order[i] = i


@wp.func
def differ(keys: wp.array(dtype=wp.uint64), n: int, i: int, j: int) -> wp.uint64:
    """Return the XOR of keys i and j. If there is no key j, return a number with only the highest bit set. n: number of keys."""
    if j < 0 or j >= n:
        return wp.uint64(0x8000000000000000)
    return keys[i] ^ keys[j]


@wp.func
def nearer(a: wp.uint64, b: wp.uint64) -> bool:
    """Test whether the highest bit of a is below b's: two keys with the XOR a then share a longer prefix than two keys with the XOR b."""
    return a < b and a < (a ^ b)


@kernel
def link(keys: wp.array(dtype=wp.uint64), nodes: wp.array(dtype=Bvh2Node), parents: wp.array(dtype=wp.int32), first: int):
    """Write the inner nodes first .. first + dim - 1, one per thread, and their children's entries in `parents`. A leaf is one primitive.
    The `keys` are in ascending order. There are at least two keys, and one node fewer than keys."""
    i = first + wp.tid()
    n = nodes.shape[0] + 1
    # Node i begins or ends at key i, and extends to the side whose neighbour shares the longer prefix.
    after = differ(keys, n, i, i + 1)
    before = differ(keys, n, i, i - 1)
    d = wp.where(nearer(after, before), 1, -1)
    outside = wp.where(d > 0, before, after)
    most = int(2)
    while most < n and nearer(differ(keys, n, i, i + most * d), outside):
        most = most * 2
    length = int(0)
    step = most / 2
    while step >= 1:
        if nearer(differ(keys, n, i, i + (length + step) * d), outside):
            length = length + step
        step = step / 2
    # The split is behind the last key that shares a longer prefix with key i than the key at the range's other end does.
    j = i + length * d
    whole = differ(keys, n, i, j)
    split = int(0)
    step = length
    while True:
        step = (step + 1) / 2
        if nearer(differ(keys, n, i, i + (split + step) * d), whole):
            split = split + step
        if step <= 1:
            break
    left = i + split * d + wp.min(d, 0)
    node = Bvh2Node()
    node.first_0 = left
    node.first_1 = left + 1
    if wp.min(i, j) == left:
        node.count_0 = 1
    else:
        parents[left] = i
    if wp.max(i, j) == left + 1:
        node.count_1 = 1
    else:
        parents[left + 1] = i
    nodes[i] = node
    if i == 0:
        parents[0] = NO_PARENT


@kernel
def write_nodes(tree: Tree, nodes: wp.array(dtype=Bvh2Node), parents: wp.array(dtype=wp.int32), first: int):
    """Write those of the nodes first .. first + dim - 1 that are still inner nodes after `fit`, in depth-first order, left before right.
    A node's new index is the number of nodes before it in this order: its ancestors, and all nodes left of the path from the root to it."""
    i = first + wp.tid()
    slot = int(0)
    at = int(i)
    while True:
        if tree.summaries[at].inner_nodes == 0:
            return  # inside a leaf
        parent = tree.parents[at]
        if parent == NO_PARENT:
            break
        slot = slot + 1
        node = tree.nodes[parent]
        if node.count_1 == 0 and node.first_1 == at and node.count_0 == 0:
            sibling = node.first_0
            slot = slot + tree.summaries[sibling].inner_nodes
        at = parent
    node = tree.nodes[i]
    left = SubtreeSummary()
    if node.count_0 == 0:
        left = tree.summaries[node.first_0]
        if left.inner_nodes == 0:
            node.first_0 = node.first_0 + 1 - left.size  # its range ends at the split
            node.count_0 = left.size
        else:
            node.first_0 = slot + 1
            parents[slot + 1] = slot
    if node.count_1 == 0:
        right = tree.summaries[node.first_1]
        if right.inner_nodes == 0:
            node.count_1 = right.size
        else:
            node.first_1 = slot + 1 + left.inner_nodes
            parents[slot + 1 + left.inner_nodes] = slot
    nodes[slot] = node
    if i == 0:
        parents[0] = NO_PARENT
