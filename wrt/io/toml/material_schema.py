"""Tables of textures and materials of a TOML scene file, as pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, create_model, model_validator

from wrt.io.toml.kinds import TYPES, described
from wrt.io.toml.values import Angle, Scale2, Table, Wraps, require_one
from wrt.scene.materials import MATERIALS, Checkerboard, Material, kinds_that_use

_checkerboard: Any = create_model("_Checkerboard", __base__=Table, **described(Checkerboard))


class CheckerboardTable(_checkerboard):
    """Squares of two alternating colours."""


class _PlacedImage(Table):
    srgb: bool | None = Field(None, description="RGB is sRGB-encoded (default: true for albedo and emission, else false)")
    wrap: Wraps = Field(["repeat", "repeat"], description="lookup outside the image, in u and in v (one for both)")
    scale: Scale2 = Field([1.0, 1.0], description="repetitions in one unit of u and of v")
    offset: Annotated[list[float], Field(min_length=2, max_length=2)] = Field([0.0, 0.0], description="added to u and v")
    rotation: Angle = Field(0.0, description="rotation of the image about uv (0, 0), clockwise")
    matrix: Annotated[list[float], Field(min_length=6, max_length=6)] | None = Field(
        None, description="two rows of three: (u, v, 1) to the image's (u, v), in place of scale, offset and rotation")

    @model_validator(mode="after")
    def _check_matrix(self) -> _PlacedImage:
        if self.matrix is not None and {"scale", "offset", "rotation"} & self.model_fields_set:
            raise ValueError("a matrix takes no scale, offset or rotation beside it")
        return self


class ImageTable(_PlacedImage):
    """An image file; (u, v) = (0, 0) is its top left."""

    file: str = Field(description="image file (8 bits a channel are kept), relative to the scene file")


class ColorTextureTable(_PlacedImage):
    """An image file, or a checkerboard."""

    file: str | None = Field(None, description="image file (8 bits a channel are kept), relative to the scene file")
    checkerboard: CheckerboardTable | None = Field(None, description="checkerboard, in place of an image file")

    @model_validator(mode="after")
    def _check(self) -> ColorTextureTable:
        require_one(self, ("file",), ("checkerboard",))
        if self.checkerboard is not None and len(self.model_fields_set) > 1:
            raise ValueError("a checkerboard takes no other keys beside it; its scale is a key of the checkerboard")
        return self


class MaterialTable(Table):
    """A surface's reflection, transmission and emission."""

    kind: str = Field("diffuse")  # material_table makes it a choice of the registered kinds
    metal: Literal["gold", "silver", "copper", "aluminium"] | None = Field(None, description="a metal's eta and k (conductor)")

    @model_validator(mode="after")
    def _check(self) -> MaterialTable:
        users = kinds_that_use()
        users["metal"] = users["eta"]
        idle = [name for name, kinds in users.items() if name in self.model_fields_set and self.kind not in kinds]
        if idle:
            uses = "; ".join(f"{name} is used by {' and '.join(users[name])}" for name in idle)
            raise ValueError(f"kind {self.kind!r} does not use {', '.join(idle)} ({uses})")
        if self.metal is not None and {"eta", "k"} & self.model_fields_set:
            raise ValueError("give either metal, or eta and k")
        return self


def material_table(kinds: tuple[str, ...]) -> type[MaterialTable]:
    """Make a MaterialTable with all fields of Material and a choice of these kinds."""
    literal: Any = Literal
    about = "; ".join(f"{name}: {MATERIALS[name].about}" for name in kinds)
    texture = {"texture": lambda limits: ColorTextureTable if Checkerboard in limits["among"] else ImageTable}
    return create_model("MaterialTable", __base__=MaterialTable, __doc__=MaterialTable.__doc__,
                        kind=(literal[kinds], Field("diffuse", description=about)), **described(Material, TYPES | texture))
