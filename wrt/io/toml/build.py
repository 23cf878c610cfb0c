"""Conversion of a checked TOML scene file to a `Scene`: read files, look up names, convert degrees to radians."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from wrt.core.checks import unknown
from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.core.types import JsonObject
from wrt.io.mesh_file import load_mesh
from wrt.io.toml.report import raise_all
from wrt.io.toml.schema import has_name
from wrt.scene import shapes
from wrt.scene.backgrounds import BACKGROUNDS, Background, ConstantBackground
from wrt.scene.cameras import CAMERAS, Camera, CameraKind
from wrt.scene.kinds import Kind, forms
from wrt.scene.lights import LIGHTS, Light
from wrt.scene.materials import CONDUCTORS, SLOTS, Checkerboard, Material, Texture, kinds_that_use
from wrt.scene.mesh import Mesh, smooth
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.motion import Motion
from wrt.scene.settings import Settings
from wrt.scene.values import BLACK, SMALLEST, as_vector, require_count

K = TypeVar("K", bound=Kind)
STILL = {"translate": (0.0, 0.0, 0.0), "rotate": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}


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


class _Materials:
    """Materials of a scene file, their textures and images; and the mistakes in the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[InputError] = []
        self.materials: dict[str, Material] = {}
        self._textures: dict[tuple[str, bool], Texture | Checkerboard] = {}
        self._image = cache(self._read_image)

    @contextlib.contextmanager
    def at(self, place: str) -> Iterator[None]:
        """Record an InputError that the block raises as a problem at `place`, and continue after the block."""
        try:
            yield
        except InputError as error:
            self.problems.append(error.at(place=place))

    def file(self, name: str) -> Path:
        return self.path.parent / name

    def material(self, table: JsonObject, name: str, place: str) -> Material:
        """Return a material. It is a plain one of that name if the table has a mistake."""
        values = {key: value for key, value in table.items() if key != "metal" and key not in SLOTS}
        if "metal" in table:
            values["eta"], values["k"] = CONDUCTORS[table["metal"]]
        for slot, is_color in SLOTS.items():
            if slot in table:
                with self.at(f"{place}.{slot}"):
                    values[slot] = self.texture(table[slot], is_color)
        with self.at(place):
            material = Material(name=name, **values)
            if idle := [key for key in values if not material.reads(key)]:
                kinds = "; ".join(f"{key} is used by {' and '.join(kinds_that_use()[key])}" for key in idle)
                raise InputError(f"kind {material.kind!r} does not use {', '.join(idle)}", hint=kinds)
            return material
        return Material(name=name)

    def material_named(self, name: str) -> Material:
        if name not in self.materials:
            raise unknown(name, "material", self.materials, place="material")
        return self.materials[name]

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
        return Texture(self._image(self.file(table["file"])), srgb=table.get("srgb", is_color),
                       wrap=(wrap, wrap) if isinstance(wrap, str) else tuple(wrap),
                       uv_transform=np.array(matrix, np.float64).reshape(2, 3), name=table["file"])

    def _read_image(self, path: Path) -> np.ndarray:
        from wrt.picture.decode import decode_rgba8

        with at(path=path):
            image = decode_rgba8(read_file(path))
        image.flags.writeable = False  # so that textures share it
        return image


class _Builder(_Materials):
    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._included_objects = 0
        self._gltf, self._mesh = cache(self._read_gltf), cache(self._make_mesh)

    def scene(self, table: JsonObject) -> Scene | None:
        own = {name: self.material(material, name, f"materials.{name}") for name, material in table.get("materials", {}).items()}
        included: list[Scene] = []
        for i, entry in enumerate(table.get("include", [])):
            included += self.included(entry, f"include[{i}]")
        included = self.overridden(included, table)
        self.materials = {m.name: m for scene in included for m in scene.materials} | own

        found: list[Sphere | Object | Light] = []
        for key, make in (("spheres", self.sphere), ("quads", self.quad), ("boxes", self.box), ("meshes", self.objects),
                          ("lights", self.light)):
            for i, each in enumerate(table.get(key, [])):
                with self.at(f"{key}[{i}]"):
                    found += make(each, each.get("name") or f"{key}[{i}]")
        cameras: list[CameraKind] = []
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
            objects=(*(each for each in found if isinstance(each, Object)), *(each for scene in included for each in scene.objects)),
            spheres=tuple(each for each in found if isinstance(each, Sphere)),
            lights=(*(each for each in found if isinstance(each, Light)), *(each for scene in included for each in scene.lights)),
            cameras=(*cameras, *(each for scene in included for each in scene.cameras)),
            background=background,
            settings=settings(table.get("settings", {}), included),
            name=table.get("title") or self.path.stem,
            **{key: table[key] for key in ("ambient", "ambient_occlusion") if key in table},
        )

    def included(self, entry: str | JsonObject, place: str) -> list[Scene]:
        name, to_world = (entry, None) if isinstance(entry, str) else (entry["file"], entry.get("transform"))
        with self.at(place):
            if not name.lower().endswith((".gltf", ".glb")):
                raise InputError(f"{name!r} is no .gltf or .glb file", hint="mesh files belong into [[meshes]]")
            scene = self._gltf(self.file(name))
            self._included_objects += len(scene.objects)
            require_count(self._included_objects, "objects")
            return [moved(scene, transform(to_world))]
        return []

    def _read_gltf(self, path: Path) -> Scene:
        from wrt.io.gltf.reader import load_gltf

        return load_gltf(path, staged=False)

    def overridden(self, included: list[Scene], table: JsonObject) -> list[Scene]:
        """Return the included scenes with materials replaced by the materials of the same name in [override]."""
        names = list(dict.fromkeys(m.name for scene in included for m in scene.materials))
        new: dict[str, Material] = {}
        for name, material in table.get("override", {}).items():
            with self.at(f"override.{name}"):
                if name not in names and len(included) == len(table.get("include", [])):
                    raise unknown(name, "included material", names)
            new[name] = self.material(material, name, f"override.{name}")
        return [replace(scene, objects=tuple(
            replace(thing, materials=tuple(new.get(m.name, m) for m in thing.materials)) for thing in scene.objects))
            for scene in included]

    def sphere(self, table: JsonObject, name: str) -> list[Sphere]:
        return [Sphere(**{**table, "material": self.material_named(table["material"])})]

    def quad(self, table: JsonObject, name: str) -> list[Object]:
        mesh = shapes.quad(table["corner"], table["edge_u"], table["edge_v"])
        return [Object(mesh, (self.material_named(table["material"]),), name=name)]

    def box(self, table: JsonObject, name: str) -> list[Object]:
        mesh = shapes.box(table["low"], table["high"])
        return [Object(mesh, (self.material_named(table["material"]),), transform(table.get("transform")), name=name)]

    def objects(self, table: JsonObject, name: str) -> list[Object]:
        """Return an object for each instance of a mesh."""
        parts = table.get("parts", [])
        mesh = self.mesh(table, tuple((part["first"], part["count"]) for part in parts), table.get("smooth"))
        by_group: Mapping[str, str] = table.get("materials") or {str(i): part["material"] for i, part in enumerate(parts)}
        groups, wanted = set(mesh.groups), {0: table.get("material")}  # wanted: the material's name for each group in use
        for group in by_group:
            if group not in groups:
                raise unknown(group, "group of " + mesh.name, mesh.groups, place="materials")
        if by_group and mesh.face_group is not None:
            wanted = {i: by_group.get(mesh.groups[i], table.get("material")) for i in np.unique(mesh.face_group).tolist()}
        for i, material in wanted.items():
            if material is None:
                where = f"the triangles of group {mesh.groups[i]!r} have" if by_group else "has"
                raise InputError(f"{where} no material", hint="give `material`")
        names = {material: i for i, material in enumerate(dict.fromkeys(map(str, wanted.values())))}
        face_material = None
        if by_group and mesh.face_group is not None:
            of_group = np.zeros(len(mesh.groups), dtype=np.int32)
            of_group[list(wanted)] = [names[str(material)] for material in wanted.values()]
            face_material = of_group[mesh.face_group]
        to_world = transform(table.get("transform"))
        placements = [] if "instances" in table else [to_world]
        for i, instance in enumerate(table.get("instances", [])):
            with at(f"instances[{i}]"):
                placements.append(to_world @ transform(instance))
        materials, motion = tuple(self.material_named(material) for material in names), self.motion(table)
        return [Object(mesh, materials, matrix, face_material, name, motion) for matrix in placements]

    def motion(self, table: JsonObject) -> Motion | None:
        if "motion" not in table and "morph" not in table:
            return None
        keys = [[np.broadcast_to(value, 3) for value in (STILL | key).values()] for key in table.get("motion", [])]
        target = self.mesh(table["morph"], (), table.get("smooth")) if "morph" in table else None
        return Motion(np.array(keys, np.float64) if keys else None, target)

    def mesh(self, table: JsonObject, parts: tuple[tuple[int, int], ...], normals: bool | None) -> Mesh:
        """Return the mesh of the table's file or shape. normals: True adds missing vertex normals, False drops them, None does neither."""
        source = json.dumps(table["shape"], sort_keys=True) if "shape" in table else self.file(table["file"])
        return self._mesh(source, parts, normals)

    def _make_mesh(self, source: str | Path, parts: tuple[tuple[int, int], ...], normals: bool | None) -> Mesh:
        """Return the mesh of a file, or of a shape as JSON."""
        if normals is not None:
            mesh = self._mesh(source, parts, None)
            return smooth(mesh) if normals else replace(mesh, normals=None)
        if isinstance(source, Path):
            return load_mesh(source, parts)
        arguments = json.loads(source)
        return shapes.SHAPES[arguments.pop("kind")](**arguments)

    def light(self, table: JsonObject, name: str) -> list[Light | Object]:
        """Return a light; for a rectangle light, an emissive object of albedo 0."""
        if table["type"] != "rectangle":
            return [self.make(LIGHTS[table["type"]], table, name)]
        emission = as_vector(table["radiance"], "radiance")
        material = Material(name=name, albedo=BLACK, emission=emission, two_sided=table.get("two_sided", False))
        return [Object(shapes.quad(table["corner"], table["edge_u"], table["edge_v"]), (material,), name=name)]

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


def transform(table: JsonObject | None) -> np.ndarray:
    """Return the matrix (4, 4) float64 of a table: scale, then rotate, then translate. None gives the identity.

    Raises InputError for a singular matrix."""
    matrix = np.eye(4)
    if table is None:
        return matrix
    placed: JsonObject = STILL | table
    if "matrix" in table:
        matrix = np.array(table["matrix"], np.float64).reshape(4, 4)
    else:
        if "axis" in placed:
            rotation = _about(np.array(placed["axis"], np.float64), placed["angle"])
        else:
            x, y, z = (_about(axis, angle) for axis, angle in zip(np.eye(3), placed["rotate"], strict=True))
            rotation = z @ y @ x
        matrix[:3, :3] = rotation * placed["scale"]
        matrix[:3, 3] = placed["translate"]
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise InputError("the transform must be invertible: neither its scale in any axis nor its axis may be 0")
    return matrix


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Return the (3, 3) matrix of a rotation about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cosine, sine = cosine_sine(degrees)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def cosine_sine(degrees: float) -> tuple[float, float]:
    """Return cosine and sine of an angle. Multiples of 90 degrees are exact, so that axis-parallel edges stay axis-parallel."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
