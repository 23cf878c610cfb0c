"""Several worlds in one structure: all their objects are instances in one geometry."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import MESH_OF_A_SPHERE
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.scenes.flatten import flatten
from wrt.accel.scenes.instancing import is_invertible
from wrt.core.errors import InputError
from wrt.scene.far import moved_by, scene_origin
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene


def worlds_over(worlds: Sequence[Mesh | Scene], unnamed: bool = False) -> FlatScene:
    """Join several worlds in one geometry; each mesh is stored once. Raises InputError for spheres and flattened objects.
    unnamed: the caller has one scene and knows no world, so that messages name none."""
    for index, scene in enumerate(worlds):
        place = "" if unnamed else f"world {index}"
        for thing in scene.objects if isinstance(scene, Scene) else ():
            if not is_invertible(thing):
                raise InputError("is flattened or sheared too much to be an instance",
                                 place=f"{place and place + ': '}object {thing.name!r}")
        if isinstance(scene, Scene) and scene.spheres:
            raise InputError("has spheres, but only meshes move (movable=True) or are in worlds", place=place or "the scene",
                             hint=MESH_OF_A_SPHERE)
    grey = (Material(),)
    objects = [scene.objects if isinstance(scene, Scene) else (Object(scene, grey, name=scene.name),) for scene in worlds]
    together = tuple(thing for each in objects for thing in each)
    if not together:
        raise InputError("must have at least one object in all its worlds together", argument="mesh")
    joined = Scene(together)
    origin = scene_origin(joined)
    joined = moved_by(joined, origin)
    together = joined.objects
    flat = flatten(joined, frozenset(id(thing.mesh) for thing in together))
    geometry = flat.geometry
    assert isinstance(geometry, InstancedGeometry)
    places = {id(material): i for i, material in enumerate(joined.materials)}
    own = [(world, places[id(material)], i) for world, scene in enumerate(worlds)
           for i, material in enumerate(scene.materials if isinstance(scene, Scene) else grey)]
    return replace(flat, geometry=replace(geometry, origin=origin, worlds=np.cumsum([0, *map(len, objects)])), objects=None,
                   own_materials=np.array(sorted(own), np.int64).reshape(-1, 3))
