"""Conversion of a checked TOML scene file to a `Scene`: read files, look up names, convert degrees to radians."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from wrt.core.checks import unknown
from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.core.types import JsonObject
from wrt.io.toml.meshes import Meshes, cosine_sine, transform
from wrt.io.toml.report import raise_all, unknown_materials
from wrt.io.toml.schema import has_name
from wrt.scene import shapes
from wrt.scene.backgrounds import BACKGROUNDS, Background, ConstantBackground
from wrt.scene.cameras import CAMERAS, Camera, CameraKind
from wrt.scene.kinds import Kind, forms
from wrt.scene.lights import LIGHTS, Light
from wrt.scene.materials import CONDUCTORS, SLOTS, Checkerboard, Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.values import BLACK, SMALLEST, as_vector, require_count

K = TypeVar("K", bound=Kind)


def build(table: JsonObject, path: Path) -> Scene:
    """Make the scene of a checked scene file at `path`; the names of files in it are relative to the folder of `path`.

    A file that is named twice is read once, and its mesh or texture is shared. Raises one InputError that lists all unknown names,
    unusable files and values that the scene refuses."""
    builder = _Builder(path)
    with at(path=path):
        scene = builder.scene(table)
    raise_all(builder.problems, path)
    assert scene is not None
    return scene


class _Builder:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[InputError] = []
        self.materials: dict[str, Material] = {}
        self._included: dict[Path, Scene] = {}
        self._included_objects = 0
        self._images: dict[Path, np.ndarray] = {}
        self._textures: dict[tuple[str, bool], Texture | Checkerboard] = {}
        self.meshes = Meshes(path.parent)

    @contextlib.contextmanager
    def at(self, place: str) -> Iterator[None]:
        """Record an InputError that the block raises as a problem at `place`, and continue after the block."""
        try:
            yield
        except InputError as error:
            self.problems.append(error.at(place=place))

    def file(self, name: str) -> Path:
        return self.path.parent / name

    def scene(self, table: JsonObject) -> Scene | None:
        materials = table.get("materials", {})
        for name, material in materials.items():
            self.materials |= self.material(material, name, f"materials.{name}")
        included: list[Scene] = []
        for i, entry in enumerate(table.get("include", [])):
            included += self.included(entry, f"include[{i}]")
        included = self.overridden(included, table)
        known = {m.name: m for scene in included for m in scene.materials} | self.materials
        # A material with a mistake counts as known, so that the message has one line for it.
        self.problems += unknown_materials(table, {**known, **materials})
        self.materials = known

        objects: list[Object] = []
        spheres: list[Sphere] = []
        lights: list[Light] = []
        cameras: list[CameraKind] = []
        for place, sphere in self.each(table, "spheres"):
            with self.at(place):
                spheres += [Sphere(**{**sphere, "material": m}) for m in self.material_named(sphere["material"])]
        for place, quad in self.each(table, "quads"):
            with self.at(place):
                mesh = shapes.quad(quad["corner"], quad["edge_u"], quad["edge_v"])
                objects += [Object(mesh, (m,), name=quad.get("name") or place) for m in self.material_named(quad["material"])]
        for place, box in self.each(table, "boxes"):
            with self.at(place):
                mesh, matrix = shapes.box(box["low"], box["high"]), transform(box.get("transform"))
                objects += [Object(mesh, (m,), matrix, name=box.get("name") or place) for m in self.material_named(box["material"])]
        for place, each in self.each(table, "meshes"):
            with self.at(place):
                objects += self.meshes.objects(each, place, self.materials)
        for place, light in self.each(table, "lights"):
            with self.at(place):
                made = self.light(light, light.get("name") or place)
                if isinstance(made, Object):
                    objects.append(made)
                else:
                    lights.append(made)
        for name, camera in table.get("cameras", {}).items():
            with self.at(f"cameras.{name}"):
                cameras.append(make_camera(camera, name))
        background: Background = ConstantBackground()
        with self.at("background"):
            if "background" in table:
                background = self.make(BACKGROUNDS[table["background"]["type"]], table["background"], "")
        if self.problems:
            return None
        return Scene(
            objects=(*objects, *(thing for scene in included for thing in scene.objects)),
            spheres=tuple(spheres),
            lights=(*lights, *(light for scene in included for light in scene.lights)),
            cameras=(*cameras, *(camera for scene in included for camera in scene.cameras)),
            background=background,
            settings=settings(table.get("settings", {}), included),
            name=table.get("title") or self.path.stem,
            **{key: table[key] for key in ("ambient", "ambient_occlusion") if key in table},
        )

    @staticmethod
    def each(table: JsonObject, key: str) -> list[tuple[str, JsonObject]]:
        """Return the tables of a list in the file, each with its place."""
        return [(f"{key}[{i}]", each) for i, each in enumerate(table.get(key, []))]

    def material_named(self, name: str) -> list[Material]:
        """Return [the material of a known name], or [] for an unknown name, which `unknown_materials` reports."""
        return [self.materials[name]] if name in self.materials else []

    def included(self, entry: str | JsonObject, place: str) -> list[Scene]:
        from wrt.io.gltf.reader import load_gltf

        name, to_world = (entry, None) if isinstance(entry, str) else (entry["file"], entry.get("transform"))
        with self.at(place):
            if not name.lower().endswith((".gltf", ".glb")):
                raise InputError(f"{name!r} is no .gltf or .glb file", hint="mesh files belong into [[meshes]]")
            path = self.file(name)
            if path not in self._included:
                self._included[path] = load_gltf(path, staged=False)
            scene = self._included[path]
            self._included_objects += len(scene.objects)
            require_count(self._included_objects, "objects")
            return [moved(scene, transform(to_world))]
        return []

    def overridden(self, included: list[Scene], table: JsonObject) -> list[Scene]:
        """Return the included scenes with materials replaced by the materials of the same name in [override]."""
        names = list(dict.fromkeys(m.name for scene in included for m in scene.materials))
        new: dict[str, Material] = {}
        for name, material in table.get("override", {}).items():
            with self.at(f"override.{name}"):
                if name not in names and len(included) == len(table.get("include", [])):
                    raise unknown(name, "included material", names)
            new |= self.material(material, name, f"override.{name}")
        return [replace(scene, objects=tuple(
            replace(thing, materials=tuple(new.get(m.name, m) for m in thing.materials)) for thing in scene.objects))
            for scene in included]

    def material(self, table: JsonObject, name: str, place: str) -> dict[str, Material]:
        """Return {name: material}, or {} if the table has a mistake."""
        values = {key: value for key, value in table.items() if key != "metal" and key not in SLOTS}
        if "metal" in table:
            values["eta"], values["k"] = CONDUCTORS[table["metal"]]
        for slot, is_color in SLOTS.items():
            if slot in table:
                with self.at(f"{place}.{slot}"):
                    values[slot] = self.texture(table[slot], is_color)
        with self.at(place):
            return {name: Material(name=name, **values)}
        return {}

    def texture(self, table: JsonObject, is_color: bool) -> Texture | Checkerboard:
        key = (json.dumps(table, sort_keys=True), is_color)
        if key not in self._textures:
            self._textures[key] = Checkerboard(**table["checkerboard"]) if "checkerboard" in table else self.picture(table, is_color)
        return self._textures[key]

    def picture(self, table: JsonObject, is_color: bool) -> Texture:
        cosine, sine = cosine_sine(table.get("rotation", 0.0))
        (u, v), (du, dv) = np.broadcast_to(table.get("scale", 1.0), 2), table.get("offset", (0.0, 0.0))
        # As in KHR_texture_transform: scale, then rotate (v points down), then translate.
        matrix = table.get("matrix", [cosine * u, sine * v, du, -sine * u, cosine * v, dv])
        wrap = table.get("wrap", "repeat")
        return Texture(self.image(self.file(table["file"])), srgb=table.get("srgb", is_color),
                       wrap=(wrap, wrap) if isinstance(wrap, str) else tuple(wrap),
                       uv_transform=np.array(matrix, np.float64).reshape(2, 3), name=table["file"])

    def image(self, path: Path) -> np.ndarray:
        from wrt.picture.decode import decode_rgba8

        if path not in self._images:
            with at(path=path):
                self._images[path] = decode_rgba8(read_file(path))
            self._images[path].flags.writeable = False  # so that textures share it
        return self._images[path]

    def light(self, table: JsonObject, name: str) -> Light | Object:
        """Return a light; for a rectangle light, an emissive object of albedo 0."""
        if table["type"] != "rectangle":
            return self.make(LIGHTS[table["type"]], table, name)
        emission = as_vector(table["radiance"], "radiance")
        material = Material(name=name, albedo=BLACK, emission=emission, two_sided=table.get("two_sided", False))
        return Object(shapes.quad(table["corner"], table["edge_u"], table["edge_v"]), (material,), name=name)

    def make(self, kind: type[K], table: JsonObject, name: str) -> K:
        """Make the light or background of a table. An image is read, and its file gives the name."""
        from wrt.picture.image import read_image

        values: dict[str, Any] = ({"name": name} if has_name(kind) else {}) | values_of(kind, table)
        for key, each in forms(kind).items():
            if each.metadata["form"] == "image":
                values |= {key: read_image(self.file(values[key]), environment=True), "name": values[key]}
        return kind(**values)


def values_of(kind: type, table: JsonObject) -> dict[str, Any]:
    """Return the values of a table by the class's field names: angles in radians, an image as the name of its file."""
    values: dict[str, Any] = {}
    for name, each in forms(kind).items():
        form = each.metadata["form"]
        key = "file" if form == "image" else name
        if key in table:
            values[name] = math.radians(table[key]) if form == "angle" else table[key]
    return values


def settings(table: JsonObject, included: Sequence[Scene]) -> Settings:
    """Return the settings of a scene file. glass_shadows is "tinted" by default if an included file has solid glass."""
    tinted = any(scene.settings.glass_shadows == "tinted" for scene in included)
    needed = {"glass_shadows": "tinted"} if tinted else {}
    return Settings(**{**needed, **table})


def moved(scene: Scene, matrix: np.ndarray) -> Scene:
    """Return a scene with objects, lights and cameras transformed by a (4, 4) matrix. Intensities stay the same, as in glTF."""
    if np.array_equal(matrix, np.eye(4)):
        return scene
    return replace(
        scene,
        objects=tuple(replace(thing, transform=matrix @ thing.transform) for thing in scene.objects),
        lights=tuple(light.moved(matrix) for light in scene.lights),
        cameras=tuple(replace(camera, camera_to_world=matrix @ camera.camera_to_world) for camera in scene.cameras),
    )


def make_camera(table: JsonObject, name: str) -> CameraKind:
    """Make a camera. Position and target or a matrix give its pose; fov_y or a real lens gives a perspective camera's angle of view."""
    kind = CAMERAS[table.get("type", Camera.kind)]
    values: dict[str, Any] = {}
    if "focus_distance" in forms(kind) and "position" in table:
        values["focus_distance"] = max(math.dist(table["position"], table["target"]), SMALLEST)
    values |= values_of(kind, table)
    if "focal_length" in table:
        values |= Camera.lens(table["focal_length"], values.get("focus_distance", 1.0), table["sensor_height"],
                              f_number=table.get("f_number"), aperture_radius=values.get("aperture_radius"))
    if "matrix" in table:
        return kind.posed(np.array(table["matrix"], np.float64).reshape(4, 4), name=name, **values)
    up = {"up": table["up"]} if "up" in table else {}
    return kind.look_at(table["position"], table["target"], **up, name=name, **values)
