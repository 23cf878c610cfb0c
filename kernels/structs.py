"""Structs that the parts of the device code exchange, and `kernel`, which compiles all kernels with the same options.
Rays and hits are in world space."""

from typing import TYPE_CHECKING, Any

import warp as wp

from wrt.kernels.headers import STACK_LENGTH, text_of, with_headers
from wrt.kernels.parameters import Material as Material

NO_HIT = wp.constant(0x7FFFFFFF)  # prim_id of a miss during traversal: larger than every index, so that a hit at equal t wins
EPSILON = wp.constant(2.0**-24)  # unit roundoff u of float32

# No fused multiply-add: it rounds a b - c d and c d - a b differently. The edge tests of two neighbouring triangles would no longer be
# exact negatives, and a ray could slip between the triangles.
#
# The headers contain vectorised box and edge tests for the traversal of wide BVHs on a CPU.
MODULE_OPTIONS = {"fuse_fp": False, "enable_backward": False,
                  "extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=text_of("wide/triangle.h"))}
OWN_OPTIONS = {"extra_build_options": with_headers("wide/triangle.h")}


if TYPE_CHECKING:  # type checkers skip device code, because Warp's annotations are not Python types
    from typing import no_type_check as kernel
    from typing import no_type_check as noinline
    from typing import no_type_check as query_kernel
else:
    def kernel(function, registers=None, **options):
        """Make a Warp kernel in a module of its own, without fused multiply-add and without code for gradients.
        registers: most registers of a CUDA thread."""
        own = OWN_OPTIONS if str(function.__module__).startswith("wrt.") else {}  # __module__ is None in code made by exec
        return wp.kernel(function, module="unique", module_options=MODULE_OPTIONS | own | options, enable_backward=False,
                         cuda_max_registers=registers)

    def query_kernel(function):
        """Make a kernel that traces one ray per thread. With at most 80 registers, a multiprocessor holds 24 warps."""
        return kernel(function, registers=80)

    def noinline(function):
        """Make a Warp function that is called, never inlined. Functions that run once per block or wave then compile faster.
        Warp 1.17 has no such option."""
        return wp.func(function) if wp.config.version.startswith("1.17.") else wp.func(function, inline=False)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(mask);
#else
    return __builtin_popcount(mask);
#endif
""")
def bit_count(mask: int) -> int:
    """Count the bits of a mask that are 1."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def on_cuda() -> bool:
    """Test whether the code runs on CUDA. Callers then choose a faster form of the same arithmetic."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int arch = __CUDA_ARCH__;
    return arch == 600 || arch == 700 || arch == 800 || arch == 900 || arch == 1000;
#else
    return false;
#endif
""")
def fast_float64() -> bool:
    """Test whether the code runs on a GPU for data centres (sm_60, sm_70, sm_80, sm_90, sm_100): its float64 has half the rate of float32,
    that of other GPUs 1/32 to 1/64."""


def stack_type(dtype: Any) -> Any:
    """Return the type of a traversal stack: a vector whose entries kernels of wrt do not set when they make it (headers.STACKS)."""
    return wp.types.vector(STACK_LENGTH, dtype)


def size_of(struct: Any) -> int:
    """Return the size of a struct in bytes."""
    return int(struct.numpy_dtype()["itemsize"])


@wp.func
def gamma(n: float) -> float:
    """Bound the relative error of n successive roundings: n u / (1 - n u) (Higham 2002, lemma 3.1)."""
    return n * EPSILON / (1.0 - n * EPSILON)


@wp.func
def last_entry(first: wp.array(dtype=wp.int32), begin: int, end: int, prim_id: int) -> int:
    """Return the last i of begin .. end - 1 with first[i] <= prim_id. Objects without primitives are skipped: their entry equals the next
    entry."""
    low = int(begin)
    high = int(end)
    while high - low > 1:
        middle = (low + high) / 2
        if first[middle] <= prim_id:
            low = middle
        else:
            high = middle
    return low


@wp.func
def largest(v: wp.vec3) -> float:
    """Return the largest absolute component."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def lift(v: wp.vec3) -> float:
    """Return 2^80 if all components are below 2^-40, because the square could be denormal; else 1. The product with v is exact."""
    return wp.where(largest(v) < wp.static(2.0**-40), wp.static(2.0**80), 1.0)


@wp.struct
class Ray:
    """The points origin + t * direction for t_min <= t <= t_max; direction need not have unit length.
    `make_ray` makes a ray that reaches to infinity. In Ray(), all fields are 0: set at least direction and t_max."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int  # 1 + prim_id of the triangle that the ray starts on and must not hit; 0: no such triangle.
    slot: int  # Index of the ray's counters or hit list. With Units.resumes: lowest prim_id of a hit at t_min.
    first_prim: int  # Inside an instance: the offset to add to prim_id. Above instances: root node of the ray's world.


@wp.struct
class Filter:
    """Instances that a ray does not see (Units.filtered)."""

    exclude: int  # Value of Instances.bodies that the ray passes through; -1: none.
    mask: int  # Bits: the ray sees an instance that has at least one of them in Instances.masks.


@wp.func
def any_positive(v: wp.vec3) -> bool:
    """Test whether a component is above 0; NaN is not. A test with wp.max takes three times as long."""
    return v[0] > 0.0 or v[1] > 0.0 or v[2] > 0.0


@wp.func
def unit(v: wp.vec3) -> wp.vec3:
    """Normalise v; (0, 0, 0) stays. Unlike wp.normalize, it has no branch, so loops with it are vectorised."""
    length = wp.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return wp.vec3(wp.where(length > 0.0, v[0] / length, 0.0), wp.where(length > 0.0, v[1] / length, 0.0),
                   wp.where(length > 0.0, v[2] / length, 0.0))


@wp.func
def make_ray(origin: wp.vec3, direction: wp.vec3) -> Ray:
    """Make the ray from origin to infinity (t_min = 0, t_max = inf) that excludes no triangle, in world space.
    The direction's length must be between 2^-64 and 2^64; for other lengths see kernels.query.direction_scale."""
    ray = Ray()
    ray.origin = origin
    ray.direction = direction
    ray.t_min = 0.0
    ray.t_max = float(wp.inf)
    ray.exclude_plus_one = 0
    return ray


@wp.struct
class Hit:
    """A hit: the point (1 - u - v) v0 + u v1 + v v2 on triangle prim_id.
    A miss has prim_id = NO_HIT during traversal, and -1 in the result of a traversal."""

    t: float  # In units of the direction's length.
    u: float  # u, v: barycentric coordinates; 0 on a sphere.
    v: float
    prim_id: int


@wp.struct
class Primitive:
    """A triangle by its corners v0, v1, v2, or by the corner v0 and the edges v1, v2 from it; 40 bytes.
    If prim_id >= n_triangles, the record stands for sphere prim_id - n_triangles, and v0, v1, v2 are not read."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    prim_id: int


@wp.struct
class PlanePrimitive:
    """A triangle by three planes (x, y, z: normal, w: offset), for the tests units.triangle.plane_equation and baldwin_weber; 52 bytes.
    Spheres: as in Primitive."""

    a: wp.vec4
    b: wp.vec4
    c: wp.vec4
    prim_id: int


@wp.struct
class Texture:
    """An image in the shared array Surfaces.texels, or a checkerboard of two colours (width = 0)."""

    first: int  # Index of the image's first texel in Surfaces.texels; the image has `height` rows of `width` texels.
    width: int
    height: int
    srgb: int  # 1: the texels are sRGB-encoded; 0: linear.
    wrap_u: int  # wrap_u, wrap_v: kernels.shade.textures.WRAP_REPEAT, WRAP_CLAMP or WRAP_MIRROR.
    wrap_v: int
    row_u: wp.vec3  # row_u, row_v: rows of the affine map from a surface's uv to texture coordinates.
    row_v: wp.vec3
    color_a: wp.vec3  # Colour of the checkerboard's square at (0, 0); color_b: of its neighbours.
    color_b: wp.vec3


@wp.struct
class Instance:
    """A mesh placed in the scene. Its primitives have the prim_id from first_prim up to the first_prim of the next instance."""

    first_prim: int
    first_face: int  # Index of the mesh's first face in Surfaces.faces.
    first_material: int  # Index of the instance's first material in Surfaces.prim_material.
    material_step: int  # Either 1, or 0 if one material serves the whole mesh.
    world_x: wp.vec4d  # world_x, world_y, world_z: rows of the affine map from the mesh's space to world space.
    world_y: wp.vec4d
    world_z: wp.vec4d
    normal_x: wp.vec3  # normal_x, normal_y, normal_z: columns of the map's inverse, times a positive factor, to transform normals.
    normal_y: wp.vec3
    normal_z: wp.vec3
    handedness: float  # -1 for a mirroring map, else 1.


@wp.struct
class Surfaces:
    """Attributes of primitives, read after a hit.
    With instances, vertices, normals and faces are stored once per mesh, in the mesh's space. Without instances (array of length 0), they
    are in world space, and prim_id indexes faces and prim_material. Arrays that a scene does not use have length 1."""

    n_triangles: int  # Primitives with prim_id >= n_triangles are spheres.
    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)  # Indices of each triangle's vertices.
    normals: wp.array(dtype=wp.vec3)  # One per vertex.
    uvs: wp.array(dtype=wp.vec2)  # One per vertex.
    spheres: wp.array(dtype=wp.vec4)  # (center, radius)
    instances: wp.array(dtype=Instance)  # Ascending by first_prim.
    prim_material: wp.array(dtype=wp.int32)  # Indices into `materials`.
    materials: wp.array(dtype=Material)
    textures: wp.array(dtype=Texture)
    texels: wp.array(dtype=wp.uint32)  # RGBA of 8 bits each, red in the lowest byte.
    srgb_to_linear: wp.array(dtype=wp.float32)  # Linear values: of the 256 sRGB bytes, then of the 256 linear bytes.


@wp.struct
class Light:
    """A light. The list names the fields that each kind of light uses; other fields are not read.

    - Point, spot: position, color = radiant intensity; spot also: direction = axis, cos_inner, cos_outer = cosines of the half angles.
    - Directional: direction of travel, color = irradiance.
    - Sphere: position = center, radius, color = radiance, two_sided = 1 if it also shines inwards.
    - Mesh: emitters first .. first + count - 1.
    """

    kind: int  # Index into the list of light kinds that the kernel is compiled for.
    position: wp.vec3
    direction: wp.vec3
    color: wp.vec3
    cos_inner: float
    cos_outer: float
    radius: float
    two_sided: int
    first: int
    count: int


@wp.struct
class Emitter:
    """An emitting triangle: corners and unit normal in the space of the mesh."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    normal: wp.vec3
    material: int  # Index of the triangle's material.
    instance: int  # Index of the triangle's instance, if the scene has instances.
    pdf_area: float  # Probability density, per unit area, with which sampling the light returns a point of this triangle.


@wp.struct
class Background:
    """Radiance of rays that leave the scene: a constant (bottom = top), a gradient in y, or an image with tables to sample it."""

    bottom: wp.vec3
    top: wp.vec3
    scale: float  # Factor of the image's radiance.
    rotation: float  # Angle of the image about +y in radians, counter-clockwise seen from above.
    width: int
    height: int
    pixels: wp.array(dtype=wp.vec3)  # `height` rows of `width` pixels.
    row_cdf: wp.array(dtype=wp.float32)  # Cumulative distribution over the rows.
    column_cdf: wp.array(dtype=wp.float32)  # Cumulative distribution over the columns of each row.


@wp.struct
class Lighting:
    """The sources of light that shading samples, the background, and the ambient term."""

    count: int  # Number of lights.
    lights: wp.array(dtype=Light)
    emitters: wp.array(dtype=Emitter)
    emitter_cdf: wp.array(dtype=wp.float32)  # Entry i: share of a light's power in its emitters up to and including emitter i.
    background: Background
    ambient: wp.vec3
    ambient_radius: float  # Surfaces farther away do not occlude the ambient term. Unread unless Features.ambient_occlusion.


@wp.struct
class Limits:
    """Limits of the tree of rays, and the seed of the samples."""

    max_depth: int  # Largest number of bounces.
    min_throughput: float  # Paths with less throughput are cut.
    seed: wp.uint32
