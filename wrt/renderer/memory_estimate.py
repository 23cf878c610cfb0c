"""How much memory a render will take, so that what cannot fit is refused before the work.

The numbers of a scene are peaks that were measured on meshes of 330,000 triangles, rounded up.
"""

from __future__ import annotations

from typing import Any

from wrt.accel.base import Accelerator
from wrt.accel.instancing import stored_meshes
from wrt.accel.structures import ACCELERATORS
from wrt.core.address_space import told_limit
from wrt.core.device import free_memory
from wrt.core.errors import InputError
from wrt.core.memory import SMALL, available, gib
from wrt.core.threads import thread_count
from wrt.renderer.film_arrays import BYTES_OF_FILM, BYTES_OF_GROUP
from wrt.renderer.plan import Plan
from wrt.renderer.waves import capacity
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.materials import Texture
from wrt.scene.model import Scene

BYTES_OF_FACE, BYTES_OF_VERTEX = 55.0, 60.0  # of a mesh in the world: joined, turned and uploaded
BYTES_OF_EMITTER = 190.0  # of a triangle that lights others, beside that
BYTES_OF_OBJECT, BYTES_OF_TEXEL, BYTES_OF_SKY = 1000.0, 12.0, 40.0
BYTES_OF_AOVS, BYTES_OF_RESULT = 36, 80  # a pixel; of the result: measured, with writing it to a file
# Of a sample of a wave (wrt.renderer.waves.Buffers), of each path that it has room for, and of its ray to each light.
BYTES_OF_SAMPLE, BYTES_OF_PATH, BYTES_OF_SHADOW = 350.0, 60.0, 55.0
BYTES_OF_WALK = 200.0  # of a shadow ray that goes through surfaces, beside that


def require_memory(plan: Plan, device: Any) -> None:
    """Raise InputError for a render that does not fit: better now than by the system after an hour, which ends whoever takes too
    much."""
    x0, y0, x1, y1 = plan.crop
    pixel = BYTES_OF_FILM + BYTES_OF_GROUP * (plan.groups - 1) + (BYTES_OF_AOVS if plan.options.aov else 0)
    film = plan.area * (pixel + BYTES_OF_RESULT) + bytes_of_waves(plan)
    scene = bytes_of_scene(plan.scene, ACCELERATORS[plan.accel], plan.meshes)
    rooms = {str(device): free_memory(device)} | ({"the host": available()} if device.is_cuda else {})  # trees grow on the host
    where, free = min(rooms.items(), key=lambda room: room[1])
    if film + scene > max(free, SMALL):
        otherwise = "" if where.startswith("cuda") else " (WRT_MEMORY can say otherwise)"
        raise InputError(f"a picture of {x1 - x0}x{y1 - y0} takes {gib(film)} of memory, its scene {gib(scene)};"
                         f" {where} has {gib(free)} free{otherwise}{told_limit()}")


def bytes_of_waves(plan: Plan) -> float:
    """Bytes that all threads of this process take to trace."""
    if not plan.by_waves:
        return 0.0
    features, scene = plan.features, plan.scene
    lights = len(scene.lights) + sum(any(m.lights_others for m in thing.materials) for thing in scene.objects) + sum(
        sphere.material.lights_others for sphere in scene.spheres) + 1
    shadow = BYTES_OF_SHADOW + (BYTES_OF_WALK if features.transparent_shadows else 0.0)
    sample = BYTES_OF_SAMPLE + BYTES_OF_PATH * features.stack_size + shadow * lights
    return thread_count(plan.options.threads) * capacity(features, lights) * sample


def bytes_of_scene(scene: Scene, accel: type[Accelerator], kept_once: frozenset[int] = frozenset()) -> float:
    """Bytes that the scene's arrays and its structure take at most while they are made, beside the scene itself. kept_once: the
    id()s of the meshes that are (wrt.accel.instancing)."""
    every = stored_meshes(scene, kept_once)
    faces, vertices = sum(len(mesh.faces) for mesh in every), sum(len(mesh.vertices) for mesh in every)
    emitters = sum(len(thing.mesh.faces) for thing in scene.objects if any(m.lights_others for m in thing.materials))
    images = {id(t.image): t.image for m in scene.materials for t in m.textures if isinstance(t, Texture)}
    texels = sum(image.shape[0] * image.shape[1] for image in images.values())
    sky = scene.background.image.size // 3 if isinstance(scene.background, EnvironmentBackground) else 0
    return (faces * BYTES_OF_FACE + vertices * BYTES_OF_VERTEX + emitters * BYTES_OF_EMITTER
            + (len(scene.objects) + len(scene.spheres)) * BYTES_OF_OBJECT + texels * BYTES_OF_TEXEL + sky * BYTES_OF_SKY
            + (faces + len(scene.spheres)) * accel.bytes_to_build)
