"""Rows of 4 or 8 floats that one CPU instruction works on, for the few loops that take most of a ray's time.

Rows lie one after another in a flat array of float32. Each function on a row has two forms, which a test holds to the same bits. One is C++
for the CPU; the other is plain Warp, lane by lane, for CUDA."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import on_cuda
from wrt.kernels.units.box import FAR_PAD, BoxRay
from wrt.kernels.units.triangle import edge_areas, outside, sheared
from wrt.kernels.wide.layout import CACHE_LINE

# Rows widen far distances by widening the reciprocals: one product instead of two. The two ways differ by at most four roundings.
# 8 u more than FAR_PAD outweigh these, so that rows enter every box that the box unit enters.
LANE_PAD = wp.constant(FAR_PAD * (1.0 + 8.0 * 2.0**-24))


@wp.struct
class LaneRay:
    """A ray as the tests of rows need it."""

    box: BoxRay  # For the box unit; t_min is never -0.
    far_inv_dir: wp.vec3  # Reciprocals for far planes.
    near_x: int  # The plane (nodes.PLANES) that the ray meets first on x.
    near_y: int
    near_z: int
    kx: int  # This and the next four: as in TriangleRay.
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    origin: wp.vec3  # In the order kx, ky, kz.


def lanes_only(body: str, otherwise: str = "0") -> str:
    """Return the body of a native function for the CPU, where kernels of structs.kernel have the headers of wide/.

    CUDA calls the plain form. A kernel that a user made by wp.kernel is refused (ray_query.fused)."""
    return f"\n#if defined(WRT_INLINE)\n{body}\n#else\n    return {otherwise};\n#endif\n"


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def lowest(mask: int) -> int:
    """Return the lowest lane of a mask, which must not be empty."""


@wp.func_native("return rows.data[(long long)i];")
def value(rows: wp.array(dtype=wp.float32), i: int) -> float:
    """Return rows[i], of an array without gaps."""


@wp.func_native("int value; memcpy(&value, rows.data + (long long)i, sizeof(value)); return value;")
def bits(rows: wp.array(dtype=wp.float32), i: int) -> int:
    """Return rows[i] as the int32 of the same bits."""


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
    for (int k = 0; k < lines; ++k) __builtin_prefetch(rows.data + (long long)first + {CACHE_LINE} * k);
#endif
""")
def prefetch(rows: wp.array(dtype=wp.float32), first: int, lines: int) -> None:
    """Prefetch so many cache lines from rows[first] on."""


@cache
def row_type(width: int) -> Any:
    """Return the vector type of a row of `width` float32."""
    return wp.types.vector(width, wp.float32)


@cache
def make_plain_cull(width: int) -> Any:
    """Return make_cull in plain Warp, lane by lane."""

    @wp.func
    def corner(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> wp.vec3:
        """Return a corner as the ray sees it. Its three rows have this lane at first, first + width and first + 2 width."""
        x = value(rows, first + width * ray.kx)
        y = value(rows, first + width * ray.ky)
        z = value(rows, first + width * ray.kz)
        return sheared(wp.vec3(x, y, z) - ray.origin, ray.shear_x, ray.shear_y)

    @wp.func
    def cull(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> int:
        mask = int(0)
        j = int(0)
        while j < width:  # A `for` would be unrolled, and double a traversal's instructions.
            a = corner(rows, first + j, ray)
            b = corner(rows, first + j + 3 * width, ray)
            c = corner(rows, first + j + 6 * width, ray)
            if not outside(edge_areas(a, b, c)):
                mask = mask | (1 << j)
            j = j + 1
        return mask

    return cull


@cache
def make_native_cull(width: int) -> Any:
    """Return make_cull in C++, for the CPU only."""

    @wp.func_native(lanes_only(f"return wrt::cull<{width}>(rows.data + (long long)first, ray);"))
    def cull(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> int: ...

    return cull


@cache
def make_cull(width: int) -> Any:
    """Return cull(rows, first, ray): the mask of a row's triangles without the ones that the watertight unit refuses in float32."""
    plain, vector = make_plain_cull(width), make_native_cull(width)

    @wp.func
    def cull(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> int:
        if on_cuda():
            return plain(rows, first, ray)
        return vector(rows, first, ray)

    return cull
