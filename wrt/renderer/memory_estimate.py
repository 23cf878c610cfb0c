"""How much memory a scene will take on its way to the device, so that what cannot fit is refused before the work.

The numbers are peaks that were measured on meshes of 330,000 triangles, rounded up; a picture's own are in wrt.renderer.renderer.
"""

from __future__ import annotations

from wrt.accel.base import Accelerator
from wrt.renderer.instancing import instanced_meshes, is_instance
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.materials import Texture
from wrt.scene.model import Scene

BYTES_OF_FACE, BYTES_OF_VERTEX = 55.0, 60.0  # of a mesh in the world: joined, turned and uploaded
BYTES_OF_EMITTER = 120.0  # of a triangle that lights others, beside that
BYTES_OF_OBJECT, BYTES_OF_TEXEL, BYTES_OF_SKY = 1000.0, 12.0, 40.0


def bytes_of_scene(scene: Scene, accel: type[Accelerator], instancing: str = "auto") -> float:
    """Bytes that the scene's arrays and its structure take at most while they are made, beside the scene itself."""
    kept_once = instanced_meshes(scene, instancing)
    meshes = {id(thing.mesh): thing.mesh for thing in scene.objects if is_instance(thing, kept_once)}
    copied = [thing.mesh for thing in scene.objects if not is_instance(thing, kept_once)]
    every = [*meshes.values(), *copied]
    faces, vertices = sum(len(mesh.faces) for mesh in every), sum(len(mesh.vertices) for mesh in every)
    emitters = sum(len(thing.mesh.faces) for thing in scene.objects if any(m.lights_others for m in thing.materials))
    images = {id(t.image): t.image for m in scene.materials for t in m.textures if isinstance(t, Texture)}
    texels = sum(image.shape[0] * image.shape[1] for image in images.values())
    sky = scene.background.image.size // 3 if isinstance(scene.background, EnvironmentBackground) else 0
    return (faces * BYTES_OF_FACE + vertices * BYTES_OF_VERTEX + emitters * BYTES_OF_EMITTER
            + (len(scene.objects) + len(scene.spheres)) * BYTES_OF_OBJECT + texels * BYTES_OF_TEXEL + sky * BYTES_OF_SKY
            + (faces + len(scene.spheres)) * accel.bytes_to_build)
