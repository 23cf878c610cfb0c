"""The kernels that shade a wave's traced rays: they add light, push new paths, and queue shadow rays."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.loops.state import (
    BLOCK,
    FACETS,
    MISS_COLORS,
    MISS_DIRECTIONS,
    Outcomes,
    RayQueue,
    Wave,
    lanes_kernel,
    push_path,
    queue_next,
    store_sample,
)
from wrt.kernels.loops.wave_hits import (
    make_sample_facets,
    make_wave_normals,
    make_wave_surfaces,
    make_wave_textures,
    store_keys,
    textures_vectorised,
)
from wrt.kernels.loops.wave_lights import Vertex, make_wave_lights
from wrt.kernels.query import load_render_ray, store_render_ray
from wrt.kernels.shade.backgrounds import BACKGROUNDS
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.follow_up import FOLLOWED, FollowUp, add_cuts, make_follow_up
from wrt.kernels.shade.paths import Path, camera_path
from wrt.kernels.shade.shading import Shading, make_shading
from wrt.kernels.shade.shadows import begin_shadow
from wrt.kernels.shade.step import DirectLight, Sample, Shaded, ShadowRequest, Step, add_surface_light, make_step, receives_light
from wrt.kernels.shade.surface import with_normal
from wrt.kernels.structs import Lighting, Limits, Surfaces, any_positive


@wp.struct
class WaveHit:
    """A queued ray that has hit something, and the state of its sample."""

    j: int  # Index in Outcomes.hit_rays.
    k: int  # Place of the ray in the queue.
    sample: int  # Index of the sample.
    pending: int  # Number of waiting paths of the sample.
    traced: int  # Number of the sample's rays so far, with this ray and without shadow rays.
    path: Path  # The path of the ray.
    total: Sample  # Radiance and counts of the sample so far, with this ray.


@wp.func
def partition(queue: RayQueue, outcomes: Outcomes, first: int, end: int) -> int:
    """Sort the queue's places first .. end - 1 into outcomes.hit_rays and outcomes.missed_rays; return the number of hits.

    It is branch-free: hits and misses alternate unpredictably."""
    hits = int(0)
    missed = int(0)
    for k in range(first, end):
        outcomes.hit_rays[hits] = k
        outcomes.missed_rays[missed] = k
        is_hit = wp.where(queue.hits.prim_id[k] >= 0, 1, 0)
        hits += is_hit
        missed += 1 - is_hit
    return hits


@wp.func
def load_wave_hit(wave: Wave, j: int) -> WaveHit:
    """Return hit j with the state of its sample."""
    hit = WaveHit()
    hit.j = j
    hit.k = wave.outcomes.hit_rays[j]
    hit.sample = wave.queue.sample[hit.k]
    if wave.progress[0].fresh != 0:
        hit.path = camera_path(load_render_ray(wave.queue.rays, hit.k), wave.pixels.key[hit.sample / wave.task[0].samples])
        hit.traced = 1
    else:
        hit.pending = wave.samples.pending[hit.sample]
        hit.path = wave.samples.paths[hit.pending * wave.capacity + hit.sample]
        hit.traced = wave.samples.traced_rays[hit.sample] + 1
        hit.total = wave.samples.total[hit.sample]
    hit.total.rays += 1
    return hit


def make_add_background(features: Features) -> Any:
    """Return add_background(wave, lighting, missed) -> int: add the background's radiance to the samples of all missed rays.

    missed: number of missed rays. The result is the number of these samples that have waiting paths, stored in resumed_samples."""
    kind = BACKGROUNDS[features.background]
    radiance, store_direction, load_color = kind.radiance, MISS_DIRECTIONS.store(), MISS_COLORS.load()
    block_radiance = kind.make_block_radiance(MISS_DIRECTIONS, MISS_COLORS) if kind.make_block_radiance else None

    @wp.func
    def miss_radiance(wave: Wave, lighting: Lighting, j: int, missed: int) -> wp.vec3:
        """Return the background's radiance for missed ray j. The first ray of a block computes the radiance of the whole block."""
        if wp.static(block_radiance is not None):
            i = j % BLOCK
            if i == 0:
                count = wp.min(BLOCK, missed - j)
                for n in range(count):
                    store_direction(wave.rows, n, wave.queue.rays.direction[wave.outcomes.missed_rays[j + n]])
                block_radiance(lighting.background, wave.rows, count)
            return load_color(wave.rows, i)
        else:
            return radiance(lighting.background, wave.queue.rays.direction[wave.outcomes.missed_rays[j]])

    @wp.func
    def add_background(wave: Wave, lighting: Lighting, missed: int) -> int:
        fresh = wave.progress[0].fresh
        resumed = int(0)
        for j in range(missed):
            s = wave.queue.sample[wave.outcomes.missed_rays[j]]
            background = miss_radiance(wave, lighting, j, missed)
            if fresh != 0:
                out = Sample()
                out.radiance += background
                out.rays = 1
                store_sample(wave.samples.total, s, out)
            else:
                pending = wave.samples.pending[s]
                total = wave.samples.total[s]
                total.radiance += wp.cw_mul(wave.samples.paths[pending * wave.capacity + s].throughput, background)
                total.rays += 1
                store_sample(wave.samples.total, s, total)
                wave.samples.traced_rays[s] = wave.samples.traced_rays[s] + 1
                wave.outcomes.resumed_samples[resumed] = s
                resumed += wp.where(pending > 0, 1, 0)
        return resumed

    return add_background


class BlockFunctions(NamedTuple):
    """The device functions for a block of at most BLOCK hits."""

    prepare: Any  # (wave, surfaces, lighting, first, end): compute the vectorised parts of the hits first .. end - 1.
    own_kernel: bool  # True if `prepare` is compiled as a kernel of its own.
    shade: Any  # (wave, surfaces, lighting, hit) -> Shaded, for a hit of the prepared block.
    light_at: Any  # The result of make_light_at.


def make_block_functions(features: Features, shading: Shading, step: Step) -> BlockFunctions:
    """Return the BlockFunctions of a scene.

    In scenes with vectorised textures, rough surfaces or vectorised light samples, `prepare` is a kernel of its own. Two cores compile
    the two kernels in 0.6 of the time that one kernel takes. In other scenes, two kernels would take longer."""
    compute_surfaces, hit_surface = make_wave_surfaces(features, shading.surface_at)
    sample_textures, texels_at = make_wave_textures(features, shading.look_up)
    compute_normals, normal_at = make_wave_normals(features, shading.shading_normal)
    lights = make_wave_lights(features, step.sample_light)
    sample_facets, load_facet = make_sample_facets(step.choose_facet), FACETS.load()
    needs_keys = features.rough or lights.needs_keys

    @wp.func
    def prepare(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        if wp.static(compute_surfaces is not None):
            compute_surfaces(wave, surfaces, first, end, wave.progress[0].hits)
        if wp.static(sample_textures is not None):
            sample_textures(surfaces, wave.rows, end - first)
        if wp.static(compute_normals is not None):
            compute_normals(wave.rows, end - first)
        if wp.static(needs_keys):
            store_keys(wave, first, end)
        if wp.static(features.rough):
            sample_facets(wave, end - first)
        if wp.static(lights.needs_keys):
            lights.sample(wave, surfaces, lighting, first, end)

    @wp.func
    def shade(wave: Wave, surfaces: Surfaces, lighting: Lighting, hit: WaveHit) -> Shaded:
        i = hit.j % BLOCK
        facet = wp.vec3()
        if wp.static(features.rough):
            facet = load_facet(wave.rows, i)
        surface = hit_surface(wave, surfaces, i, hit.k)
        texels = texels_at(wave, surfaces, surface, i)
        surface = with_normal(surface, normal_at(wave, surfaces, surface, texels, -hit.path.direction, i))
        return step.shade(surfaces, lighting, hit.path, surface, texels, wave.queue.hits.t[hit.k], facet)

    return BlockFunctions(prepare, needs_keys or textures_vectorised(features), shade, lights.at)


def make_request_shadows(features: Features, step: Step, light_at: Any) -> Any:
    """Return request_shadows(wave, surfaces, lighting, shaded, hit, receiver) -> bool: queue the shadow rays of a hit.

    It stores the slots of the rays in Receivers.shadow, and returns True if it queued a ray. receiver: index of the receiver."""

    @wp.func
    def queue_shadow(wave: Wave, light: int, request: ShadowRequest) -> int:
        """Queue a shadow ray; return its slot."""
        slot = light * wave.capacity + wave.shadow_queue.count[light]
        wave.shadow_queue.count[light] = wave.shadow_queue.count[light] + 1
        if wp.static(features.transparent_shadows):
            wave.shadows.walk[slot] = begin_shadow(request.ray, request.end)
            wave.shadow_queue.slot[slot] = slot
        wave.shadows.value[slot] = request.value
        store_render_ray(wave.shadow_queue.rays, slot, request.ray)
        return slot

    @wp.func
    def request_shadows(wave: Wave, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, hit: WaveHit, receiver: int) -> bool:
        has_shadows = bool(False)
        task = wave.task[0]
        vertex = Vertex()
        vertex.surface = shaded.surface
        vertex.key.key = shaded.key
        vertex.key.index = wp.uint32(task.first_sample + hit.sample % task.samples)
        vertex.i = hit.j % BLOCK
        for i in range(lighting.count + wp.static(step.extra_lights)):
            sample = light_at(wave, surfaces, lighting, vertex, i)
            request = step.shadow_request(shaded, sample)
            slot = int(-1)
            if any_positive(request.value):
                slot = queue_shadow(wave, i, request)
                has_shadows = True
            wave.receivers.shadow[i * wave.capacity + receiver] = slot
        return has_shadows

    return request_shadows


def make_push_paths(features: Features) -> Any:
    """Return push_paths(wave, hit, shaded, next) -> int: push the FOLLOWED paths (follow_up.py), return the number of waiting paths."""

    @wp.func
    def push_paths(wave: Wave, hit: WaveHit, shaded: Shaded, next: FollowUp) -> int:
        pending = int(hit.pending)
        if wp.static(features.blend):
            if next.onward == FOLLOWED:
                push_path(wave.samples, wave.capacity, hit.sample, pending, shaded.onward)
                pending += 1
        if wp.static(features.clearcoat):
            if next.coated == FOLLOWED:
                push_path(wave.samples, wave.capacity, hit.sample, pending, shaded.coated)
                pending += 1
        if wp.static(features.reflection):
            if next.reflected == FOLLOWED:
                push_path(wave.samples, wave.capacity, hit.sample, pending, shaded.reflected)
                pending += 1
        if wp.static(features.refraction):
            if next.refracted == FOLLOWED:
                push_path(wave.samples, wave.capacity, hit.sample, pending, shaded.refracted)
                pending += 1
        return pending

    return push_paths


def make_shade_kernels(features: Features) -> tuple[Any, Any]:
    """Return the kernel shade_wave, and prepare_block, which is the kernel of BlockFunctions.prepare, or None without own_kernel."""
    shading = make_shading(features)
    step, follow_up, add_background = make_step(features, shading), make_follow_up(features), make_add_background(features)
    block_functions = make_block_functions(features, shading, step)
    request_shadows, push_paths = make_request_shadows(features, step, block_functions.light_at), make_push_paths(features)

    @lanes_kernel
    def shade_wave(wave: Wave, surfaces: Surfaces, lighting: Lighting, limits: Limits, block: Launch, first: int, end: int):
        """Shade the rays at the places first .. end - 1. Queue new rays from place progress.queued <= first on. block: prepare_block."""
        queued = int(wave.progress[0].queued)
        receivers = int(wave.progress[0].receivers)
        hits = partition(wave.queue, wave.outcomes, first, end)
        wave.progress[0].hits = hits
        resumed = add_background(wave, lighting, end - first - hits)
        for j in range(hits):
            if j % BLOCK == 0:
                if wp.static(block_functions.own_kernel):
                    run_range(block, j, wp.min(j + BLOCK, hits))
                else:
                    block_functions.prepare(wave, surfaces, lighting, j, wp.min(j + BLOCK, hits))
            hit = load_wave_hit(wave, j)
            shaded = block_functions.shade(wave, surfaces, lighting, hit)
            next = follow_up(surfaces, shaded, limits, hit.traced)
            pending = push_paths(wave, hit, shaded, next)
            total = add_cuts(hit.total, next)
            has_shadows = bool(False)
            if wp.static(features.direct_light):
                if receives_light(shaded.scatter):
                    has_shadows = request_shadows(wave, surfaces, lighting, shaded, hit, receivers)
            if has_shadows:
                wave.receivers.sample[receivers] = hit.sample
                wave.receivers.pending_light[receivers] = next.pending_light
                if wp.static(features.transparent_shadows):
                    wave.receivers.scatter[receivers] = shaded.scatter
                receivers += 1
            else:
                total = add_surface_light(total, next.pending_light, DirectLight())
            store_sample(wave.samples.total, hit.sample, total)
            if pending > 0:
                wave.samples.traced_rays[hit.sample] = hit.traced
                queue_next(wave, queued, hit.sample, pending)
                queued += 1
        for j in range(resumed):
            queue_next(wave, queued, wave.outcomes.resumed_samples[j], wave.samples.pending[wave.outcomes.resumed_samples[j]])
            queued += 1
        wave.progress[0].queued = queued
        wave.progress[0].receivers = receivers

    if not block_functions.own_kernel:
        return shade_wave, None

    @lanes_kernel
    def prepare_block(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        block_functions.prepare(wave, surfaces, lighting, first, end)

    return shade_wave, prepare_block
