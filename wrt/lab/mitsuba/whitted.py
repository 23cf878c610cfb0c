"""A Whitted integrator inside Mitsuba: its geometry, BSDFs and emitters, with wrt's light transport."""

from __future__ import annotations

import importlib
from typing import Any

from wrt.scene.values import Color

MAX_TRANSPARENT = 256  # surfaces in a row that a ray may go straight through


def whitted_integrator(mi: Any, max_depth: int, ambient: Color, lights: bool, absorption: dict[str, Color],
                       blended: set[str]) -> Any:
    """An integrator whose expectation is wrt's picture: direct light and ambient at diffuse surfaces, where paths end.

    Reflection, refraction and transparency are followed, one of them by chance where wrt follows all. max_depth:
    bounces after the first hit. lights: whether there is an emitter to sample. absorption: shape id -> coefficient
    inside it; blended: ids of shapes that rays pass by their alpha, which is no bounce.
    It is Python code in a scalar variant, some 10 microseconds a bounce: for small pictures.
    """
    flags = mi.BSDFFlags
    diffuse, smooth = int(flags.Diffuse), int(flags.Smooth)
    followed = int(flags.All) & ~diffuse
    anywhere, onward = mi.BSDFContext(), mi.BSDFContext()
    onward.type_mask = followed
    exp = importlib.import_module("drjit").exp
    radiance_around = mi.Color3f(ambient)
    inside = {shape: mi.Color3f(value) for shape, value in absorption.items()}

    def transmittance(scene: Any, si: Any, light: Any) -> Any:
        """What is left of the light on a shadow ray: solid surfaces take all, cut-outs and thin panes a part."""
        share = mi.Color3f(1.0)
        ray = si.spawn_ray_to(light.p)
        for _ in range(MAX_TRANSPARENT):
            hit = scene.ray_intersect(ray)
            if not hit.is_valid():
                return share
            bsdf = hit.bsdf()
            if not bsdf.flags() & int(flags.Null):
                break
            share *= bsdf.eval_null_transmission(hit)
            ray = hit.spawn_ray_to(light.p)
        return mi.Color3f(0.0)

    def direct_light(scene: Any, sampler: Any, si: Any, bsdf: Any) -> Any:
        """One sample of one light; a traced reflection finds those with an area by itself."""
        light, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False)
        if light.pdf == 0.0 or not (light.delta or bsdf.flags() & diffuse):
            return mi.Color3f(0.0)
        value = weight * bsdf.eval(anywhere, si, si.to_local(light.d))
        return value * transmittance(scene, si, light) if max(value) > 0.0 else value

    class Whitted(mi.SamplingIntegrator):  # its base exists only once Mitsuba's variant is set
        def __init__(self) -> None:
            super().__init__(mi.Properties())

        def aov_names(self) -> list[str]:
            return []

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: bool = True) -> Any:
            radiance, throughput, within = mi.Color3f(0.0), mi.Color3f(1.0), None
            depth = passed = 0
            while depth <= max_depth and passed <= MAX_TRANSPARENT:
                si = scene.ray_intersect(ray)
                if within is not None and si.is_valid():
                    throughput *= exp(-within * si.t)
                emitter = si.emitter(scene)
                if emitter is not None:
                    radiance += throughput * emitter.eval(si)
                if not si.is_valid():
                    return radiance, depth + passed > 0, []
                bsdf = si.bsdf()
                if lights and bsdf.flags() & smooth:
                    radiance += throughput * direct_light(scene, sampler, si, bsdf)
                if bsdf.flags() & diffuse and max(ambient) > 0.0:
                    there = 1.0 - bsdf.eval_null_transmission(si)
                    radiance += throughput * radiance_around * bsdf.eval_diffuse_reflectance(si) * there
                if not bsdf.flags() & followed:
                    break
                bounce, weight = bsdf.sample(onward, si, sampler.next_1d(), sampler.next_2d())
                throughput *= weight
                if not max(throughput) > 0.0:
                    break
                direction = si.to_world(bounce.wo)
                if bounce.eta != 1.0:  # refracted, and now on the side where it goes
                    within = inside.get(si.shape.id()) if direction @ si.n < 0.0 else None
                ray = si.spawn_ray(direction)
                if si.shape.id() in blended and bounce.sampled_component == bsdf.component_count() - 1:
                    passed += 1  # straight on past a blended surface (the last component of Mitsuba's mask): no bounce
                else:
                    depth, passed = depth + 1, 0
            return radiance, True, []

    return Whitted()
