"""The plan of a render, made before any work: camera, features, crop, and kernels."""

import hashlib
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np

from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS, stack_on
from wrt.core.device import made_once, memory_of
from wrt.core.errors import InputError
from wrt.core.types import Device, Kernel, WarpStruct
from wrt.core.warp_private import module_hash
from wrt.kernels import structs
from wrt.kernels.loops import one_ray as kernels
from wrt.kernels.shade.features import Features
from wrt.kernels.traverse.common import Units
from wrt.renderer.features import features_of
from wrt.renderer.film import BYTES_OF_AOVS, BYTES_OF_FILM, BYTES_OF_GROUP, GROUPS
from wrt.renderer.launches import WaveKernels, wave_kernels
from wrt.renderer.options import Options
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges, Settings
from wrt.scene.size import moved_by, moved_camera, scene_origin

# Settings that the kernels do not depend on.
AIMED = ("size", "spp", "max_depth", "min_throughput", "clamp", "exposure", "tonemap", "auto_exposure")


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
    units = Units(options.triangle, options.box, features.spheres, instances=features.instances, stack=stack_on(options.device))
    return Plan(scene, options, camera, accel, meshes, features, Structure(ACCELERATORS[accel], units),
                _crop(scene.settings, options), scene.settings.max_depth, origin)


def _crop(settings: Settings, options: Options) -> tuple[int, int, int, int]:
    width, height = settings.size
    x0, y0, x1, y1 = (0, 0, width, height) if options.crop is None else options.crop
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise InputError(f"must be within the picture of {width}x{height}, got {x0},{y0},{x1},{y1}", argument="crop")
    return x0, y0, x1, y1
