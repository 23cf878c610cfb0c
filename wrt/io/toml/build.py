"""Conversion of a checked TOML scene file to a `Scene`: read files, look up names, convert degrees to radians."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.core.checks import unknown
from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.io.toml.kinds import make, values_of
from wrt.io.toml.meshes import Meshes
from wrt.io.toml.report import raise_all, unknown_materials
from wrt.io.toml.transforms import cosine_sine, transform
from wrt.scene import shapes
from wrt.scene.backgrounds import BACKGROUNDS, Background, ConstantBackground
from wrt.scene.cameras import CAMERAS, Camera, CameraKind
from wrt.scene.kinds import forms
from wrt.scene.lights import LIGHTS, Light
from wrt.scene.materials import CONDUCTORS, SLOTS, Checkerboard, Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.values import BLACK, SMALLEST, as_vector, require_count

if TYPE_CHECKING:
    from wrt.io.toml import schema as tables
    from wrt.io.toml.camera_schema import PoseTable
    from wrt.io.toml.material_schema import ColorTextureTable, ImageTable, MaterialTable
    from wrt.io.toml.values import Table, TypedTable


def build(table: tables.SceneTable, path: Path) -> Scene:
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

    def scene(self, table: tables.SceneTable) -> Scene | None:
        for name, material in table.materials.items():
            self.materials |= self.material(material, name, f"materials.{name}")
        included: list[Scene] = []
        for i, entry in enumerate(table.include):
            included += self.included(entry, f"include[{i}]")
        included = self.overridden(included, table)
        known = {m.name: m for scene in included for m in scene.materials} | self.materials
        # A material with a mistake counts as known, so that the message has one line for it.
        self.problems += unknown_materials(table.model_dump(exclude_unset=True), {**known, **table.materials})
        self.materials = known

        objects: list[Object] = []
        spheres: list[Sphere] = []
        lights: list[Light] = []
        cameras: list[CameraKind] = []
        for i, sphere in enumerate(table.spheres):
            with self.at(f"spheres[{i}]"):
                spheres += [Sphere(**{**sphere.given(), "material": m}) for m in self.material_named(sphere.material)]
        for i, quad in enumerate(table.quads):
            with self.at(f"quads[{i}]"):
                mesh = shapes.quad(quad.corner, quad.edge_u, quad.edge_v)
                objects += [Object(mesh, (m,), name=quad.name or f"quads[{i}]") for m in self.material_named(quad.material)]
        for i, box in enumerate(table.boxes):
            with self.at(f"boxes[{i}]"):
                mesh, matrix = shapes.box(box.low, box.high), transform(box.transform)
                objects += [Object(mesh, (m,), matrix, name=box.name or f"boxes[{i}]") for m in self.material_named(box.material)]
        for i, each in enumerate(table.meshes):
            with self.at(f"meshes[{i}]"):
                objects += self.meshes.objects(each, f"meshes[{i}]", self.materials)
        for i, light in enumerate(table.lights):
            with self.at(f"lights[{i}]"):
                made = self.light(light, light.name or f"lights[{i}]")
                if isinstance(made, Object):
                    objects.append(made)
                else:
                    lights.append(made)
        for name, camera in table.cameras.items():
            with self.at(f"cameras.{name}"):
                cameras.append(make_camera(camera, name))
        background: Background = ConstantBackground()
        with self.at("background"):
            background = self.background(table)
        if self.problems:
            return None
        return Scene(
            objects=(*objects, *(thing for scene in included for thing in scene.objects)),
            spheres=tuple(spheres),
            lights=(*lights, *(light for scene in included for light in scene.lights)),
            cameras=(*cameras, *(camera for scene in included for camera in scene.cameras)),
            background=background,
            ambient=as_vector(table.ambient, "ambient"),
            ambient_occlusion=table.ambient_occlusion,
            settings=settings(table.settings, included),
            name=table.title or self.path.stem,
        )

    def material_named(self, name: str) -> list[Material]:
        """Return [the material of a known name], or [] for an unknown name, which `unknown_materials` reports."""
        return [self.materials[name]] if name in self.materials else []

    def included(self, entry: str | tables.IncludeTable, place: str) -> list[Scene]:
        from wrt.io.gltf.reader import load_gltf

        name, to_world = (entry, None) if isinstance(entry, str) else (entry.file, entry.transform)
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

    def overridden(self, included: list[Scene], table: tables.SceneTable) -> list[Scene]:
        """Return the included scenes with materials replaced by the materials of the same name in [override]."""
        names = list(dict.fromkeys(m.name for scene in included for m in scene.materials))
        new: dict[str, Material] = {}
        for name, material in table.override.items():
            with self.at(f"override.{name}"):
                if name not in names and len(included) == len(table.include):
                    raise unknown(name, "included material", names)
            new |= self.material(material, name, f"override.{name}")
        return [replace(scene, objects=tuple(
            replace(thing, materials=tuple(new.get(m.name, m) for m in thing.materials)) for thing in scene.objects))
            for scene in included]

    def material(self, table: MaterialTable, name: str, place: str) -> dict[str, Material]:
        """Return {name: material}, or {} if the table has a mistake."""
        fields = table.given("metal", *SLOTS)
        if table.metal is not None:
            fields["eta"], fields["k"] = CONDUCTORS[table.metal]
        for slot, is_color in SLOTS.items():
            texture = getattr(table, slot)
            if texture is not None:
                with self.at(f"{place}.{slot}"):
                    fields[slot] = self.texture(texture, is_color)
        with self.at(place):
            return {name: Material(name=name, **fields)}
        return {}

    def texture(self, table: ImageTable | ColorTextureTable, is_color: bool) -> Texture | Checkerboard:
        key = (table.model_dump_json(), is_color)
        if key not in self._textures:
            if (checkerboard := getattr(table, "checkerboard", None)) is not None:
                self._textures[key] = Checkerboard(**checkerboard.given())
            else:
                cosine, sine = cosine_sine(table.rotation)
                (u, v), (du, dv) = table.scale, table.offset
                # As in KHR_texture_transform: scale, then rotate (v points down), then translate.
                placed = [[cosine * u, sine * v, du], [-sine * u, cosine * v, dv]]
                self._textures[key] = Texture(
                    self.image(self.file(str(table.file))),
                    srgb=is_color if table.srgb is None else table.srgb,
                    wrap=(table.wrap[0], table.wrap[1]),
                    uv_transform=np.array(placed if table.matrix is None else table.matrix).reshape(2, 3),
                    name=str(table.file),
                )
        return self._textures[key]

    def image(self, path: Path) -> np.ndarray:
        from wrt.picture.decode import decode_rgba8

        if path not in self._images:
            with at(path=path):
                self._images[path] = decode_rgba8(read_file(path))
            self._images[path].flags.writeable = False  # so that textures share it
        return self._images[path]

    def background(self, table: tables.SceneTable) -> Background:
        from wrt.picture.image import read_image

        if table.background is None:
            return ConstantBackground()
        return make(BACKGROUNDS[table.background.type], table.background, "", lambda name: read_image(self.file(name), environment=True))

    def light(self, table: TypedTable, name: str) -> Light | Object:
        """Return a light; for a rectangle light, an emissive object of albedo 0."""
        from wrt.io.toml.schema import RectangleLightTable
        from wrt.picture.image import read_image

        if isinstance(table, RectangleLightTable):
            material = Material(name=name, albedo=BLACK, emission=as_vector(table.radiance, "radiance"), two_sided=table.two_sided)
            return Object(shapes.quad(table.corner, table.edge_u, table.edge_v), (material,), name=name)
        return make(LIGHTS[table.type], table, name, lambda file: read_image(self.file(file), environment=True))


def settings(table: Table, included: Sequence[Scene]) -> Settings:
    """Return the settings of a scene file. glass_shadows is "tinted" by default if an included file has solid glass."""
    tinted = any(scene.settings.glass_shadows == "tinted" for scene in included)
    needed = {"glass_shadows": "tinted"} if tinted else {}
    return Settings(**{**needed, **table.given()})


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


def make_camera(table: PoseTable, name: str) -> CameraKind:
    """Make a camera. Position and target or a matrix give its pose; fov_y or a real lens gives a perspective camera's angle of view."""
    kind = CAMERAS[table.type]
    values: dict[str, Any] = {}
    if "focus_distance" in forms(kind) and table.position is not None and table.target is not None:
        values["focus_distance"] = max(math.dist(table.position, table.target), SMALLEST)
    values |= values_of(kind, table)
    focal_length, sensor_height = (getattr(table, key, None) for key in ("focal_length", "sensor_height"))
    if focal_length is not None and sensor_height is not None:
        values |= Camera.lens(focal_length, values.get("focus_distance", 1.0), sensor_height,
                              f_number=getattr(table, "f_number", None), aperture_radius=values.get("aperture_radius"))
    if table.matrix is not None:
        return kind.posed(np.array(table.matrix).reshape(4, 4), name=name, **values)
    assert table.position is not None and table.target is not None  # as the schema checks
    return kind.look_at(table.position, table.target, table.up, name=name, **values)
