"""Schema of TOML scene files: editors read it, `wrt.io.toml.report` checks files by it, and docs/scene_format.md is made from it.

It is a JSON Schema, draft 2020-12; numbers may have a `unit`. The keys of cameras, lights, backgrounds, materials and settings are the
described fields of their classes (wrt.scene.kinds). Angles are in degrees in files and in radians in wrt/scene/; lengths have the
scene's own unit; colours are linear Rec. 709. A single number in place of a colour is a grey.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields
from functools import cache
from inspect import Parameter, signature
from typing import Any

from wrt.core.types import JsonObject
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS, Camera, CameraKind
from wrt.scene.kinds import Kind, forms
from wrt.scene.lights import LIGHTS
from wrt.scene.materials import CONDUCTORS, MATERIALS, WRAPS, Checkerboard, Material
from wrt.scene.settings import Settings
from wrt.scene.shapes import SHAPES
from wrt.scene.values import MAX_REACH, SMALLEST, Limits

Schema = dict[str, Any]
BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}


class Table(dict[str, Any]):
    """Schema of a table. one_of: groups of keys; a table has exactly one key of each group. apart: keys that exclude other keys.
    needs: keys that require other keys."""

    def __init__(self, about: str, /, *one_of: tuple[str, ...], apart: Mapping[str, Iterable[str]] | None = None,
                 needs: Mapping[str, list[str]] | None = None, **keys: Schema) -> None:
        needed = [name for name, value in keys.items() if value.get("needed")]
        properties = {name: {key: each for key, each in value.items() if key != "needed"} for name, value in keys.items()}
        super().__init__(type="object", description=about, properties=properties, required=needed, additionalProperties=False,
                         **({"dependentRequired": needs} if needs else {}))
        self.one_of, self.apart = one_of, {**(apart or {})}

    def mistakes(self, table: JsonObject) -> str:
        """Return what is wrong with the keys of a table together; "" if nothing is."""
        wrong = [f"give exactly one of {', '.join(names)}" for names in self.one_of if sum(name in table for name in names) != 1]
        wrong += [f"{name} takes no {', '.join(beside)} beside it" for name, others in self.apart.items()
                  if name in table and (beside := [other for other in others if other in table])]
        wrong += [f"{name} needs {', '.join(missing)}" for name, others in self.get("dependentRequired", {}).items()
                  if name in table and (missing := [other for other in others if other not in table])]
        return "; ".join(wrong)


# --- types of values --------------------------------------------------------------------------------------------------

NUMBER, WHOLE, TEXT, FLAG = ({"type": each} for each in ("number", "integer", "string", "boolean"))

def numbers(count: int, item: Schema | None = None, **more: Any) -> Schema:
    return {"type": "array", "items": item or NUMBER, "minItems": count, "maxItems": count, **more}


def one_or(count: int, item: Schema) -> Schema:
    """Return the schema of `count` items, or of one that stands for all."""
    return {"anyOf": [item, numbers(count, item)]}


def many(item: Schema, least: int = 0) -> Schema:
    return {"type": "array", "items": item} | ({"minItems": least} if least else {})


def by_name(item: Schema) -> Schema:
    return {"type": "object", "additionalProperties": item}


def among(choices: Iterable[str]) -> Schema:
    return {"type": "string", "enum": list(choices)}


def only(choice: str) -> Schema:
    return {"type": "string", "const": choice, "needed": True}


def ref(name: str) -> Schema:
    return {"$ref": f"#/$defs/{name}"}


def one_of(key: str, tables: Mapping[str, str]) -> Schema:
    """Return the schema of one of several tables, which a key tells apart. tables: names of the tables, by the values of the key."""
    places = {value: ref(name)["$ref"] for value, name in tables.items()}
    return {"oneOf": [{"$ref": place} for place in places.values()], "discriminator": {"propertyName": key, "mapping": places}}


def key(value: Schema, about: str, default: object = None) -> Schema:
    """Return the schema of a key that may be absent. default: what its absence means, None if `about` says that."""
    return value | {"description": about} | ({} if default is None else {"default": default})


def needed(value: Schema, about: str) -> Schema:
    """Return the schema of a key that a table must have."""
    return value | {"description": about, "needed": True}


ANGLE, LENGTH = NUMBER | {"unit": "degrees"}, NUMBER | {"exclusiveMinimum": 0.0, "unit": "length"}
VECTOR, POINT, ANGLES, MATRIX = numbers(3), numbers(3, unit="length"), numbers(3, unit="degrees"), numbers(16)
RADIANCE = one_or(3, NUMBER | {"minimum": 0.0}) | {"unit": "radiance"}
SEGMENTS = WHOLE | {"minimum": 3, "maximum": 4096}
NAME, MATERIAL = key(TEXT, "name in messages", ""), needed(TEXT, "name of a material")
MESH_FILE = key(TEXT, "mesh file, relative to the scene file")
IMAGE_FILE = TEXT, "image file (8 bits a channel are kept), relative to the scene file"
TRANSFORM = key(ref("TransformTable"), "object to world")
SHAPE = key(one_of("kind", {kind: f"{kind.capitalize()}Shape" for kind in SHAPES}), "shape, in place of a file")


def bounds(limits: Limits) -> Schema:
    found = {BOUNDS[name]: limit for name, limit in limits.items() if name in BOUNDS}
    return {"exclusiveMinimum": 0.0} if found.get("minimum") == SMALLEST else found


# For each form of a field (wrt.scene.values.FORMS), a function from the field's limits to its schema.
FORMS: dict[str, Callable[[Limits], Schema]] = {
    "point": lambda limits: POINT,
    "direction": lambda limits: VECTOR,
    "color": lambda limits: one_or(3, NUMBER | {"minimum": 0.0} | bounds(limits)),
    "number": lambda limits: NUMBER | bounds(limits),
    "angle": lambda limits: ANGLE | bounds(limits),
    "whole": lambda limits: WHOLE | bounds(limits),
    "flag": lambda limits: FLAG,
    "choice": lambda limits: among(limits["among"]),
    "size": lambda limits: numbers(2, WHOLE | {"minimum": 1, "maximum": 32768}),
    "image": lambda limits: TEXT,
    "texture": lambda limits: ref("ColorTextureTable" if Checkerboard in limits["among"] else "ImageTable"),
}


def described(kind: type) -> dict[str, Schema]:
    """Return the keys of a class's table: its described fields, with angles in degrees and the key "file" for an image."""
    keys = {}
    for name, each in forms(kind).items():
        form, about, unit, limits = (each.metadata[part] for part in ("form", "about", "unit", "limits"))
        default = math.degrees(each.default) if form == "angle" and each.default is not MISSING else each.default
        default = list(default) if isinstance(default, tuple) else default
        value = FORMS[form](limits) | ({"unit": unit} if unit else {})
        keys["file" if form == "image" else name] = needed(value, about) if default is MISSING else key(value, about, default)
    return keys


def summary(thing: object) -> str:
    """Return the first paragraph of a docstring."""
    return (getattr(thing, "__doc__", None) or "").split("\n\n")[0]


# --- tables -----------------------------------------------------------------------------------------------------------

PLACED = {
    "translate": key(POINT, "translation, applied last", [0.0, 0.0, 0.0]),
    "rotate": key(ANGLES, "rotation about x, then y, then z", [0.0, 0.0, 0.0]),
    "scale": key(one_or(3, NUMBER), "scale, applied first; one number, or one for each axis", [1.0, 1.0, 1.0]),
}
PLACED_IMAGE = {
    "srgb": key(FLAG, "RGB is sRGB-encoded (default: true for albedo and emission, else false)"),
    "wrap": key(one_or(2, among(WRAPS)), "lookup outside the image, in u and in v (one for both)", ["repeat", "repeat"]),
    "scale": key(one_or(2, NUMBER), "repetitions in one unit of u and of v", [1.0, 1.0]),
    "offset": key(numbers(2), "added to u and v", [0.0, 0.0]),
    "rotation": key(ANGLE, "rotation of the image about uv (0, 0), clockwise", 0.0),
    "matrix": key(numbers(6), "two rows of three: (u, v, 1) to the image's (u, v), in place of scale, offset and rotation"),
}
MATRIX_ALONE = {"matrix": ("scale", "offset", "rotation")}
POSE = {
    "position": key(POINT, "position of the camera"),
    "target": key(POINT, "point in the middle of the picture"),
    "up": key(VECTOR, "direction that points up in the picture", [0.0, 1.0, 0.0]),
    "matrix": key(MATRIX, "camera to world; the camera looks along -z, +y is up"),
}
LENS = {
    "focal_length": key(LENGTH, "focal length of a real lens, in place of fov_y"),
    "sensor_height": key(LENGTH, "height of the sensor behind a real lens"),
    "f_number": key(NUMBER | {"exclusiveMinimum": 0.0}, "f-number of a real lens: the aperture's radius is focal_length / (2 f_number)"),
}
# The type and the description of each parameter of SHAPES.
SHAPE_KEYS: dict[str, dict[str, tuple[Schema, str]]] = {
    "icosphere": {"subdivisions": (WHOLE | {"minimum": 0, "maximum": 9}, "number of times that each triangle is split into four"),
                  "radius": (LENGTH, "radius of the sphere")},
    "torus": {"radius": (LENGTH, "distance from the axis to the middle of the tube"), "tube_radius": (LENGTH, "radius of the tube"),
              "segments": (SEGMENTS, "segments around the axis"), "tube_segments": (SEGMENTS, "segments around the tube")},
    "lathe": {"profile": (many(numbers(2, unit="length"), 2), "points (radius, height), bottom up; a repeated point makes a sharp edge"),
              "segments": (SEGMENTS, "segments around the axis")},
    "prism": {"sides": (SEGMENTS, "sides of the polygon"), "radius": (LENGTH, "radius of the circle through the polygon's corners"),
              "length": (LENGTH, "length along z")},
    "tube": {"points": (many(POINT, 2), "points of the line in the middle of the tube"),
             "radius": ({"anyOf": [LENGTH, many(LENGTH)]}, "one radius, or one for each point"),
             "segments": (SEGMENTS, "segments around the tube")},
    "teapot": {"segments": (SEGMENTS, "segments around the axis")},
}
TABLES: dict[str, Table] = {
    "SettingsTable": Table("Defaults of a render; the command line overrides them.", **described(Settings)),
    "TransformTable": Table(
        "A scale, then a rotation, then a translation; or a matrix.",
        apart={"matrix": ("translate", "rotate", "axis", "angle", "scale"), "axis": ("rotate",)},
        needs={"axis": ["angle"], "angle": ["axis"]},
        translate=PLACED["translate"], rotate=PLACED["rotate"],
        axis=key(VECTOR, "axis of a rotation, in place of rotate"),
        angle=key(ANGLE, "rotation about axis, counter-clockwise if the axis points to the viewer"),
        scale=PLACED["scale"],
        matrix=key(MATRIX, "object to world, in place of all other keys")),
    "IncludeTable": Table(
        "A glTF file, placed as a whole.",
        file=needed(TEXT, "glTF file, relative to the scene file"),
        transform=key(ref("TransformTable"), "file to world, for shapes, cameras and lights; intensities stay the same")),
    "SphereTable": Table(
        "An exact sphere.", center=needed(POINT, "centre of the sphere"), radius=needed(LENGTH, "radius of the sphere"),
        material=MATERIAL, name=NAME),
    "QuadTable": Table(
        "A parallelogram; its front is towards cross(edge_u, edge_v), uvs run from 0 to 1.",
        corner=needed(POINT, "lower left corner, seen from the front"), edge_u=needed(POINT, "edge from the corner to the right"),
        edge_v=needed(POINT, "edge from the corner up"), material=MATERIAL, name=NAME),
    "BoxTable": Table(
        "A closed box along the axes, before its transform.",
        low=needed(POINT, "lowest corner"), high=needed(POINT, "highest corner"), material=MATERIAL, transform=TRANSFORM, name=NAME),
    "PartTable": Table(
        "A range of a mesh file's triangles, in the order of the file.",
        first=needed(WHOLE | {"minimum": 0}, "index of the first triangle, from 0"),
        count=needed(WHOLE | {"minimum": 0}, "number of triangles"), material=MATERIAL),
    "MorphTable": Table(
        "A mesh with the same faces as the mesh to be moved. In an animation, the vertices move to the vertices of this mesh and back.",
        ("file", "shape"), file=MESH_FILE, shape=SHAPE),
    "KeyTable": Table(
        "A placement at one time of an animation: a scale, then a rotation, then a translation. All three are interpolated linearly.",
        **PLACED | {"rotate": PLACED["rotate"] | {"description": "rotation about x, then y, then z; not limited to 360"}}),
    "MeshTable": Table(
        "A mesh from a file or made by a formula.", ("file", "shape"), apart={"materials": ("parts",)}, file=MESH_FILE, shape=SHAPE,
        material=key(TEXT, "name of a material; with materials or parts, for all other triangles"),
        materials=key(by_name(TEXT), "material of each group of the file (OBJ: usemtl, else g, else o; STL: solid)"),
        parts=key(many(ref("PartTable")), "materials by ranges of triangles; later ranges override earlier ones"),
        smooth=key(FLAG, "true: compute missing vertex normals; false: flat (default: as in the file, by its normals or smoothing groups)"),
        transform=TRANSFORM,
        instances=key(many(ref("TransformTable"), 1),
                      "transforms, each of one copy of the mesh, applied before `transform`; the mesh is stored once"),
        motion=key(many(ref("KeyTable"), 2),
                   "for `wrt animate`: placements evenly spread over the period, applied before instances and transform"),
        morph=key(ref("MorphTable"), "for `wrt animate`: mesh to which the vertices move, and back"), name=NAME),
    "RectangleLightTable": Table(
        "A parallelogram that emits light; its front is towards cross(edge_u, edge_v).", type=only("rectangle"),
        corner=needed(POINT, "one corner"), edge_u=needed(POINT, "edge from the corner"),
        edge_v=needed(POINT, "other edge from the corner"),
        radiance=needed(RADIANCE, "emitted radiance, the same in all directions"),
        two_sided=key(FLAG, "both sides emit", False), name=NAME),
    "CheckerboardTable": Table("Squares of two alternating colours.", **described(Checkerboard)),
    "ImageTable": Table("An image file; (u, v) = (0, 0) is its top left.", apart=MATRIX_ALONE, **PLACED_IMAGE, file=needed(*IMAGE_FILE)),
    "ColorTextureTable": Table(
        "An image file, or a checkerboard.", ("file", "checkerboard"), apart=MATRIX_ALONE | {"checkerboard": (*PLACED_IMAGE,)},
        **PLACED_IMAGE, file=key(*IMAGE_FILE),
        checkerboard=key(ref("CheckerboardTable"), "checkerboard, in place of an image file")),
}


def shape_table(kind: str) -> Table:
    """Return the table of a shape, with the defaults of its function."""
    parameters = signature(SHAPES[kind]).parameters
    keys = {name: needed(*row) if parameters[name].default is Parameter.empty else key(*row, parameters[name].default)
            for name, row in SHAPE_KEYS[kind].items()}
    about = summary(SHAPES[kind]).removeprefix("Return a ")
    return Table(about[:1].upper() + about[1:], kind=only(kind), **keys)


def camera_table(kind: type[CameraKind]) -> Table:
    """Return the table of a kind of camera: its pose, for a perspective camera a real lens, and the parameters of its class."""
    lens = issubclass(kind, Camera)
    about = "Give position and target, or matrix." + " Give fov_y, or focal_length." * lens
    name = {"type": "string", "const": kind.kind, "default": kind.kind} if kind is Camera else only(kind.kind)
    apart = {"matrix": ("position",)} | ({"focal_length": ("fov_y",), "f_number": ("aperture_radius",)} if lens else {})
    needs = {"position": ["target"], "target": ["position"]} | (
        {"focal_length": ["sensor_height"], "sensor_height": ["focal_length"], "f_number": ["focal_length"]} if lens else {})
    return Table(f"{summary(kind)} {about}", ("target", "matrix"), apart=apart, needs=needs, type=name, **POSE, **(LENS if lens else {}),
                 **described(kind))


def kind_table(kind: type[Kind]) -> Table:
    """Return the table of a kind of light or background."""
    keys = described(kind)
    if "file" not in keys and has_name(kind):
        keys["name"] = NAME
    return Table(summary(kind), type=only(kind.kind), **keys)


def has_name(kind: type[Kind]) -> bool:
    return "name" in (each.name for each in fields(kind))  # type: ignore[arg-type]


def material_table(kinds: tuple[str, ...]) -> Table:
    about = "; ".join(f"{name}: {MATERIALS[name].about}" for name in kinds)
    return Table("A surface's reflection, transmission and emission.", apart={"metal": ("eta", "k")},
                 kind=key(among(kinds), about, "diffuse"),
                 metal=key(among(CONDUCTORS), "a metal's eta and k (conductor)"), **described(Material))


def scene_schema() -> Table:
    """Return the schema of scene files, with all registered kinds of cameras, lights, backgrounds and materials."""
    return _schema(tuple(CAMERAS.values()), tuple(LIGHTS.values()), tuple(BACKGROUNDS.values()), tuple(MATERIALS))


@cache
def _schema(cameras: tuple[type[CameraKind], ...], lights: tuple[type[Kind], ...], backgrounds: tuple[type[Kind], ...],
            materials: tuple[str, ...]) -> Table:

    def named(kinds: tuple[type[Kind], ...], what: str) -> dict[type[Kind], str]:
        return {each: "".join(part.capitalize() for part in each.kind.split("_")) + f"{what}Table" for each in kinds}

    camera_names = {each: f"{each.__name__}Table" for each in cameras}
    light_names, background_names = named(lights, "Light"), named(backgrounds, "")
    tables = TABLES | {f"{kind.capitalize()}Shape": shape_table(kind) for kind in SHAPE_KEYS}
    tables |= {name: camera_table(each) for each, name in camera_names.items()}
    tables |= {name: kind_table(each) for each, name in (light_names | background_names).items()}
    tables |= {"MaterialTable": material_table(materials)}
    top = Table(
        "A wrt scene file.",
        title=key(TEXT, "title of the picture", ""),
        include=key(many({"anyOf": [TEXT, ref("IncludeTable")]}),
                    "glTF files; their shapes, cameras and lights are added after those of this file", []),
        settings=key(ref("SettingsTable"), "defaults of a render"),
        cameras=key(by_name(one_of("type", {each.kind: name for each, name in camera_names.items()})),
                    "cameras by name; the first is the default", {}),
        background=key(one_of("type", {each.kind: name for each, name in background_names.items()}),
                       "radiance of rays that hit nothing (default: black)"),
        ambient=key(RADIANCE, "radiance that every diffuse surface receives from all directions, unshadowed", [0.0, 0.0, 0.0]),
        ambient_occlusion=key(NUMBER | {"minimum": 0.0, "maximum": MAX_REACH, "unit": "length"},
                              "surfaces within this radius occlude `ambient`; 0: nothing does", 0.0),
        materials=key(by_name(ref("MaterialTable")), "materials by name", {}),
        override=key(by_name(ref("MaterialTable")), "materials that replace included materials of the same name", {}),
        spheres=key(many(ref("SphereTable")), "exact spheres", []),
        quads=key(many(ref("QuadTable")), "parallelograms", []),
        boxes=key(many(ref("BoxTable")), "closed boxes", []),
        meshes=key(many(ref("MeshTable")), "meshes from files or formulas", []),
        lights=key(many(one_of("type", {**{each.kind: name for each, name in light_names.items()}, "rectangle": "RectangleLightTable"})),
                   "lights", []))
    dialect = "https://json-schema.org/draft/2020-12/schema"
    top |= {"$schema": dialect, "title": "wrt scene", "$defs": {name: tables[name] for name in sorted(tables)}}
    return top
