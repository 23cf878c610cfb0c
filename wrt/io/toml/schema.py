"""Schema of TOML scene files: pydantic models, from which the JSON Schema is made.

Names, bounds and defaults come from the dataclasses in wrt/scene/. Angles are in degrees in scene files and in radians in wrt/scene/;
lengths have the scene's own unit; colours are linear Rec. 709. A single number in place of a colour is a grey.
"""

from __future__ import annotations

from functools import cache, reduce
from inspect import Parameter, signature
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from wrt.io.toml.camera_schema import any_camera
from wrt.io.toml.kinds import described, kind_table
from wrt.io.toml.material_schema import MaterialTable, material_table
from wrt.io.toml.values import LENGTH, Angle, Angles, Length, Matrix, Point, Radiance, Scale3, Table, TypedTable, Vector, require_one, unit
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS, CameraKind
from wrt.scene.kinds import Kind
from wrt.scene.lights import LIGHTS
from wrt.scene.materials import MATERIALS
from wrt.scene.settings import Settings
from wrt.scene.shapes import SHAPES
from wrt.scene.values import MAX_REACH

RADIANCE = unit("radiance")
Profile = Annotated[list[Annotated[list[float], Field(min_length=2, max_length=2), LENGTH]], Field(min_length=2)]
Segments = Annotated[int, Field(ge=3, le=4096)]
SettingsTable: Any = create_model(
    "SettingsTable", __base__=Table, __doc__="Defaults of a render; the command line overrides them.",
    **described(Settings))


class TransformTable(Table):
    """A scale, then a rotation, then a translation; or a matrix."""

    translate: Point = Field([0.0, 0.0, 0.0], description="translation, applied last")
    rotate: Angles = Field([0.0, 0.0, 0.0], description="rotation about x, then y, then z")
    axis: Vector | None = Field(None, description="axis of a rotation, in place of rotate")
    angle: Angle | None = Field(None, description="rotation about axis, counter-clockwise if the axis points to the viewer")
    scale: Scale3 = Field([1.0, 1.0, 1.0], description="scale, applied first; one number, or one for each axis")
    matrix: Matrix | None = Field(None, description="object to world, in place of all other keys")

    @model_validator(mode="after")
    def _check(self) -> TransformTable:
        if self.matrix is not None and len(self.model_fields_set) > 1:
            raise ValueError("a matrix takes no other keys beside it")
        if (self.axis is None) != (self.angle is None):
            raise ValueError("give both axis and angle")
        if self.axis is not None and "rotate" in self.model_fields_set:
            raise ValueError("give either rotate, or axis and angle")
        if self.axis is not None and not any(self.axis):
            raise ValueError("axis must not be zero")
        if not all(self.scale):
            raise ValueError("scale must not be zero in any axis")
        return self


class IncludeTable(Table):
    """A glTF file, placed as a whole."""

    file: str = Field(description="glTF file, relative to the scene file")
    transform: TransformTable | None = Field(None, description="file to world, for shapes, cameras and lights; intensities stay the same")


class SphereTable(Table):
    """An exact sphere."""

    center: Point = Field(description="centre of the sphere")
    radius: Length = Field(description="radius of the sphere")
    material: str = Field(description="name of a material")
    name: str = Field("", description="name in messages")


class QuadTable(Table):
    """A parallelogram; its front is towards cross(edge_u, edge_v), uvs run from 0 to 1."""

    corner: Point = Field(description="lower left corner, seen from the front")
    edge_u: Point = Field(description="edge from the corner to the right")
    edge_v: Point = Field(description="edge from the corner up")
    material: str = Field(description="name of a material")
    name: str = Field("", description="name in messages")


class BoxTable(Table):
    """A closed box along the axes, before its transform."""

    low: Point = Field(description="lowest corner")
    high: Point = Field(description="highest corner")
    material: str = Field(description="name of a material")
    transform: TransformTable | None = Field(None, description="object to world")
    name: str = Field("", description="name in messages")


# The type and the description of each parameter of SHAPES.
SHAPE_KEYS: dict[str, dict[str, tuple[Any, str]]] = {
    "icosphere": {"subdivisions": (Annotated[int, Field(ge=0, le=9)], "number of times that each triangle is split into four"),
                  "radius": (Length, "radius of the sphere")},
    "torus": {"radius": (Length, "distance from the axis to the middle of the tube"), "tube_radius": (Length, "radius of the tube"),
              "segments": (Segments, "segments around the axis"), "tube_segments": (Segments, "segments around the tube")},
    "lathe": {"profile": (Profile, "points (radius, height), bottom up; a repeated point makes a sharp edge"),
              "segments": (Segments, "segments around the axis")},
    "prism": {"sides": (Segments, "sides of the polygon"), "radius": (Length, "radius of the circle through the polygon's corners"),
              "length": (Length, "length along z")},
    "tube": {"points": (Annotated[list[Point], Field(min_length=2)], "points of the line in the middle of the tube"),
             "radius": (Length | list[Length], "one radius, or one for each point"), "segments": (Segments, "segments around the tube")},
    "teapot": {"segments": (Segments, "segments around the axis")},
}


def shape_table(kind: str) -> type[Table]:
    """Make the table of a shape, with the defaults of its function."""
    literal: Any = Literal
    parameters = signature(SHAPES[kind]).parameters
    keys: dict[str, Any] = {"kind": (literal[kind], ...)}
    for name, (value, about) in SHAPE_KEYS[kind].items():
        default = parameters[name].default
        keys[name] = (value, Field(... if default is Parameter.empty else default, description=about))
    summary = (SHAPES[kind].__doc__ or "").split("\n\n")[0].removeprefix("Return a ")
    summary = summary[:1].upper() + summary[1:]
    return create_model(f"{kind.capitalize()}Shape", __base__=Table, __doc__=summary, **keys)


if TYPE_CHECKING:
    Shape = Any
else:
    Shape = Annotated[reduce(or_, map(shape_table, SHAPE_KEYS)), Field(discriminator="kind")]


class PartTable(Table):
    """A range of a mesh file's triangles, in the order of the file."""

    first: int = Field(ge=0, description="index of the first triangle, from 0")
    count: int = Field(ge=0, description="number of triangles")
    material: str = Field(description="name of a material")


class MorphTable(Table):
    """A mesh with the same faces as the mesh to be moved. In an animation, the vertices move to the vertices of this mesh and back."""

    file: str | None = Field(None, description="mesh file, relative to the scene file")
    shape: Shape | None = Field(None, description="shape, in place of a file")

    @model_validator(mode="after")
    def _check(self) -> MorphTable:
        require_one(self, ("file",), ("shape",))
        return self


class KeyTable(Table):
    """A placement at one time of an animation: a scale, then a rotation, then a translation. All three are interpolated linearly."""

    translate: Point = Field([0.0, 0.0, 0.0], description="translation, applied last")
    rotate: Angles = Field([0.0, 0.0, 0.0], description="rotation about x, then y, then z; not limited to 360")
    scale: Scale3 = Field([1.0, 1.0, 1.0], description="scale, applied first; one number, or one for each axis")


class MeshTable(Table):
    """A mesh from a file or made by a formula."""

    file: str | None = Field(None, description="mesh file, relative to the scene file")
    shape: Shape | None = Field(None, description="shape, in place of a file")
    material: str | None = Field(None, description="name of a material; with materials or parts, for all other triangles")
    materials: dict[str, str] | None = Field(
        None, description="material of each group of the file (OBJ: usemtl, else g, else o; STL: solid)")
    parts: list[PartTable] | None = Field(None, description="materials by ranges of triangles; later ranges override earlier ones")
    smooth: bool | None = Field(
        None, description="true: compute missing vertex normals; false: flat (default: as in the file, by its normals or smoothing groups)")
    transform: TransformTable | None = Field(None, description="object to world")
    instances: Annotated[list[TransformTable], Field(min_length=1)] | None = Field(
        None, description="transforms, each of one copy of the mesh, applied before `transform`; the mesh is stored once")
    motion: Annotated[list[KeyTable], Field(min_length=2)] | None = Field(
        None, description="for `wrt animate`: placements evenly spread over the period, applied before instances and transform")
    morph: MorphTable | None = Field(None, description="for `wrt animate`: mesh to which the vertices move, and back")
    name: str = Field("", description="name in messages")

    @model_validator(mode="after")
    def _check(self) -> MeshTable:
        require_one(self, ("file",), ("shape",))
        if self.materials is not None and self.parts is not None:
            raise ValueError("give either materials or parts")
        if self.material is None and not self.materials and not self.parts:
            raise ValueError("needs a material (or materials, or parts)")
        return self


class RectangleLightTable(TypedTable):
    """A parallelogram that emits light; its front is towards cross(edge_u, edge_v)."""

    type: Literal["rectangle"]
    corner: Point = Field(description="one corner")
    edge_u: Point = Field(description="edge from the corner")
    edge_v: Point = Field(description="other edge from the corner")
    radiance: Annotated[Radiance, RADIANCE] = Field(description="emitted radiance, the same in all directions")
    two_sided: bool = Field(False, description="both sides emit")
    name: str = Field("", description="name in messages")


IncludeEntry = Annotated[
    Annotated[str, Tag("file")] | Annotated[IncludeTable, Tag("table")],
    Discriminator(lambda value: "file" if isinstance(value, str) else "table" if isinstance(value, dict | IncludeTable) else None,
                  custom_error_type="include_type", custom_error_message="a file's name or a table")]

class SceneTable(Table):
    """A wrt scene file."""

    title: str = Field("", description="title of the picture")
    include: list[IncludeEntry] = Field([], description="glTF files; their shapes, cameras and lights are added after those of this file")
    settings: Any = Field(default_factory=SettingsTable, description="defaults of a render")
    cameras: dict[str, Any] = Field({}, description="cameras by name; the first is the default")
    background: Any = Field(None, description="radiance of rays that hit nothing (default: black)")
    ambient: Annotated[Radiance, RADIANCE] = Field(
        [0.0, 0.0, 0.0], description="radiance that every diffuse surface receives from all directions, unshadowed")
    ambient_occlusion: Annotated[float, Field(ge=0.0, le=MAX_REACH), LENGTH] = Field(
        0.0, description="surfaces within this radius occlude `ambient`; 0: nothing does")
    materials: dict[str, MaterialTable] = Field({}, description="materials by name")
    override: dict[str, MaterialTable] = Field({}, description="materials that replace included materials of the same name")
    spheres: list[SphereTable] = Field([], description="exact spheres")
    quads: list[QuadTable] = Field([], description="parallelograms")
    boxes: list[BoxTable] = Field([], description="closed boxes")
    meshes: list[MeshTable] = Field([], description="meshes from files or formulas")
    lights: list[Any] = Field([], description="lights")


def scene_table() -> type[SceneTable]:
    """Return a SceneTable that knows all registered kinds of cameras, lights, backgrounds and materials."""
    return _scene_table(tuple(CAMERAS.values()), tuple(LIGHTS.values()), tuple(BACKGROUNDS.values()), tuple(MATERIALS))


@cache
def _scene_table(cameras: tuple[type[CameraKind], ...], lights: tuple[type[Kind], ...], backgrounds: tuple[type[Kind], ...],
                 materials: tuple[str, ...]) -> Any:
    tagged: Any = Annotated
    one_of: Any = Union
    by_name: Any = dict
    many: Any = list
    material = material_table(materials)
    light = one_of[(*(kind_table(each, "Light") for each in lights), RectangleLightTable)]
    background = one_of[tuple(kind_table(each, "") for each in backgrounds)]
    changes = {"settings": SettingsTable, "cameras": by_name[str, any_camera(cameras)],
               "background": tagged[background, Field(discriminator="type")] | None,
               "materials": by_name[str, material], "override": by_name[str, material],
               "lights": many[tagged[light, Field(discriminator="type")]]}
    fields: dict[str, Any] = {name: (kind, SceneTable.model_fields[name]) for name, kind in changes.items()}
    return create_model("SceneTable", __base__=SceneTable, __doc__=SceneTable.__doc__, **fields)
