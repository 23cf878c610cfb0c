"""Scenes as JSON text and NumPy arrays, for other processes. The format holds no code."""

import json
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.scene import model as scenes
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS
from wrt.scene.lights import LIGHTS
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings


def kinds() -> dict[str, type[object]]:
    """Return the classes that the format can hold, by name."""
    return {kind.__name__: kind for kind in (
        Scene, Settings, Object, Mesh, scenes.Sphere, Material, Texture, Checkerboard, *CAMERAS.values(),
        *LIGHTS.values(), *BACKGROUNDS.values())}


LEFT_OUT: dict[type, tuple[str, ...]] = {Object: ("motion",)}  # a single picture ignores it


def pack(scene: object, left_out: dict[type, tuple[str, ...]] = LEFT_OUT) -> tuple[str, list[np.ndarray]]:
    """Return the JSON text of a scene, and the arrays to which the text refers. Shared meshes, materials and textures are stored once.

    left_out: names of the fields to store as None, by class; the key `object` stands for every class."""
    packer = _Packer(left_out)
    packer.plain(scene)
    return json.dumps(packer.things), packer.arrays


def unpack(text: str, arrays: list[np.ndarray]) -> Scene:
    """Return the packed scene, bit for bit and with the same sharing; it uses `arrays` without a copy. Raises InputError for another text.

    Constructors are bypassed, because they would round the pose of a camera once more."""
    things: list[Any] = []
    known = kinds()

    def value(plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        ((kind, content),) = plain.items()
        if kind == "thing":
            return things[content]
        return arrays[content] if kind == "array" else tuple(value(each) for each in content)

    try:
        for name, content in json.loads(text):
            thing = object.__new__(known[name])
            for each in fields(known[name]):  # type: ignore[arg-type]
                object.__setattr__(thing, each.name, value(content[each.name]))
            things.append(thing)
        if not isinstance(things[-1], Scene):
            raise KeyError("Scene")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"is no scene of this version ({type(error).__name__}: {error})") from error
    return things[-1]


class _Packer:
    """Collector of `things` (instances, as [class name, {field: value}]) and of `arrays`. A thing comes after the things it refers to."""

    def __init__(self, left_out: dict[type, tuple[str, ...]]) -> None:
        self.left_out = left_out
        self.things: list[tuple[str, dict[str, Any]]] = []
        self.arrays: list[np.ndarray] = []
        self.known: dict[int, dict[str, int]] = {}

    def plain(self, value: object) -> Any:
        """Return a value for JSON; a thing or an array is replaced by a reference, such as {"array": index}."""
        if isinstance(value, tuple):
            return {"tuple": [self.plain(each) for each in value]}
        if isinstance(value, np.generic):
            return value.item()
        if not (is_dataclass(value) or isinstance(value, np.ndarray)):
            return value
        if id(value) not in self.known:
            if isinstance(value, np.ndarray):
                self.arrays.append(value)
                place = {"array": len(self.arrays) - 1}
            else:
                left_out = (*self.left_out.get(object, ()), *self.left_out.get(type(value), ()))
                content = {each.name: None if each.name in left_out else self.plain(getattr(value, each.name)) for each in fields(value)}
                self.things.append((type(value).__name__, content))
                place = {"thing": len(self.things) - 1}
            self.known[id(value)] = place
        return self.known[id(value)]
