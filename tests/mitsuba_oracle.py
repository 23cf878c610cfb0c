"""Mitsuba 3 as an independent oracle: render the scenes of wrt, and trace their camera rays."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tests.mitsuba_whitted import whitted
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.renderer.upload import camera_rays
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.materials import Material
from wrt.scene.model import Scene


def to_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, integrator: str = "auto") -> Any:
    """Translate the scene to a `mitsuba.Scene` of variant scalar_rgb."""
    with mitsuba() as mi:
        return translate(mi, scene, camera, whitted if integrator == "whitted" else integrator).scene


class Rendering(NamedTuple):
    """pixels: (H, W, 3) float32 linear radiance; variance of these means: (H, W, 3) float64 or None; spp: samples per pixel."""

    pixels: np.ndarray
    variance: np.ndarray | None
    spp: int


def render_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, *, seed: int = 0, integrator: str = "auto",
                   **settings: Any) -> Rendering:
    """Render with Mitsuba; settings: settings of the scene to change. integrator: as for `translate`, or "whitted".

    spp is rounded up to a multiple of the samples per pass.

    The variance of the mean is estimated from 32 or more passes (fewer if spp is below 32) with different seeds; None for one pass.
    """
    scene = scene.with_settings(**settings)
    per_pass = max(1, scene.settings.spp // 32)
    passes = math.ceil(scene.settings.spp / per_pass)
    with mitsuba() as mi:
        translated = translate(mi, scene, camera, whitted if integrator == "whitted" else integrator).scene
        pictures = np.stack([np.array(mi.render(translated, spp=per_pass, seed=seed * passes + index), dtype=np.float64)
                             for index in range(passes)])
    variance = pictures.var(axis=0, ddof=1) / passes if passes > 1 else None
    return Rendering(pictures.mean(axis=0).astype(np.float32), variance, passes * per_pass)


class Aovs(NamedTuple):
    """The closest hits of the rays through the pixel centres, (H, W, ...). Alpha is ignored; normals point outside.

    - depth: float32 distance from the camera, inf on a miss.
    - position, geometric_normal, shading_normal: (H, W, 3) float32 in world space, zero on a miss; uv: (H, W, 2) float32.
    - object_id: int32 index into scene.objects followed by scene.spheres, -1 on a miss.
    - prim_id: int32 index into the faces of all objects followed by the spheres, -1 on a miss."""

    depth: np.ndarray
    position: np.ndarray
    geometric_normal: np.ndarray
    shading_normal: np.ndarray
    uv: np.ndarray
    object_id: np.ndarray
    prim_id: np.ndarray


def aov_mitsuba(scene: Scene, camera: CameraKind | str | int | None = None, size: tuple[int, int] | None = None) -> Aovs:
    """Trace the pixel centres' rays of wrt.camera_rays with Mitsuba. Materials and lights play no part, so any scene will do."""
    plain = Material()
    shapes_only = Scene(
        objects=tuple(replace(thing, materials=(plain,), face_material=None) for thing in scene.objects),
        spheres=tuple(replace(sphere, material=plain) for sphere in scene.spheres),
    )
    width, height = size or scene.settings.size
    rays = camera_rays(camera if isinstance(camera, CameraKind) else scene.camera(camera), (width, height))
    count = height * width
    position, geometric, shading = np.zeros((3, count, 3), np.float32)
    out = Aovs(np.full(count, np.inf, np.float32), position, geometric, shading, np.zeros((count, 2), np.float32),
               np.full(count, -1, np.int32), np.full(count, -1, np.int32))
    sizes = [len(thing.mesh.faces) for thing in shapes_only.objects] + [1] * len(shapes_only.spheres)
    first_prim = np.concatenate([[0], np.cumsum(sizes)])
    with mitsuba() as mi:
        translated = translate(mi, shapes_only, Camera(), "path")
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
