"""Rows of 4 or 8 floats, which one vector instruction of a CPU processes: for the loops that take most of a ray's time.

Rows are consecutive in a flat array of float32. Each function on a row has two forms with the same bits (tests/kernels/wide/test_lanes.py):
C++ for the CPU and, for CUDA, plain Warp that processes one lane after another."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import on_cuda
from wrt.kernels.units.box import FAR_PAD, BoxRay
from wrt.kernels.units.triangle import edge_areas, outside, sheared
from wrt.kernels.wide.layout import CACHE_LINE

# Factor of far distances, as FAR_PAD. Rows multiply the reciprocal direction by it once per ray, not each distance: this differs by at
# most four roundings. LANE_PAD exceeds FAR_PAD by 8 u, so that a ray enters every box of a row that it enters in the box unit.
LANE_PAD = wp.constant(FAR_PAD * (1.0 + 8.0 * 2.0**-24))


@wp.struct
class LaneRay:
    """A ray set up for the tests of rows."""

    box: BoxRay  # Set-up for the box unit; t_min is never -0.
    far_inv_dir: wp.vec3  # inv_dir times nodes.far_pad, for distances to far planes.
    near_x: int  # Indices near_x, near_y, near_z in layout.PLANES: for each axis, the plane that the ray meets first.
    near_y: int
    near_z: int
    kx: int  # kx, ky, kz, shear_x, shear_y: as in TriangleRay.
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    origin: wp.vec3  # The ray's origin in the axis order kx, ky, kz.


def lanes_only(body: str, otherwise: str = "0") -> str:
    """Return the C++ body of a native function that needs the headers of wide/. Only CPU kernels of structs.kernel include them.

    Elsewhere it returns `otherwise`, and is never called: CUDA runs the form in plain Warp, and ray_query.fused rejects wp.kernel."""
    return f"\n#if defined(WRT_INLINE)\n{body}\n#else\n    return {otherwise};\n#endif\n"


CHECK_MASK = "\n#if defined(WRT_CHECK)\n    if (mask == 0) __builtin_trap();\n#endif\n"  # as WRT_ASSERT in lanes.h


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else{CHECK_MASK}
    return __builtin_ctz(mask);
#endif
""")
def lowest(mask: int) -> int:
    """Return the index of the lowest bit set in a mask, which must not be 0."""


@wp.func_native("return rows.data[(long long)i];")
def value(rows: wp.array(dtype=wp.float32), i: int) -> float:
    """Return rows[i] of a contiguous array."""


@wp.func_native("int value; memcpy(&value, rows.data + (long long)i, sizeof(value)); return value;")
def bits(rows: wp.array(dtype=wp.float32), i: int) -> int:
    """Return the bits of rows[i] as an int32."""


@wp.func_native("""
    struct alignas(16) Four { float numbers[4]; };
    const Four found = *(const Four*)(rows.data + (long long)i);
    return wp::vec_t<4, wp::float32>(found.numbers[0], found.numbers[1], found.numbers[2], found.numbers[3]);
""")
def four(rows: wp.array(dtype=wp.float32), i: int) -> wp.vec4:
    """Return rows[i : i + 4] of a contiguous array by one load on CUDA; they must begin at a multiple of 16 bytes."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return fmaxf(a, b);
#else
    return a > b ? a : b;
#endif
""")
def larger(a: float, b: float) -> float:
    """Return the larger number, or b if a is NaN."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return fminf(a, b);
#else
    return a < b ? a : b;
#endif
""")
def smaller(a: float, b: float) -> float:
    """Return the smaller number, or b if a is NaN."""


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
    for (int k = 0; k < lines; ++k) __builtin_prefetch(rows.data + (long long)first + {CACHE_LINE} * k);
#endif
""")
def prefetch(rows: wp.array(dtype=wp.float32), first: int, lines: int) -> None:
    """Prefetch `lines` cache lines, from rows[first] on."""


@cache
def row_type(width: int) -> Any:
    """Return the vector type of a row of `width` float32."""
    return wp.types.vector(width, wp.float32)


@cache
def make_plain_cull(width: int) -> Any:
    """Return the function of `make_cull` in plain Warp: it tests four triangles for each load."""

    @wp.func
    def coordinates(rows: wp.array(dtype=wp.float32), first: int, axis: int) -> wp.vec4:
        return four(rows, first + width * axis)

    @wp.func
    def turned(x: wp.vec4, y: wp.vec4, z: wp.vec4, j: int, ray: LaneRay) -> wp.vec3:
        """Return a corner in the space where the ray is the z axis."""
        return sheared(wp.vec3(x[j], y[j], z[j]) - ray.origin, ray.shear_x, ray.shear_y)

    @wp.func
    def cull(rows: wp.array(dtype=wp.float32), first: int, mask: int, ray: LaneRay) -> int:
        out = int(0)
        lane = int(0)
        while lane < width:  # Warp would unroll a `for`, which doubles the number of instructions of a traversal.
            if (mask >> lane) & 15 != 0:
                i = first + lane
                a_x, a_y, a_z = coordinates(rows, i, ray.kx), coordinates(rows, i, ray.ky), coordinates(rows, i, ray.kz)
                i = i + 3 * width
                b_x, b_y, b_z = coordinates(rows, i, ray.kx), coordinates(rows, i, ray.ky), coordinates(rows, i, ray.kz)
                i = i + 3 * width
                c_x, c_y, c_z = coordinates(rows, i, ray.kx), coordinates(rows, i, ray.ky), coordinates(rows, i, ray.kz)
                for j in range(4):
                    a, b, c = turned(a_x, a_y, a_z, j, ray), turned(b_x, b_y, b_z, j, ray), turned(c_x, c_y, c_z, j, ray)
                    if not outside(edge_areas(a, b, c)):
                        out = out | (1 << (lane + j))
            lane = lane + 4
        return out & mask

    return cull


@cache
def make_native_cull(width: int) -> Any:
    """Return the function of `make_cull` in C++, for the CPU only."""

    @wp.func_native(lanes_only(f"return mask & wrt::cull<{width}>(rows.data + (long long)first, ray);"))
    def cull(rows: wp.array(dtype=wp.float32), first: int, mask: int, ray: LaneRay) -> int: ...

    return cull


@cache
def make_cull(width: int) -> Any:
    """Return cull(rows, first, mask, ray): the triangles in `mask`, of the row at rows[first], that the float32 areas do not reject."""
    plain, vector = make_plain_cull(width), make_native_cull(width)

    @wp.func
    def cull(rows: wp.array(dtype=wp.float32), first: int, mask: int, ray: LaneRay) -> int:
        if on_cuda():
            return plain(rows, first, mask, ray)
        return vector(rows, first, mask, ray)

    return cull
