"""The step at every hit of a wave's queue."""

from typing import Any

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.loops.wave import BLOCK, Path, Wave, enqueue, put_sample
from wrt.kernels.loops.wave_lights import Vertex, make_wave_lights
from wrt.kernels.loops.wave_normals import make_wave_normals
from wrt.kernels.loops.wave_numbers import make_sample_facets, put_keys
from wrt.kernels.loops.wave_rows import FACETS, HITS, SEEN
from wrt.kernels.loops.wave_surfaces import make_wave_surfaces
from wrt.kernels.loops.wave_textures import in_lanes, make_wave_textures
from wrt.kernels.query import put_ray, queued_ray
from wrt.kernels.shade.backgrounds import BACKGROUNDS
from wrt.kernels.shade.follow_up import FOLLOWED, make_follow_up, with_cuts
from wrt.kernels.shade.paths import make_paths
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, begin_shadow
from wrt.kernels.shade.step import Sample, ShadowRequest, add_up, is_lit, make_step
from wrt.kernels.structs import Lighting, Limits, Surfaces, any_positive, kernel


def make_shade_kernels(features: Any) -> tuple[Any, Any]:
    """The step at every hit of the queue: its light, its new paths, and its requests for shadow rays. And a kernel for what it
    launches for a block of hits, or None: where textures, or numbers that choose a facet or a place in the sky, are computed in
    lanes, so that two cores compile the two in 0.6 of the time; without, both together would take longer than one."""
    shading = make_shading(features)
    step = make_step(features, shading)
    find, found = make_wave_surfaces(features, shading.surface_at)
    sample_textures, texels_at = make_wave_textures(features, shading.look_up)
    follow_up, camera_path = make_follow_up(features), make_paths(False).camera_path
    bend, normal_at = make_wave_normals(features, shading.shading_normal)
    wave_lights = make_wave_lights(features, shading, found, step.choose)
    sample_lights, light_at = wave_lights.sample, wave_lights.at
    keyed = features.rough or wave_lights.keyed
    load_facet, store_direction = FACETS.load(), HITS.field("direction").store()
    load_seen = SEEN.load()
    apart = keyed or in_lanes(features)
    sample_facets = make_sample_facets(step.choose_facet)
    radiance, _, make_seen = BACKGROUNDS[features.background]
    seen_at = make_seen(HITS.field("direction"), SEEN) if make_seen else None

    @wp.func
    def push(wave: Wave, number: int, size: int, path: Path, verdict: int) -> int:
        """The number of paths that wait, with this one where it is followed."""
        if verdict == FOLLOWED:
            wave.paths[size * wave.capacity + number] = path
            return size + 1
        return size

    @wp.func
    def ask(wave: Wave, i: int, request: ShadowRequest) -> int:
        """The place of a shadow ray to light i."""
        slot = i * wave.capacity + wave.asking[i]
        wave.asking[i] = wave.asking[i] + 1
        if wp.static(features.transparent_shadows):
            wave.walks[slot] = begin_shadow(request.ray, request.end)
            wave.waiting[slot] = slot
        wave.value[slot] = request.value
        put_ray(wave.shadow_rays, slot, request.ray)
        return slot

    @wp.func
    def part(wave: Wave, first: int, end: int) -> int:
        """wave.met: those of the rays first .. end - 1 that hit something, wave.missed: the others. Returns how many hit. There are
        no branches, which would be mispredicted here, at each line that is called in, and where a ray is shaded."""
        met = int(0)
        missed = int(0)
        for k in range(first, end):
            wave.met[met] = k
            wave.missed[missed] = k
            hit = wp.where(wave.hits.prim_id[k] >= 0, 1, 0)
            met += hit
            missed += 1 - hit
        return met

    @wp.func
    def see_background(wave: Wave, lighting: Lighting, missed: int) -> int:
        """What the rays that missed add to their samples. Returns how many of those have paths that wait: wave.missed holds their
        numbers then."""
        job = wave.job[0]
        left = int(0)
        for j in range(missed):
            k = wave.missed[j]
            number = wave.number[k]
            seen = wp.vec3()
            if wp.static(seen_at is not None):
                i = j % BLOCK
                if i == 0:
                    count = wp.min(BLOCK, missed - j)
                    for n in range(count):
                        store_direction(wave.rows, n, wave.rays.direction[wave.missed[j + n]])
                    seen_at(lighting.background, wave.rows, count)
                seen = load_seen(wave.rows, i)
            else:
                seen = radiance(lighting.background, wave.rays.direction[k])
            if job.fresh != 0:
                out = Sample()
                out.radiance += seen
                out.rays = 1
                put_sample(wave.done, number, out)
            else:
                size = wave.size[number]
                more = wave.done[number]
                more.radiance += wp.cw_mul(wave.paths[size * wave.capacity + number].throughput, seen)
                more.rays += 1
                put_sample(wave.done, number, more)
                wave.traced[number] = wave.traced[number] + 1
                wave.missed[left] = number
                left += wp.where(size > 0, 1, 0)
        return left

    @wp.func
    def follow_next(wave: Wave, queued: int, number: int, size: int):
        """Queue the last path of a sample of which `size` wait."""
        wave.size[number] = size - 1
        enqueue(wave, queued, number, wave.paths[(size - 1) * wave.capacity + number])

    @wp.func
    def prepare(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        """What is computed in lanes, for the hits first .. end - 1, at most BLOCK."""
        find(wave, surfaces, first, end, wave.job[0].hits)
        sample_textures(wave, surfaces, first, end)
        bend(wave, surfaces, first, end)
        if wp.static(keyed):
            put_keys(wave, first, end)
        if wp.static(features.rough):
            sample_facets(wave, end - first)
        if wp.static(features.lit):
            sample_lights(wave, surfaces, lighting, first, end)

    @kernel
    def shade_wave(wave: Wave, surfaces: Surfaces, lighting: Lighting, limits: Limits, block: Launch, first: int, end: int):
        """Of the rays first .. end - 1 of the queue. What is traced next is queued from place job.queued on, which is not behind
        `first`. block: of prepare_block, if there is one."""
        job = wave.job[0]
        queued = int(job.queued)
        asked = int(job.asked)
        hits = part(wave, first, end)
        wave.job[0].hits = hits
        left = see_background(wave, lighting, end - first - hits)
        for j in range(hits):
            if j % BLOCK == 0:
                if wp.static(apart):
                    run_range(block, j, wp.min(j + BLOCK, hits))
                else:
                    prepare(wave, surfaces, lighting, j, wp.min(j + BLOCK, hits))
            k = wave.met[j]
            number = wave.number[k]
            size = int(0)
            traced = int(1)
            path = Path()
            out = Sample()
            if job.fresh != 0:
                path = camera_path(queued_ray(wave.rays, k), wave.pixel_keys[number / job.samples])
            else:
                size = wave.size[number]
                traced = wave.traced[number] + 1
                path = wave.paths[size * wave.capacity + number]
                out = wave.done[number]
            out.rays += 1
            asks = int(0)
            index = wp.uint32(job.first_sample + number % job.samples)
            facet = wp.vec3()
            if wp.static(features.rough):
                facet = load_facet(wave.rows, j % BLOCK)
            met = found(wave, surfaces, j % BLOCK, k)
            texels = texels_at(wave, surfaces, met, j % BLOCK)
            met.shading = normal_at(wave, surfaces, met, texels, -path.direction, j % BLOCK)
            shaded = step.shade(surfaces, lighting, path, met, texels, wave.hits.t[k], facet)
            next = follow_up(surfaces, shaded, limits, traced)
            out = with_cuts(out, next)
            lit = next.lit
            if wp.static(features.blend):
                size = push(wave, number, size, shaded.onward, next.onward)
            if wp.static(features.reflection):
                size = push(wave, number, size, shaded.reflected, next.reflected)
            if wp.static(features.refraction):
                size = push(wave, number, size, shaded.refracted, next.refracted)
            if wp.static(features.lit):
                if is_lit(shaded.scatter):
                    vertex = Vertex()
                    vertex.surface = shaded.surface
                    vertex.key.key = shaded.key
                    vertex.key.index = index
                    vertex.i = j % BLOCK
                    for i in range(lighting.count + wp.static(step.extra_lights)):
                        sample = light_at(wave, surfaces, lighting, vertex, i)
                        request = step.shadow_request(shaded, sample)
                        slot = int(-1)
                        if any_positive(request.value):
                            slot = ask(wave, i, request)
                            asks += 1
                        wave.request[i * wave.capacity + asked] = slot
            if asks > 0:
                wave.asked[asked] = number
                wave.lit[asked] = lit
                if wp.static(features.transparent_shadows):
                    wave.scatter[asked] = shaded.scatter
                asked += 1
            else:
                out = add_up(out, lit, Shadow())
            put_sample(wave.done, number, out)
            if size > 0:
                wave.traced[number] = traced
                follow_next(wave, queued, number, size)
                queued += 1
        for j in range(left):
            number = wave.missed[j]
            follow_next(wave, queued, number, wave.size[number])
            queued += 1
        wave.job[0].queued = queued
        wave.job[0].asked = asked

    if not apart:
        return shade_wave, None

    @kernel
    def prepare_block(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        prepare(wave, surfaces, lighting, first, end)

    return shade_wave, prepare_block
