"""One ray at a time: a loop around the integrator's step that traces what it asks for. Pending paths wait on a small stack."""

import warp as wp

from wrt.kernels.shade.backgrounds import make_background
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, make_transmittance
from wrt.kernels.shade.step import Sample, make_shaded, make_step, mean3
from wrt.kernels.structs import Lighting, Limits, Ray, Surfaces


def make_direct_light(features, accel_struct, transmittance, step, counting=False):
    """Light straight from every light (and the background) by one shadow ray each."""
    Shaded = make_shaded(counting)
    shadow_request, extra_lights = step.shadow_request, step.extra_lights

    @wp.func
    def direct_light(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, index: wp.uint32) -> Shadow:
        """In `transmittance`: the radiance towards the eye. cut: shadow rays that were, and lost: the light they were worth in
        a room of radiance 1."""
        out = Shadow()
        for i in range(lighting.count + wp.static(extra_lights)):
            request = shadow_request(surfaces, lighting, shaded, i, index)
            if wp.max(request.value) > 0.0:
                shadow = transmittance(accel, surfaces, request.ray, request.end)
                out.transmittance += wp.cw_mul(request.value, shadow.transmittance)
                out.rays += shadow.rays
                if wp.static(features.transparent_shadows):
                    out.cut += shadow.cut
                    out.lost += wp.cw_mul(shaded.scatter.diffuse + shaded.scatter.highlight, shadow.lost)
        return out

    return direct_light


def make_radiance(features, accel_struct, closest_hit, any_hit, counting=False):
    """The whole tree of rays behind one camera ray. `features`: wrt.renderer.features.Features; counting: rays carry a label."""
    shading = make_shading(features)
    step = make_step(features, shading, counting)
    Path, first_path, ray_of, shade, _, _, keep, tally = step
    background_radiance = make_background(features)
    transmittance = make_transmittance(features, shading, accel_struct, closest_hit, any_hit)
    direct_light = make_direct_light(features, accel_struct, transmittance, step, counting)
    lit = bool(features.lights) or features.sky_light

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
            shaded = shade(surfaces, lighting, path, ray, hit, index)
            if wp.static(features.blend):
                verdict = keep(shaded.onward, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.onward
                    size = size + 1
                out = tally(out, surfaces, shaded.onward, verdict)
            light = shaded.light
            if wp.static(lit):
                if wp.max(shaded.scatter.diffuse) > 0.0 or wp.max(shaded.scatter.highlight) > 0.0:
                    direct = direct_light(accel, surfaces, lighting, shaded, index)
                    light += direct.transmittance
                    out.rays += direct.rays
                    if wp.static(features.transparent_shadows):
                        out.cut_depth += direct.cut
                        out.lost += mean3(wp.cw_mul(shaded.throughput, direct.lost))
            out.radiance += wp.cw_mul(shaded.throughput, light)
            if wp.static(features.reflection):
                verdict = keep(shaded.reflected, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.reflected
                    size = size + 1
                out = tally(out, surfaces, shaded.reflected, verdict)
            if wp.static(features.refraction):
                verdict = keep(shaded.refracted, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.refracted
                    size = size + 1
                out = tally(out, surfaces, shaded.refracted, verdict)
        return out

    return radiance
