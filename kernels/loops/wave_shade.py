"""The step at every hit of a wave's queue: light, new paths, and requests for shadow rays."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.loops.state import BLOCK, Outcomes, Path, RayQueue, Wave, push_path, put_sample, queue_next
from wrt.kernels.loops.wave_lights import Vertex, make_wave_lights
from wrt.kernels.loops.wave_normals import make_wave_normals
from wrt.kernels.loops.wave_numbers import make_sample_facets, put_keys
from wrt.kernels.loops.wave_rows import FACETS, MISSED, SEEN
from wrt.kernels.loops.wave_surfaces import make_wave_surfaces
from wrt.kernels.loops.wave_textures import in_lanes, make_wave_textures
from wrt.kernels.query import put_ray, queued_ray
from wrt.kernels.shade.backgrounds import BACKGROUNDS
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.follow_up import FOLLOWED, FollowUp, make_follow_up, with_cuts
from wrt.kernels.shade.headers import lanes_kernel
from wrt.kernels.shade.paths import make_paths
from wrt.kernels.shade.shading import Shading, make_shading
from wrt.kernels.shade.shadows import Shadow, begin_shadow
from wrt.kernels.shade.step import Sample, ShadowRequest, Step, add_up, is_lit, make_shaded, make_step
from wrt.kernels.structs import Lighting, Limits, Surfaces, any_positive

Shaded = make_shaded(False)
camera_path = make_paths(False).camera_path


@wp.struct
class Arrival:
    """A ray that has hit something. j: its count among the hits; k: its place in the queue; sample: its sample, of which `pending`
    paths wait, and `traced` rays have been traced with this one; sum: what the sample has so far."""

    j: int
    k: int
    sample: int
    pending: int
    traced: int
    path: Path
    sum: Sample


@wp.func
def partition(queue: RayQueue, outcomes: Outcomes, first: int, end: int) -> int:
    """Sort the rays first .. end - 1 into outcomes.hit and outcomes.missed; return how many hit. There are no branches, which would
    be mispredicted here, at each line that is called in, and where a ray is shaded."""
    hits = int(0)
    missed = int(0)
    for k in range(first, end):
        outcomes.hit[hits] = k
        outcomes.missed[missed] = k
        is_hit = wp.where(queue.hits.prim_id[k] >= 0, 1, 0)
        hits += is_hit
        missed += 1 - is_hit
    return hits


@wp.func
def arrive(wave: Wave, j: int) -> Arrival:
    """Return hit j, with what its sample has so far."""
    at = Arrival()
    at.j = j
    at.k = wave.outcomes.hit[j]
    at.sample = wave.queue.sample[at.k]
    if wave.progress[0].fresh != 0:
        at.path = camera_path(queued_ray(wave.queue.rays, at.k), wave.pixels.key[at.sample / wave.task[0].samples])
        at.traced = 1
    else:
        at.pending = wave.samples.pending[at.sample]
        at.path = wave.samples.paths[at.pending * wave.capacity + at.sample]
        at.traced = wave.samples.traced[at.sample] + 1
        at.sum = wave.samples.sum[at.sample]
    at.sum.rays += 1
    return at


def make_add_background(features: Features) -> Any:
    """Return add_background(wave, lighting, missed) -> int: add what the first rays of outcomes.missed see to their samples; return
    how many samples are in outcomes.resumed then."""
    kind = BACKGROUNDS[features.background]
    radiance, store_direction, load_seen = kind.radiance, MISSED.store(), SEEN.load()
    seen_block = kind.make_seen(MISSED, SEEN) if kind.make_seen else None

    @wp.func
    def seen_by(wave: Wave, lighting: Lighting, j: int, missed: int) -> wp.vec3:
        """Return the radiance of ray j; with the first of a block, that of the others is computed."""
        if wp.static(seen_block is not None):
            i = j % BLOCK
            if i == 0:
                count = wp.min(BLOCK, missed - j)
                for n in range(count):
                    store_direction(wave.block.rows, n, wave.queue.rays.direction[wave.outcomes.missed[j + n]])
                seen_block(lighting.background, wave.block.rows, count)
            return load_seen(wave.block.rows, i)
        else:
            return radiance(lighting.background, wave.queue.rays.direction[wave.outcomes.missed[j]])

    @wp.func
    def add_background(wave: Wave, lighting: Lighting, missed: int) -> int:
        fresh = wave.progress[0].fresh
        resumed = int(0)
        for j in range(missed):
            s = wave.queue.sample[wave.outcomes.missed[j]]
            seen = seen_by(wave, lighting, j, missed)
            if fresh != 0:
                out = Sample()
                out.radiance += seen
                out.rays = 1
                put_sample(wave.samples.sum, s, out)
            else:
                pending = wave.samples.pending[s]
                more = wave.samples.sum[s]
                more.radiance += wp.cw_mul(wave.samples.paths[pending * wave.capacity + s].throughput, seen)
                more.rays += 1
                put_sample(wave.samples.sum, s, more)
                wave.samples.traced[s] = wave.samples.traced[s] + 1
                wave.outcomes.resumed[resumed] = s
                resumed += wp.where(pending > 0, 1, 0)
        return resumed

    return add_background


class Lanes(NamedTuple):
    """The functions for a block of hits. prepare(wave, surfaces, lighting, first, end): compute what runs in lanes of the hits
    first .. end - 1, at most BLOCK; apart: whether in a kernel of its own. shade(wave, surfaces, lighting, at) -> Shaded: of a hit
    that is prepared; light_at: of make_wave_lights."""

    prepare: Any
    apart: bool
    shade: Any
    light_at: Any


def make_lanes(features: Features, shading: Shading, step: Step) -> Lanes:
    """Where textures, or numbers that choose a facet or a place in the sky, are computed in lanes, two cores compile two kernels in
    0.6 of the time; without, both together would take longer than one."""
    find, found = make_wave_surfaces(features, shading.surface_at)
    sample_textures, texels_at = make_wave_textures(features, shading.look_up)
    bend, normal_at = make_wave_normals(features, shading.shading_normal)
    lights = make_wave_lights(features, shading, found, step.choose)
    sample_facets, load_facet = make_sample_facets(step.choose_facet), FACETS.load()
    keyed = features.rough or lights.keyed

    @wp.func
    def prepare(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        find(wave, surfaces, first, end, wave.progress[0].hits)
        sample_textures(surfaces, wave.block.rows, end - first)
        bend(wave.block.rows, end - first)
        if wp.static(keyed):
            put_keys(wave, first, end)
        if wp.static(features.rough):
            sample_facets(wave, end - first)
        if wp.static(features.lit):
            lights.sample(wave, surfaces, lighting, first, end)

    @wp.func
    def shade(wave: Wave, surfaces: Surfaces, lighting: Lighting, at: Arrival) -> Shaded:
        i = at.j % BLOCK
        facet = wp.vec3()
        if wp.static(features.rough):
            facet = load_facet(wave.block.rows, i)
        met = found(wave, surfaces, i, at.k)
        texels = texels_at(wave, surfaces, met, i)
        met.shading = normal_at(wave, surfaces, met, texels, -at.path.direction, i)
        return step.shade(surfaces, lighting, at.path, met, texels, wave.queue.hits.t[at.k], facet)

    return Lanes(prepare, keyed or in_lanes(features), shade, lights.at)


def make_ask_lights(features: Features, step: Step, light_at: Any) -> Any:
    """Return ask_lights(wave, surfaces, lighting, shaded, at) -> bool: queue the shadow rays of a hit, and the surface as the next
    receiver; return whether it has any."""

    @wp.func
    def queue_shadow(wave: Wave, light: int, request: ShadowRequest) -> int:
        """Queue a shadow ray; return its slot."""
        slot = light * wave.capacity + wave.shadow_queue.count[light]
        wave.shadow_queue.count[light] = wave.shadow_queue.count[light] + 1
        if wp.static(features.transparent_shadows):
            wave.shadows.walk[slot] = begin_shadow(request.ray, request.end)
            wave.shadow_queue.slot[slot] = slot
        wave.shadows.value[slot] = request.value
        put_ray(wave.shadow_queue.rays, slot, request.ray)
        return slot

    @wp.func
    def ask_lights(wave: Wave, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, at: Arrival, receiver: int) -> bool:
        asks = bool(False)
        task = wave.task[0]
        vertex = Vertex()
        vertex.surface = shaded.surface
        vertex.key.key = shaded.key
        vertex.key.index = wp.uint32(task.first_sample + at.sample % task.samples)
        vertex.i = at.j % BLOCK
        for i in range(lighting.count + wp.static(step.extra_lights)):
            sample = light_at(wave, surfaces, lighting, vertex, i)
            request = step.shadow_request(shaded, sample)
            slot = int(-1)
            if any_positive(request.value):
                slot = queue_shadow(wave, i, request)
                asks = True
            wave.receivers.shadow[i * wave.capacity + receiver] = slot
        return asks

    return ask_lights


def make_push_paths(features: Features) -> Any:
    """Return push_paths(wave, at, shaded, next) -> int: let the new paths that are followed wait; return how many of the sample's
    paths wait then."""

    @wp.func
    def push_paths(wave: Wave, at: Arrival, shaded: Shaded, next: FollowUp) -> int:
        pending = int(at.pending)
        if wp.static(features.blend):
            if next.onward == FOLLOWED:
                push_path(wave.samples, wave.capacity, at.sample, pending, shaded.onward)
                pending += 1
        if wp.static(features.reflection):
            if next.reflected == FOLLOWED:
                push_path(wave.samples, wave.capacity, at.sample, pending, shaded.reflected)
                pending += 1
        if wp.static(features.refraction):
            if next.refracted == FOLLOWED:
                push_path(wave.samples, wave.capacity, at.sample, pending, shaded.refracted)
                pending += 1
        return pending

    return push_paths


def make_shade_kernels(features: Features) -> tuple[Any, Any]:
    """Return the kernel for the step at every hit of the queue, and the kernel for a block of hits that it launches, or None."""
    shading = make_shading(features)
    step, follow_up, add_background = make_step(features, shading), make_follow_up(features), make_add_background(features)
    lanes = make_lanes(features, shading, step)
    ask_lights, push_paths = make_ask_lights(features, step, lanes.light_at), make_push_paths(features)

    @lanes_kernel
    def shade_wave(wave: Wave, surfaces: Surfaces, lighting: Lighting, limits: Limits, block: Launch, first: int, end: int):
        """Of the rays first .. end - 1 of the queue. What is traced next is queued from place progress.queued on, which is not
        behind `first`. block: of prepare_block, if there is one."""
        queued = int(wave.progress[0].queued)
        receivers = int(wave.progress[0].receivers)
        hits = partition(wave.queue, wave.outcomes, first, end)
        wave.progress[0].hits = hits
        resumed = add_background(wave, lighting, end - first - hits)
        for j in range(hits):
            if j % BLOCK == 0:
                if wp.static(lanes.apart):
                    run_range(block, j, wp.min(j + BLOCK, hits))
                else:
                    lanes.prepare(wave, surfaces, lighting, j, wp.min(j + BLOCK, hits))
            at = arrive(wave, j)
            shaded = lanes.shade(wave, surfaces, lighting, at)
            next = follow_up(surfaces, shaded, limits, at.traced)
            pending = push_paths(wave, at, shaded, next)
            sum = with_cuts(at.sum, next)
            asks = bool(False)
            if wp.static(features.lit):
                if is_lit(shaded.scatter):
                    asks = ask_lights(wave, surfaces, lighting, shaded, at, receivers)
            if asks:
                wave.receivers.sample[receivers] = at.sample
                wave.receivers.lit[receivers] = next.lit
                if wp.static(features.transparent_shadows):
                    wave.receivers.scatter[receivers] = shaded.scatter
                receivers += 1
            else:
                sum = add_up(sum, next.lit, Shadow())
            put_sample(wave.samples.sum, at.sample, sum)
            if pending > 0:
                wave.samples.traced[at.sample] = at.traced
                queue_next(wave, queued, at.sample, pending)
                queued += 1
        for j in range(resumed):
            queue_next(wave, queued, wave.outcomes.resumed[j], wave.samples.pending[wave.outcomes.resumed[j]])
            queued += 1
        wave.progress[0].queued = queued
        wave.progress[0].receivers = receivers

    if not lanes.apart:
        return shade_wave, None

    @lanes_kernel
    def prepare_block(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        lanes.prepare(wave, surfaces, lighting, first, end)

    return shade_wave, prepare_block
