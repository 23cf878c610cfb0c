"""The plan of a render, made before any work: camera, features (kernels/shade/features.py), crop, and kernels."""

import hashlib
import math
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np

from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import made_once, memory_of
from wrt.core.errors import InputError
from wrt.core.types import Device, JsonObject, Kernel, WarpStruct
from wrt.core.warp_private import module_hash
from wrt.kernels import structs
from wrt.kernels.loops import one_ray as kernels
from wrt.kernels.parameters import TEXTURES
from wrt.kernels.shade.features import Features
from wrt.kernels.traverse.common import Units
from wrt.renderer.film import BYTES_OF_AOVS, BYTES_OF_FILM, BYTES_OF_GROUP, GROUPS
from wrt.renderer.launches import WaveKernels, wave_kernels
from wrt.renderer.options import Options
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CameraKind
from wrt.scene.lights import EMISSIVE, LIGHTS
from wrt.scene.materials import MATERIALS, Checkerboard, Texture
from wrt.scene.model import Scene, moved_by, moved_camera, scene_origin
from wrt.scene.settings import SettingChanges, Settings

# Settings that the kernels do not depend on.
AIMED = ("size", "spp", "max_depth", "min_throughput", "clamp", "exposure", "tonemap", "auto_exposure")
STACK_STEP = 16  # Stack sizes are multiples of this, so that scenes share kernels.
TOOLS = {"counting", "recording"}  # features for measurements and the inspector, which no scene asks for
PARAMETER_TEXTURES = tuple(name for name, texture in TEXTURES.items() if texture.feature == "parameter_textures")


@made_once
def render_kernel(features: Features, structure: Structure) -> Kernel:
    return kernels.make_render_kernel(features, structure, import_module(features.camera))


@made_once
def aov_kernel(features: Features, structure: Structure) -> Kernel:
    return kernels.make_aov_kernel(features, structure, import_module(features.camera))


@dataclass(frozen=True, eq=False)
class Plan:
    """A scene and the options of its render, with defaults resolved.

    - accel: the acceleration structure's real name ("bvh" is an alias). structure: a Structure, or a class with the same members.
    - meshes: id()s of the instanced meshes (wrt.accel.scenes.instancing). crop: x0, y0, x1, y1 in pixels.
    - deepest: largest max_depth for which the kernels' stacks suffice.
    - origin: (3,) float64, which the places of the scene and the camera lack, because the scene is far from 0; or None.
    """

    scene: Scene
    options: Options
    camera: CameraKind
    accel: str
    meshes: frozenset[int]
    features: Features
    structure: Any
    crop: tuple[int, int, int, int]
    deepest: int
    origin: np.ndarray | None = None

    @property
    def groups(self) -> int:
        """Number of groups of samples, each an independent sequence (wrt.renderer.film)."""
        return 1 if self.options.target_error is None else GROUPS

    @property
    def area(self) -> int:
        """Number of pixels of the crop."""
        x0, y0, x1, y1 = self.crop
        return (x1 - x0) * (y1 - y0)

    def require_memory(self, device: Device) -> None:
        """Raise InputError if the film and the picture written from it exceed the memory of the device."""
        x0, y0, x1, y1 = self.crop
        pixel = BYTES_OF_FILM + BYTES_OF_GROUP * (self.groups - 1) + (BYTES_OF_AOVS if self.options.aov else 0)
        if self.area * pixel > (memory := memory_of(device)):
            raise InputError(f"a picture of {x1 - x0}x{y1 - y0} takes {self.area * pixel / 2**30:.1f} GiB of memory; {device} has"
                             f" {memory / 2**30:.1f} GiB")

    @property
    def by_waves(self) -> bool:
        """True if samples are traced in waves: on the CPU, unless rays are counted or recorded. Else a thread traces one ray at a time."""
        return self.options.device == "cpu" and not self.structure.units.observer and not self.features.recording

    @property
    def wave_kernels(self) -> WaveKernels:
        return wave_kernels(self.features, self.structure, bool(self.options.aov))

    @property
    def kernels(self) -> list[Kernel]:
        """All kernels to compile: those of the waves; or the render kernel, the AOV kernel (if needed) and, on GPUs, add_samples."""
        if self.by_waves:
            return self.wave_kernels.all()
        makes = [render_kernel, aov_kernel] if self.options.aov else [render_kernel]
        folds = [] if self.options.device == "cpu" else [kernels.add_samples]
        return [make(self.features, self.structure) for make in makes] + folds

    def kernels_hash(self) -> str:
        """Return a hash of the code of all kernels but the AOV kernels. The hash is equal in every process."""
        block_dim = 1 if self.options.device == "cpu" else None
        kernels = replace(self, options=replace(self.options, aov=())).kernels
        hashes = [module_hash(kernel, block_dim) for kernel in kernels]
        return hashlib.sha256(b"".join(hashes)).hexdigest()

    def limits(self, seed: int) -> WarpStruct:
        limits = structs.Limits()
        limits.max_depth, limits.min_throughput = self.scene.settings.max_depth, self.scene.settings.min_throughput
        limits.seed = seed
        return limits

    def aimed(self, camera: CameraKind, **settings: Unpack[SettingChanges]) -> "Plan":
        """Return the plan with another camera and other settings (those in AIMED), for the same kernels.

        Raises InputError if the kernels do not suffice: for another kind of camera, a lens in place of a pinhole, or more bounces."""
        scene = self.scene.with_settings(**settings)
        lacks = [name for name, needed, has in (
            (f"a camera of the kind {camera.kind}", camera.device != self.features.camera, False),
            *((f"a camera's {name}", needed, getattr(self.features, name)) for name, needed in camera.switches().items()),
            ("so many bounces", scene.settings.max_depth > self.deepest, False),
            ("other settings than " + ", ".join(AIMED), bool(settings.keys() - AIMED), False)) if needed and not has]
        if lacks:
            raise InputError(f"this renderer was not made for {lacks[0]}")
        return replace(self, scene=scene, camera=moved_camera(camera, self.origin), crop=_crop(scene.settings, self.options))

    def moved(self, scene: Scene) -> "Plan":
        """Return the plan for a scene with the same objects in other places."""
        scene = moved_by(scene, self.origin)
        return replace(self, scene=scene, meshes=instanced_meshes(scene, self.options.instancing))


def plan_of(scene: Scene, options: Options) -> Plan:
    """Resolve options for a scene. Raises InputError for an unknown camera, and for a crop outside the picture."""
    accel = "bvh8" if options.accel == "bvh" else options.accel
    camera = options.camera if isinstance(options.camera, CameraKind) else scene.camera(options.camera)
    origin = scene_origin(scene)
    scene, camera = moved_by(scene, origin), moved_camera(camera, origin)
    meshes = instanced_meshes(scene, options.instancing)
    features = features_of(scene, camera, meshes)
    units = Units(options.triangle, options.box, features.spheres, instances=features.instances)
    return Plan(scene, options, camera, accel, meshes, features, Structure(ACCELERATORS[accel], units),
                _crop(scene.settings, options), scene.settings.max_depth, origin)


def _crop(settings: Settings, options: Options) -> tuple[int, int, int, int]:
    width, height = settings.size
    x0, y0, x1, y1 = (0, 0, width, height) if options.crop is None else options.crop
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise InputError(f"must be within the picture of {width}x{height}, got {x0},{y0},{x1},{y1}", argument="crop")
    return x0, y0, x1, y1


# --- what a scene needs ------------------------------------------------------------------------------------------------


def switches(features: Features) -> dict[str, bool]:
    """Return each on/off feature by name. Each kind of light, material and background counts as a feature, too."""
    on_off = {name: value for name, value in vars(features).items() if isinstance(value, bool) and name not in TOOLS}
    return on_off | {f"{name}_lights": name in features.lights for name in (*LIGHTS, *EMISSIVE)} | {
        name: name in features.materials for name in MATERIALS} | {
        name: name == features.background for name in BACKGROUNDS if name != Features.background}


def features_of(scene: Scene, camera: CameraKind, meshes: frozenset[int] = frozenset()) -> Features:
    """Return the features for a scene and a camera. meshes: id()s of the instanced meshes (wrt.accel.scenes.instancing)."""
    settings, materials = scene.settings, scene.materials
    textures = [texture for material in materials for texture in material.textures]
    kinds = {material.kind for material in materials}
    diffuse = any(MATERIALS[m.kind].scatters and max(m.albedo) > 0.0 for m in materials)
    rough = any(m.is_rough for m in materials)
    highlight = rough or any(max(m.specular) > 0.0 for m in materials)
    lit = diffuse or highlight
    occlusion = diffuse and max(scene.ambient) > 0.0 and scene.ambient_occlusion > 0.0
    lights = {light.kind for light in scene.lights}
    lights |= {"mesh"} if any(m.lights_others for thing in scene.objects for m in thing.materials) else set()
    lights |= {"sphere"} if any(s.material.lights_others for s in scene.spheres) else set()
    clear = [m for m in materials if m.is_clear]
    blend = any(m.alpha_mode == "blend" for m in materials)
    tinted = settings.glass_shadows == "tinted" and any(not m.thin for m in clear)
    reflection = any(MATERIALS[kind].reflects for kind in kinds)
    refraction = bool(clear)
    clearcoat = any(m.is_coated for m in materials)
    children = int(reflection) + int(refraction) + int(blend) + int(clearcoat)
    # A ray is popped before its children are pushed, so that each level adds children - 1 rays to the stack. The ray straight through a
    # blended surface does not increase the depth: it waits on the stack below its siblings until they are done.
    pending = (children - 1) * (settings.max_depth + 1) + 1
    return Features(
        camera=camera.device,
        **camera.switches(),
        filter=settings.filter != "box",
        independent=settings.sampler == "independent",
        instances=bool(meshes),
        spheres=bool(scene.spheres),
        smooth=any(thing.mesh.normals is not None for thing in scene.objects),
        textures=any(isinstance(texture, Texture) for texture in textures),
        checkerboards=any(isinstance(texture, Checkerboard) for texture in textures),
        normal_maps=any(m.normal_texture is not None for m in materials),
        parameter_textures=any(m.reads(name) and getattr(m, name) is not None for m in materials for name in PARAMETER_TEXTURES),
        cutout=any(m.alpha_mode == "mask" for m in materials),
        blend=blend,
        materials=tuple(name for name in MATERIALS if name in kinds),
        thin_glass=any(m.thin for m in clear),
        absorption=any(max(m.absorption) > 0.0 for m in clear),
        transmission=any(m.uses("transmission") for m in clear),
        rough=rough,
        highlight=highlight,
        specular=any(m.scales_reflectance for m in materials),
        clearcoat=clearcoat,
        schlick=settings.fresnel == "schlick" and any(m.uses("ior") for m in materials),
        emission=any(m.is_emissive for m in materials),
        lights=tuple(name for name in (*LIGHTS, *EMISSIVE) if lit and name in lights),
        background=scene.background.kind,
        sky_light=lit and not scene.background.is_black,
        ambient=max(scene.ambient) > 0.0 and not occlusion,
        ambient_occlusion=occlusion,
        tinted_shadows=tinted,
        transparent_shadows=lit and (blend or tinted or any(m.thin for m in clear)),
        reflection=reflection,
        refraction=refraction,
        stack_size=1 if children < 2 else STACK_STEP * math.ceil(pending / STACK_STEP),
    )


def describe(scene: Scene, camera: str | int | None = None) -> JsonObject:
    """Return counts, names, bounds (None without shapes) and features of a scene, as `python -m wrt info` prints them."""
    meshes = {id(o.mesh): o.mesh for o in scene.objects}.values()
    has_shapes = scene.spheres or any(len(thing.mesh.faces) for thing in scene.objects)
    low, high = (corner.tolist() for corner in scene.bounds()) if has_shapes else (None, None)
    return {
        "name": scene.name,
        "triangles": sum(len(thing.mesh.faces) for thing in scene.objects),
        "unique_triangles": sum(len(mesh.faces) for mesh in meshes),
        "zero_area_triangles_left_out": sum(mesh.dropped for mesh in meshes),
        "objects": len(scene.objects),
        "spheres": len(scene.spheres),
        "materials": [f"{m.name or i} ({m.kind})" for i, m in enumerate(scene.materials)],
        "lights": [f"{light.name or i} ({type(light).__name__})" for i, light in enumerate(scene.lights)],
        "emissive_objects": sum(any(m.lights_others for m in o.materials) for o in scene.objects),
        "background": type(scene.background).__name__,
        "cameras": [c.name or str(i) for i, c in enumerate(scene.cameras)],
        "size": "{}x{}".format(*scene.settings.size),
        "spp": scene.settings.spp,
        "bounds_low": low,
        "bounds_high": high,
        "features": switches(features_of(scene, scene.camera(camera), instanced_meshes(scene))),
    }
