"""One ray at a time: a loop around the integrator's step that traces what it asks for. Pending paths wait on a small stack."""

from typing import Any

import warp as wp

from wrt.kernels.shade.backgrounds import make_background
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, make_transmittance
from wrt.kernels.shade.step import Lit, Sample, add_up, counted, is_lit, lit_by, make_shaded, make_step
from wrt.kernels.structs import Lighting, Limits, Ray, Surfaces, any_positive


def make_direct_light(features: Any, accel_struct: Any, transmittance: Any, step: Any, counting: bool = False) -> Any:
    """Light straight from every light (and the background) by one shadow ray each."""
    Shaded = make_shaded(counting)
    choose, shadow_request, extra_lights = step.choose, step.shadow_request, step.extra_lights
    light_point = make_light_points(features).point

    @wp.func
    def direct_light(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, index: wp.uint32) -> Shadow:
        """As `add_up` takes it. cut: shadow rays that were, and lost: the light they were worth in a room of radiance 1."""
        out = Shadow()
        for i in range(lighting.count + wp.static(extra_lights)):
            point = light_point(lighting, shaded.key, index, i)
            request = shadow_request(shaded, choose(lighting, surfaces, i, shaded.surface, point))
            if any_positive(request.value):
                out = lit_by(out, request.value, shaded.scatter, transmittance(accel, surfaces, request.ray, request.end))
        return out

    return direct_light


def make_radiance(features: Any, accel_struct: Any, closest_hit: Any, any_hit: Any, counting: bool = False) -> Any:
    """The whole tree of rays behind one camera ray. `features`: wrt.renderer.features.Features; counting: rays carry a label."""
    shading = make_shading(features)
    step = make_step(features, shading, counting)
    surface_at, look_up, shading_normal = shading.surface_at, shading.look_up, shading.shading_normal
    Path, first_path, ray_of, shade, keep, worth = step.Path, step.first_path, step.ray_of, step.shade, step.keep, step.worth
    choose_facet = step.choose_facet
    background_radiance = make_background(features)
    transmittance = make_transmittance(features, shading, accel_struct, closest_hit, any_hit)
    direct_light = make_direct_light(features, accel_struct, transmittance, step, counting)

    @wp.func
    def radiance(
        accel: accel_struct, surfaces: Surfaces, lighting: Lighting, limits: Limits, camera_ray: Ray, key: wp.uint32,
        index: wp.uint32,
    ) -> Sample:
        out = Sample()
        stack = wp.zeros(shape=wp.static(features.stack_size), dtype=Path)
        stack[0] = first_path(camera_ray, key)
        size = int(1)
        traced = int(0)
        while size > 0:
            size = size - 1
            path = stack[size]
            ray = ray_of(path)
            out.rays += 1
            traced += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.radiance += wp.cw_mul(path.throughput, background_radiance(lighting.background, path.direction))
                continue
            met = surface_at(surfaces, ray, hit)
            texels = look_up(surfaces, met)
            met.shading = shading_normal(surfaces, met, texels, -path.direction)
            shaded = shade(surfaces, lighting, path, met, texels, hit.t, choose_facet(path.key, index))
            lit = Lit()
            lit.light = shaded.light
            lit.throughput = shaded.throughput
            if wp.static(features.blend):
                verdict = keep(shaded.onward, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.onward
                    size = size + 1
                out = counted(out, verdict)
                out.lost += worth(surfaces, shaded.onward, verdict)
            if wp.static(features.reflection):
                verdict = keep(shaded.reflected, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.reflected
                    size = size + 1
                out = counted(out, verdict)
                lit.reflected = worth(surfaces, shaded.reflected, verdict)
            if wp.static(features.refraction):
                verdict = keep(shaded.refracted, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.refracted
                    size = size + 1
                out = counted(out, verdict)
                lit.refracted = worth(surfaces, shaded.refracted, verdict)
            direct = Shadow()
            if wp.static(features.lit):
                if is_lit(shaded.scatter):
                    direct = direct_light(accel, surfaces, lighting, shaded, index)
            out = add_up(out, lit, direct)
        return out

    return radiance
