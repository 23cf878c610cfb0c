"""Affine maps as rows of numbers: poses of bodies and sensors."""

import warp as wp

QUATERNION = wp.constant(7)  # Numbers in a row of transforms that are a position and a quaternion (x, y, z, w).


@wp.struct
class Transforms:
    """Affine maps as rows of `size` numbers: QUATERNION, 12 or 16 (3 or 4 rows of a matrix). One of the arrays is empty."""

    floats: wp.array(dtype=wp.float32)
    doubles: wp.array(dtype=wp.float64)
    size: int
    own: bool  # The present matrices of all instances, whose boxes alone change.
    outside: bool  # Maps between the caller's mesh and world, whose origins differ from the part's and the structure's.


@wp.struct
class Affine:
    """The map p -> a p + t."""

    a: wp.mat33d
    t: wp.vec3d


@wp.func
def number(transforms: Transforms, i: int) -> wp.float64:
    if transforms.floats.shape[0] > 0:
        return wp.float64(transforms.floats[i])
    return transforms.doubles[i]


@wp.func
def vector(transforms: Transforms, i: int) -> wp.vec4d:
    return wp.vec4d(number(transforms, i), number(transforms, i + 1), number(transforms, i + 2), number(transforms, i + 3))


@wp.func
def rotation(q: wp.vec4d) -> wp.mat33d:
    """Return the matrix of a rotation by a quaternion (x, y, z, w) of any length; NaN for 0."""
    s = wp.float64(2.0) / wp.dot(q, q)
    one = wp.float64(1.0)
    x, y, z, w = q[0], q[1], q[2], q[3]
    return wp.mat33d(one - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
                     s * (x * y + z * w), one - s * (x * x + z * z), s * (y * z - x * w),
                     s * (x * z - y * w), s * (y * z + x * w), one - s * (x * x + y * y))


@wp.func
def affine_of(transforms: Transforms, i: int) -> Affine:
    """Load the i-th transform."""
    out = Affine()
    begin = i * transforms.size
    if transforms.size == QUATERNION:
        out.t = wp.vec3d(number(transforms, begin), number(transforms, begin + 1), number(transforms, begin + 2))
        out.a = rotation(vector(transforms, begin + 3))
        return out
    for k in range(3):
        row = vector(transforms, begin + 4 * k)
        out.t[k] = row[3]
        for j in range(3):
            out.a[k, j] = row[j]  # Warp 1.17 assigns no rows of matrices in structs
    return out


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return fma(a, b, c);
#else
    return __builtin_fma(a, b, c);
#endif
""")
def fused(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64:
    """Return a b + c, rounded once."""


@wp.func
def times(a: wp.mat33d, v: wp.vec3d) -> wp.vec3d:
    """Return a v, with the arithmetic of OpenBLAS for processors with AVX2 and FMA."""
    out = wp.vec3d()
    for k in range(3):
        out[k] = fused(a[k, 2], v[2], fused(a[k, 0], v[0], a[k, 1] * v[1]))
    return out


@wp.func
def inverted(a: wp.mat33d) -> wp.mat33d:
    """Return the inverse, not finite if `a` has none, with the steps of LAPACK's gesv in OpenBLAS for processors with AVX2 and FMA."""
    m = a
    b = wp.identity(n=3, dtype=wp.float64)
    one = wp.float64(1.0)
    for k in range(2):  # partial pivoting: m becomes L below and U above its diagonal
        p = int(k)
        for i in range(k + 1, 3):
            if wp.abs(m[i, k]) > wp.abs(m[p, k]):
                p = i
        row = m[k]
        m[k] = m[p]
        m[p] = row
        row = b[k]
        b[k] = b[p]
        b[p] = row
        for i in range(k + 1, 3):
            m[i, k] = m[i, k] * (one / m[k, k])
        if k == 0:
            m[1, 1] = m[1, 1] - m[1, 0] * m[0, 1]
            m[2, 1] = m[2, 1] - m[2, 0] * m[0, 1]
    m[1, 2] = m[1, 2] - m[1, 0] * m[0, 2]
    m[2, 2] = m[2, 2] - (m[2, 0] * m[0, 2] + m[2, 1] * m[1, 2])
    b[1] = b[1] - m[1, 0] * b[0]
    b[2] = b[2] - m[2, 0] * b[0]
    for j in range(3):
        b[2, j] = fused(-b[1, j], m[2, 1], b[2, j])
    b[2] = (one / m[2, 2]) * b[2]
    b[1] = (one / m[1, 1]) * (b[1] - m[1, 2] * b[2])
    b[0] = (one / m[0, 0]) * ((b[0] - m[0, 2] * b[2]) - m[0, 1] * b[1])
    return b
