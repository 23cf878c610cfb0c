"""A scene with motion at a moment of its period."""

from __future__ import annotations

from dataclasses import replace

from wrt.scene.model import Object, Scene
from wrt.scene.motion import Motion


def moves(scene: Scene) -> bool:
    return any(thing.motion is not None for thing in scene.objects)


def scene_at(scene: Scene, time: float) -> Scene:
    """The scene at a time in [0, 1] of its period: the same objects, faces and materials, in other places."""
    objects = (thing if thing.motion is None else _moved(thing, thing.motion, time) for thing in scene.objects)
    return replace(scene, objects=tuple(objects))


def _moved(thing: Object, motion: Motion, time: float) -> Object:
    return replace(thing, mesh=motion.mesh(thing.mesh, time), transform=thing.transform @ motion.transform(time), motion=None)
