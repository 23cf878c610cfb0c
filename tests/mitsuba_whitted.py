"""A Whitted integrator for Mitsuba: wrt's light transport on Mitsuba's geometry, BSDFs and emitters."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import ModuleType

from wrt.lab.mitsuba.shapes import MitsubaObject, Part
from wrt.scene.model import Scene
from wrt.scene.values import Color

MAX_TRANSPARENT = 256  # most successive surfaces that a ray passes straight through


class Walk:
    """Random paths whose mean is wrt's picture. Diffuse surfaces end a path and add direct and ambient light.

    Where wrt follows reflection, refraction and transparency, a path follows one of them at random.
    - max_depth: most bounces after the first hit; lights: True if the scene has an emitter to sample.
    - absorption: shape id -> absorption coefficient inside; blended: ids of shapes with alpha, which rays pass without a bounce."""

    def __init__(self, mi: ModuleType, max_depth: int, ambient: Color, lights: bool, absorption: dict[str, Color],
                 blended: set[str]) -> None:
        flags = mi.BSDFFlags
        self.mi, self.max_depth, self.lights, self.blended = mi, max_depth, lights, blended
        self.diffuse, self.smooth, self.null = int(flags.Diffuse), int(flags.Smooth), int(flags.Null)
        self.followed = int(flags.All) & ~self.diffuse
        self.anywhere, self.onward = mi.BSDFContext(), mi.BSDFContext()
        self.onward.type_mask = self.followed
        self.exp = importlib.import_module("drjit").exp
        self.ambient = mi.Color3f(ambient)
        self.inside = {shape: mi.Color3f(value) for shape, value in absorption.items()}

    def transmittance(self, scene: MitsubaObject, si: MitsubaObject, light: MitsubaObject) -> MitsubaObject:
        """Return the share of `light` that reaches the surface point `si`. Solid surfaces block all of it, cut-outs and thin panes some."""
        share = self.mi.Color3f(1.0)
        ray = si.spawn_ray_to(light.p)
        for _ in range(MAX_TRANSPARENT):
            hit = scene.ray_intersect(ray)
            if not hit.is_valid():
                return share
            bsdf = hit.bsdf()
            if not bsdf.flags() & self.null:
                break
            share *= bsdf.eval_null_transmission(hit)
            ray = hit.spawn_ray_to(light.p)
        return self.mi.Color3f(0.0)

    def direct_light(self, scene: MitsubaObject, sampler: MitsubaObject, si: MitsubaObject, bsdf: MitsubaObject) -> MitsubaObject:
        """Return the reflected light of one sampled emitter. A surface without a diffuse part reflects only lights without area."""
        light, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False)
        if light.pdf == 0.0 or not (light.delta or bsdf.flags() & self.diffuse):
            return self.mi.Color3f(0.0)
        value = weight * bsdf.eval(self.anywhere, si, si.to_local(light.d))
        return value * self.transmittance(scene, si, light) if max(value) > 0.0 else value

    def reflected(self, scene: MitsubaObject, sampler: MitsubaObject, si: MitsubaObject, bsdf: MitsubaObject) -> MitsubaObject:
        """Return the direct and ambient light that a surface reflects back along the path."""
        radiance = self.mi.Color3f(0.0)
        if self.lights and bsdf.flags() & self.smooth:
            radiance += self.direct_light(scene, sampler, si, bsdf)
        if bsdf.flags() & self.diffuse and max(self.ambient) > 0.0:
            opacity = 1.0 - bsdf.eval_null_transmission(si)
            radiance += self.ambient * bsdf.eval_diffuse_reflectance(si) * opacity
        return radiance

    def sample(self, scene: MitsubaObject, sampler: MitsubaObject, ray: MitsubaObject) -> tuple[MitsubaObject, bool, list[str]]:
        """Return radiance, a flag for a hit, and no AOVs: the interface of Mitsuba's SamplingIntegrator.sample."""
        radiance, throughput, within = self.mi.Color3f(0.0), self.mi.Color3f(1.0), None
        depth = passed = 0
        while depth <= self.max_depth and passed <= MAX_TRANSPARENT:
            si = scene.ray_intersect(ray)
            if within is not None and si.is_valid():
                throughput *= self.exp(-within * si.t)
            emitter = si.emitter(scene)
            if emitter is not None:
                radiance += throughput * emitter.eval(si)
            if not si.is_valid():
                return radiance, depth + passed > 0, []
            bsdf = si.bsdf()
            radiance += throughput * self.reflected(scene, sampler, si, bsdf)
            if not bsdf.flags() & self.followed:
                break
            bounce, weight = bsdf.sample(self.onward, si, sampler.next_1d(), sampler.next_2d())
            throughput *= weight
            if not max(throughput) > 0.0:
                break
            direction = si.to_world(bounce.wo)
            if bounce.eta != 1.0:  # refracted: the ray enters or leaves a medium
                within = self.inside.get(si.shape.id()) if direction @ si.n < 0.0 else None
            ray = si.spawn_ray(direction)
            if si.shape.id() in self.blended and bounce.sampled_component == bsdf.component_count() - 1:
                passed += 1  # straight through a blended surface (the last component of Mitsuba's mask): no bounce
            else:
                depth, passed = depth + 1, 0
        return radiance, True, []


def whitted(mi: MitsubaObject, scene: Scene, lit: bool, parts: Mapping[str, Part]) -> MitsubaObject:
    """Return a Mitsuba integrator that samples a Walk in Python, at about 10 microseconds a bounce: for small pictures only."""
    inside = {key: part.material.absorption for key, part in parts.items() if max(part.material.absorption) > 0.0}
    blended = {key for key, part in parts.items() if part.material.alpha_mode == "blend"}
    walk = Walk(mi, scene.settings.max_depth, scene.ambient, lit, inside, blended)

    class Whitted(mi.SamplingIntegrator):  # the base class exists only after a variant is set
        def __init__(self) -> None:
            super().__init__(mi.Properties())

        def aov_names(self) -> list[str]:
            return []

        def sample(self, scene: MitsubaObject, sampler: MitsubaObject, ray: MitsubaObject, *_: object) -> MitsubaObject:
            return walk.sample(scene, sampler, ray)

    return Whitted()
