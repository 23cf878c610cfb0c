"""Light samples of a scene, taken on the device, and the irradiance that they estimate."""

from functools import cache

import numpy as np

from tests.kernel_tools import DEVICE, launch, sobol_like, vec2s, vec3s, zeros  # isort: skip
import warp as wp

from wrt.kernels.shade.backgrounds import make_sky_point, make_sky_sample
from wrt.kernels.shade.direct import shadow_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample, make_light_sample
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Lighting, Ray, Surfaces, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.lights import EMISSIVE, LIGHTS
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere

ALL_LIGHTS = Features(lights=(*LIGHTS, *EMISSIVE), sky_light=True)


@cache
def light_kernel(features):
    light_sample = make_light_sample(features)
    sky_sample, sky_point = make_sky_sample(features), make_sky_point(features)

    @kernel
    def take(lighting: Lighting, surfaces: Surfaces, point: wp.array(dtype=wp.vec3), n: wp.array(dtype=wp.vec3), light: int,
             xi: wp.array(dtype=wp.vec2), out: wp.array(dtype=LightSample), ray: wp.array(dtype=Ray)):
        i = wp.tid()
        s = Surface()
        s.point = point[i]
        s.geometric = n[i]
        s.shading = n[i]
        if light < lighting.count:
            out[i] = light_sample(lighting, surfaces, lighting.lights[light], s, xi[i])
        else:
            out[i] = sky_sample(lighting.background, n[i], sky_point(xi[i]))
        ray[i] = shadow_ray(s, out[i])

    return take


def take(scene, point=(0.0, 0.0, 0.0), n=(0.0, 1.0, 0.0), light=0, xi=None, features=ALL_LIGHTS):
    """Return samples of a light and their shadow rays as structured arrays. The light with index len(lights) is the background."""
    xi = sobol_like(1 << 15, np.random.default_rng(0)) if xi is None else xi
    on_device = upload_scene(scene, DEVICE)
    out, ray = zeros(len(xi), LightSample), zeros(len(xi), Ray)
    rows = [vec3s(np.broadcast_to(np.asarray(a, float), (len(xi), 3))) for a in (point, n)]
    launch(light_kernel(features), len(xi), on_device.lighting, on_device.surfaces, *rows, light, vec2s(xi), out, ray)
    return out.numpy(), ray.numpy()


def irradiance(scene, point=(0.0, 0.0, 0.0), n=(0.0, 1.0, 0.0), light=0, **rest):
    """Return the unoccluded irradiance, (3,): the mean of weight times cosine over the samples."""
    out, _ = take(scene, point, n, light, **rest)
    cosine = np.maximum(out["wi"].astype(np.float64) @ np.asarray(n, float), 0.0)
    return (out["weight"] * cosine[:, None]).mean(axis=0)


def lamp(mesh, emission=(3.0, 2.0, 1.0), **rest):
    return Object(mesh, (Material(emission=emission, **rest),))


def inside_out(center=(0.0, 0.1, 0.0), radius=1.0, two_sided=True):
    return Scene(spheres=(Sphere(center, radius, Material(emission=(3.0, 2.0, 1.0), two_sided=two_sided)),))
