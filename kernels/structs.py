"""The records that the units hand to each other, on the device.

Rays and hits are in world space. Every kernel of the project is made by `kernel`, so that all of them are compiled with
the same options.
"""

from typing import TYPE_CHECKING, Any

import warp as wp

from wrt.kernels.headers import with_headers

NO_HIT = wp.constant(0x7FFFFFFF)  # prim_id while nothing is hit: larger than any other, so that ties go to a real one
INF = wp.constant(float("inf"))
EPSILON = wp.constant(2.0**-24)  # the unit roundoff of float32

# A fused multiply-add rounds once where its mirror image rounds twice: the edge tests of two neighbouring triangles would
# no longer be exact negatives of each other, and a ray could slip between them.
#
# The headers have the box and edge tests in lanes, for the walks of wide trees; on the CPU alone.
MODULE_OPTIONS = {"fuse_fp": False, "enable_backward": False, "extra_build_options": with_headers("wide/triangle.h")}


if TYPE_CHECKING:  # device code is not for type checkers: its annotations are Warp's
    from typing import no_type_check as kernel
    from typing import no_type_check as noinline
else:
    def kernel(function, **options):
        """A Warp kernel in a module of its own, without fused multiply-add and without the code for gradients.

        wrt's own kernels are compiled in release mode, whatever wp.config.mode is: a kernel of Warp 1.19 in debug mode ends the
        process where several threads launch it. A kernel of the user follows wp.config.mode."""
        own = {"mode": "release"} if str(function.__module__).startswith("wrt.") else {}  # None where code was made by exec
        return wp.kernel(function, module="unique", module_options=MODULE_OPTIONS | own | options, enable_backward=False)

    def noinline(function):
        """A Warp function that is called, and not copied to where it is called."""
        return wp.func(function, inline=False)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def on_cuda() -> bool:
    """Where the same arithmetic has a faster form on one of the two."""


def size_of(struct: Any) -> int:
    """Bytes of a record."""
    return int(struct.numpy_dtype()["itemsize"])


@wp.func
def gamma(n: float) -> float:
    """n rounding errors in a row, relative: n u / (1 - n u) (Higham 2002, lemma 3.1)."""
    return n * EPSILON / (1.0 - n * EPSILON)


@wp.func
def largest(v: wp.vec3) -> float:
    """The largest of the absolute components."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def lift(v: wp.vec3) -> float:
    """A power of two that brings a very short vector to where its square is no denormal, else 1: scaling by it is exact."""
    return wp.where(largest(v) < wp.static(2.0**-40), wp.static(2.0**80), 1.0)


@wp.struct
class Ray:
    """The points origin + t * direction for t_min <= t <= t_max; direction need not be of unit length.

    `make_ray` makes one that meets all that is before its origin. Ray() is all zeros: its segment ends where it begins, and
    t_max has to be set. exclude_plus_one: 1 + the prim_id of a triangle that is not hit, because the ray starts on it (a plane is
    crossed once); 0: none is left out. slot: the row of the counters that this ray adds to, where they are compiled in.
    first_prim: what an instance adds to its primitives' numbers, where there are instances; above them, the node that a walk begins
    at, the root of the ray's world.
    """

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int
    slot: int
    first_prim: int


@wp.func
def any_positive(v: wp.vec3) -> bool:
    """Whether a component is above 0; NaN is not. wp.max takes three times as long."""
    return v[0] > 0.0 or v[1] > 0.0 or v[2] > 0.0


@wp.func
def unit(v: wp.vec3) -> wp.vec3:
    """wp.normalize without a branch, for loops in lanes."""
    length = wp.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return wp.vec3(wp.where(length > 0.0, v[0] / length, 0.0), wp.where(length > 0.0, v[1] / length, 0.0),
                   wp.where(length > 0.0, v[2] / length, 0.0))


@wp.func
def make_ray(origin: wp.vec3, direction: wp.vec3) -> Ray:
    """The ray from origin to infinity (t_min = 0, t_max = inf), which leaves nothing out. World space; direction of any length
    between 2^-64 and 2^64 (kernels.query.direction_scale brings others there)."""
    ray = Ray()
    ray.origin = origin
    ray.direction = direction
    ray.t_min = 0.0
    ray.t_max = float(wp.inf)
    ray.exclude_plus_one = 0
    return ray


@wp.struct
class Hit:
    """point = (1 - u - v) v0 + u v1 + v v2 on triangle prim_id; prim_id = NO_HIT where there is none."""

    t: float
    u: float
    v: float
    prim_id: int


@wp.struct
class Primitive:
    """A triangle by its corners, or by one corner and two edges (v1, v2); 40 bytes.

    Where prim_id >= the number of triangles, it is sphere prim_id - n_triangles, and the rest is not read.
    """

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    prim_id: int


@wp.struct
class PlanePrimitive:
    """A triangle by three planes (x, y, z: normal, w: offset), for the tests that precompute; 52 bytes. Spheres as above."""

    a: wp.vec4
    b: wp.vec4
    c: wp.vec4
    prim_id: int


@wp.struct
class Texture:
    """A picture in the shared array of texels (from `first`, rows of `width`), or a checkerboard (width = 0)."""

    first: int
    width: int
    height: int
    srgb: int
    wrap_u: int
    wrap_v: int
    row_u: wp.vec3
    row_v: wp.vec3
    color_a: wp.vec3
    color_b: wp.vec3


@wp.struct
class Material:
    """As wrt.scene.materials.Material; textures are indices, -1 for none."""

    kind: int
    albedo: wp.vec3
    specular: wp.vec3
    exponent: float
    eta: wp.vec3
    k: wp.vec3
    ior: float
    absorption: wp.vec3
    thin: int
    metallic: float
    roughness: float
    transmission: float
    emission: wp.vec3
    two_sided: int
    alpha: float
    alpha_mode: int
    alpha_cutoff: float
    normal_scale: float
    albedo_texture: int
    metallic_roughness_texture: int
    transmission_texture: int
    emission_texture: int
    normal_texture: int


@wp.struct
class Instance:
    """A mesh in one place: the primitives from first_prim up to the next instance's.

    first_face: where its faces begin in Surfaces.faces; first_material: likewise in Surfaces.prim_material, and
    material_step: 1, or 0 where it is all of one material. world_x, world_y, world_z: the rows of the affine map of its
    vertices to the world; normal_x ..: the columns of the inverse, up to a positive factor, by which normals go; handedness: -1
    where it is mirrored, else 1.
    """

    first_prim: int
    first_face: int
    first_material: int
    material_step: int
    world_x: wp.vec4d
    world_y: wp.vec4d
    world_z: wp.vec4d
    normal_x: wp.vec3
    normal_y: wp.vec3
    normal_z: wp.vec3
    handedness: float


@wp.struct
class Surfaces:
    """What there is to know about a primitive beyond where it is hit.

    normals and uvs are per vertex (length 1 and unread where the scene has none); n_triangles: primitives from here on are
    spheres (center, radius). instances: in the order of first_prim; then vertices, normals and faces are those of each mesh in
    its own space, once. Without any (length 0), they are in the world, and face and material are numbered as primitives are.
    """

    n_triangles: int
    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    normals: wp.array(dtype=wp.vec3)
    uvs: wp.array(dtype=wp.vec2)
    spheres: wp.array(dtype=wp.vec4)
    instances: wp.array(dtype=Instance)
    prim_material: wp.array(dtype=wp.int32)
    materials: wp.array(dtype=Material)
    textures: wp.array(dtype=Texture)
    texels: wp.array(dtype=wp.uint32)
    srgb_to_linear: wp.array(dtype=wp.float32)


@wp.struct
class Light:
    """kind: its place among the kinds of lights that the kernel is made for.

    Point, spot: position, color = radiant intensity; directional: direction of travel, color = irradiance; sphere:
    position, radius, color = radiance, two_sided: inwards too; mesh: emitters first .. first + count - 1.
    """

    kind: int
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
    """A triangle that emits: its corners and unit normal, in the space of its mesh; the rows of its material and, where there are
    instances, of its instance; and the density per area with which its points are chosen among its light's."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    normal: wp.vec3
    material: int
    instance: int
    pdf_area: float


@wp.struct
class Background:
    """Radiance from outside: a constant (bottom = top), a gradient in y, or a picture with tables to sample it by."""

    bottom: wp.vec3
    top: wp.vec3
    scale: float
    rotation: float
    width: int
    height: int
    pixels: wp.array(dtype=wp.vec3)
    row_cdf: wp.array(dtype=wp.float32)
    column_cdf: wp.array(dtype=wp.float32)


@wp.struct
class Lighting:
    """Every source of light but the surfaces that are seen directly.

    emitter_cdf: per emitter, the share of its light's power up to and with it.
    """

    count: int
    lights: wp.array(dtype=Light)
    emitters: wp.array(dtype=Emitter)
    emitter_cdf: wp.array(dtype=wp.float32)
    background: Background
    ambient: wp.vec3


@wp.struct
class Limits:
    """Where the tree of rays is cut, and how the picture is sampled."""

    max_depth: int
    min_throughput: float
    seed: wp.uint32


@wp.struct
class Film:
    """One entry a pixel, row by row: running mean and sum of squared deviations (Welford 1962), samples, and what it took.

    width, height: of the whole picture; the arrays hold the rectangle of it that begins at x, y and has `columns` pixels a row.
    rays: closest-hit and any-hit rays; cut_depth, cut_throughput: rays that were not followed, and lost: the throughput
    (mean over the channels) that they would have carried. not_finite: samples that came out NaN or infinite and count as 0.
    """

    width: int
    height: int
    x: int
    y: int
    columns: int
    mean: wp.array(dtype=wp.vec3)
    m2: wp.array(dtype=wp.vec3)
    samples: wp.array(dtype=wp.int32)
    rays: wp.array(dtype=wp.int64)
    cut_depth: wp.array(dtype=wp.int32)
    cut_throughput: wp.array(dtype=wp.int32)
    lost: wp.array(dtype=wp.float32)
    not_finite: wp.array(dtype=wp.int32)
    filter_icdf: wp.array(dtype=wp.float32)


@wp.struct
class AovFilm:
    """What the ray through a pixel's centre sees first. width .. columns: as of Film."""

    width: int
    height: int
    x: int
    y: int
    columns: int
    depth: wp.array(dtype=wp.float32)
    normal: wp.array(dtype=wp.vec3)
    albedo: wp.array(dtype=wp.vec3)
    prim_id: wp.array(dtype=wp.int32)
    material_id: wp.array(dtype=wp.int32)
