"""Records that the units exchange on the device, and `kernel`, which compiles all kernels with the same options.
Rays and hits are in world space."""

from typing import TYPE_CHECKING, Any

import warp as wp

from wrt.kernels.headers import with_headers

NO_HIT = wp.constant(0x7FFFFFFF)  # prim_id of a miss inside a walk: larger than any other, so that a hit at equal t wins.
INF = wp.constant(float("inf"))
EPSILON = wp.constant(2.0**-24)  # the unit roundoff of float32

# A fused multiply-add rounds once where its mirror image rounds twice. The edge tests of two neighbouring triangles would no longer be
# exact negatives, and a ray could slip between them.
#
# The headers hold the box and edge tests in lanes, for the walks of wide trees on a CPU.
MODULE_OPTIONS = {"fuse_fp": False, "enable_backward": False, "extra_build_options": with_headers("wide/triangle.h")}


if TYPE_CHECKING:  # type checkers do not read device code: its annotations are Warp's
    from typing import no_type_check as kernel
    from typing import no_type_check as noinline
else:
    def kernel(function, **options):
        """Make a Warp kernel in a module of its own, without fused multiply-add and without code for gradients.
        In wrt's own modules, kernels are compiled in release mode, whatever wp.config.mode is: in debug mode, a kernel of Warp 1.19 ends
        the process when several threads launch it. A user's kernel follows wp.config.mode."""
        own = {"mode": "release"} if str(function.__module__).startswith("wrt.") else {}  # __module__ is None in code made by exec
        return wp.kernel(function, module="unique", module_options=MODULE_OPTIONS | own | options, enable_backward=False)

    def noinline(function):
        """Make a Warp function that is called, never inlined."""
        return wp.func(function, inline=False)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def on_cuda() -> bool:
    """Test for CUDA, where the same arithmetic may have a faster form."""


def size_of(struct: Any) -> int:
    """Return the bytes of a record."""
    return int(struct.numpy_dtype()["itemsize"])


@wp.func
def gamma(n: float) -> float:
    """Relative bound on n successive rounding errors, n u / (1 - n u) (Higham 2002, lemma 3.1)."""
    return n * EPSILON / (1.0 - n * EPSILON)


@wp.func
def largest(v: wp.vec3) -> float:
    """Largest absolute component."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def lift(v: wp.vec3) -> float:
    """Power of two that brings a very short vector to where its square is no denormal, else 1: an exact factor."""
    return wp.where(largest(v) < wp.static(2.0**-40), wp.static(2.0**80), 1.0)


@wp.struct
class Ray:
    """The points origin + t * direction for t_min <= t <= t_max; direction need not have unit length.
    `make_ray` makes one that reaches to infinity. Ray() is all zeros: its segment is empty until t_max is set."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int  # 1 + prim_id of the triangle that the ray starts on, which it does not hit; 0: none.
    slot: int  # Index of its counters, if counters are compiled in.
    first_prim: int  # Inside an instance: added to its primitives' prim_id. Above instances: root node of the ray's world.


@wp.func
def any_positive(v: wp.vec3) -> bool:
    """Test whether a component is above 0; NaN is not. wp.max takes three times as long."""
    return v[0] > 0.0 or v[1] > 0.0 or v[2] > 0.0


@wp.func
def unit(v: wp.vec3) -> wp.vec3:
    """Normalise v without wp.normalize's branch, for loops in lanes; (0, 0, 0) stays."""
    length = wp.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return wp.vec3(wp.where(length > 0.0, v[0] / length, 0.0), wp.where(length > 0.0, v[1] / length, 0.0),
                   wp.where(length > 0.0, v[2] / length, 0.0))


@wp.func
def make_ray(origin: wp.vec3, direction: wp.vec3) -> Ray:
    """Make the ray from origin to infinity (t_min = 0, t_max = inf) that excludes no triangle. World space; the direction's length is
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
    """The point (1 - u - v) v0 + u v1 + v v2 on triangle prim_id; a miss has prim_id = NO_HIT."""

    t: float
    u: float
    v: float
    prim_id: int


@wp.struct
class Primitive:
    """A triangle by its corners, or by one corner and two edges (v1, v2); 40 bytes.
    If prim_id >= the number of triangles, it is sphere prim_id - n_triangles, and the rest is not read."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    prim_id: int


@wp.struct
class PlanePrimitive:
    """A triangle by three planes (x, y, z: normal, w: offset), for tests that precompute; 52 bytes. Spheres as in Primitive."""

    a: wp.vec4
    b: wp.vec4
    c: wp.vec4
    prim_id: int


@wp.struct
class Texture:
    """An image in the shared array of texels, or a checkerboard (width = 0)."""

    first: int  # Its first texel; rows of `width` texels follow.
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
    """The fields of wrt.scene.materials.Material; textures are indices, -1 for none."""

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
    """A mesh in one place: the primitives from first_prim up to the next instance's."""

    first_prim: int
    first_face: int  # Index of its first face in Surfaces.faces.
    first_material: int  # Index of its first material in Surfaces.prim_material.
    material_step: int  # 1, or 0 if one material serves the whole mesh.
    world_x: wp.vec4d  # Rows of the affine map from the mesh to the world: world_x, world_y, world_z.
    world_y: wp.vec4d
    world_z: wp.vec4d
    normal_x: wp.vec3  # Columns of the inverse, up to a positive factor, which map normals: normal_x, normal_y, normal_z.
    normal_y: wp.vec3
    normal_z: wp.vec3
    handedness: float  # -1 for a mirroring map, else 1.


@wp.struct
class Surfaces:
    """Attributes of primitives, read after a hit.
    With instances, vertices, normals and faces are stored once a mesh, in its own space. Without (length 0), they are in world space, and
    prim_id indexes faces and materials. Unused arrays of a scene have length 1."""

    n_triangles: int  # Primitives from this prim_id on are spheres.
    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    normals: wp.array(dtype=wp.vec3)  # Per vertex.
    uvs: wp.array(dtype=wp.vec2)  # Per vertex.
    spheres: wp.array(dtype=wp.vec4)  # (center, radius)
    instances: wp.array(dtype=Instance)  # In the order of first_prim.
    prim_material: wp.array(dtype=wp.int32)
    materials: wp.array(dtype=Material)
    textures: wp.array(dtype=Texture)
    texels: wp.array(dtype=wp.uint32)
    srgb_to_linear: wp.array(dtype=wp.float32)


@wp.struct
class Light:
    """One light of a kind that the kernel is made for; fields that its kind does not name are not read.

    - Point, spot: position, color = radiant intensity.
    - Directional: direction of travel, color = irradiance.
    - Sphere: position, radius, color = radiance, two_sided = 1 if it also shines inwards.
    - Mesh: emitters first .. first + count - 1.
    """

    kind: int  # Index among the kernel's kinds of lights.
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
    """An emitting triangle: corners and unit normal in the space of its mesh."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    normal: wp.vec3
    material: int  # Index of its material.
    instance: int  # Index of its instance, if the scene has instances.
    pdf_area: float  # Probability density, per area, of a point on it among its light's points.


@wp.struct
class Background:
    """Radiance from outside: a constant (bottom = top), a gradient in y, or an image with tables for importance sampling."""

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
    """All sources of light but emitting surfaces that a ray hits."""

    count: int
    lights: wp.array(dtype=Light)
    emitters: wp.array(dtype=Emitter)
    emitter_cdf: wp.array(dtype=wp.float32)  # Per emitter: cumulative share of its light's power, itself included.
    background: Background
    ambient: wp.vec3


@wp.struct
class Limits:
    """Limits of the tree of rays, and the seed of the samples."""

    max_depth: int
    min_throughput: float
    seed: wp.uint32


@wp.struct
class Film:
    """One entry a pixel, in row order: running mean and sum of squared deviations (Welford 1962), samples, and costs.
    The arrays hold the rectangle of the image that begins at (x, y) and is `columns` pixels wide."""

    width: int  # Of the whole image, as height.
    height: int
    x: int
    y: int
    columns: int
    mean: wp.array(dtype=wp.vec3)
    m2: wp.array(dtype=wp.vec3)
    samples: wp.array(dtype=wp.int32)
    rays: wp.array(dtype=wp.int64)  # Closest-hit and any-hit rays.
    cut_depth: wp.array(dtype=wp.int32)  # Rays not followed because of max_depth.
    cut_throughput: wp.array(dtype=wp.int32)  # Rays not followed because of min_throughput.
    lost: wp.array(dtype=wp.float32)  # Throughput, mean over the channels, of the rays that were not followed.
    not_finite: wp.array(dtype=wp.int32)  # Samples that were NaN or infinite, and count as 0.
    filter_icdf: wp.array(dtype=wp.float32)


@wp.struct
class AovFilm:
    """What the ray through a pixel's centre hits first; width .. columns as in Film."""

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
