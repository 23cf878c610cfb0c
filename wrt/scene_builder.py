"""A checked TOML scene file becomes a `Scene`: files are read, names looked up, degrees become radians."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt import shapes
from wrt.arguments import unknown
from wrt.errors import InputError
from wrt.memory import Meter
from wrt.mesh import Mesh, load_mesh
from wrt.motion import Motion
from wrt.read_file import read_file
from wrt.scene import (
    BLACK,
    CONDUCTORS,
    SMALLEST,
    Background,
    Camera,
    Checkerboard,
    ConstantBackground,
    DirectionalLight,
    EnvironmentBackground,
    GradientBackground,
    Light,
    Material,
    Object,
    PointLight,
    Scene,
    Settings,
    Sphere,
    SpotLight,
    Texture,
    as_vector,
    require_count,
)
from wrt.scene_check import raise_all, unknown_materials
from wrt.smooth import smooth

if TYPE_CHECKING:
    from wrt import scene_schema as tables
    from wrt.material_schema import MaterialTable

_COLOR_SLOTS = ("albedo_texture", "emission_texture")
_DATA_SLOTS = ("metallic_roughness_texture", "transmission_texture", "normal_texture")


def build(table: tables.SceneTable, path: Path) -> Scene:
    """The scene that the tables describe; files are looked for beside `path`.

    A file that is named twice is read once, and its mesh or texture is one object. Raises one InputError that lists
    every name that is not known, every file that cannot be used, and every value that the scene refuses.
    """
    builder = _Builder(path)
    try:
        scene = builder.scene(table)
    except InputError as error:
        raise InputError(str(error), path) from None
    raise_all(builder.problems, path)
    assert scene is not None
    return scene


class _Builder:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self.materials: dict[str, Material] = {}
        self._included: dict[Path, Scene] = {}  # a file that is named again is read once
        self._included_objects = 0
        self._images: dict[Path, np.ndarray] = {}
        self._textures: dict[tuple[Any, ...], Texture | Checkerboard] = {}
        self._meshes: dict[tuple[Any, ...], Mesh] = {}
        self.meter = Meter()

    @contextlib.contextmanager
    def at(self, place: str) -> Iterator[None]:
        """Note an InputError as a problem at that place, and go on."""
        try:
            yield
        except InputError as error:
            self.problems.append(f"{place}: {error}")

    def file(self, name: str) -> Path:
        return self.path.parent / name

    # --- the whole ---

    def scene(self, table: tables.SceneTable) -> Scene | None:
        for name, material in table.materials.items():
            self.materials |= self.material(material, name, f"materials.{name}")
        included: list[Scene] = []
        for i, entry in enumerate(table.include):
            included += self.included(entry, f"include[{i}]")
        included = self.overridden(included, table)
        known = {m.name: m for scene in included for m in scene.materials} | self.materials
        # A material that is itself wrong is known all the same: one mistake gives one line.
        self.problems += unknown_materials(table.model_dump(exclude_unset=True), {**known, **table.materials})
        self.materials = known

        objects: list[Object] = []
        spheres: list[Sphere] = []
        lights: list[Light] = []
        cameras: list[Camera] = []
        for i, sphere in enumerate(table.spheres):
            with self.at(f"spheres[{i}]"):
                spheres += [Sphere(**{**sphere.given(), "material": m}) for m in self.found(sphere.material)]
        for i, quad in enumerate(table.quads):
            with self.at(f"quads[{i}]"):
                mesh = shapes.quad(quad.corner, quad.edge_u, quad.edge_v)
                objects += [Object(mesh, (m,), name=quad.name or f"quads[{i}]") for m in self.found(quad.material)]
        for i, box in enumerate(table.boxes):
            with self.at(f"boxes[{i}]"):
                mesh, matrix = shapes.box(box.low, box.high), transform(box.transform)
                objects += [Object(mesh, (m,), matrix, name=box.name or f"boxes[{i}]")
                            for m in self.found(box.material)]
        for i, each in enumerate(table.meshes):
            with self.at(f"meshes[{i}]"):
                objects += self.mesh_object(each, f"meshes[{i}]")
        for i, light in enumerate(table.lights):
            with self.at(f"lights[{i}]"):
                made = make_light(light, f"lights[{i}]")
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
            settings=settings(table.settings, included),
            name=table.title or self.path.stem,
        )

    def found(self, name: str | None) -> list[Material]:
        """The material of that name, or nothing where it is not known (which is reported elsewhere)."""
        return [self.materials[name]] if name in self.materials else []

    # --- included files ---

    def included(self, entry: str | tables.IncludeTable, place: str) -> list[Scene]:
        from wrt.gltf import load_gltf

        name, to_world = (entry, None) if isinstance(entry, str) else (entry.file, entry.transform)
        with self.at(place):
            if not name.lower().endswith((".gltf", ".glb")):
                raise InputError(f"{name!r} is no .gltf or .glb file; a mesh file belongs into [[meshes]]")
            path = self.file(name)
            if path not in self._included:
                self._included[path] = load_gltf(path, staged=False)
            scene = self._included[path]
            self._included_objects += len(scene.objects)
            require_count(self._included_objects, "objects")
            return [moved(scene, transform(to_world))]
        return []

    def overridden(self, included: list[Scene], table: tables.SceneTable) -> list[Scene]:
        """The included scenes with the materials that the file replaces."""
        names = list(dict.fromkeys(m.name for scene in included for m in scene.materials))
        new: dict[str, Material] = {}
        for name, material in table.override.items():
            with self.at(f"override.{name}"):
                if name not in names and len(included) == len(table.include):
                    raise InputError(unknown(name, "included material", names))
            new |= self.material(material, name, f"override.{name}")
        return [replace(scene, objects=tuple(
            replace(thing, materials=tuple(new.get(m.name, m) for m in thing.materials)) for thing in scene.objects))
            for scene in included]

    # --- materials ---

    def material(self, table: MaterialTable, name: str, place: str) -> dict[str, Material]:
        """The material by its name, or nothing where it is wrong."""
        fields = table.given("metal", *_COLOR_SLOTS, *_DATA_SLOTS)
        if table.metal is not None:
            fields["eta"], fields["k"] = CONDUCTORS[table.metal]
        for slot in (*_COLOR_SLOTS, *_DATA_SLOTS):
            texture = getattr(table, slot)
            if texture is not None:
                with self.at(f"{place}.{slot}"):
                    fields[slot] = self.texture(texture, slot in _COLOR_SLOTS)
        with self.at(place):
            return {name: Material(name=name, **fields)}
        return {}

    def texture(self, table: Any, is_color: bool) -> Texture | Checkerboard:
        """table: ImageTable or ColorTextureTable."""
        key = (table.model_dump_json(), is_color)
        if key not in self._textures:
            if getattr(table, "checkerboard", None) is not None:
                self._textures[key] = Checkerboard(**table.checkerboard.given())
            else:
                cosine, sine = _turn(table.rotation)
                (u, v), (du, dv) = table.scale, table.offset
                self._textures[key] = Texture(
                    self.image(self.file(table.file)),
                    srgb=is_color if table.srgb is None else table.srgb,
                    wrap=tuple(table.wrap),
                    # As in KHR_texture_transform: scale, then turn (v points down), then move.
                    uv_transform=np.array([[cosine * u, sine * v, du], [-sine * u, cosine * v, dv]]),
                    name=table.file,
                )
        return self._textures[key]

    def image(self, path: Path) -> np.ndarray:
        from wrt.image_decode import decode_rgba8

        if path not in self._images:
            try:
                self._images[path] = decode_rgba8(read_file(path))
                self.meter.take(self._images[path].nbytes, "the images")
            except InputError as error:
                raise InputError(str(error), path) from None
        return self._images[path]

    def background(self, table: tables.SceneTable) -> Background:
        from wrt.image import read_image

        given = table.background
        if given is None:
            return ConstantBackground()
        if given.type == "environment":
            image = read_image(self.file(given.file))
            return EnvironmentBackground(image, given.scale, math.radians(given.rotation), name=given.file)
        return {"constant": ConstantBackground, "gradient": GradientBackground}[given.type](**given.given("type"))

    # --- meshes ---

    def mesh_object(self, table: tables.MeshTable, place: str) -> list[Object]:
        """The object, or nothing where one of its materials is not known (which is reported elsewhere)."""
        mesh = self.mesh(table)
        parts = table.parts or []
        by_group: Mapping[str, str] = table.materials or {str(i): part.material for i, part in enumerate(parts)}
        groups = set(mesh.groups)
        for group in by_group:
            if group not in groups:
                raise InputError(f"materials: {unknown(group, 'group of ' + mesh.name, mesh.groups)}")
        used = np.unique(mesh.face_group).tolist() if mesh.face_group is not None else []
        wanted = [by_group.get(mesh.groups[group], table.material) for group in used] if by_group else [table.material]
        for group, name in zip(used, wanted, strict=False):
            if name is None:
                raise InputError(f"the triangles of group {mesh.groups[group]!r} have no material; give `material` for "
                                 "the rest")
        names = list(dict.fromkeys(str(name) for name in wanted))
        materials = [material for name in names for material in self.found(name)]
        if len(materials) < len(names):
            return []
        face_material = None
        if by_group and mesh.face_group is not None:
            of_group = np.zeros(len(mesh.groups), dtype=np.int32)
            number = {name: i for i, name in enumerate(names)}
            of_group[used] = [number[str(name)] for name in wanted]
            face_material = of_group[mesh.face_group]
        whole, name = transform(table.transform), table.name or place
        each = [np.eye(4)] if table.instances is None else [self.placed(one, i) for i, one in enumerate(table.instances)]
        motion = self.motion(table)
        return [Object(mesh, tuple(materials), whole @ matrix, face_material, name, motion) for matrix in each]

    def motion(self, table: tables.MeshTable) -> Motion | None:
        if table.motion is None and table.morph is None:
            return None
        keys = None
        if table.motion is not None:
            keys = np.array([[key.translate, key.rotate, key.scale] for key in table.motion])
        target = None
        if table.morph is not None:
            from wrt import scene_schema

            given = {name: getattr(table.morph, name) for name in ("file", "shape")} | {"smooth": table.smooth}
            target = self.mesh(scene_schema.MeshTable.model_construct(**given))
        return Motion(keys, target)

    @staticmethod
    def placed(table: tables.TransformTable, index: int) -> np.ndarray:
        try:
            return transform(table)
        except InputError as error:
            raise InputError(f"instances[{index}]: {error}") from None

    def mesh(self, table: tables.MeshTable) -> Mesh:
        key: tuple[Any, ...]
        if table.shape is not None:
            shape, key = table.shape, (table.shape.model_dump_json(),)
            plain = self._once(key, lambda: shapes.SHAPES[shape.kind](**shape.given("kind")))
        else:
            parts = tuple((part.first, part.count) for part in table.parts or [])
            path = self.file(str(table.file))
            key = (path, parts)
            plain = self._once(key, lambda: load_mesh(path, parts))
        if table.smooth is None:
            return plain
        return self._once((*key, table.smooth), lambda: smooth(plain) if table.smooth else replace(plain, normals=None))

    def _once(self, key: tuple[Any, ...], make: Callable[[], Mesh]) -> Mesh:
        if key not in self._meshes:
            mesh = self._meshes[key] = make()
            self.meter.take(32.0 * len(mesh.vertices) + 12.0 * len(mesh.faces), "the meshes")
        return self._meshes[key]


def settings(table: tables.SettingsTable, included: Sequence[Scene]) -> Settings:
    """What the file says; where it does not say how glass casts shadows, the included files decide: tinted if one needs that."""
    tinted = any(scene.settings.glass_shadows == "tinted" for scene in included)
    needed = {"glass_shadows": "tinted"} if tinted else {}
    return Settings(**{**needed, **table.given(), "size": tuple(table.size)})


def moved(scene: Scene, matrix: np.ndarray) -> Scene:
    """The scene's shapes, lights and cameras under a further (4, 4) transform; intensities stay as they are, as in glTF."""
    if np.array_equal(matrix, np.eye(4)):
        return scene
    return replace(
        scene,
        objects=tuple(replace(thing, transform=matrix @ thing.transform) for thing in scene.objects),
        lights=tuple(_moved_light(light, matrix) for light in scene.lights),
        cameras=tuple(replace(camera, camera_to_world=matrix @ camera.camera_to_world) for camera in scene.cameras),
    )


def _moved_light(light: Light, matrix: np.ndarray) -> Light:
    changes: dict[str, Any] = {}
    if not isinstance(light, DirectionalLight):
        changes["position"] = matrix[:3, :3] @ light.position + matrix[:3, 3]
    if not isinstance(light, PointLight):
        changes["direction"] = matrix[:3, :3] @ light.direction
    return replace(light, **changes)


def make_light(table: tables.LightTable, name: str) -> Light | Object:
    """A light; a rectangle is an object that shines and reflects nothing."""
    fields = {**table.given("type"), "name": table.name or name}
    if table.type == "rectangle":
        material = Material(name=table.name or name, albedo=BLACK, emission=as_vector(table.radiance, "radiance"),
                            two_sided=table.two_sided)
        return Object(shapes.quad(table.corner, table.edge_u, table.edge_v), (material,), name=table.name or name)
    if table.type == "spot":
        fields |= {"inner": math.radians(table.inner), "outer": math.radians(table.outer)}
        return SpotLight(**fields)
    return PointLight(**fields) if table.type == "point" else DirectionalLight(**fields)


def make_camera(table: tables.CameraTable, name: str) -> Camera:
    """A camera from where it stands and looks, or from its matrix; from its angle of view, or from a real lens."""
    focus = table.focus_distance
    if focus is None and table.position is not None and table.target is not None:
        focus = max(math.dist(table.position, table.target), SMALLEST)
    fields: dict[str, Any] = {"blades": table.blades, "blade_rotation": math.radians(table.blade_rotation), "name": name}
    if table.focal_length is not None and table.sensor_height is not None:
        fields |= Camera.lens(table.focal_length, focus or 1.0, table.sensor_height, f_number=table.f_number,
                              aperture_radius=table.aperture_radius)
    else:
        fields |= {"fov_y": math.radians(45.0 if table.fov_y is None else table.fov_y), "focus_distance": focus or 1.0,
                   "aperture_radius": table.aperture_radius or 0.0}
    if table.matrix is not None:
        return Camera(np.array(table.matrix).reshape(4, 4), **fields)
    return Camera.look_at(table.position, table.target, table.up, **fields)


def transform(table: tables.TransformTable | None) -> np.ndarray:
    """(4, 4) float64: scale, then rotate, then translate; the identity for None.

    Raises InputError where the matrix is singular.
    """
    matrix = np.eye(4)
    if table is None:
        return matrix
    if table.matrix is not None:
        matrix = np.array(table.matrix).reshape(4, 4)
        if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            raise InputError("the transform's matrix is singular")
        return matrix
    if table.axis is not None and table.angle is not None:
        rotation = _about(np.array(table.axis), table.angle)
    else:
        x, y, z = (_about(axis, angle) for axis, angle in zip(np.eye(3), table.rotate, strict=True))
        rotation = z @ y @ x
    matrix[:3, :3] = rotation * table.scale
    matrix[:3, 3] = table.translate
    return matrix


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    """(3, 3) rotation about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cosine, sine = _turn(degrees)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def _turn(degrees: float) -> tuple[float, float]:
    """Cosine and sine, exact for whole quarter turns, so that axis-parallel things stay axis-parallel."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
