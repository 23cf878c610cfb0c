"""Sizes and places of scenes that single precision cannot represent.

A scene may be too small: differences of positions, or their squares, would be 0. A scene far from 0 is moved near it in float64, before
anything is rounded to float32."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import InputError
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Object, Scene
from wrt.scene.values import SMALLEST, far_origin, shift, warn_if_alone

NEAR = 4.0  # an object is near 0 if it is moved by at most this multiple of its own size
# Smallest size with a light at a finite distance. The squared distance to the light is a normal float32 down to a distance of 2^-63
# (1.1e-19), a ten-thousandth of this size.
SMALLEST_LIT = 1e-15
FACES_AT_ONCE = 1 << 12  # faces whose corners `_points` yields together


def require_size(scene: Scene) -> None:
    """Raise InputError if a scene is too small to be rendered."""
    light = _finite_light(scene)
    needed = SMALLEST_LIT if light else SMALLEST
    size = _size(scene, needed)
    if 0.0 < size < needed:  # a single point cannot be hit
        within = f" with a light at a finite distance ({light})" if light else ""
        raise InputError(f"the scene is {size:.3g} units across; at least {needed:g} can be rendered{within}", hint="make it larger")


def _finite_light(scene: Scene) -> str:
    """Return the name of the first light at a finite distance, or of the first emissive shape; "" without both."""
    for light in scene.lights:
        if light.places():
            return at_thing("light", light.name)[:-2]
    for thing in scene.objects:
        if any(material.lights_others for material in thing.materials):
            return at_thing("object", thing.name)[:-2]
    for sphere in scene.spheres:
        if sphere.material.lights_others:
            return at_thing("sphere", sphere.name)[:-2]
    return ""


def _size(scene: Scene, enough: float) -> float:
    """Return the longest side of the box around all shapes and finite lights, or a smaller value that is at least `enough`."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    size = 0.0
    for points in _points(scene):
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        size = float((high - low).max())
        if size >= enough:
            break
    return size


def _points(scene: Scene) -> Iterator[np.ndarray]:
    """Yield points (N, 3) float64 in world space, part by part: lights, two opposite corners of each sphere's box, corners of faces."""
    for light in scene.lights:
        if light.places():
            yield np.array(light.places())
    for sphere in scene.spheres:
        yield np.array(sphere.center) + sphere.radius * np.array([[-1.0], [1.0]])
    for thing in scene.objects:
        for i in range(0, len(thing.mesh.faces), FACES_AT_ONCE):
            corners = thing.mesh.vertices[thing.mesh.faces[i:i + FACES_AT_ONCE].reshape(-1)].astype(np.float64)
            yield corners @ thing.placement[:3, :3].T + thing.placement[:3, 3]


def scene_origin(scene: Scene) -> np.ndarray | None:
    """Return a point, (3,) float64, near the middle of the shapes of a scene that is far from 0; None for other scenes."""
    shown = [thing for thing in scene.objects if len(thing.mesh.faces)]
    origin = far_origin(*scene.bounds()) if (shown or scene.spheres) and all(map(_is_far, shown)) else None
    for thing in shown if origin is None else ():
        if thing.mesh.origin is not None:
            place, size = thing.placement[:3, 3], _reach(thing)
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
    return bool(np.abs(thing.placement[:3, 3]).max() > NEAR * _reach(thing))


def _reach(thing: Object) -> float:
    return float(np.abs(thing.transform[:3, :3]).sum(axis=1).max() * thing.mesh.reach)
