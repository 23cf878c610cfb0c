"""The state of a wave: arrays with one entry for each pixel, sample, place in a queue, or hit. A place is an index in a queue.

The host writes Task and Pixels.order; kernels write the other arrays. wrt/renderer/launches.py allocates the arrays for up to `capacity`
samples. Sample s belongs to pixel s / task.samples of the wave, rounded down."""

import warp as wp

from wrt.kernels.query import HitArrays, RenderRays, store_render_ray
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import make_path, make_paths
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample

Path = make_path(False)
ray_of = make_paths(False).ray_of
BLOCK = 64  # Number of hits or missed rays that vectorised loops process together.


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
class Block:
    """Intermediate values of up to BLOCK hits or missed rays, in the layout of wave_rows.py."""

    rows: wp.array(dtype=wp.float32)  # Row r begins at index r * BLOCK.


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
    block: Block


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
