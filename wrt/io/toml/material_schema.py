"""Values, textures and materials of a TOML scene file as pydantic models.

Wherever a colour stands, one number is a grey.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, WithJsonSchema, create_model, model_validator

from wrt.scene.materials import MATERIALS, WRAPS, Checkerboard, Material, kinds_that_use

# --- values -----------------------------------------------------------------------------------------------------------


def _repeated(count: int) -> Callable[[Any], Any]:
    """A single value (but no bool and no text) stands for `count` of it."""
    return lambda value: [value] * count if isinstance(value, int | float) and not isinstance(value, bool) else value


def _or_one(values: dict[str, Any], count: int) -> WithJsonSchema:
    array = {"type": "array", "items": values, "minItems": count, "maxItems": count}
    return WithJsonSchema({"anyOf": [values, array]})


def unit(name: str) -> Any:
    """Says in the schema what a number is measured in."""
    return Field(json_schema_extra={"unit": name})


LENGTH, DEGREES = unit("length"), unit("degrees")
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[float], Field(min_length=16, max_length=16)]
Positive = Annotated[float, Field(gt=0.0)]
Point = Annotated[list[float], Field(min_length=3, max_length=3), LENGTH]
Length = Annotated[float, Field(gt=0.0), LENGTH]
Angle = Annotated[float, DEGREES]
Angles = Annotated[list[float], Field(min_length=3, max_length=3), DEGREES]
Share = Annotated[  # a colour that reflects or transmits
    list[Unit], Field(min_length=3, max_length=3), BeforeValidator(_repeated(3)),
    _or_one({"type": "number", "minimum": 0, "maximum": 1}, 3)]
Radiance = Annotated[  # a colour without an upper bound
    list[NotNegative], Field(min_length=3, max_length=3), BeforeValidator(_repeated(3)),
    _or_one({"type": "number", "minimum": 0}, 3)]
Scale3 = Annotated[list[float], Field(min_length=3, max_length=3), BeforeValidator(_repeated(3)),
                   _or_one({"type": "number"}, 3)]
Scale2 = Annotated[list[float], Field(min_length=2, max_length=2), BeforeValidator(_repeated(2)),
                   _or_one({"type": "number"}, 2)]
WrapMode = Literal["repeat", "clamp", "mirror"]
Wraps = Annotated[list[WrapMode], Field(min_length=2, max_length=2),
                  BeforeValidator(lambda value: [value] * 2 if isinstance(value, str) else value),
                  _or_one({"type": "string", "enum": list(WRAPS)}, 2)]
Subdivisions = Annotated[int, Field(ge=0, le=9)]
Segments = Annotated[int, Field(ge=3, le=4096)]


class Table(BaseModel):
    """A table of the file: unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _note_keys(cls, data: Any, info: ValidationInfo) -> Any:
        """Leave the known keys where the report of an unknown one finds them."""
        if isinstance(info.context, dict) and isinstance(data, dict):
            info.context[id(data)] = list(cls.model_fields)
        return data

    def given(self, *leave_out: str) -> dict[str, Any]:
        """The fields that the file gives, as plain values."""
        return self.model_dump(exclude_unset=True, exclude=set(leave_out))


def require_one(table: Table, *choices: tuple[str, ...]) -> None:
    """Raise ValueError unless exactly one of the groups of fields is given."""
    given = [names for names in choices if any(getattr(table, name) is not None for name in names)]
    if len(given) != 1:
        raise ValueError("give exactly one of " + ", or ".join(" and ".join(names) for names in choices))


# --- textures ---------------------------------------------------------------------------------------------------------

_CHECKER = Checkerboard()


class CheckerboardTable(Table):
    """Two colours in turn."""

    color_a: Radiance = Field(list(_CHECKER.color_a), description="colour of the square at (u, v) = (0, 0)")
    color_b: Radiance = Field(list(_CHECKER.color_b), description="colour of its neighbours")
    scale: float = Field(_CHECKER.scale, ge=1e-6, description="squares to one unit of u and of v")


class _PlacedImage(Table):
    srgb: bool | None = Field(
        None, description="RGB is sRGB-encoded (default: true for albedo and emission, else false)")
    wrap: Wraps = Field(["repeat", "repeat"], description="beyond the image, in u and in v (one for both)")
    scale: Scale2 = Field([1.0, 1.0], description="how often the image repeats in one unit of u and of v")
    offset: Annotated[list[float], Field(min_length=2, max_length=2)] = Field(
        [0.0, 0.0], description="added to u and v")
    rotation: Angle = Field(0.0, description="about uv (0, 0): turns the image clockwise")


class ImageTable(_PlacedImage):
    """An image file; (u, v) = (0, 0) is its top left."""

    file: str = Field(description="image file, relative to the scene file")


class ColorTextureTable(_PlacedImage):
    """An image file, or a checkerboard."""

    file: str | None = Field(None, description="image file, relative to the scene file")
    checkerboard: CheckerboardTable | None = Field(None, description="in place of an image file")

    @model_validator(mode="after")
    def _check(self) -> ColorTextureTable:
        require_one(self, ("file",), ("checkerboard",))
        if self.checkerboard is not None and len(self.model_fields_set) > 1:
            raise ValueError("a checkerboard takes no other fields beside it; its scale stands inside it")
        return self


# --- materials --------------------------------------------------------------------------------------------------------

_MATERIAL = Material()


class MaterialTable(Table):
    """How a surface answers light."""

    kind: str = Field("diffuse")  # a choice of those there are: material_table
    albedo: Share = Field(list(_MATERIAL.albedo), description="share of the light that is scattered or mirrored, or (glass) "
                          "let through by each surface: clear glass has 1, and by default each takes a fifth")
    specular: Share = Field(list(_MATERIAL.specular), description="colour of the highlight (diffuse)")
    exponent: float = Field(_MATERIAL.exponent, ge=0.0, le=1e6, description="Blinn-Phong exponent (diffuse)")
    metal: Literal["gold", "silver", "copper", "aluminium"] | None = Field(
        None, description="a metal's eta and k (conductor)")
    eta: Radiance = Field(
        list(_MATERIAL.eta), description="real part of the index of refraction at red, green, blue (conductor)")
    k: Radiance = Field(list(_MATERIAL.k), description="imaginary part of the index of refraction (conductor)")
    ior: float = Field(_MATERIAL.ior, ge=1.0, le=10.0, description="index of refraction (glass, metallic_roughness)")
    absorption: Annotated[Radiance, unit("1 / length")] = Field(
        list(_MATERIAL.absorption), description="per unit length inside: what is left after a length d is exp(-absorption d) "
        "(glass, metallic_roughness)")
    thin: bool = Field(_MATERIAL.thin, description="an infinitely thin pane: nothing is bent (glass, "
                       "metallic_roughness)")
    metallic: Unit = Field(_MATERIAL.metallic, description="0 dielectric, 1 metal (metallic_roughness)")
    roughness: Unit = Field(_MATERIAL.roughness, description="perceptual roughness, the GGX alpha is its square; 0 "
                            "is a perfect mirror (conductor, glass, metallic_roughness)")
    transmission: Unit = Field(_MATERIAL.transmission, description="share that is transmitted (metallic_roughness)")
    emission: Annotated[Radiance, unit("radiance")] = Field(
        list(_MATERIAL.emission), description="of the front side")
    two_sided: bool = Field(_MATERIAL.two_sided, description="both sides emit")
    emits_light: bool = Field(_MATERIAL.emits_light, description="the emission lights other surfaces (false: it is "
                              "only seen)")
    alpha: Unit = Field(_MATERIAL.alpha, description="opacity")
    alpha_mode: Literal["opaque", "mask", "blend"] = Field(
        "opaque", description="opaque: alpha is not used; mask: nothing where alpha < alpha_cutoff; blend: 1 - alpha "
        "of the light goes straight through")
    alpha_cutoff: Unit = Field(_MATERIAL.alpha_cutoff, description="threshold of alpha_mode mask")
    normal_scale: float = Field(_MATERIAL.normal_scale, ge=-1e3, le=1e3, description="strength of the normal map")
    albedo_texture: ColorTextureTable | None = Field(None, description="multiplies albedo; its alpha multiplies alpha")
    metallic_roughness_texture: ImageTable | None = Field(None, description="green multiplies roughness, blue metallic")
    transmission_texture: ImageTable | None = Field(None, description="red multiplies transmission")
    emission_texture: ColorTextureTable | None = Field(None, description="multiplies emission")
    normal_texture: ImageTable | None = Field(None, description="tangent-space normal map")

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
    """MaterialTable with a choice between these kinds."""
    literal: Any = Literal
    about = "; ".join(f"{name}: {MATERIALS[name].about}" for name in kinds)
    return create_model("MaterialTable", __base__=MaterialTable, __doc__=MaterialTable.__doc__,
                        kind=(literal[kinds], Field("diffuse", description=about)))
