"""Scenes far from 0: they are moved near it in float64, before anything is rounded to float32."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.model import Object, Scene
from wrt.scene.values import far_origin, shift, warn_if_alone

NEAR = 4.0  # an object is near 0 if it is moved by at most this multiple of its own size


def scene_origin(scene: Scene) -> np.ndarray | None:
    """Return a point, (3,) float64, near the middle of the shapes of a scene that is far from 0; None for other scenes."""
    shown = [thing for thing in scene.objects if len(thing.mesh.faces)]
    origin = far_origin(*scene.bounds()) if (shown or scene.spheres) and all(map(_is_far, shown)) else None
    for thing in shown if origin is None else ():
        if thing.mesh.origin is not None:
            place, size = thing.placement[:3, 3], _size(thing)
            warn_if_alone(place - size, place + size, thing.name or thing.mesh.name or "a mesh")
    return origin


def moved_by(scene: Scene, origin: np.ndarray | None) -> Scene:
    """Return the scene with `origin` subtracted from all places in float64; None: the scene itself."""
    if origin is None:
        return scene
    return replace(scene, objects=tuple(replace(thing, transform=shift(origin, -1.0) @ thing.transform) for thing in scene.objects),
                   spheres=tuple(replace(each, center=tuple(each.center - origin)) for each in scene.spheres),
                   lights=tuple(light.moved(shift(origin, -1.0)) if light.places() else light for light in scene.lights),
                   cameras=tuple(moved_camera(camera, origin) for camera in scene.cameras))


def moved_camera(camera: CameraKind, origin: np.ndarray | None) -> CameraKind:
    """Return the camera with `origin` subtracted from its place; None: the camera itself."""
    return camera if origin is None else replace(camera, camera_to_world=shift(origin, -1.0) @ camera.camera_to_world)


def _is_far(thing: Object) -> bool:
    """Return whether an object may be far from 0; its mesh alone does not decide that without an origin."""
    return bool(np.abs(thing.placement[:3, 3]).max() > NEAR * _size(thing))


def _size(thing: Object) -> float:
    return float(np.abs(thing.transform[:3, :3]).sum(axis=1).max() * thing.mesh.reach)
