"""The state of a wave: a struct for each index. The host writes Task and Pixels.order, kernels the rest; wrt/renderer/waves.py
allocates it.

A wave has room for `capacity` samples. Samples are numbered pixel by pixel: sample s is of pixel s / task.samples of the wave.
"""

import warp as wp

from wrt.kernels.query import HitArrays, Queue, put_ray
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import make_path, make_paths
from wrt.kernels.shade.shadows import ShadowWalk
from wrt.kernels.shade.step import PendingLight, Sample

Path = make_path(False)
ray_of = make_paths(False).ray_of
BLOCK = 64  # rays for which something is computed in lanes at a time


@wp.struct
class Task:
    """The order for a wave: `samples` samples, from first_sample on, of each of the first `pixels` of Pixels.order, in a tile at
    x, y of the picture that is `width` pixels wide."""

    x: int
    y: int
    width: int
    pixels: int
    first_sample: int
    samples: int


@wp.struct
class Progress:
    """How far a wave is. fresh: 1 while camera rays are traced, which end in the queue before place `begun`; hits: of the rays that
    are shaded, those that hit something; queued: rays that are traced next; receivers: surfaces that ask lights."""

    fresh: int
    begun: int
    hits: int
    queued: int
    receivers: int


@wp.struct
class Pixels:
    """By pixel p of the wave. order: its place in the tile, row by row; key: of its samples; film_index: its place in the film."""

    order: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.uint32)
    film_index: wp.array(dtype=wp.int32)


@wp.struct
class Samples:
    """By sample s. film_point: where on the film it is, in pixels; lens_point: where on the lens, in [0, 1)^2; total: what it has
    so far; traced_rays: its rays so far, without those to lights; pending: how many of its paths wait.

    paths[level * capacity + s], for levels below pending: the paths that wait; at level `pending`: the path that is queued, unless
    that is a camera ray.
    """

    film_point: wp.array(dtype=wp.vec2)
    lens_point: wp.array(dtype=wp.vec2)
    total: wp.array(dtype=Sample)
    traced_rays: wp.array(dtype=wp.int32)
    pending: wp.array(dtype=wp.int32)
    paths: wp.array(dtype=Path)


@wp.struct
class RayQueue:
    """By place k in the queue of rays: the sample that a ray is of, the ray, and what it hits."""

    sample: wp.array(dtype=wp.int32)
    rays: Queue
    hits: HitArrays


@wp.struct
class Outcomes:
    """Of the rays that are shaded. hit_rays, missed_rays: their places in the queue; resumed_samples: the samples of missed rays
    whose other paths still wait."""

    hit_rays: wp.array(dtype=wp.int32)
    missed_rays: wp.array(dtype=wp.int32)
    resumed_samples: wp.array(dtype=wp.int32)


@wp.struct
class Receivers:
    """By count a of the surfaces that ask lights. sample: theirs; pending_light; scatter: where shadows are transparent.
    shadow[light * capacity + a]: the slot of the shadow ray, or -1."""

    sample: wp.array(dtype=wp.int32)
    pending_light: wp.array(dtype=PendingLight)
    scatter: wp.array(dtype=Scatter)
    shadow: wp.array(dtype=wp.int32)


@wp.struct
class Shadows:
    """By slot, light * capacity + the shadow ray's count. value: radiance that the light adds to the sample where nothing is in
    between; walk: where shadows are transparent, how far the light is on its way."""

    value: wp.array(dtype=wp.vec3)
    walk: wp.array(dtype=ShadowWalk)


@wp.struct
class ShadowQueue:
    """By place, light * capacity + count of the shadow rays that are traced: ray; occluded: whether something is in between.

    Where shadows are transparent, hits in place of occluded, and slot: of the walk that the ray belongs to. Else the place is the
    slot. count[light]: how many rays.
    """

    rays: Queue
    occluded: wp.array(dtype=wp.bool)
    hits: HitArrays
    slot: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)


@wp.struct
class Block:
    """By place i in a block of BLOCK hits, or of rays that missed. rows: what wave_rows.py says."""

    rows: wp.array(dtype=wp.float32)


@wp.struct
class Wave:
    """All of it. task, progress: one each."""

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
def put_fields(samples: wp.array(dtype=Sample), i: int, radiance: wp.vec3, rays: int, cut_depth: int, cut_throughput: int,
               lost: float) -> None: ...


@wp.func
def put_sample(samples: wp.array(dtype=Sample), i: int, sample: Sample):
    """Put sample i field by field: a copy of the whole reads 16 bytes at a time what was written 4 at a time just before, and for
    that a core waits until it is in the cache."""
    put_fields(samples, i, sample.radiance, sample.rays, sample.cut_depth, sample.cut_throughput, sample.lost)


@wp.func
def push_path(samples: Samples, capacity: int, s: int, pending: int, path: Path):
    """Let a path of sample s wait, on top of `pending` others."""
    samples.paths[pending * capacity + s] = path


@wp.func
def queue_next(wave: Wave, k: int, s: int, pending: int):
    """Put the last path of sample s, of which `pending` wait, to place k of the queue."""
    wave.samples.pending[s] = pending - 1
    wave.queue.sample[k] = s
    put_ray(wave.queue.rays, k, ray_of(wave.samples.paths[(pending - 1) * wave.capacity + s]))
