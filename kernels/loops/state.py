"""The state of a wave: arrays by pixel, sample, place in a queue, or hit. The host writes Task and Pixels.order, kernels the rest.

wrt/renderer/waves.py allocates room for `capacity` samples. Sample s belongs to pixel s / task.samples of the wave."""

import warp as wp

from wrt.kernels.query import HitArrays, RenderRays, store_render_ray
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import make_path, make_paths
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample

Path = make_path(False)
ray_of = make_paths(False).ray_of
BLOCK = 64  # Hits, or missed rays, that vectorised loops take at a time.


@wp.struct
class Task:
    """The pixels and samples that a wave takes: those of one tile."""

    x: int  # The tile's left column in the picture.
    y: int  # The tile's top line.
    width: int  # Of the tile.
    pixels: int  # How many entries of Pixels.order.
    first_sample: int  # Index of the first sample of each pixel.
    samples: int  # Samples of each pixel.


@wp.struct
class Progress:
    """Counts of the wave that is under way."""

    fresh: int  # 1 while camera rays are traced and shaded, then 0.
    begun: int  # Place in the queue behind the last camera ray.
    hits: int  # Hits among the rays that are shaded.
    queued: int  # Rays that are traced next.
    receivers: int  # Surfaces that wait for shadow rays.


@wp.struct
class Pixels:
    """The wave's pixels: arrays by pixel p."""

    order: wp.array(dtype=wp.int32)  # Index in the tile, y * width + x.
    key: wp.array(dtype=wp.uint32)  # Seed of the samples.
    film_index: wp.array(dtype=wp.int32)  # Index in the film.


@wp.struct
class Samples:
    """The wave's samples: arrays by sample s.

    Paths are stacked: paths[level * capacity + s], level < pending, wait. At level `pending` is the queued path."""

    film_point: wp.array(dtype=wp.vec2)  # In pixels.
    lens_point: wp.array(dtype=wp.vec2)  # In [0, 1)^2.
    total: wp.array(dtype=Sample)  # The light so far.
    traced_rays: wp.array(dtype=wp.int32)  # So far, without shadow rays.
    pending: wp.array(dtype=wp.int32)  # Paths that wait.
    paths: wp.array(dtype=Path)


@wp.struct
class RayQueue:
    """The queue of rays: arrays by place k."""

    sample: wp.array(dtype=wp.int32)  # The sample of the ray.
    rays: RenderRays
    hits: HitArrays


@wp.struct
class Outcomes:
    """The queued rays by what they hit."""

    hit_rays: wp.array(dtype=wp.int32)  # Their places in the queue.
    missed_rays: wp.array(dtype=wp.int32)  # Their places in the queue.
    resumed_samples: wp.array(dtype=wp.int32)  # Samples of missed rays that have other paths waiting.


@wp.struct
class Receivers:
    """The surfaces that wait for shadow rays: arrays by receiver a, and `shadow` by light * capacity + a."""

    sample: wp.array(dtype=wp.int32)
    pending_light: wp.array(dtype=PendingLight)
    scatter: wp.array(dtype=Scatter)  # Only with transparent shadows.
    shadow: wp.array(dtype=wp.int32)  # Slot of the shadow ray, or -1.


@wp.struct
class Shadows:
    """The shadow rays: arrays by slot, light * capacity + index."""

    value: wp.array(dtype=wp.vec3)  # Radiance that the light adds if nothing is in between.
    walk: wp.array(dtype=ShadowWalk)  # The ray's progress, with transparent shadows.


@wp.struct
class ShadowQueue:
    """The shadow rays that are traced next: arrays by place, light * capacity + index. Without transparent shadows the place is the
    slot."""

    rays: RenderRays
    occluded: wp.array(dtype=wp.bool)  # Without transparent shadows.
    hits: HitArrays  # With transparent shadows.
    slot: wp.array(dtype=wp.int32)  # With transparent shadows.
    count: wp.array(dtype=wp.int32)  # Shadow rays of each light.


@wp.struct
class Block:
    """Values of a block of up to BLOCK hits or missed rays; wave_rows.py has their layout."""

    rows: wp.array(dtype=wp.float32)


@wp.struct
class Wave:
    """The whole state. `task` and `progress` have one entry."""

    capacity: int
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

    A copy of the struct would read 16 bytes at a time what was written 4 bytes at a time. The core cannot forward such stores."""
    store_fields(samples, i, sample.radiance, sample.rays, sample.cut_depth, sample.cut_throughput, sample.lost)


@wp.func
def push_path(samples: Samples, capacity: int, s: int, pending: int, path: Path):
    """Push a path of sample s on top of its `pending` waiting paths."""
    samples.paths[pending * capacity + s] = path


@wp.func
def queue_next(wave: Wave, k: int, s: int, pending: int):
    """Pop the top of the `pending` waiting paths of sample s, and put its ray at place k of the queue."""
    wave.samples.pending[s] = pending - 1
    wave.queue.sample[k] = s
    store_render_ray(wave.queue.rays, k, ray_of(wave.samples.paths[(pending - 1) * wave.capacity + s]))
