"""Scenes, objects and spheres: frozen NumPy data, validated on construction.

Nothing here knows Warp, files or acceleration structures. World space is right-handed; lengths are in the scene's own unit; colours are
linear Rec. 709, (3,) floats; angles are radians. A camera looks along its -z axis with +y up, as in glTF.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any, Self, Unpack

import numpy as np

from wrt.core.checks import as_array, as_one, as_path, as_tuple, at_thing, shown, unknown
from wrt.core.errors import InputError, wrong
from wrt.core.registry import Registry
from wrt.core.types import PathLike
from wrt.scene.backgrounds import BACKGROUNDS, Background, ConstantBackground
from wrt.scene.cameras import CameraKind
from wrt.scene.lights import LIGHTS, Light
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.motion import Motion
from wrt.scene.settings import DEPTH, GLASS_DEPTH, SETTINGS, SettingChanges, Settings
from wrt.scene.values import (
    BLACK,
    MAX_REACH,
    SMALLEST,
    Color,
    as_number,
    as_transform,
    as_vector,
    far_origin,
    require_count,
    shift,
    warn_if_alone,
)

GREY = Material()
MANY_VERTICES = 1 << 26  # of all objects together; with more, `outlines` replaces repeated meshes by their boxes


@dataclass(frozen=True, eq=False)
class Object:
    """A mesh placed in the world.

    Parameters
    ----------
    mesh, materials
        The geometry, which objects can share; one or more materials, by default a grey one.
    transform
        (4, 4), object to world, acting on column vectors. If it mirrors, the outside of the mesh stays outside.
    face_material
        (F,) index into `materials` for each face. None: all faces have the first material.
    motion
        Movement in `wrt animate`; a single picture ignores it.

    Raises
    ------
    InputError
        If a field has the wrong type, shape or range, or if a world coordinate exceeds 1e18.
    """

    mesh: Mesh
    materials: tuple[Material, ...] = (GREY,)
    transform: np.ndarray = field(default_factory=lambda: np.eye(4), repr=False)
    face_material: np.ndarray | None = field(default=None, repr=False)
    name: str = ""
    motion: Motion | None = None

    def __post_init__(self) -> None:
        at = at_thing("object", self.name)
        as_one(self.mesh, Mesh, at + "mesh", hint="wrt.Mesh.from_trimesh converts a mesh of trimesh")
        object.__setattr__(self, "materials", as_tuple(self.materials, Material, at + "materials"))
        if not self.materials:
            raise wrong(at + "materials", "must hold at least one material")
        object.__setattr__(self, "transform", as_transform(self.transform, at + "transform"))
        with np.errstate(over="ignore"):
            place = self.placement
            reach = (np.abs(place[:3, :3]).sum(axis=1) * self.mesh.reach + np.abs(place[:3, 3])).max()
        if not reach <= MAX_REACH:
            raise InputError(f"reaches {reach:.3g} units from the origin; at most {MAX_REACH:g} are possible", place=at[:-2])
        if self.face_material is not None:
            index = as_array(self.face_material, np.int32, at + "face_material")
            if index.shape != (len(self.mesh.faces),):
                raise wrong(at + "face_material", f"must be ({len(self.mesh.faces)},), got {index.shape}")
            if index.size and (index.min() < 0 or index.max() >= len(self.materials)):
                raise wrong(at + "face_material", f"must be 0 to {len(self.materials) - 1}, got {index.min()} to {index.max()}")
            known = vars(self.mesh).get("_face_material")  # the objects of a mesh share a copy
            index = vars(self.mesh)["_face_material"] = known if known is not None and np.array_equal(known, index) else index
            object.__setattr__(self, "face_material", index)
        if self.motion is not None:
            as_one(self.motion, Motion, at + "motion").check(self.mesh)

    @property
    def placement(self) -> np.ndarray:
        """Matrix from `mesh.vertices` to the world: the transform after the mesh's origin is added. (4, 4) float64."""
        return self.transform if self.mesh.origin is None else self.transform @ shift(self.mesh.origin)


@dataclass(frozen=True, eq=False)
class Sphere:
    """An exact sphere in world space. u runs around +y from -x (0 to 1), v from the top (0) to the bottom (1)."""

    center: Color
    radius: float
    material: Material = GREY
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("sphere", self.name)
        as_one(self.material, Material, at + "material")
        object.__setattr__(self, "center", as_vector(self.center, at + "center", low=-MAX_REACH, high=MAX_REACH))
        object.__setattr__(self, "radius", as_number(self.radius, at + "radius", low=SMALLEST, high=MAX_REACH))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a render needs. A frozen dataclass: `dataclasses.replace` makes changed copies.

    Parameters
    ----------
    objects, spheres, lights
        Placed meshes; exact spheres; lights without a surface.
    cameras
        Cameras; `render` uses the first by default.
    background
        Radiance of rays that hit nothing; black by default.
    ambient
        Radiance that every diffuse surface receives from all directions, unshadowed (Whitted's ambient term).
    ambient_occlusion
        Radius in scene units. A shadow ray of this length, in a random direction, then decides whether a surface receives `ambient`, so
        that corners are darker. 0: the ambient term is unshadowed.
    settings
        Size, samples and other defaults of `render`. Its keywords override the settings.

    Raises
    ------
    InputError
        If a field has the wrong type.

    Examples
    --------
    >>> floor = wrt.Object(wrt.Mesh(vertices, faces), (wrt.Material(albedo=(0.7, 0.3, 0.2)),))
    >>> scene = wrt.Scene(objects=(floor,), lights=(wrt.PointLight((0, 3, 0), (20, 20, 20)),))
    """

    objects: tuple[Object, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    lights: tuple[Light, ...] = ()
    cameras: tuple[CameraKind, ...] = ()
    background: Background = field(default_factory=ConstantBackground)
    ambient: Color = BLACK
    ambient_occlusion: float = 0.0
    settings: Settings = field(default_factory=Settings)
    name: str = ""

    def __post_init__(self) -> None:
        kinds: dict[str, Any] = {"objects": Object, "spheres": Sphere, "cameras": CameraKind, "lights": tuple(LIGHTS.values())}
        for name, kind in kinds.items():
            hint = "wrt.Scene.of makes a scene of meshes" if name == "objects" else None
            object.__setattr__(self, name, as_tuple(getattr(self, name), kind, name, hint))
        for name in ("objects", "spheres", "lights"):
            require_count(len(getattr(self, name)), name)
        as_one(self.background, tuple(BACKGROUNDS.values()), "background")
        as_one(self.settings, Settings, "settings")
        if self.settings.max_depth is None:
            depth = GLASS_DEPTH if any(material.is_clear for material in self.materials) else DEPTH
            object.__setattr__(self, "settings", replace(self.settings, max_depth=depth))
        object.__setattr__(self, "ambient", as_vector(self.ambient, "ambient", low=0.0))
        object.__setattr__(self, "ambient_occlusion", as_number(self.ambient_occlusion, "ambient_occlusion", low=0.0, high=MAX_REACH))

    @classmethod
    def of(cls, meshes: Iterable[object], **fields: Any) -> Self:
        """Make one scene of several meshes.

        Parameters
        ----------
        meshes
            Meshes, objects and spheres; a mesh becomes an object at its place, in a grey material. Also trimesh meshes and pairs
            (vertices, faces).
        **fields
            Further fields of the scene, such as `lights`.

        Raises
        ------
        InputError
            If an entry is none of these.

        Examples
        --------
        >>> accel = wrt.build(wrt.Scene.of([floor, robot]))    # wrt.build([floor, robot]): two worlds, of one mesh each
        """
        things: list[Any] = []
        for i, thing in enumerate(meshes if isinstance(meshes, Iterable) and not isinstance(meshes, Mesh) else [meshes]):
            at = f"meshes[{i}]"
            if isinstance(thing, tuple) and len(thing) == 2:
                thing = Mesh(*thing)
            elif type(thing).__module__.split(".")[0] == "trimesh":
                thing = Mesh.from_trimesh(thing)  # type: ignore[arg-type]
            if isinstance(thing, str | os.PathLike):
                raise InputError(f"must be a mesh, got {shown(thing)}", argument=at, hint="wrt.load_mesh reads a file")
            things.append(Object(thing, name=thing.name) if isinstance(thing, Mesh) else as_one(thing, (Object, Sphere), at))
        spheres = tuple(thing for thing in things if isinstance(thing, Sphere))
        return cls(tuple(thing for thing in things if isinstance(thing, Object)), spheres, **fields)

    def save(self, path: PathLike) -> None:
        """Write a TOML scene file, from which `wrt.load_scene` makes a scene that renders to the same bits.

        Meshes (.npz), textures (.png) and images (.exr) become files in a folder beside it, "room_files" for "room.toml". Names that are
        empty or occur twice change, and materials that no face has are left out.

        Parameters
        ----------
        path : str or path
            A .toml file in a folder that exists.

        Raises
        ------
        InputError
            For another suffix, if a file cannot be written, and for what scene files do not hold: singular transforms, meshes without
            triangles, classes that are not registered, fields without a description (`wrt.scene.kinds.given`).
        """
        path = as_path(path, "path")
        if path.suffix.lower() not in WRITERS:
            raise InputError(f"a scene is written as {' or '.join(WRITERS)}, not as {path.suffix or 'a file without suffix'}", path=path)
        WRITERS[path.suffix.lower()](self, path)

    def __repr__(self) -> str:
        counts = {"triangle": sum(len(thing.mesh.faces) for thing in self.objects), "object": len(self.objects),
                  "sphere": len(self.spheres), "material": len(self.materials), "light": len(self.lights),
                  "camera": len(self.cameras)}
        parts = [f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items() if count]
        with contextlib.suppress(InputError):  # without shapes there are no bounds
            low, high = ("({})".format(", ".join(f"{value:.4g}" for value in corner)) for corner in self.bounds())
            parts.append(f"from {low} to {high}")
        return f"Scene({', '.join([repr(self.name)] * bool(self.name) + parts)})"

    @property
    def materials(self) -> tuple[Material, ...]:
        """Materials in use, each once, in the order of first use. A film's "material_id" is an index into this tuple."""
        used: dict[int, Material] = {}
        for thing in self.objects:
            for material in thing.materials:
                used.setdefault(id(material), material)
        for sphere in self.spheres:
            used.setdefault(id(sphere.material), sphere.material)
        return tuple(used.values())

    def camera(self, name: str | int | None = None) -> CameraKind:
        """Return the camera of a name or index, or the first camera for None. Raises InputError if there is no such camera."""
        if not self.cameras:
            raise InputError("the scene has no camera", hint="give one: camera=wrt.Camera.look_at((0, 1, 5), (0, 0, 0))")
        if name is None:
            return self.cameras[0]
        named = {str(i): camera for i, camera in enumerate(self.cameras)} | {each.name: each for each in reversed(self.cameras)}
        if str(name) in named:
            return named[str(name)]
        known = ", ".join(f"{camera.name!r} (index {i})" for i, camera in enumerate(self.cameras))
        raise InputError(f"the scene has no camera {name!r}", argument="camera", hint=f"its cameras are {known}")

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest corner, (3,) float64 each, of the box around all shapes in world space.

        The box may be too large if the objects have more than 2^26 vertices together. Raises InputError if the scene has no shapes."""
        corners: list[np.ndarray] = []
        for points, transform in self.outlines():
            points = points @ transform[:3, :3].T + transform[:3, 3]
            corners += [points.min(axis=0), points.max(axis=0)]
        for sphere in self.spheres:
            center = np.array(sphere.center)
            corners += [center - sphere.radius, center + sphere.radius]
        if not corners:
            raise InputError("the scene has no shapes")
        return np.min(corners, axis=0), np.max(corners, axis=0)

    def outlines(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield (points, transform) of each object with faces. The points, (N, 3) float64, are in object space; their hull holds the mesh.

        The points are the vertices; with more than MANY_VERTICES vertices in all, the corners of a shared mesh's box."""
        shown = [thing for thing in self.objects if len(thing.mesh.faces)]
        times = Counter(id(thing.mesh) for thing in shown)
        many = sum(len(thing.mesh.vertices) for thing in shown) > MANY_VERTICES
        boxes: dict[int, np.ndarray] = {}
        for thing in shown:
            vertices, key = thing.mesh.vertices, id(thing.mesh)
            if many and times[key] > 1:
                if key not in boxes:
                    boxes[key] = np.array(list(product(*zip(vertices.min(axis=0), vertices.max(axis=0), strict=True))), np.float64)
                yield boxes[key], thing.placement
            else:
                yield vertices.astype(np.float64), thing.placement

    def with_settings(self, **changes: Unpack[SettingChanges]) -> Scene:
        """Return a copy of the scene with changed settings. A setting of None keeps the scene's value; an exposure ends
        auto_exposure; a size that is one number is a width, and the aspect ratio stays. Raises InputError for an unknown setting."""
        for name in changes:
            if name not in SETTINGS:
                raise unknown(name, "setting", SETTINGS, argument=name)
        changed: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
        if isinstance(changed.get("size"), int):
            width, height = self.settings.size
            changed["size"] = (changed["size"], max(1, round(changed["size"] * height / width)))
        if "exposure" in changed:
            changed.setdefault("auto_exposure", False)
        return replace(self, settings=replace(self.settings, **changed))


WRITERS: Registry[Callable[[Scene, Path], None]] = Registry("scene format", {".toml": "wrt.io.toml.write:write_toml"})


def moves(scene: Scene) -> bool:
    return any(thing.motion is not None for thing in scene.objects)


def scene_at(scene: Scene, time: float) -> Scene:
    """Return the scene at `time` in [0, 1] of its period: its objects are moved, and have no motion themselves."""
    return replace(scene, objects=tuple(
        replace(thing, mesh=thing.motion.mesh(thing.mesh, time), transform=thing.transform @ thing.motion.transform(time),
                motion=None) if thing.motion else thing for thing in scene.objects))


# --- scenes far from 0 are moved near it in float64, before anything is rounded to float32 ----------------------------

NEAR = 4.0  # an object is near 0 if it is moved by at most this multiple of its own size


def scene_origin(scene: Scene) -> np.ndarray | None:
    """Return a point, (3,) float64, near the middle of the shapes of a scene that is far from 0; None for other scenes."""
    shown = [thing for thing in scene.objects if len(thing.mesh.faces)]
    origin = far_origin(*scene.bounds()) if (shown or scene.spheres) and all(map(_is_far, shown)) else None
    for thing in shown if origin is None else ():
        if thing.mesh.origin is not None:
            place, size = thing.placement[:3, 3], _reach(thing)
            warn_if_alone(place - size, place + size, thing.name or thing.mesh.name or "a mesh")
    return origin


def moved_by(scene: Scene, origin: np.ndarray | None) -> Scene:
    """Return the scene with `origin` subtracted from all places in float64; None: the scene itself."""
    if origin is None:
        return scene
    return replace(scene, objects=tuple(replace(thing, transform=shift(origin, -1.0) @ thing.transform) for thing in scene.objects),
                   spheres=tuple(replace(each, center=tuple(each.center - origin)) for each in scene.spheres),
                   lights=tuple(light.moved(shift(origin, -1.0)) if light.places() else light for light in scene.lights),
                   cameras=tuple(moved_camera(camera, origin) for camera in scene.cameras))


def moved_camera(camera: CameraKind, origin: np.ndarray | None) -> CameraKind:
    """Return the camera with `origin` subtracted from its place; None: the camera itself."""
    return camera if origin is None else replace(camera, camera_to_world=shift(origin, -1.0) @ camera.camera_to_world)


def _is_far(thing: Object) -> bool:
    return bool(np.abs(thing.placement[:3, 3]).max() > NEAR * _reach(thing))


def _reach(thing: Object) -> float:
    return float(np.abs(thing.transform[:3, :3]).sum(axis=1).max() * thing.mesh.reach)


# Fields that do not enter the digest: they change no pixel, or are a scene's cameras and settings. object: fields of every class.
LEFT_OUT: dict[type, tuple[str, ...]] = {
    object: ("name",), Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def digest(thing: Scene | CameraKind) -> str:
    """Return the SHA-256, in hexadecimal, of all fields of a scene or a camera except those in LEFT_OUT. Equal ones: equal pictures."""
    out = sha256()
    known: dict[int, int] = {}  # what several things share enters once, by its id

    def add(value: Any) -> None:
        if isinstance(value, tuple):
            out.update(f"({len(value)} ".encode())
            for each in value:
                add(each)
        elif not (is_dataclass(value) or isinstance(value, np.ndarray)):
            out.update(f"{value.item() if isinstance(value, np.generic) else value!r} ".encode())
        elif id(value) in known:
            out.update(f"{known[id(value)]} ".encode())
        else:
            known[id(value)] = len(known)
            if isinstance(value, np.ndarray):
                out.update(f"{value.shape}{value.dtype.str}".encode() + np.ascontiguousarray(value).tobytes())
            else:
                out.update(type(value).__name__.encode())
                for each in fields(value):
                    if each.name not in (*LEFT_OUT[object], *LEFT_OUT.get(type(value), ())):
                        add(getattr(value, each.name))

    add(thing)
    return out.hexdigest()
