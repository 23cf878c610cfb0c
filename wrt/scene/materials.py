"""Materials of surfaces, and their textures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_choice, at_thing
from wrt.core.errors import wrong
from wrt.scene.kinds import check_fields, forms, given
from wrt.scene.values import BLACK, Color

WRAPS = ("repeat", "clamp", "mirror")


@dataclass(frozen=True, eq=False)
class Texture:
    """An 8-bit image, sampled bilinearly.

    (u, v) = (0, 0) is the top left corner of the image, as in glTF; readers of formats with v upwards (OBJ, PLY) flip v.

    Parameters
    ----------
    image
        (H, W, 4) uint8, row 0 on top.
    srgb
        True if RGB is sRGB-encoded. Alpha is always linear.
    wrap
        Lookup outside the image, in u and in v: "repeat", "clamp" or "mirror".
    uv_transform
        (2, 3), maps (u, v, 1) of the mesh to the (u, v) of the image.
    """

    image: np.ndarray = field(repr=False)
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    uv_transform: np.ndarray = field(default_factory=lambda: np.eye(2, 3), repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 4 or image.size == 0:
            raise wrong(at_thing("texture", self.name) + "image", f"must be (H, W, 4) uint8, got {image.shape} {image.dtype}")
        for wrap in self.wrap:
            as_choice(wrap, WRAPS, at_thing("texture", self.name) + "wrap")
        transform = as_array(self.uv_transform, np.float64, at_thing("texture", self.name) + "uv_transform")
        if transform.shape != (2, 3) or not (np.abs(transform) <= LARGEST).all():
            raise wrong(at_thing("texture", self.name) + "uv_transform", f"must be a 2x3 matrix of numbers up to {LARGEST:g}")
        image = as_array(image, np.uint8, "image")
        image.flags.writeable = False  # textures share images that nobody writes to
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "uv_transform", transform)


@dataclass(frozen=True)
class Checkerboard:
    """Squares of two alternating colours, `scale` squares for each unit of u and of v."""

    color_a: Color = field(default=(0.8, 0.8, 0.8), metadata=given("color", "colour of the square at (u, v) = (0, 0)"))
    color_b: Color = field(default=(0.2, 0.2, 0.2), metadata=given("color", "colour of the adjacent squares"))
    scale: float = field(default=1.0, metadata=given("number", "squares for each unit of u and of v", ge=1e-6))

    def __post_init__(self) -> None:
        check_fields(self, "checkerboard: ")


class MaterialKind(NamedTuple):
    """Properties of a kind of material. kernels/shade/materials.py has the kind's device function, under the same name.

    - about: text in the reference of scene files.
    - uses: fields that this kind reads and some other kind does not. A field that the kind does not use is 0 on the
      device, and an error in a scene file.
    - scatters: `albedo` is diffuse, at least in part; reflects: spawns reflected rays; clear: always transmits light."""

    about: str
    uses: tuple[str, ...] = ()
    scatters: bool = False
    reflects: bool = True
    clear: bool = False


MATERIALS: dict[str, MaterialKind] = {
    "diffuse": MaterialKind("Lambert, with an optional Blinn-Phong highlight", ("specular", "exponent"), scatters=True,
                            reflects=False),
    "mirror": MaterialKind("reflectance albedo at every angle"),
    "conductor": MaterialKind("Fresnel reflection of a metal", ("eta", "k", "roughness")),
    "glass": MaterialKind("reflection and refraction", ("ior", "absorption", "thin", "roughness"), clear=True),
    "metallic_roughness": MaterialKind(
        "glTF's", ("ior", "absorption", "thin", "roughness", "metallic", "transmission", "specular_factor", "specular_color", "clearcoat",
                   "clearcoat_roughness", "metallic_roughness_texture", "transmission_texture", "specular_texture",
                   "specular_color_texture", "clearcoat_texture", "clearcoat_roughness_texture"), scatters=True),
}
ALPHA_MODES = ("opaque", "mask", "blend")
# Complex index of refraction at 630, 532 and 465 nm, rounded to three decimals (optical tables of the pure metals).
CONDUCTORS: dict[str, tuple[Color, Color]] = {
    "gold": ((0.183, 0.422, 1.373), (3.424, 2.346, 1.771)),
    "silver": ((0.155, 0.117, 0.138), (4.828, 3.122, 2.147)),
    "copper": ((0.200, 0.924, 1.102), (3.912, 2.452, 2.142)),
    "aluminium": ((1.657, 0.880, 0.521), (9.224, 6.270, 4.837)),
}


@dataclass(frozen=True, eq=False)
class Material:
    """Optical properties of a surface; each field says what it is, and which kinds read it.

    Objects share a material if they hold the same instance; equality is identity. The kinds are

    - "diffuse": Lambert with `albedo`, plus a normalised Blinn-Phong highlight of `specular` and `exponent`.
    - "mirror": reflectance `albedo` at every angle.
    - "conductor": exact Fresnel reflection with the index of refraction `eta` + i `k` (presets in CONDUCTORS) and `roughness`.
    - "glass": dielectric of index `ior`; `albedo` tints transmission. Also reads `absorption` (Beer-Lambert), `thin` and `roughness`.
    - "metallic_roughness": as in glTF 2.0, KHR_materials_specular and KHR_materials_clearcoat.

    A texture multiplies its parameters. `emission` (radiance of the front, whose corners run counter-clockwise, or of both sides) lights
    other surfaces unless `emits_light` is False, it has a texture, or `alpha_mode` is not "opaque". Raises InputError if a value has the
    wrong type or is out of range."""

    kind: str = "diffuse"
    name: str = ""
    albedo: Color = field(default=(0.8, 0.8, 0.8), metadata=given(
        "color", "reflectance; of glass the transmittance of each surface, 1 for clear glass", le=1.0))
    specular: Color = field(default=BLACK, metadata=given("color", "colour of the highlight (diffuse)", le=1.0))
    exponent: float = field(default=50.0, metadata=given("number", "exponent of the highlight (diffuse)", ge=0.0, le=1e6))
    eta: Color = field(default=CONDUCTORS["silver"][0], metadata=given("color", "real part of the index of refraction (conductor)", le=1e3))
    k: Color = field(default=CONDUCTORS["silver"][1], metadata=given("color", "imaginary part of that index (conductor)", le=1e3))
    ior: float = field(default=1.5, metadata=given("number", "index of refraction (glass, metallic_roughness)", ge=1.0, le=10.0))
    absorption: Color = field(default=BLACK, metadata=given(
        "color", "exp(-absorption d) of the light is left after a distance d inside (glass, metallic_roughness)", "1 / length"))
    thin: bool = field(default=False, metadata=given("flag", "an infinitely thin pane, without bending (glass, metallic_roughness)"))
    metallic: float = field(default=0.0, metadata=given("number", "0: dielectric, 1: metal (metallic_roughness)", ge=0.0, le=1.0))
    roughness: float = field(default=0.0, metadata=given(
        "number", "square root of the GGX alpha; 0: a perfect mirror (conductor, glass, metallic_roughness)", ge=0.0, le=1.0))
    transmission: float = field(default=0.0, metadata=given(
        "number", "share of the light that the body transmits (metallic_roughness)", ge=0.0, le=1.0))
    specular_factor: float = field(default=1.0, metadata=given(
        "number", "factor on the reflectance of a dielectric (metallic_roughness)", ge=0.0, le=1.0))
    specular_color: Color = field(default=(1.0, 1.0, 1.0), metadata=given(
        "color", "factor on the reflectance of a dielectric at normal incidence (metallic_roughness)", le=1e3))
    clearcoat: float = field(default=0.0, metadata=given(
        "number", "share of the surface under a clear coat of index 1.5 (metallic_roughness)", ge=0.0, le=1.0))
    clearcoat_roughness: float = field(default=0.0, metadata=given(
        "number", "roughness of the clear coat (metallic_roughness)", ge=0.0, le=1.0))
    emission: Color = field(default=BLACK, metadata=given("color", "emitted by the front side", "radiance"))
    two_sided: bool = field(default=False, metadata=given("flag", "both sides emit"))
    emits_light: bool = field(default=True, metadata=given("flag", "the emission lights other surfaces; false: it is only visible"))
    alpha: float = field(default=1.0, metadata=given("number", "opacity", ge=0.0, le=1.0))
    alpha_mode: str = field(default="opaque", metadata=given("choice", "opaque: alpha is ignored; mask: no surface if alpha <"
                                                             " alpha_cutoff; blend: 1 - alpha of the light passes", among=ALPHA_MODES))
    alpha_cutoff: float = field(default=0.5, metadata=given("number", "threshold of mask", ge=0.0, le=1.0))
    normal_scale: float = field(default=1.0, metadata=given("number", "strength of the normal map", ge=-1e3, le=1e3))
    albedo_texture: Texture | Checkerboard | None = field(default=None, metadata=given(
        "texture", "multiplies albedo; its alpha multiplies alpha", among=(Texture, Checkerboard)))
    metallic_roughness_texture: Texture | None = field(default=None, metadata=given(
        "texture", "green multiplies roughness, blue metallic", among=(Texture,)))
    transmission_texture: Texture | None = field(default=None, metadata=given("texture", "red multiplies transmission", among=(Texture,)))
    specular_texture: Texture | None = field(default=None, metadata=given(
        "texture", "alpha multiplies specular_factor", among=(Texture,)))
    specular_color_texture: Texture | Checkerboard | None = field(default=None, metadata=given(
        "texture", "multiplies specular_color", among=(Texture, Checkerboard)))
    clearcoat_texture: Texture | None = field(default=None, metadata=given("texture", "red multiplies clearcoat", among=(Texture,)))
    clearcoat_roughness_texture: Texture | None = field(default=None, metadata=given(
        "texture", "green multiplies clearcoat_roughness", among=(Texture,)))
    emission_texture: Texture | Checkerboard | None = field(default=None, metadata=given(
        "texture", "multiplies emission", among=(Texture, Checkerboard)))
    normal_texture: Texture | None = field(default=None, metadata=given("texture", "tangent-space normal map", among=(Texture,)))

    def __post_init__(self) -> None:
        at = at_thing("material", self.name)
        as_choice(self.kind, MATERIALS, at + "kind")
        check_fields(self, at)

    def uses(self, field: str) -> bool:
        """Return True if this kind reads `field` and some other kind does not."""
        return field in MATERIALS[self.kind].uses

    def reads(self, field: str) -> bool:
        """Return True if this kind reads `field`, also if every kind does."""
        return self.uses(field) or field not in kinds_that_use()

    @property
    def is_clear(self) -> bool:
        """True if the surface transmits light. Alpha does not count."""
        return MATERIALS[self.kind].clear or (self.uses("transmission") and self.transmission > 0.0)

    @property
    def is_rough(self) -> bool:
        """True if reflections are blurred. Up to a roughness of 0.01 the blur is below the resolution of float32 directions."""
        return (self.uses("roughness") and self.roughness > 0.01) or (self.is_coated and self.clearcoat_roughness > 0.01)

    @property
    def is_coated(self) -> bool:
        """True if the surface has a clear coat."""
        return self.uses("clearcoat") and self.clearcoat > 0.0

    @property
    def scales_reflectance(self) -> bool:
        """True if the reflectance is not the one of a dielectric with the index `ior`."""
        plain = self.specular_factor == 1.0 and self.specular_color == (1.0, 1.0, 1.0)
        return self.uses("specular_factor") and not (plain and self.specular_texture is None and self.specular_color_texture is None)

    @property
    def is_emissive(self) -> bool:
        """True if `emission` is not black. The emission texture may still be black."""
        return max(self.emission) > 0.0

    @property
    def lights_others(self) -> bool:
        """True if surfaces of this material are sampled as lights: their power must not vary by an emission texture or alpha."""
        return self.is_emissive and self.emits_light and self.emission_texture is None and self.alpha_mode == "opaque"

    @property
    def textures(self) -> tuple[Texture | Checkerboard, ...]:
        """Textures that the material has, in the order of SLOTS."""
        slots = (getattr(self, name) for name in SLOTS)
        return tuple(texture for texture in slots if texture is not None)


# Fields that hold textures. True: the texture is a colour, and a checkerboard is allowed.
SLOTS = {name: Checkerboard in each.metadata["limits"]["among"] for name, each in forms(Material).items()
         if each.metadata["form"] == "texture"}


def kinds_that_use() -> dict[str, tuple[str, ...]]:
    """Return, by field, the kinds that read the field. Fields that every kind reads are left out."""
    used = dict.fromkeys(name for kind in MATERIALS.values() for name in kind.uses)
    return {name: tuple(kind for kind, row in MATERIALS.items() if name in row.uses) for name in used}
