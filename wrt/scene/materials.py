"""What surfaces are made of: materials and their textures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_choice, at_thing
from wrt.core.errors import InputError
from wrt.scene.kinds import check_fields, forms, given
from wrt.scene.values import BLACK, Color

WRAPS = ("repeat", "clamp", "mirror")


@dataclass(frozen=True, eq=False)
class Texture:
    """An 8-bit image, sampled bilinearly.

    image: (H, W, 4) uint8, row 0 on top; srgb: RGB is sRGB-encoded (alpha never is); wrap: per axis (u, v);
    uv_transform: (2, 3), maps a mesh's (u, v, 1) to the texture's. (u, v) = (0, 0) is the image's top left corner, as in
    glTF; readers of formats with v upwards (OBJ, PLY) flip v when they load the mesh.
    """

    image: np.ndarray = field(repr=False)
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    uv_transform: np.ndarray = field(default_factory=lambda: np.eye(2, 3), repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        image = np.ascontiguousarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 4 or image.size == 0:
            raise InputError(at_thing("texture", self.name) + f"image must be (H, W, 4) uint8, got {image.shape} {image.dtype}")
        for wrap in self.wrap:
            as_choice(wrap, WRAPS, at_thing("texture", self.name) + "wrap")
        transform = as_array(self.uv_transform, np.float64, at_thing("texture", self.name) + "uv_transform")
        if transform.shape != (2, 3) or not (np.abs(transform) <= LARGEST).all():
            raise InputError(at_thing("texture", self.name) + f"uv_transform must be a 2x3 matrix of numbers up to {LARGEST:g}")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "uv_transform", transform)


@dataclass(frozen=True)
class Checkerboard:
    """Two colours in turn; `scale` squares to one unit of u and of v."""

    color_a: Color = field(default=(0.8, 0.8, 0.8), metadata=given("color", "colour of the square at (u, v) = (0, 0)"))
    color_b: Color = field(default=(0.2, 0.2, 0.2), metadata=given("color", "colour of its neighbours"))
    scale: float = field(default=1.0, metadata=given("number", "squares to one unit of u and of v", ge=1e-6))

    def __post_init__(self) -> None:
        check_fields(self, "checkerboard ")


class MaterialKind(NamedTuple):
    """What the host knows of a kind; its device function stands in kernels/shade/materials.py, under the same name.

    about: for the reference of scene files. uses: fields of Material that not every kind reads, and this one does: for a kind
    that does not use them they are 0 on the device, and a scene file may not give them. scatters: some of `albedo` follows
    Lambert's law; reflects: sends rays back; clear: lets light through even where it does not use `transmission`.
    """

    about: str
    uses: tuple[str, ...] = ()
    scatters: bool = False
    reflects: bool = True
    clear: bool = False


MATERIALS: dict[str, MaterialKind] = {
    "diffuse": MaterialKind("Lambert, with an optional Blinn-Phong highlight", ("specular", "exponent"), scatters=True,
                            reflects=False),
    "mirror": MaterialKind("reflects albedo at every angle"),
    "conductor": MaterialKind("Fresnel reflection of a metal", ("eta", "k", "roughness")),
    "glass": MaterialKind("reflection and refraction", ("ior", "absorption", "thin", "roughness"), clear=True),
    "metallic_roughness": MaterialKind(
        "glTF's", ("ior", "absorption", "thin", "roughness", "metallic", "transmission", "metallic_roughness_texture",
                   "transmission_texture"), scatters=True),
}
ALPHA_MODES = ("opaque", "mask", "blend")
# Complex index of refraction at 630, 532 and 465 nm, rounded to three digits (optical tables of the pure metals).
CONDUCTORS: dict[str, tuple[Color, Color]] = {
    "gold": ((0.183, 0.422, 1.373), (3.424, 2.346, 1.771)),
    "silver": ((0.155, 0.117, 0.138), (4.828, 3.122, 2.147)),
    "copper": ((0.200, 0.924, 1.102), (3.912, 2.452, 2.142)),
    "aluminium": ((1.657, 0.880, 0.521), (9.224, 6.270, 4.837)),
}


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface answers light. Compared by identity: two objects share a material when they hold the same one.

    kind
        diffuse: Lambert with `albedo`, plus a normalised Blinn-Phong highlight of colour `specular` and `exponent`.
        mirror: reflects `albedo` of what comes in, at every angle.
        conductor: exact Fresnel reflection of `eta` + i `k` per channel (CONDUCTORS has presets); `roughness`.
        glass: dielectric of index `ior`; splits into reflection and refraction; `albedo` tints what is transmitted;
            `absorption` per unit length inside (Beer-Lambert); `thin`: an infinitely thin pane (no bending, both faces'
            reflections summed); `roughness`.
        metallic_roughness: glTF 2.0's model, from `albedo` (base colour), `metallic`, `roughness`, `ior`, `transmission`.
    textures: `albedo_texture` multiplies albedo (its alpha multiplies `alpha`); `metallic_roughness_texture`: g is
        roughness, b is metallic; `transmission_texture`: r; `emission_texture` multiplies emission; `normal_texture` is a
        tangent-space normal map scaled by `normal_scale`.
    roughness: glTF's perceptual one in [0, 1]; the GGX alpha is its square. 0 is a perfect mirror.
    emission: radiance, linear. The front side (counter-clockwise) emits, both where `two_sided`.
    emits_light: emissive surfaces of this material light others (False: they are only seen, as glTF's unlit ones are). With
        an emission_texture, or alpha, they are only seen in any case: `lights_others`.
    alpha_mode: opaque; mask (a hit with alpha < `alpha_cutoff` is no hit); blend (the ray goes on with 1 - alpha).
    """

    kind: str = "diffuse"
    name: str = ""
    albedo: Color = field(default=(0.8, 0.8, 0.8), metadata=given(
        "color", "share of the light that is scattered or mirrored, or (glass) let through by each surface: clear glass has 1, and"
        " by default each takes a fifth", le=1.0))
    specular: Color = field(default=BLACK, metadata=given("color", "colour of the highlight (diffuse)", le=1.0))
    exponent: float = field(default=50.0, metadata=given("number", "Blinn-Phong exponent (diffuse)", ge=0.0, le=1e6))
    eta: Color = field(default=CONDUCTORS["silver"][0], metadata=given(
        "color", "real part of the index of refraction at red, green, blue (conductor)", le=1e3))
    k: Color = field(default=CONDUCTORS["silver"][1], metadata=given(
        "color", "imaginary part of the index of refraction (conductor)", le=1e3))
    ior: float = field(default=1.5, metadata=given("number", "index of refraction (glass, metallic_roughness)", ge=1.0, le=10.0))
    absorption: Color = field(default=BLACK, metadata=given(
        "color", "per unit length inside: what is left after a length d is exp(-absorption d) (glass, metallic_roughness)",
        "1 / length"))
    thin: bool = field(default=False, metadata=given(
        "flag", "an infinitely thin pane: nothing is bent (glass, metallic_roughness)"))
    metallic: float = field(default=0.0, metadata=given("number", "0 dielectric, 1 metal (metallic_roughness)", ge=0.0, le=1.0))
    roughness: float = field(default=0.0, metadata=given(
        "number", "perceptual roughness, the GGX alpha is its square; 0 is a perfect mirror (conductor, glass, metallic_roughness)",
        ge=0.0, le=1.0))
    transmission: float = field(default=0.0, metadata=given(
        "number", "share that is transmitted (metallic_roughness)", ge=0.0, le=1.0))
    emission: Color = field(default=BLACK, metadata=given("color", "of the front side", "radiance"))
    two_sided: bool = field(default=False, metadata=given("flag", "both sides emit"))
    emits_light: bool = field(default=True, metadata=given(
        "flag", "the emission lights other surfaces (false: it is only seen)"))
    alpha: float = field(default=1.0, metadata=given("number", "opacity", ge=0.0, le=1.0))
    alpha_mode: str = field(default="opaque", metadata=given(
        "choice", "opaque: alpha is not used; mask: nothing where alpha < alpha_cutoff; blend: 1 - alpha of the light goes straight"
        " through", among=ALPHA_MODES))
    alpha_cutoff: float = field(default=0.5, metadata=given("number", "threshold of alpha_mode mask", ge=0.0, le=1.0))
    normal_scale: float = field(default=1.0, metadata=given("number", "strength of the normal map", ge=-1e3, le=1e3))
    albedo_texture: Texture | Checkerboard | None = field(default=None, metadata=given(
        "texture", "multiplies albedo; its alpha multiplies alpha", among=(Texture, Checkerboard)))
    metallic_roughness_texture: Texture | None = field(default=None, metadata=given(
        "texture", "green multiplies roughness, blue metallic", among=(Texture,)))
    transmission_texture: Texture | None = field(default=None, metadata=given(
        "texture", "red multiplies transmission", among=(Texture,)))
    emission_texture: Texture | Checkerboard | None = field(default=None, metadata=given(
        "texture", "multiplies emission", among=(Texture, Checkerboard)))
    normal_texture: Texture | None = field(default=None, metadata=given("texture", "tangent-space normal map", among=(Texture,)))

    def __post_init__(self) -> None:
        at = at_thing("material", self.name)
        as_choice(self.kind, MATERIALS, at + "kind")
        check_fields(self, at)

    def uses(self, field: str) -> bool:
        """Whether its kind reads that field, of those that not every kind reads."""
        return field in MATERIALS[self.kind].uses

    def reads(self, field: str) -> bool:
        """Whether its kind reads that field."""
        return self.uses(field) or field not in kinds_that_use()

    @property
    def is_clear(self) -> bool:
        """Whether light goes through it, alpha aside."""
        return MATERIALS[self.kind].clear or (self.uses("transmission") and self.transmission > 0.0)

    @property
    def is_rough(self) -> bool:
        """Whether its reflection is spread: below a roughness of 0.01 by less than a float32 direction can tell."""
        return self.uses("roughness") and self.roughness > 0.01

    @property
    def is_emissive(self) -> bool:
        """Whether it emits anything, textures aside."""
        return max(self.emission) > 0.0

    @property
    def lights_others(self) -> bool:
        """Whether its emission is sampled as a light: not where a texture or its alpha says where it emits, since lights are
        chosen by power, not by picture."""
        plain = self.emission_texture is None and self.alpha_mode == "opaque"
        return self.is_emissive and self.emits_light and plain

    @property
    def textures(self) -> tuple[Texture | Checkerboard, ...]:
        """Those that it has, in no order to rely on."""
        slots = (getattr(self, name) for name in SLOTS)
        return tuple(texture for texture in slots if texture is not None)


# Its textures; True: of a colour.
SLOTS = {name: Checkerboard in each.metadata["limits"]["among"] for name, each in forms(Material).items()
         if each.metadata["form"] == "texture"}


def kinds_that_use() -> dict[str, tuple[str, ...]]:
    """Of each field that not every kind of material reads, the kinds that do."""
    used = dict.fromkeys(name for kind in MATERIALS.values() for name in kind.uses)
    return {name: tuple(kind for kind, row in MATERIALS.items() if name in row.uses) for name in used}
