"""Mitsuba 3 as an independent oracle: the same scene, rays and camera, answered by someone else's code."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from wrt.lab.mitsuba.shapes import Triangles, make_mesh
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene


def to_mitsuba(scene: Scene, camera: Camera | str | int | None = None, integrator: str = "auto") -> Any:
    """The scene as a `mitsuba.Scene` of variant scalar_rgb."""
    with mitsuba() as mi:
        return translate(mi, scene, camera, integrator).scene


class Rendering(NamedTuple):
    """pixels: (H, W, 3) float32 linear radiance; variance of their means: (H, W, 3) float64 or None; spp taken."""

    pixels: np.ndarray
    variance: np.ndarray | None
    spp: int


def render_mitsuba(scene: Scene, camera: Camera | str | int | None = None, *, seed: int = 0, integrator: str = "auto",
                   **settings: Any) -> Rendering:
    """Render with Mitsuba; settings: those of the scene to change. spp is rounded up to whole passes.

    The variance of the mean is estimated from passes with different seeds (32 or more where spp allows), None for one pass.
    """
    scene = scene.with_settings(**settings)
    per_pass = max(1, scene.settings.spp // 32)
    passes = math.ceil(scene.settings.spp / per_pass)
    with mitsuba() as mi:
        translated = translate(mi, scene, camera, integrator).scene
        pictures = np.stack([np.array(mi.render(translated, spp=per_pass, seed=seed * passes + index), dtype=np.float64)
                             for index in range(passes)])
    variance = pictures.var(axis=0, ddof=1) / passes if passes > 1 else None
    return Rendering(pictures.mean(axis=0).astype(np.float32), variance, passes * per_pass)


class MeshHits(NamedTuple):
    """t: (N,) float32 in units of |direction|, inf on a miss; prim_id: (N,) int32, -1 on a miss; u, v: (N,) float32."""

    t: np.ndarray
    prim_id: np.ndarray
    u: np.ndarray
    v: np.ndarray


def trace_mitsuba(mesh: Mesh, origins: np.ndarray, directions: np.ndarray, t_max: float = math.inf) -> MeshHits:
    """Closest hits of rays (N, 3) with a mesh in its own space, by Embree inside Mitsuba, about 5 microseconds a ray.

    The hit point is (1 - u - v) * v0 + u * v1 + v * v2. Rays are rounded to float32.
    """
    origins, directions = np.asarray(origins, dtype=np.float32), np.asarray(directions, dtype=np.float32)
    count = len(origins)
    hits = MeshHits(np.full(count, np.inf, np.float32), np.full(count, -1, np.int32), np.zeros(count, np.float32),
                    np.zeros(count, np.float32))
    if len(mesh.faces) == 0:
        return hits
    with mitsuba() as mi:
        triangles = make_mesh(mi, "mesh", Triangles(mesh.vertices, mesh.faces, None, None), {})
        scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": triangles})
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


def camera_rays(camera: Camera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (H, W, 3), float64, through the centres of the pixels and of the lens."""
    width, height = size
    top = math.tan(0.5 * camera.fov_y)
    x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * top * width / height
    y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * top
    local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
    directions = local @ camera.camera_to_world[:3, :3].T
    return camera.camera_to_world[:3, 3].copy(), directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def aov_mitsuba(scene: Scene, camera: Camera | str | int | None = None, size: tuple[int, int] | None = None) -> Aovs:
    """Depth, normals and ids at the pixel centres, from rays that are made here (Mitsuba's own camera is not used).

    Materials and lights play no part, so that any scene will do.
    """
    plain = Material()
    shapes_only = Scene(
        objects=tuple(replace(thing, materials=(plain,), face_material=None) for thing in scene.objects),
        spheres=tuple(replace(sphere, material=plain) for sphere in scene.spheres),
        cameras=(camera if isinstance(camera, Camera) else scene.camera(camera),),
    )
    width, height = size or scene.settings.size
    origin, directions = camera_rays(shapes_only.cameras[0], (width, height))
    count = height * width
    position, geometric, shading = np.zeros((3, count, 3), np.float32)
    out = Aovs(np.full(count, np.inf, np.float32), position, geometric, shading, np.zeros((count, 2), np.float32),
               np.full(count, -1, np.int32), np.full(count, -1, np.int32))
    sizes = [len(thing.mesh.faces) for thing in shapes_only.objects] + [1] * len(shapes_only.spheres)
    first_prim = np.concatenate([[0], np.cumsum(sizes)])
    with mitsuba() as mi:
        translated = translate(mi, shapes_only, shapes_only.cameras[0], "path")
        start = origin.tolist()
        for index, direction in enumerate(directions.reshape(-1, 3).tolist()):
            hit = translated.scene.ray_intersect(mi.Ray3f(start, direction))
            if not hit.is_valid():
                continue
            part = translated.parts[hit.shape.id()]
            out.depth[index], out.position[index] = hit.t, hit.p
            out.geometric_normal[index], out.shading_normal[index] = hit.n, hit.sh_frame.n
            out.uv[index], out.object_id[index] = hit.uv, part.object_id
            face = 0 if part.face_index is None else part.face_index[hit.prim_index]
            out.prim_id[index] = first_prim[part.object_id] + face
    return Aovs._make(array.reshape(height, width, *array.shape[1:]) for array in out)
