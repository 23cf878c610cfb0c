"""Translate a scene to Mitsuba 3, which serves as an independent oracle in tests and as a rival in measurements.

Tests use the variant scalar_rgb in their own process. Measurements also use llvm_ad_rgb, in a process of its own (process.py). Both
variants trace with Embree's robust mode. wrt requests this mode, because Mitsuba's default is the fast mode.

Mitsuba's picture has the expectation of wrt's picture in these cases:
- integrators "path" and "volpath": only specular surfaces, a background and emissive shapes; glass with absorption needs "volpath". On
  diffuse surfaces both add interreflection, which a Whitted tracer does not have.
- "direct": diffuse surfaces, without a mirror or glass in view.
Mitsuba never cuts rays by their throughput, so compare with min_throughput = 0. All other features are refused with an InputError."""

import importlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import NamedTuple

import numpy as np

from wrt.core.checks import as_choice
from wrt.core.errors import InputError
from wrt.lab.mitsuba import INTEGRATORS
from wrt.lab.mitsuba.bsdfs import MitsubaObject, Plugin, refuse
from wrt.lab.mitsuba.emitters import background_emitter, light_emitter
from wrt.lab.mitsuba.shapes import Part, object_parts, sphere_shape
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.model import Scene

VARIANT = "scalar_rgb"


@contextmanager
def mitsuba(variant: str = VARIANT) -> Iterator[ModuleType]:
    """Context that imports `mitsuba`, sets a variant, and restores the former one. Raise InputError if Mitsuba is missing."""
    try:
        mi = importlib.import_module("mitsuba")
    except ImportError as error:
        raise InputError(f"Mitsuba 3 is not usable ({error})", hint='pip install "wrt[peers]" installs it') from error
    before = mi.variant()
    mi.set_variant(variant)
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # Mitsuba warns of every integrator that is written in Python
    try:
        yield mi
    finally:
        mi.set_log_level(level)
        if before is not None:
            mi.set_variant(before)


class Translation(NamedTuple):
    """Result of `translate`. scene: the `mitsuba.Scene`; parts: shape id -> the Part of wrt's scene that became this shape."""

    scene: MitsubaObject
    parts: dict[str, Part]


# Function that makes an integrator with a light transport of its own, from the module `mitsuba`, the scene, whether the scene has an
# emitter to sample, and the parts of the scene by shape id.
MakeIntegrator = Callable[[ModuleType, Scene, bool, Mapping[str, Part]], MitsubaObject]


def translate(mi: ModuleType, scene: Scene, camera: CameraKind | str | int | None = None,
              integrator: str | MakeIntegrator = "auto") -> Translation:
    """Return the scene for the module `mitsuba` in its current variant, with sensor, film, sampler and integrator.

    camera: a camera, or the name or index of a camera of the scene. integrator: one of INTEGRATORS, or a MakeIntegrator. "auto" means
    "volpath" if a material absorbs or is partly transparent, else "path". Raise InputError for features that cannot be translated
    exactly."""
    if isinstance(integrator, str):
        as_choice(integrator, INTEGRATORS, "integrator")
    contents: Plugin = {"type": "scene", "embree_use_robust_intersections": True}
    parts: dict[str, Part] = {}
    for index, thing in enumerate(scene.objects):
        for name, shape, part in object_parts(mi, thing, index):
            contents[name], parts[name] = shape, part
    for index, sphere in enumerate(scene.spheres):
        name = f"sphere{index}"
        contents[name] = sphere_shape(mi, sphere)
        parts[name] = Part(len(scene.objects) + index, None, sphere.material)

    if integrator == "auto":
        needs_volpath = any(m.alpha_mode != "opaque" or max(m.absorption) > 0.0 for m in scene.materials)
        integrator = "volpath" if needs_volpath else "path"
    for index, light in enumerate(scene.lights):
        contents[f"light{index}"] = light_emitter(mi, light)
    background = background_emitter(mi, scene.background)
    if background is not None:
        contents["background"] = background
    lit = bool(scene.lights) or background is not None or any(m.lights_others for m in scene.materials)
    if not lit:  # Mitsuba refuses a scene in which no emitter has a sampling weight above 0
        contents["darkness"] = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 0.0}
    _check_light_transport(scene, integrator)

    if not isinstance(integrator, str):
        contents["integrator"] = integrator(mi, scene, lit, parts)
    elif integrator == "direct":
        contents["integrator"] = {"type": "direct"}
    else:  # Mitsuba counts edges of a path: 1 edge is visible emission, 2 edges are direct light. A large rr_depth disables roulette.
        contents["integrator"] = {"type": integrator, "max_depth": scene.settings.max_depth + 2, "rr_depth": 1 << 16}
    contents["sensor"] = _sensor(mi, scene, camera if isinstance(camera, CameraKind) else scene.camera(camera))
    try:
        return Translation(mi.load_dict(contents), parts)
    except RuntimeError as error:
        raise InputError(f"Mitsuba refuses the scene: {error}") from error


def _check_light_transport(scene: Scene, integrator: str | MakeIntegrator) -> None:
    """Raise InputError for light transport of wrt that the integrator of Mitsuba does not have."""
    materials = scene.materials
    if scene.settings.fresnel == "schlick" and any(m.kind == "glass" for m in materials):
        refuse('fresnel = "schlick"')
    if scene.lights and any(m.is_rough for m in materials if m.kind != "metallic_roughness"):
        refuse("highlights of point lights on rough surfaces (Mitsuba's are GGX, wrt's are Blinn-Phong or missing)")
    if not isinstance(integrator, str):
        return
    if max(scene.ambient) > 0.0:
        refuse("the ambient term")
    if any(m.is_emissive and not m.lights_others for m in materials):
        refuse("emission that does not light other surfaces")
    if integrator != "volpath":
        if any(max(m.absorption) > 0.0 for m in materials):
            refuse(f'absorption with integrator "{integrator}"')
        if any(m.alpha_mode != "opaque" for m in materials):
            refuse(f'alpha with integrator "{integrator}"')


def _sensor(mi: ModuleType, scene: Scene, camera: CameraKind) -> Plugin:
    far, (width, height) = _farthest(scene, camera), scene.settings.size
    # Mitsuba's camera looks along +z with +x to the left: glTF's camera turned by 180 degrees about y.
    pose = camera.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
    sensor: Plugin = {
        "near_clip": 1e-5 * far, "far_clip": 4.0 * far,
        "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "component_format": "float32",
                 "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": scene.settings.spp},
    }
    if isinstance(camera, OrthographicCamera):
        half_width = 0.5 * camera.height * width / height
        pose = pose @ np.diag([half_width, half_width, 1.0, 1.0])
        sensor |= {"type": "orthographic"}
    elif isinstance(camera, Camera):
        sensor |= {"type": "perspective", "fov_axis": "y", "fov": math.degrees(2.0 * math.atan(camera.record((width, height))["tan_y"]))}
        if camera.aperture_radius > 0.0:
            sensor |= {"type": "thinlens", "aperture_radius": camera.aperture_radius, "focus_distance": camera.focus_distance}
            if camera.blades:
                refuse("aperture blades", f"camera {camera.name!r}")
    else:
        refuse(f"a {camera.kind} camera", f"camera {camera.name!r}")
    return sensor | {"to_world": mi.ScalarTransform4f(pose)}


def _farthest(scene: Scene, camera: CameraKind) -> float:
    """Return an upper bound on the distances from the camera to all shapes and to the plane of focus."""
    focus = camera.focus_distance if isinstance(camera, Camera) else 1.0
    if not scene.objects and not scene.spheres:
        return focus
    low, high = scene.bounds()
    position = camera.camera_to_world[:3, 3]
    reach = np.linalg.norm(np.maximum(np.abs(low - position), np.abs(high - position)))
    return max(float(reach), focus if camera.switches().get("lens") else 0.0)
