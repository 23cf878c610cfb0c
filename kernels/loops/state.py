"""The state of a wave: arrays with one entry for each pixel, sample, place in a queue, or hit. A place is an index in a queue.
Vectorised loops process BLOCK hits at a time. Each struct that they load and store has rows of its own (kernels/rows.py), from HITS on.

The host writes Task and Pixels.order; kernels write the other arrays. wrt/renderer/launches.py allocates the arrays for up to `capacity`
samples. Sample s belongs to pixel s / task.samples of the wave, rounded down."""

from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from wrt.kernels import structs
from wrt.kernels.headers import constants, with_headers
from wrt.kernels.parameters import Texels
from wrt.kernels.query import HitArrays, RenderRays, store_render_ray
from wrt.kernels.rows import Rows
from wrt.kernels.shade import sampling, textures
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import Path, ray_of
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample
from wrt.kernels.shade.surface import Surface, Triangle
from wrt.kernels.structs import Emitter

# Constants of Python for the C++ headers of kernels/shade. A header implements functions of the Python file of the same name: a C++
# function and its Python function have one name and return the same bits (tests/kernels/shade/test_twins.py).
LAYOUT_H = constants({name: getattr(sampling, name) for name in (
    "LANES", "HASH_1", "HASH_2", "LK_1", "LK_2", "LK_3", "SEED_X", "SEED_Y", "BITS_1", "BITS_2", "BITS_4", "BITS_8", "UNIT")} | {
        name: getattr(textures, name) for name in ("FARTHEST", "WRAP_REPEAT", "WRAP_CLAMP", "WRAP_MIRROR")})
HEADERS = ("shade/sampling.h", "shade/textures.h", "shade/backgrounds.h", "shade/film.h")
BLOCK = 64  # Number of hits or missed rays that vectorised loops process together.

# lanes_kernel: decorator of CPU kernels that call the functions of these headers.
if TYPE_CHECKING:
    from typing import no_type_check as lanes_kernel
else:
    lanes_kernel = partial(structs.kernel, extra_build_options=with_headers(*HEADERS, layout=LAYOUT_H))


@wp.struct
class Task:
    """The pixels and samples of a wave, all in one tile."""

    x: int  # The tile's left column in the picture.
    y: int  # The tile's top line in the picture.
    width: int  # Width of the tile in pixels.
    pixels: int  # Number of the wave's pixels: used entries of Pixels.order.
    first_sample: int  # Index of the first sample of each pixel.
    samples: int  # Number of samples of each pixel.


@wp.struct
class Progress:
    """Counters of the wave in progress."""

    fresh: int  # 1 while camera rays are traced and shaded, then 0.
    begun: int  # Place behind the last camera ray.
    hits: int  # Number of hits among the rays that are being shaded.
    queued: int  # Number of rays that are traced next.
    receivers: int  # Number of surfaces that wait for shadow rays.


@wp.struct
class Pixels:
    """The wave's pixels: arrays indexed by pixel p."""

    order: wp.array(dtype=wp.int32)  # The pixel's index in the tile, y * width + x.
    key: wp.array(dtype=wp.uint32)  # Seed of the pixel's samples.
    film_index: wp.array(dtype=wp.int32)  # The pixel's index in the film.


@wp.struct
class Samples:
    """The wave's samples: arrays indexed by sample s.

    Each sample has a stack of paths: the waiting paths are paths[level * capacity + s] for level < pending[s]. The path at level
    pending[s] is the one whose ray is queued."""

    film_point: wp.array(dtype=wp.vec2)  # Point in the picture, in pixels.
    lens_point: wp.array(dtype=wp.vec2)  # The lens sample, in [0, 1)^2.
    total: wp.array(dtype=Sample)  # Radiance and counts so far.
    traced_rays: wp.array(dtype=wp.int32)  # Number of rays so far, without shadow rays.
    pending: wp.array(dtype=wp.int32)  # Number of waiting paths.
    paths: wp.array(dtype=Path)  # Indexed by level * capacity + s.


@wp.struct
class RayQueue:
    """The queue of camera rays and path rays: arrays indexed by place k."""

    sample: wp.array(dtype=wp.int32)  # Index of the ray's sample.
    rays: RenderRays
    hits: HitArrays  # The closest hits of `rays`.


@wp.struct
class Outcomes:
    """The traced rays of the queue, sorted into hits and misses."""

    hit_rays: wp.array(dtype=wp.int32)  # Places in the queue of the rays that hit.
    missed_rays: wp.array(dtype=wp.int32)  # Places in the queue of the rays that missed.
    resumed_samples: wp.array(dtype=wp.int32)  # Indices of samples whose ray missed, and whose other paths wait.


@wp.struct
class Receivers:
    """The receivers, surfaces that wait for shadow rays: arrays indexed by receiver a, but `shadow` by light * capacity + a."""

    sample: wp.array(dtype=wp.int32)  # Index of the receiver's sample.
    pending_light: wp.array(dtype=PendingLight)
    scatter: wp.array(dtype=Scatter)  # Stored in scenes with transparent shadows only.
    shadow: wp.array(dtype=wp.int32)  # Slot of the shadow ray (see Shadows), or -1.


@wp.struct
class Shadows:
    """The shadow rays: arrays indexed by slot. Shadow ray i to a light has the slot light * capacity + i."""

    value: wp.array(dtype=wp.vec3)  # Radiance that the light adds if nothing occludes it.
    walk: wp.array(dtype=ShadowWalk)  # The ray's progress, with transparent shadows.


@wp.struct
class ShadowQueue:
    """The shadow rays that are traced next: arrays indexed by place. The queue of a light begins at place light * capacity.

    Without transparent shadows, the place of a ray is its slot in Shadows."""

    rays: RenderRays
    occluded: wp.array(dtype=wp.bool)  # Results in scenes without transparent shadows.
    hits: HitArrays  # Results in scenes with transparent shadows.
    slot: wp.array(dtype=wp.int32)  # Slot of the ray in Shadows; stored with transparent shadows only.
    count: wp.array(dtype=wp.int32)  # Number of queued shadow rays. Indexed by light.


@wp.struct
class Wave:
    """The whole state of a wave. The arrays `task` and `progress` have one entry."""

    capacity: int  # Largest number of samples.
    task: wp.array(dtype=Task)
    progress: wp.array(dtype=Progress)
    pixels: Pixels
    samples: Samples
    queue: RayQueue
    outcomes: Outcomes
    receivers: Receivers
    shadows: Shadows
    shadow_queue: ShadowQueue
    rows: wp.array(dtype=wp.float32)  # Values of up to BLOCK hits or missed rays. Row r begins at index r * BLOCK.


@wp.func_native("""
    auto& sample = samples.data[(long long)i];
    static_assert(sizeof(sample) == sizeof(radiance) + 16, "every field of Sample is stored");
    sample.radiance = radiance; sample.lost = lost;
    sample.rays = rays; sample.cut_depth = cut_depth; sample.cut_throughput = cut_throughput;
""")
def store_fields(samples: wp.array(dtype=Sample), i: int, radiance: wp.vec3, rays: int, cut_depth: int, cut_throughput: int,
               lost: float) -> None: ...


@wp.func
def store_sample(samples: wp.array(dtype=Sample), i: int, sample: Sample):
    """Store sample i field by field.

    If the struct were stored as a whole, 16-byte loads would read what 4-byte stores have just written. The core would have to wait: it
    cannot forward such stores to the load."""
    store_fields(samples, i, sample.radiance, sample.rays, sample.cut_depth, sample.cut_throughput, sample.lost)


@wp.func
def push_path(samples: Samples, capacity: int, s: int, pending: int, path: Path):
    """Push a path of sample s on top of its `pending` waiting paths."""
    samples.paths[pending * capacity + s] = path


@wp.func
def queue_next(wave: Wave, k: int, s: int, pending: int):
    """Pop the top of the `pending` waiting paths of sample s, and put that path's ray at place k of the queue."""
    wave.samples.pending[s] = pending - 1
    wave.queue.sample[k] = s
    store_render_ray(wave.queue.rays, k, ray_of(wave.samples.paths[(pending - 1) * wave.capacity + s]))


# --- the rows of a block ----------------------------------------------------------------------------------------------


@wp.struct
class TriangleHit:
    """A hit, with the data of its triangle for its Surface and shading normal. If it is on a sphere, the triangle is any triangle."""

    triangle: Triangle
    u: float  # Barycentric of corner v1.
    v: float  # Barycentric of corner v2.
    direction: wp.vec3  # The ray's direction.
    material: int  # Material of the triangle or sphere.
    is_mapped: int  # 1 if the material has a normal map.
    normal_scale: float  # Material.normal_scale.


@wp.struct
class SphereHit:
    """A sphere and a hit point, with the data for its Surface."""

    sphere: wp.vec4  # Centre and radius, in world space.
    point: wp.vec3  # The ray's point at the hit.
    is_hit: int  # 1 if the ray hit this sphere; 0 if it hit a triangle.


@wp.struct
class Key:
    """The seed of a hit's random numbers: its path's key, and its sample's index."""

    key: wp.uint32
    index: wp.uint32


@wp.struct
class EmitterPoint:
    """A sampled point on an emitter."""

    emitter: Emitter
    emission: wp.vec3  # Emission of the emitter's material.
    two_sided: int  # 1 if the emitter's material emits on both sides.
    xi: wp.vec2  # Places the point on the emitter, in [0, 1)^2.


@wp.struct
class Drawn:
    """Tells where the background's sample for a hit is, if only some hits of a block have one."""

    i: int  # Its index in the rows SKY; -1: there is none.


HITS = Rows(TriangleHit, BLOCK)
SPHERES = Rows(SphereHit, BLOCK, HITS.end)
SURFACES = Rows(Surface, BLOCK, SPHERES.end)
TEXELS = Rows(Texels, BLOCK, SURFACES.end)
NORMALS = Rows(wp.vec3, BLOCK, TEXELS.end)  # Shading normals on the viewer's side.
KEYS = Rows(Key, BLOCK, NORMALS.end)
FACETS = Rows(wp.vec3, BLOCK, KEYS.end)  # Results of choose_facet.
EMITTERS = Rows(EmitterPoint, BLOCK, FACETS.end)
LIGHTS = Rows(LightSample, BLOCK, EMITTERS.end)  # Samples of light 0, if it is a mesh.
SKY = Rows(LightSample, BLOCK, LIGHTS.end)  # Samples of the background.
SKY_POINTS = Rows(wp.vec3, BLOCK, SKY.end)  # Results of sky_point.
DRAWN = Rows(Drawn, BLOCK, SKY_POINTS.end)
MISS_DIRECTIONS = Rows(wp.vec3, BLOCK, DRAWN.end)  # Directions of missed rays.
MISS_COLORS = Rows(wp.vec3, BLOCK, MISS_DIRECTIONS.end)  # The background's radiance in these directions.
ROWS = MISS_COLORS.end
