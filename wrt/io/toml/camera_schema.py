"""Camera tables of a TOML scene file: each has a pose and the parameters of its kind."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from wrt.io.toml.kinds import described
from wrt.io.toml.values import Annotation, Length, Matrix, Point, Positive, TypedTable, Vector
from wrt.scene.cameras import Camera, CameraKind


class PoseTable(TypedTable):
    """Give position and target, or matrix."""

    type: str = Camera.kind
    position: Point | None = Field(None, description="position of the camera")
    target: Point | None = Field(None, description="point in the middle of the picture")
    up: Vector = Field([0.0, 1.0, 0.0], description="direction that points up in the picture")
    matrix: Matrix | None = Field(None, description="camera to world; the camera looks along -z, +y is up")

    @model_validator(mode="after")
    def _check(self) -> PoseTable:
        problems = self.problems()
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def problems(self) -> list[str]:
        """Return a message for each wrong combination of keys."""
        if (self.matrix is None) == (self.position is None and self.target is None):
            return ["give either position and target, or matrix"]
        return ["needs both position and target"] if self.matrix is None and (self.position is None or self.target is None) else []


class LensTable(PoseTable):
    """Give position and target, or matrix. Give fov_y, or focal_length."""

    focal_length: Length | None = Field(None, description="focal length of a real lens, in place of fov_y")
    sensor_height: Length | None = Field(None, description="height of the sensor behind a real lens")
    f_number: Positive | None = Field(None, description="f-number of a real lens: the aperture's radius is focal_length / (2 f_number)")

    def problems(self) -> list[str]:
        problems, given = super().problems(), self.model_fields_set
        if self.focal_length is None and (self.sensor_height is not None or self.f_number is not None):
            problems.append("sensor_height and f_number need a focal_length")
        if self.focal_length is not None:
            if "fov_y" in given:
                problems.append("give either fov_y or focal_length")
            if self.sensor_height is None:
                problems.append("focal_length needs a sensor_height")
            if (self.f_number is None) == ("aperture_radius" not in given):
                problems.append("focal_length needs either f_number or aperture_radius")
        return problems


def camera_table(kind: type[CameraKind]) -> type[PoseTable]:
    """Make the table of a kind of camera: its pose and the parameters of its class."""
    base = LensTable if issubclass(kind, Camera) else PoseTable
    keys: dict[str, Any] = {"type": (Literal[kind.kind], Camera.kind if kind is Camera else Field())}
    about_kind = (kind.__doc__ or "").split("\n\n")[0]
    return create_model(f"{kind.__name__}Table", __base__=base, __doc__=f"{about_kind} {base.__doc__}", **keys, **described(kind))


def _type_of_camera(table: object) -> str:
    return str(table.get("type", Camera.kind)) if isinstance(table, dict) else getattr(table, "type", Camera.kind)


def any_camera(kinds: tuple[type[CameraKind], ...]) -> Annotation:
    """Return the annotation of a camera table of any of these kinds. The key `type` of a table gives its kind."""
    tables: list[Any] = [Annotated[camera_table(kind), Tag(kind.kind)] for kind in kinds]
    return Annotated[reduce(or_, tables), Discriminator(_type_of_camera)]
