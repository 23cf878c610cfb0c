"""Writing of a scene as a TOML scene file, with its meshes, textures and images in a folder beside it."""

import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import InputError
from wrt.core.files import check_writable, checksum_of, write_bytes
from wrt.core.packages import needed_by
from wrt.picture.image import write_image
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS
from wrt.scene.kinds import forms
from wrt.scene.lights import LIGHTS
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

T = TypeVar("T")
Table = dict[str, Any]


def write_toml(scene: Scene, path: Path) -> None:
    """Write a scene file; see `Scene.save`. The files beside it come first, so that an existing scene file stays whole if one fails."""
    writer = _Writer(path)
    text = "\n\n".join("\n".join([*head, *(f"{key} = {_value(value)}" for key, value in table.items())])
                       for head, table in writer.sections(scene)) + "\n"
    try:
        data = text.encode()
    except UnicodeEncodeError as error:
        name = error.object[max(error.start - 20, 0):error.end]
        raise InputError(f"a scene file does not hold a name that is not UTF-8, here {name!r}", path=path) from None
    check_writable(path)
    folder = path.parent / writer.folder
    if writer.files:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror or error}", path=folder) from error
    for name, write in writer.files.items():
        write(folder / name)
    write_bytes(path, data)


class _Writer:
    """Tables of a scene file. files: the function that writes each file beside it."""

    def __init__(self, path: Path) -> None:
        self.folder = f"{path.stem}_files"
        self.files: dict[str, Callable[[Path], None]] = {}
        self._names: dict[int, str] = {}  # of materials and files, by the ids of Materials, Meshes and arrays
        self._groups: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def sections(self, scene: Scene) -> list[tuple[list[str], Table]]:
        """Return the header and the table of each section. Raises InputError for what scene files do not hold."""
        self._groups = _groups(scene.objects)
        materials = _by_unique_name(scene.materials, "material")
        self._names = {id(material): name for name, material in materials.items()}
        top = {"title": scene.name, "ambient": scene.ambient, "ambient_occlusion": scene.ambient_occlusion}
        background = {"type": scene.background.kind, **self.described(scene.background, BACKGROUNDS)}
        out: list[tuple[list[str], Table]] = [([], top), (["[settings]"], self.described(scene.settings)), (["[background]"], background)]
        for name, camera in _by_unique_name(scene.cameras, "camera").items():
            pose = {"type": camera.kind, "matrix": camera.camera_to_world.ravel().tolist()}
            out.append(([f"[cameras.{_value(name)}]"], pose | self.described(camera, CAMERAS)))
        out += [([f"[materials.{_value(name)}]"], self.material(material)) for name, material in materials.items()]
        for sphere in scene.spheres:
            material = self._names[id(sphere.material)]
            out.append((["[[spheres]]"], {"center": sphere.center, "radius": sphere.radius, "material": material, "name": sphere.name}))
        out += [(["[[meshes]]"], self.object(thing)) for thing in scene.objects]
        out += [(["[[lights]]"], {"type": light.kind, **self.described(light, LIGHTS), "name": light.name}) for light in scene.lights]
        return out

    def described(self, thing: Any, known: Mapping[str, type] | None = None) -> Table:
        """Return the described fields of a camera, light, background or settings. known: the registered classes."""
        kind = type(thing)
        described = {"name", "camera_to_world", *forms(kind)}
        if known is not None and (known.get(thing.kind) is not kind or any(each.name not in described for each in fields(kind))):
            at = at_thing(getattr(thing, "what", "camera"), getattr(thing, "name", ""))
            raise InputError(f"a scene file does not hold a {kind.__name__}: the class is not registered, or a field has no description",
                             place=at[:-2])
        out: Table = {}
        for name, each in forms(kind).items():
            value, form = getattr(thing, name), each.metadata["form"]
            if form == "image":
                out["file"] = self.file("image", ".exr", value, [value], partial(_write_exr, image=value))
            elif value is not None:
                out[name] = math.degrees(value) if form == "angle" else value
        return out

    def file(self, stem: str, suffix: str, thing: object, arrays: list[np.ndarray | None], write: Callable[[Path], None]) -> str:
        """Add the file of a thing that has these arrays, and return its name for the scene file. A shared thing is one file."""
        key = id(thing)
        if key not in self._names:
            name = f"{stem}{len(self.files)}-{checksum_of(*(np.zeros(0) if array is None else array for array in arrays)):08x}{suffix}"
            self.files[name], self._names[key] = write, f"{self.folder}/{name}"
        return self._names[key]

    def material(self, material: Material) -> Table:
        if type(material) is not Material:
            raise InputError(f"a scene file does not hold a {type(material).__name__}", place=at_thing("material", material.name)[:-2])
        out: Table = {"kind": material.kind}
        for name, each in forms(Material).items():
            value = getattr(material, name)
            if material.reads(name) and value is not None and value != each.default:
                out[name] = self.texture(value) if each.metadata["form"] == "texture" else value
        return out

    def texture(self, texture: Texture | Checkerboard) -> Table:
        if isinstance(texture, Checkerboard):
            return {"checkerboard": self.described(texture)}
        name = self.file("texture", ".png", texture.image, [texture.image], partial(_write_png, image=texture.image))
        return {"file": name, "srgb": bool(texture.srgb), "wrap": texture.wrap, "matrix": texture.uv_transform.ravel().tolist()}

    def object(self, thing: Object) -> Table:
        at = at_thing("object", thing.name)[:-2]
        if not len(thing.mesh.faces):
            raise InputError("a scene file does not hold a mesh without triangles", place=at)
        if not abs(np.linalg.det(thing.transform[:3, :3])) > 0.0:
            raise InputError("a scene file does not hold a transform that is not invertible", place=at)
        out: Table = {"file": self.mesh(thing.mesh), "name": thing.name}
        if thing.face_material is None:
            out["material"] = self._names[id(thing.materials[0])]
        else:
            _, first = self._groups[id(thing.mesh)]
            out["materials"] = {str(group): self._names[id(thing.materials[i])] for group, i in enumerate(thing.face_material[first])}
        if not np.array_equal(thing.transform, np.eye(4)):
            out["transform"] = {"matrix": thing.transform.ravel().tolist()}
        if thing.motion is not None and thing.motion.keys is not None:
            out["motion"] = [dict(zip(("translate", "rotate", "scale"), key, strict=True)) for key in thing.motion.keys.tolist()]
        if thing.motion is not None and thing.motion.target is not None:
            out["morph"] = {"file": self.mesh(thing.motion.target)}
        return out

    def mesh(self, mesh: Mesh) -> str:
        if id(mesh) in self._groups:
            group, first = self._groups[id(mesh)]
            saved = replace(mesh, groups=tuple(map(str, range(len(first)))), face_group=group)
        else:
            saved = mesh
        arrays = [saved.vertices, saved.faces, saved.normals, saved.uvs, saved.face_group, np.array(saved.groups, np.str_), saved.origin]
        return self.file("mesh", ".npz", mesh, arrays, saved.save)


def _groups(objects: tuple[Object, ...]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return, by id of a mesh whose objects have several materials, the group of each face and the first face of each group.

    All faces of a group have the same material in each object, so that objects with different materials share the file of their mesh."""
    rows: dict[int, list[np.ndarray]] = {}
    for thing in objects:
        if thing.face_material is not None and len(thing.face_material):
            rows.setdefault(id(thing.mesh), []).append(thing.face_material)
    out = {}
    for key, each in rows.items():
        _, first, group = np.unique(np.stack(each), axis=1, return_index=True, return_inverse=True)
        out[key] = group.reshape(-1).astype(np.int32), first
    return out


def _by_unique_name(things: tuple[T, ...], noun: str) -> dict[str, T]:
    """Return named things by name. A thing without a name, or with the name of an earlier thing, gets a new name."""
    out: dict[str, T] = {}
    for i, thing in enumerate(things):
        name: str = getattr(thing, "name", "") or f"{noun}_{i}"
        while name in out:
            name += "_"
        out[name] = thing
    return out


def _write_exr(path: Path, image: np.ndarray) -> None:
    write_image(path, image, bits=32)


def _write_png(path: Path, image: np.ndarray) -> None:
    with needed_by("a scene's textures"):
        from PIL import Image
    data = io.BytesIO()
    Image.fromarray(image).save(data, "PNG")
    write_bytes(path, data.getvalue())


def _value(value: Any) -> str:
    """Return a value in TOML. Numbers keep their bits."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_value(str(key))} = {_value(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return str(value).lower() if isinstance(value, bool | np.bool_) else repr(value)
