"""The parameters of materials on the device, a row each. The structs Material and Texels, and the look-up of textures, follow from it.

To add a parameter, add a row here, and a field of the same name to wrt.scene.materials.Material; its texture is a field, too. The rows
of one texture are neighbours."""

from typing import Any, NamedTuple

import warp as wp


class Parameter(NamedTuple):
    """A parameter of a material, and the texture that multiplies it."""

    dtype: Any
    texture: str = ""  # The texture's field in wrt.scene.materials.Material; "": none.
    channels: str = ""  # The channels (of "rgba") of the texture: one for each number of the parameter.
    feature: str = "parameter_textures"  # The field of Features that compiles the texture in; "": compiled in with any texture.
    is_factor: bool = True  # False: the parameter is the texture's value alone.


PARAMETERS = {
    "kind": Parameter(int),
    "albedo": Parameter(wp.vec3, "albedo_texture", "rgb", ""),
    "alpha": Parameter(float, "albedo_texture", "a", ""),
    "emission": Parameter(wp.vec3, "emission_texture", "rgb", ""),
    "specular": Parameter(wp.vec3),
    "exponent": Parameter(float),
    "eta": Parameter(wp.vec3),
    "k": Parameter(wp.vec3),
    "ior": Parameter(float),
    "absorption": Parameter(wp.vec3),
    "thin": Parameter(int),
    "roughness": Parameter(float, "metallic_roughness_texture", "g"),
    "metallic": Parameter(float, "metallic_roughness_texture", "b"),
    "transmission": Parameter(float, "transmission_texture", "r"),
    "specular_factor": Parameter(float, "specular_texture", "a", "specular"),
    "specular_color": Parameter(wp.vec3, "specular_color_texture", "rgb", "specular"),
    "clearcoat": Parameter(float, "clearcoat_texture", "r", "clearcoat"),
    "clearcoat_roughness": Parameter(float, "clearcoat_roughness_texture", "g", "clearcoat"),
    "normal": Parameter(wp.vec3, "normal_texture", "rgb", "normal_maps", is_factor=False),
    "normal_scale": Parameter(float),
    "two_sided": Parameter(int),
    "alpha_mode": Parameter(int),
    "alpha_cutoff": Parameter(float),
}


class MaterialTexture(NamedTuple):
    """A texture of a material: the parameters that it multiplies, which are neighbouring fields of Texels."""

    parameters: tuple[str, ...]
    channels: tuple[int, ...]  # Index in "rgba" of the channel for each number of these parameters.
    feature: str  # Parameter.feature.


def _texture(name: str) -> MaterialTexture:
    rows = {each: row for each, row in PARAMETERS.items() if row.texture == name}
    channels = tuple("rgba".index(channel) for row in rows.values() for channel in row.channels)
    return MaterialTexture(tuple(rows), channels, next(iter(rows.values())).feature)


TEXTURES = {row.texture: _texture(row.texture) for row in PARAMETERS.values() if row.texture}


def _struct(name: str, text: str, fields: dict[str, Any]) -> Any:
    return wp.struct(type(name, (), {"__annotations__": fields, "__doc__": text, "__module__": __name__, "__qualname__": name}))


Material = _struct("Material", "A material: wrt.scene.materials.Material describes the fields. A texture is an index into"
                   " Surfaces.textures, or -1 for none.",
                   {name: row.dtype for name, row in PARAMETERS.items() if row.is_factor} | dict.fromkeys(TEXTURES, int))
Texels = _struct("Texels", "The linear values of a material's textures at a point; 1 without a texture. Fields are unread if no material"
                 " has the texture.", {name: row.dtype for name, row in PARAMETERS.items() if row.texture})
