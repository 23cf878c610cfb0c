"""Translate materials and textures to Mitsuba; refuse those without an exact counterpart."""

from types import ModuleType
from typing import Any, NoReturn, TypeAlias

import numpy as np

from wrt.core.errors import InputError
from wrt.picture.tonemap import decode_srgb
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.values import Color

Plugin: TypeAlias = dict[str, Any]  # for mitsuba.load_dict
MitsubaObject: TypeAlias = Any  # its class exists only after a variant of Mitsuba is set
BSDFS: dict[str, Plugin] = {"diffuse": {"type": "diffuse"}, "mirror": {"type": "conductor", "material": "none"},
                                    "conductor": {"type": "conductor"}, "glass": {"ext_ior": 1.0}}
# Kind of material -> the property of Mitsuba's BSDF that is the albedo.
COLORED = {"diffuse": "reflectance", "mirror": "specular_reflectance", "glass": "specular_transmittance"}


def refuse(what: str, where: str = "") -> NoReturn:
    """Raise InputError for a feature that Mitsuba cannot render exactly: pictures of different light cannot be compared."""
    raise InputError(f"not translatable exactly: {what}", place=f"Mitsuba: {where}" if where else "Mitsuba")


def bsdf(mi: ModuleType, material: Material) -> Plugin:
    """Return the material as a dictionary for `mitsuba.load_dict`."""
    where = f"material {material.name!r}"
    if material.kind not in BSDFS:
        refuse(f"{material.kind} (Mitsuba's principled BSDF is different)", where)
    if material.normal_texture is not None:
        refuse("normal texture (Mitsuba uses different tangents)", where)
    if max(material.specular) > 0.0:
        refuse("Blinn-Phong highlight", where)
    result = _bsdf(mi, material)
    if material.kind != "glass":  # all other materials reflect light on the back as on the front
        result = {"type": "twosided", "bsdf": result}
    elif not material.thin and material.alpha_mode == "blend":
        refuse("blended solid glass", where)
    opacity = _opacity(mi, material)
    return result if opacity is None else {"type": "mask", "opacity": opacity, "bsdf": result}


def emission(mi: ModuleType, material: Material) -> Plugin:
    """Return the material's emission as an area emitter. If it does not light other surfaces, the emitter has the sampling weight 0."""
    if material.alpha_mode != "opaque":
        refuse("emission of a partly transparent surface", f"material {material.name!r}")
    radiance = _color(mi, material.emission, material.emission_texture)
    return {"type": "area", "radiance": radiance, "sampling_weight": 1.0 if material.lights_others else 0.0}


def _bsdf(mi: ModuleType, material: Material) -> Plugin:
    """Return the material's BSDF for the front side, without opacity."""
    result = dict(BSDFS[material.kind])
    if material.kind == "conductor":
        result |= {"eta": rgb(material.eta), "k": rgb(material.k)}
    else:
        result[COLORED[material.kind]] = _color(mi, material.albedo, material.albedo_texture)
    if material.kind == "glass":
        result |= {"type": "thindielectric" if material.thin else "dielectric", "int_ior": material.ior}
        if material.thin and material.is_rough:
            refuse("a thin pane with roughness", f"material {material.name!r}")
    if material.is_rough:
        result |= {"type": f"rough{result['type']}", "distribution": "ggx", "alpha": material.roughness**2}
    return result


def rgb(color: Color) -> Plugin:
    return {"type": "rgb", "value": list(color)}


def _color(mi: ModuleType, factor: Color, texture: Texture | Checkerboard | None) -> Plugin:
    """Return factor times the texture, as linear RGB."""
    if texture is None:
        return rgb(factor)
    if isinstance(texture, Checkerboard):
        return _checkerboard(mi, factor, texture)
    return _bitmap(mi, texture, linear_rgb(texture) * np.asarray(factor, np.float32))


def _checkerboard(mi: ModuleType, factor: Color, texture: Checkerboard) -> Plugin:
    # Mitsuba's checkerboard has two squares in a unit of u or v, and color0 in the square at the origin.
    first, second = (rgb(np.multiply(color, factor).tolist()) for color in (texture.color_a, texture.color_b))
    to_uv = mi.ScalarTransform3f().scale([0.5 * texture.scale, 0.5 * texture.scale])
    return {"type": "checkerboard", "color0": first, "color1": second, "to_uv": to_uv}


def linear_rgb(texture: Texture) -> np.ndarray:
    """Return (H, W, 3) float32 linear RGB of the texels (IEC 61966-2-1 if the texture is sRGB-encoded)."""
    steps = np.arange(256, dtype=np.float64) / 255.0
    return (decode_srgb(steps) if texture.srgb else steps).astype(np.float32)[texture.image[..., :3]]


def _bitmap(mi: ModuleType, texture: Texture, values: np.ndarray) -> Plugin:
    """Return a bitmap of texels (H, W, C) float32 with the texture's filter and transform; row 0 is at v = 0 in wrt and Mitsuba."""
    if texture.wrap[0] != texture.wrap[1]:
        refuse("wrap that differs between the axes", f"texture {texture.name!r}")
    to_uv = np.vstack([texture.uv_transform, (0.0, 0.0, 1.0)])
    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(values, np.float32)), "raw": True,
            "filter_type": "bilinear", "wrap_mode": texture.wrap[0], "to_uv": mi.ScalarTransform3f(to_uv)}


def _opacity(mi: ModuleType, material: Material) -> MitsubaObject:
    """Return the opacity as a number or a bitmap, or None for an opaque material."""
    if material.alpha_mode == "opaque":
        return None
    texture = material.albedo_texture if isinstance(material.albedo_texture, Texture) else None
    if texture is None:
        return material.alpha if material.alpha_mode == "blend" else float(material.alpha >= material.alpha_cutoff)
    if material.alpha_mode != "blend":
        refuse("alpha mask with a texture (Mitsuba would cut at whole texels)", f"material {material.name!r}")
    return _bitmap(mi, texture, texture.image[..., 3:4].astype(np.float32) / 255.0 * np.float32(material.alpha))
