"""Choice between meshes that are stored once, with an instance for each object, and meshes that are copied."""

from collections import defaultdict

import numpy as np

from wrt.core.checks import as_choice
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

INSTANCING = ("auto", "always", "never")
MIN_SAVED = 250_000  # triangles that instances of a mesh must save to be worth a second level (docs/moving.md, "Instances")


def instanced_meshes(scene: Scene, instancing: str = "auto") -> frozenset[int]:
    """Return the id() of each mesh to store once: meshes that save MIN_SAVED triangles ("auto"), or all shared meshes ("always").

    Objects whose transform flattens or shears too much (MAX_SPREAD) are always copied. Raises InputError for an unknown choice.
    """
    as_choice(instancing, INSTANCING, "instancing")
    if instancing == "never":
        return frozenset()
    users: dict[int, list[Object]] = defaultdict(list)
    for thing in scene.objects:
        users[id(thing.mesh)].append(thing)
    least = MIN_SAVED if instancing == "auto" else 1
    return frozenset(key for key, things in users.items() if len(things) > 1
                     and (sum(map(is_invertible, things)) - 1) * len(things[0].mesh.faces) >= least)


def stored_meshes(scene: Scene, meshes: frozenset[int]) -> list[Mesh]:
    """Return the meshes that a structure stores: `meshes` (from instanced_meshes) once, other meshes once per object."""
    once = {id(thing.mesh): thing.mesh for thing in scene.objects if is_instance(thing, meshes)}
    return [*once.values(), *(thing.mesh for thing in scene.objects if not is_instance(thing, meshes))]


def is_instance(thing: Object, meshes: frozenset[int]) -> bool:
    return id(thing.mesh) in meshes and is_invertible(thing)


def is_invertible(thing: Object) -> bool:
    """Return whether rays can be transformed to the object's own space without much loss of accuracy."""
    from wrt.accel.geometry import MAX_SPREAD  # not at the top, because it imports Warp, which slows `render --help`

    linear = thing.transform[:3, :3]
    with np.errstate(all="ignore"):
        try:
            spread = (np.abs(linear) @ np.abs(np.linalg.inv(linear))).sum(axis=1).max()
        except np.linalg.LinAlgError:
            return False
    return bool(spread <= MAX_SPREAD)
