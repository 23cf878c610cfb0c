"""Compute the boxes and records of triangles and spheres on any device, so that a moving mesh need not leave the GPU.
The results equal those of the host's functions to the last bit (Geometry.bounds, wrt.accel.geometry.corners).
A launch of size dim processes the primitives or records first .. first + dim - 1."""

from typing import TYPE_CHECKING

import warp as wp

from wrt.kernels.headers import with_headers
from wrt.kernels.structs import Primitive, kernel, noinline
from wrt.kernels.units.box import box_pad, padded_hi, padded_lo
from wrt.kernels.units.triangle import lower, upper

SPLIT = wp.constant(wp.float64(2.0**27 + 1.0))  # Dekker's factor that splits a float64 into two halves
DOUBT = wp.constant(wp.float64(2.0**-50))  # bound on the relative error of a float64 area, as in wrt.scene.clean.corners_have_area
Terms = wp.types.vector(16, wp.float64)

if TYPE_CHECKING:  # type checkers skip device code (structs.py)
    from typing import no_type_check as rows_kernel
else:
    def rows_kernel(function):
        return kernel(function, extra_build_options=with_headers("build/rows.h"))


@wp.struct
class Shape:
    """The arrays of wrt.accel.geometry.Geometry. The F faces are the primitives 0 .. F - 1; spheres follow."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    spheres: wp.array(dtype=wp.vec4)


@kernel
def bounds(shape: Shape, low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), first: int):
    """Store the padded boxes of primitives first .. first + dim - 1. The box of a primitive that is not finite is all of space."""
    i = first + wp.tid()
    n = shape.faces.shape[0]
    lo = wp.vec3()
    hi = wp.vec3()
    if i < n:
        face = shape.faces[i]
        a = shape.vertices[face[0]]
        b = shape.vertices[face[1]]
        c = shape.vertices[face[2]]
        lo = lower(lower(a, b), c)
        hi = upper(upper(a, b), c)
        if not wp.isfinite(a + b + c):  # a single test for most triangles; a sum beyond float32 also gets here
            if not (wp.isfinite(a) and wp.isfinite(b) and wp.isfinite(c)):
                lo = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
                hi = wp.vec3(wp.inf, wp.inf, wp.inf)
    else:
        s = shape.spheres[i - n]
        lo = wp.vec3(s[0] - s[3], s[1] - s[3], s[2] - s[3])
        hi = wp.vec3(s[0] + s[3], s[1] + s[3], s[2] + s[3])
    pad = box_pad(lo, hi)
    low[i] = padded_lo(lo, pad)
    high[i] = padded_hi(hi, pad)


@wp.func
def two_sum(a: wp.float64, b: wp.float64) -> wp.vec2d:
    """Return the rounded sum a + b and its rounding error (Knuth)."""
    s = a + b
    t = s - a
    return wp.vec2d(s, (a - (s - t)) + (b - t))


@wp.func
def two_product(a: wp.float64, b: wp.float64) -> wp.vec2d:
    """Return the rounded product a b and its rounding error (Dekker)."""
    p = a * b
    c = SPLIT * a
    a_high = c - (c - a)
    a_low = a - a_high
    c = SPLIT * b
    b_high = c - (c - b)
    b_low = b - b_high
    return wp.vec2d(p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low)


@wp.func
def is_zero(terms: Terms) -> bool:
    """Test whether the exact sum of the terms is 0 (Shewchuk 1997, "Adaptive Precision Floating-Point Arithmetic", grow-expansion)."""
    parts = Terms()
    for n in range(16):
        q = terms[n]
        for k in range(n):
            s = two_sum(q, parts[k])
            q = s[0]
            parts[k] = s[1]
        parts[n] = q
    zero = bool(True)
    for n in range(16):
        zero = zero and parts[n] == wp.float64(0.0)
    return zero


@wp.func
def with_products(terms: Terms, place: int, e: wp.vec2d, f: wp.vec2d, sign: wp.float64) -> Terms:
    """Return `terms` with eight new terms from index `place` on. Their exact sum is sign * (e[0] + e[1]) * (f[0] + f[1])."""
    out = terms
    for i in range(2):
        for j in range(2):
            p = two_product(e[i], f[j])
            out[place + 4 * i + 2 * j] = sign * p[0]
            out[place + 4 * i + 2 * j + 1] = sign * p[1]
    return out


@noinline
def exactly_across(a: wp.vec3, b: wp.vec3, c: wp.vec3, i: int, j: int) -> bool:
    """Test exactly whether component k of the cross product of b - a and c - a differs from 0; i and j are the two other axes.
    Nothing under- or overflows: all numbers are multiples of 2^-298 and below 2^258. Inlined, its long vectors would be cleared for each
    triangle, in twice the time of all the rest."""
    e_i = two_sum(wp.float64(b[i]), -wp.float64(a[i]))
    e_j = two_sum(wp.float64(b[j]), -wp.float64(a[j]))
    f_i = two_sum(wp.float64(c[i]), -wp.float64(a[i]))
    f_j = two_sum(wp.float64(c[j]), -wp.float64(a[j]))
    terms = with_products(Terms(), 0, e_i, f_j, wp.float64(1.0))
    return not is_zero(with_products(terms, 8, e_j, f_i, wp.float64(-1.0)))


@wp.func
def surely_across(a: wp.vec3, b: wp.vec3, c: wp.vec3, i: int, j: int) -> bool:
    """Test as `exactly_across` does, but in float64; return False also if rounding errors could change the result."""
    left = (wp.float64(b[i]) - wp.float64(a[i])) * (wp.float64(c[j]) - wp.float64(a[j]))
    right = (wp.float64(b[j]) - wp.float64(a[j])) * (wp.float64(c[i]) - wp.float64(a[i]))
    return not wp.abs(left - right) <= DOUBT * (wp.abs(left) + wp.abs(right))


@wp.func
def has_area(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> bool:
    """Test whether the corners are not on one line, as wrt.scene.clean.has_area does; True if a corner is not finite."""
    if surely_across(a, b, c, 1, 2):  # `or` computes all its operands
        return True
    if surely_across(a, b, c, 2, 0) or surely_across(a, b, c, 0, 1):
        return True
    if not (wp.isfinite(a) and wp.isfinite(b) and wp.isfinite(c)):
        return True
    return exactly_across(a, b, c, 1, 2) or exactly_across(a, b, c, 2, 0) or exactly_across(a, b, c, 0, 1)


@wp.func
def corners_of(shape: Shape, prim_id: int) -> Primitive:
    """Return a primitive's record with corners (the layout "corners")."""
    record = Primitive()
    record.prim_id = prim_id
    if record.prim_id < shape.faces.shape[0]:
        face = shape.faces[record.prim_id]
        record.v0 = shape.vertices[face[0]]
        record.v1 = shape.vertices[face[1]]
        record.v2 = shape.vertices[face[2]]
        if not has_area(record.v0, record.v1, record.v2):
            record.v0 = wp.vec3(wp.nan, wp.nan, wp.nan)
    return record


@kernel
def write_corners(shape: Shape, order: wp.array(dtype=wp.int32), out: wp.array(dtype=Primitive), first: int):
    """Write the records first .. first + dim - 1 with corners. order[i] is the prim_id of record i."""
    i = first + wp.tid()
    out[i] = corners_of(shape, order[i])


# Faster than assignments to elements, for which Warp computes an address each.
@wp.func_native("""
    const int numbers = sizeof(record) / sizeof(float);
    float* to = rows.data + (long long)row * numbers * width + lane;
    const char* from = (const char*)&record;
    for (int k = 0; k < numbers; ++k) memcpy(to + k * width, from + k * sizeof(float), sizeof(float));
""")
def store_lane(rows: wp.array(dtype=wp.float32), row: int, lane: int, width: int, record: Primitive) -> None: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return false;
#else
    float* to = out.data + (long long)row * 10 * width;
    return width == 8 ? wrt::store_triangles<8>(shape, order, begin, count, to) : wrt::store_triangles<4>(shape, order, begin, count, to);
#endif
""")
def store_triangles(shape: Shape, order: wp.array(dtype=wp.int32), begin: int, count: int, out: wp.array(dtype=wp.float32), row: int,
                    width: int) -> bool: ...


@rows_kernel
def write_rows(shape: Shape, order: wp.array(dtype=wp.int32), start: wp.array(dtype=wp.int32), width: int,
               out: wp.array(dtype=wp.float32), first: int):
    """Write the rows first .. first + dim - 1 of `width` records with corners: a row has `width` values for each number of a record.
    Row r holds the primitives order[start[r] .. start[r + 1] - 1], at least one. Its unused lanes repeat the last of them.
    The shape has at least one face. Width: 4 or 8."""
    row = first + wp.tid()
    begin = start[row]
    count = start[row + 1] - begin
    if not store_triangles(shape, order, begin, count, out, row, width):
        for lane in range(width):
            store_lane(out, row, lane, width, corners_of(shape, order[begin + wp.min(lane, count - 1)]))


@kernel
def count_outside(faces: wp.array(dtype=wp.vec3i), n_vertices: int, count: wp.array(dtype=wp.int32), first: int):
    """Add to count[0] the number of faces with an index outside 0 .. n_vertices - 1."""
    face = faces[first + wp.tid()]
    for k in range(3):
        if face[k] < 0 or face[k] >= n_vertices:
            wp.atomic_add(count, 0, 1)
            return
