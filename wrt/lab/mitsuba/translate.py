"""Mitsuba 3 as an independent oracle and a rival: the same scene, rays and camera, answered by someone else's code.

As an oracle the variant is scalar_rgb, in this process; as a rival also llvm_ad_rgb, which is faster, but ends the whole process
where the LLVM library does not suit it (mitsuba_llvm.py chooses one, mitsuba_process.py is the process). Both trace with Embree,
which is asked for its robust mode; Mitsuba unasked takes the fast one.

What can be compared exactly (Mitsuba's estimate has the same expectation as wrt's picture):
- integrator "whitted" (mitsuba_whitted.py): any scene of diffuse, mirror, conductor and glass surfaces;
- "path" and "volpath": surfaces that are all specular, under a background and emissive shapes (glass with absorption:
  "volpath"); with diffuse surfaces they add the interreflection that a Whitted tracer leaves out;
- "direct": diffuse surfaces, with mirrors or glass nowhere in view.
Mitsuba never cuts rays by their throughput: compare with min_throughput = 0.
Everything else is refused with an InputError, or with `approximate=True` replaced and named in one SceneWarning.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError, SceneWarning
from wrt.lab.mitsuba.emitters import background_emitter, light_emitter
from wrt.lab.mitsuba.shapes import Part, object_parts, raw_mesh, sphere_shape
from wrt.renderer.features import is_rough
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene

VARIANT = "scalar_rgb"
INTEGRATORS = ("auto", "whitted", "path", "direct", "volpath")
FILTERS = ("box", "gaussian", "tent", "mitchell")


@contextmanager
def mitsuba(variant: str = VARIANT) -> Iterator[Any]:
    """The module `mitsuba`, its variant set while the block runs; InputError where it is missing."""
    try:
        mi = importlib.import_module("mitsuba")
    except ImportError as error:
        raise InputError(f'Mitsuba 3 is not usable ({error}); pip install "wrt[peers]" installs it') from error
    before = mi.variant()
    mi.set_variant(variant)
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # it warns of every integrator written in Python
    try:
        yield mi
    finally:
        mi.set_log_level(level)
        if before is not None:
            mi.set_variant(before)


@dataclass(frozen=True)
class Options:
    """How Mitsuba renders; None takes the scene's own setting.

    crop: x, y, width, height in pixels of the whole picture. spp is rounded up to whole passes. integrator: one of
    INTEGRATORS; "auto" is "volpath" where something absorbs or lets light through by its alpha, else "path". max_depth
    counts as in wrt: bounces after the first hit. approximate: replace what has no exact counterpart and warn, instead
    of raising InputError.
    """

    size: tuple[int, int] | None = None
    crop: tuple[int, int, int, int] | None = None
    spp: int | None = None
    seed: int = 0
    max_depth: int | None = None
    integrator: str = "auto"
    filter: str = "box"
    approximate: bool = False

    def __post_init__(self) -> None:
        for value, choices, what in ((self.integrator, INTEGRATORS, "integrator"), (self.filter, FILTERS, "filter")):
            if value not in choices:
                raise InputError(f"{what} must be one of {', '.join(choices)}; got {value!r}")


class Approximations:
    """Collects what is not translated exactly: an InputError at the first one, or one warning for all at the end."""

    def __init__(self, allowed: bool) -> None:
        self.allowed = allowed
        self.found: dict[str, dict[str, None]] = {}

    def add(self, what: str, where: str = "") -> None:
        """Note what is approximated, and in which thing; raises InputError where approximations are not allowed."""
        if not self.allowed:
            raise InputError(f"not translatable exactly: {what}", None, f"Mitsuba: {where}" if where else "Mitsuba")
        self.found.setdefault(what, {})[where] = None

    def warn(self) -> None:
        """One SceneWarning for all, with the first three things that each is about."""
        sentences = []
        for what, places in self.found.items():
            named = [where for where in places if where]
            more = [f"{len(named) - 3} more"] if len(named) > 3 else []
            sentences.append(what + (f" in {', '.join(named[:3] + more)}" if named else ""))
        if sentences:
            warnings.warn("Mitsuba: approximated: " + "; ".join(sentences), SceneWarning, stacklevel=4)


class Translation(NamedTuple):
    """scene: the `mitsuba.Scene`; parts: shape id -> which object and faces the shape holds."""

    scene: Any
    parts: dict[str, Part]


# --- scenes -----------------------------------------------------------------------------------------------------------


def to_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, **options: Any) -> Any:
    """The scene as a `mitsuba.Scene` of variant scalar_rgb, with sensor, film, sampler and integrator set.

    options: the fields of `Options`. Raises InputError for what cannot be translated, and where Mitsuba is missing.
    """
    with mitsuba() as mi:
        return translate(mi, scene, camera, Options(**options)).scene


def _camera(scene: Scene, camera: CameraKind | str | int | None) -> CameraKind:
    return camera if isinstance(camera, CameraKind) else scene.camera(camera)


def translate(mi: Any, scene: Scene, camera: CameraKind | str | int | None, options: Options) -> Translation:
    """As `to_mitsuba`, for the module `mitsuba` with the variant that it has set."""
    notes = Approximations(options.approximate)
    contents: dict[str, Any] = {"type": "scene", "embree_use_robust_intersections": True}
    parts: dict[str, Part] = {}
    for index, thing in enumerate(scene.objects):
        for name, shape, part in object_parts(mi, thing, index, notes):
            contents[name], parts[name] = shape, part
    for index, sphere in enumerate(scene.spheres):
        name = f"sphere{index}"
        contents[name] = sphere_shape(mi, sphere, notes)
        parts[name] = Part(len(scene.objects) + index, None, sphere.material)

    integrator = _resolve_integrator(scene, options.integrator)
    for index, light in enumerate(scene.lights):
        contents[f"light{index}"] = light_emitter(mi, light, notes)
    background = background_emitter(mi, scene.background)
    if background is not None:
        contents["background"] = background
    lit = bool(scene.lights) or background is not None or any(m.lights_others for m in scene.materials)
    if not lit:  # Mitsuba refuses a scene whose emitters are all never sampled
        contents["darkness"] = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 0.0}
    _check_light_transport(scene, integrator, notes)

    contents["integrator"] = _integrator(mi, integrator, scene, options, lit, parts)
    contents["sensor"] = _sensor(mi, scene, _camera(scene, camera), options, notes)
    notes.warn()
    try:
        return Translation(mi.load_dict(contents), parts)
    except RuntimeError as error:
        raise InputError(f"Mitsuba refuses the scene: {error}") from error


def _resolve_integrator(scene: Scene, integrator: str) -> str:
    if integrator != "auto":
        return integrator
    passes = any(m.alpha_mode != "opaque" or max(m.absorption) > 0.0 for m in scene.materials)
    return "volpath" if passes else "path"


def _check_light_transport(scene: Scene, integrator: str, notes: Approximations) -> None:
    """Features of wrt's light transport that only some integrators have."""
    materials = scene.materials
    if scene.settings.fresnel == "schlick" and any(m.kind == "glass" for m in materials):
        notes.add('fresnel = "schlick" (the exact one)')
    if scene.lights and any(is_rough(m) for m in materials if m.kind != "metallic_roughness"):
        notes.add("highlights of point lights on rough surfaces (GGX's, where wrt takes Blinn's or none)")
    if integrator == "whitted":
        mixed = [m.name for m in materials if m.kind == "metallic_roughness"]
        if mixed:  # Mitsuba's principled BSDF cannot sample its mirror-like part by itself
            raise InputError(f'integrator "whitted" cannot render metallic_roughness (material {mixed[0]!r})', None, "Mitsuba")
        if scene.settings.glass_shadows == "tinted" and any(m.kind == "glass" and not m.thin for m in materials):
            notes.add('glass_shadows = "tinted" (shadows of glass are opaque)')
        return
    if max(scene.ambient) > 0.0:
        notes.add("the ambient term (left out)")
    if any(m.is_emissive and not m.lights_others for m in materials):
        notes.add("emission that is only seen (the surface lights others)")
    if integrator != "volpath":
        if any(max(m.absorption) > 0.0 for m in materials):
            notes.add(f'absorption with integrator "{integrator}" (left out)')
        if any(m.alpha_mode != "opaque" for m in materials):
            notes.add(f'alpha with integrator "{integrator}" (shadows are those of opaque surfaces)')


def _integrator(mi: Any, name: str, scene: Scene, options: Options, lit: bool, parts: dict[str, Part]) -> Any:
    max_depth = scene.settings.max_depth if options.max_depth is None else options.max_depth
    if name == "whitted":
        from wrt.lab.mitsuba.whitted import whitted_integrator

        inside = {key: part.material.absorption for key, part in parts.items() if max(part.material.absorption) > 0.0}
        blended = {key for key, part in parts.items() if part.material.alpha_mode == "blend"}
        return whitted_integrator(mi, max_depth, scene.ambient, lit, inside, blended)
    if name == "direct":
        return {"type": "direct"}
    # Mitsuba counts a path's edges: 1 is emission seen by the camera, 2 direct light. No Russian roulette: less noise.
    return {"type": name, "max_depth": max_depth + 2, "rr_depth": 1 << 16}


# --- camera and film --------------------------------------------------------------------------------------------------


def _sensor(mi: Any, scene: Scene, camera: CameraKind, options: Options, notes: Approximations) -> dict[str, Any]:
    far = _farthest(scene, camera)
    # Mitsuba's camera looks along +z with +x to the left: half a turn about y away from glTF's.
    pose = camera.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
    sensor: dict[str, Any] = {
        "near_clip": 1e-5 * far, "far_clip": 4.0 * far, "film": _film(scene, options),
        "sampler": {"type": "independent", "sample_count": options.spp or scene.settings.spp},
    }
    if isinstance(camera, OrthographicCamera):
        width, height = options.size or scene.settings.size
        half_width = 0.5 * camera.height * width / height
        pose = pose @ np.diag([half_width, half_width, 1.0, 1.0])
        sensor |= {"type": "orthographic"}
    elif isinstance(camera, Camera):
        sensor |= {"type": "perspective", "fov_axis": "y", "fov": math.degrees(camera.fov_y)}
        if camera.aperture_radius > 0.0:
            sensor |= {"type": "thinlens", "aperture_radius": camera.aperture_radius,
                       "focus_distance": camera.focus_distance}
            if camera.blades:
                notes.add("aperture blades (a round aperture of the same radius)", f"camera {camera.name!r}")
    else:
        raise InputError(f"Mitsuba has no {camera.kind} camera (camera {camera.name!r})")
    return sensor | {"to_world": mi.ScalarTransform4f(pose)}


def _farthest(scene: Scene, camera: CameraKind) -> float:
    """An upper bound of the distance from the camera to any shape."""
    if not scene.objects and not scene.spheres:
        return _focus(camera)
    low, high = scene.bounds()
    position = camera.camera_to_world[:3, 3]
    reach = np.linalg.norm(np.maximum(np.abs(low - position), np.abs(high - position)))
    return max(float(reach), _focus(camera) if camera.switches().get("lens") else 0.0)


def _focus(camera: CameraKind) -> float:
    return camera.focus_distance if isinstance(camera, Camera) else 1.0


def _film(scene: Scene, options: Options) -> dict[str, Any]:
    width, height = options.size or scene.settings.size
    film: dict[str, Any] = {
        "type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "component_format": "float32",
        "rfilter": {"type": options.filter},
    }
    if options.crop is not None:
        x, y, crop_width, crop_height = options.crop
        if min(x, y) < 0 or min(crop_width, crop_height) < 1 or x + crop_width > width or y + crop_height > height:
            raise InputError(f"crop {options.crop} does not lie in {width}x{height}")
        film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": crop_width, "crop_height": crop_height}
    return film


# --- pictures ---------------------------------------------------------------------------------------------------------


class Rendering(NamedTuple):
    """pixels: (H, W, 3) float32 linear radiance; variance of their means: (H, W, 3) float64 or None; spp taken."""

    pixels: np.ndarray
    variance: np.ndarray | None
    spp: int


def render_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, **options: Any) -> Rendering:
    """Render with Mitsuba; options are the fields of `Options`.

    The variance of the mean is estimated from passes with different seeds (32 or more where spp allows). It is None for
    one pass, and for filters wider than a pixel: neighbours share samples there, and each pass is normalised by itself.
    Raises InputError for what cannot be translated.
    """
    choice = Options(**options)
    spp = scene.settings.spp if choice.spp is None else choice.spp
    per_pass = max(1, spp // 32) if choice.filter == "box" else spp
    passes = math.ceil(spp / per_pass)
    with mitsuba() as mi:
        translated = translate(mi, scene, camera, choice).scene
        mean: Any = 0.0
        squares: Any = 0.0
        for index in range(passes):  # Welford's update: the sum of squares does not cancel
            picture = np.array(mi.render(translated, spp=per_pass, seed=choice.seed * passes + index), dtype=np.float64)
            delta = picture - mean
            mean = mean + delta / (index + 1)
            squares = squares + delta * (picture - mean)
    variance = squares / (passes - 1) / passes if passes > 1 else None
    return Rendering(np.asarray(mean, dtype=np.float32), variance, passes * per_pass)


# --- rays -------------------------------------------------------------------------------------------------------------


class MeshHits(NamedTuple):
    """t: (N,) float32 in units of |direction|, inf on a miss; prim_id: (N,) int32, -1 on a miss; u, v: (N,) float32."""

    t: np.ndarray
    prim_id: np.ndarray
    u: np.ndarray
    v: np.ndarray


def trace_mitsuba(mesh: Mesh, origins: np.ndarray, directions: np.ndarray, t_max: float = math.inf) -> MeshHits:
    """Closest hits of rays (N, 3) with a mesh in its own space, by Embree inside Mitsuba, about 5 microseconds a ray.

    The hit point is (1 - u - v) * v0 + u * v1 + v * v2. Rays are rounded to float32. Raises InputError for bad shapes.
    """
    origins, directions = np.asarray(origins, dtype=np.float32), np.asarray(directions, dtype=np.float32)
    if origins.ndim != 2 or origins.shape[1] != 3 or origins.shape != directions.shape:
        raise InputError(f"origins and directions must both be (N, 3), got {origins.shape} and {directions.shape}")
    count = len(origins)
    hits = MeshHits(np.full(count, np.inf, np.float32), np.full(count, -1, np.int32), np.zeros(count, np.float32),
                    np.zeros(count, np.float32))
    if len(mesh.faces) == 0:
        return hits
    with mitsuba() as mi:
        scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": raw_mesh(mi, mesh)})
        longest = min(t_max, float(np.finfo(np.float32).max))
        for index, (origin, direction) in enumerate(zip(origins.tolist(), directions.tolist(), strict=True)):
            hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction, longest, 0.0, []))
            if hit.is_valid():
                hits.t[index], hits.prim_id[index] = hit.t, hit.prim_index
                hits.u[index], hits.v[index] = hit.prim_uv
    return hits


class Aovs(NamedTuple):
    """What the rays through the pixel centres hit, (H, W, ...); alpha is ignored, normals point outside.

    depth: float32 distance from the camera, inf on a miss; position, geometric_normal, shading_normal: (H, W, 3)
    float32 in world space, zero on a miss; uv: (H, W, 2); object_id: int32 index into scene.objects, then (from
    len(objects)) into scene.spheres, -1 on a miss; prim_id: int32, counted through the faces of all objects in order,
    then the spheres, -1 on a miss.
    """

    depth: np.ndarray
    position: np.ndarray
    geometric_normal: np.ndarray
    shading_normal: np.ndarray
    uv: np.ndarray
    object_id: np.ndarray
    prim_id: np.ndarray


def aov_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, size: tuple[int, int] | None = None) -> Aovs:
    """Depth, normals and ids at the pixel centres, from wrt.camera_rays (Mitsuba's own camera is not used).

    Materials and lights play no part, so that any scene will do. Raises InputError where Mitsuba is missing.
    """
    from wrt.renderer.pixel_rays import camera_rays  # late: it starts Warp, which a process of Mitsuba's can do without

    plain = Material()
    shapes_only = Scene(
        objects=tuple(replace(thing, materials=(plain,), face_material=None) for thing in scene.objects),
        spheres=tuple(replace(sphere, material=plain) for sphere in scene.spheres),
    )
    width, height = size or scene.settings.size
    rays = camera_rays(_camera(scene, camera), (width, height))
    count = height * width
    position, geometric, shading = np.zeros((3, count, 3), np.float32)
    out = Aovs(np.full(count, np.inf, np.float32), position, geometric, shading, np.zeros((count, 2), np.float32),
               np.full(count, -1, np.int32), np.full(count, -1, np.int32))
    sizes = [len(thing.mesh.faces) for thing in shapes_only.objects] + [1] * len(shapes_only.spheres)
    first_prim = np.concatenate([[0], np.cumsum(sizes)])
    with mitsuba() as mi:
        translated = translate(mi, shapes_only, Camera(), Options(integrator="path"))
        for index, (origin, direction) in enumerate(zip(*(array.tolist() for array in rays), strict=True)):
            if not any(direction):
                continue
            hit = translated.scene.ray_intersect(mi.Ray3f(origin, direction))
            if not hit.is_valid():
                continue
            part = translated.parts[hit.shape.id()]
            out.depth[index], out.position[index] = hit.t, hit.p
            out.geometric_normal[index], out.shading_normal[index] = hit.n, hit.sh_frame.n
            out.uv[index], out.object_id[index] = hit.uv, part.object_id
            face = 0 if part.face_index is None else part.face_index[hit.prim_index]
            out.prim_id[index] = first_prim[part.object_id] + face
    return Aovs._make(array.reshape(height, width, *array.shape[1:]) for array in out)
