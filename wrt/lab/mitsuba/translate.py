"""Translate a scene to Mitsuba 3, which serves as an independent oracle in tests and as a rival in measurements.

Tests use the variant scalar_rgb in their own process. Measurements also use llvm_ad_rgb, in a process of its own (equal_error.py). Both
variants trace with Embree's robust mode. wrt requests this mode, because Mitsuba's default is the fast mode.

Mitsuba's picture has the expectation of wrt's picture in these cases:
- integrators "path" and "volpath": only specular surfaces, a background and emissive shapes; glass with absorption needs "volpath". On
  diffuse surfaces both add interreflection, which a Whitted tracer does not have.
- "direct": diffuse surfaces, without a mirror or glass in view.
Mitsuba never cuts rays by their throughput, so compare with min_throughput = 0. All other features are refused with an InputError."""

import importlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from wrt.core.checks import as_choice
from wrt.core.errors import InputError
from wrt.lab.mitsuba import INTEGRATORS
from wrt.lab.mitsuba.shapes import MitsubaObject, Part, Plugin, object_parts, refuse, rgb, sphere_shape
from wrt.scene.backgrounds import Background, EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.lights import Light, SpotLight
from wrt.scene.model import Scene

VARIANT = "scalar_rgb"
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"  # where Mitsuba's compiler, Dr.Jit, looks for LLVM
# Rows of a gradient's picture: linear interpolation of a cosine over steps of pi / 1024 has an error of at most 1.2e-6.
GRADIENT_ROWS = 1025
SPOT_TEXELS = 1024  # columns and rows of the texture that holds a spot light's falloff
WIDEST_SPOT = math.radians(80.0)  # largest half angle of a spot light with a soft edge


def llvm_missing() -> str:
    """Return the reason why llvm_ad_rgb finds no LLVM library, or ""."""
    library = os.environ.get(PATH_VARIABLE, "")
    if os.path.isfile(library):
        return ""
    problem = f"names no file: {library}" if library else "is not set"
    return f"llvm_ad_rgb needs an LLVM library, and {PATH_VARIABLE} {problem}; set it to the path of libLLVM (19 works)"


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


def light_emitter(mi: ModuleType, light: Light) -> Plugin:
    """Return a light as a dictionary for `mitsuba.load_dict`."""
    if light.kind not in LIGHTS:
        refuse(f"light {light.name!r} of kind {light.kind!r}")
    return LIGHTS[light.kind](mi, light)


def _spot(mi: ModuleType, light: SpotLight) -> Plugin:
    """Return a spot light as a dictionary for `mitsuba.load_dict`; the light's projected texture holds wrt's falloff.
    Mitsuba's own falloff is linear in the angle, so `beam_width` switches it off. Raise InputError if a soft edge ends beyond 80
    degrees from the axis."""
    direction = np.array(light.direction)
    up = np.eye(3)[int(np.argmin(np.abs(direction)))]
    cutoff = math.degrees(light.outer)
    target = np.array(light.position) + direction
    spot: Plugin = {
        "type": "spot", "intensity": rgb(light.intensity), "cutoff_angle": cutoff, "beam_width": cutoff * (1.0 - 1e-6),
        "to_world": mi.ScalarTransform4f().look_at(list(light.position), target.tolist(), up.tolist()),
    }
    if light.inner >= light.outer:
        return spot
    if light.outer > WIDEST_SPOT:
        refuse("a soft spot light of more than 80 degrees from its axis", f"light {light.name!r}")
    x = (2.0 * (np.arange(SPOT_TEXELS) + 0.5) / SPOT_TEXELS - 1.0) * math.tan(light.outer)
    cosine = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + x[:, None] ** 2)
    ramp = (cosine - math.cos(light.outer)) / (math.cos(light.inner) - math.cos(light.outer))
    falloff = np.clip(ramp, 0.0, 1.0) ** 2
    texels = np.ascontiguousarray(np.repeat(falloff[..., None], 3, axis=2), np.float32)
    return spot | {"texture": {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True, "wrap_mode": "clamp"}}


LIGHTS: dict[str, Callable[[Any, Any], Plugin]] = {
    "point": lambda mi, light: {"type": "point", "position": list(light.position), "intensity": rgb(light.intensity)},
    "directional": lambda mi, light: {
        "type": "directional", "direction": list(light.direction), "irradiance": rgb(light.irradiance)},
    "spot": _spot,
}


def background_emitter(mi: ModuleType, background: Background) -> Plugin | None:
    """Return the background as an emitter, or None for constant black.
    Raise InputError for an environment picture of fewer than 3 columns, and for a kind that is not in BACKGROUNDS."""
    if background.kind not in BACKGROUNDS:
        raise InputError(f"not translatable: a background of kind {background.kind!r}", place="Mitsuba")
    return BACKGROUNDS[background.kind](mi, background)


def _gradient(mi: ModuleType, background: GradientBackground) -> Plugin:
    height = np.cos(np.linspace(0.0, math.pi, GRADIENT_ROWS))[:, None]
    share = 0.5 * (height + 1.0)
    rows = share * np.array(background.top) + (1.0 - share) * np.array(background.bottom)
    picture = np.repeat(rows[:, None, :], 4, axis=1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(picture, np.float32))}


def _environment(mi: ModuleType, background: EnvironmentBackground) -> Plugin:
    image = background.image
    if image.shape[1] < 3:
        raise InputError(f"Mitsuba needs a picture of 3 columns or more, got {image.shape[1]}", place=f"environment {background.name!r}")
    # Mitsuba's first and last row lie at the poles, wrt's lie half a row from them. Both interpolate linearly between rows. So a picture
    # in which rows alternate with the means of neighbouring rows is the same function.
    above, below = np.concatenate([image[:1], image]), np.concatenate([image, image[-1:]])
    rows = np.empty((2 * len(image) + 1, *image.shape[1:]), np.float32)
    rows[0::2] = 0.5 * (above + below)
    rows[1::2] = image
    # -z is the left edge of Mitsuba's picture, but the middle of wrt's: turn by 180 degrees.
    turn = mi.ScalarTransform4f().rotate([0.0, 1.0, 0.0], math.degrees(background.rotation) + 180.0)
    return {"type": "envmap", "bitmap": mi.Bitmap(rows), "scale": background.scale, "to_world": turn}


BACKGROUNDS: dict[str, Callable[[Any, Any], Plugin | None]] = {
    "constant": lambda mi, sky: {"type": "constant", "radiance": rgb(sky.color)} if max(sky.color) > 0.0 else None,
    "gradient": _gradient, "environment": _environment}
