"""Materials and textures for Mitsuba: one function a kind of material, in the table BSDFS.

`notes.add(what, where)` names an approximation; it raises InputError where these are not allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.values import Color


def bsdf(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    """The material as a dictionary for `mitsuba.load_dict`. Raises InputError for a kind that is not in BSDFS."""
    if material.kind not in BSDFS:
        raise InputError(f"not translatable: material {material.name!r} of kind {material.kind!r}", None, "Mitsuba")
    result = BSDFS[material.kind](mi, material, notes)
    # Glass has two sides by nature; everything else answers light on its back as on its front.
    transmits = material.is_clear
    if material.normal_texture is not None:
        notes.add("normal texture (Mitsuba's own tangents)", f"material {material.name!r}")
        result = {"type": "normalmap", "normalmap": _normal_map(mi, material, notes), "bsdf": result}
    if not transmits:
        result = {"type": "twosided", "bsdf": result}
    if transmits and not material.thin and material.alpha_mode == "blend":
        notes.add("blended solid glass (each face by itself)", f"material {material.name!r}")
    opacity = _opacity(mi, material, notes)
    return result if opacity is None else {"type": "mask", "opacity": opacity, "bsdf": result}


def emission(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    """An area emitter; one that does not light other surfaces is never sampled."""
    if material.alpha_mode != "opaque":
        notes.add("emission of a surface that is partly transparent (emits as if opaque)", f"material {material.name!r}")
    radiance = _color(mi, material.emission, material.emission_texture, notes)
    return {"type": "area", "radiance": radiance, "sampling_weight": 1.0 if material.lights_others else 0.0}


def _diffuse(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    if max(material.specular) > 0.0:
        notes.add("Blinn-Phong highlight (left out)", f"material {material.name!r}")
    return {"type": "diffuse", "reflectance": _color(mi, material.albedo, material.albedo_texture, notes)}


def _mirror(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    reflectance = _color(mi, material.albedo, material.albedo_texture, notes)
    return {"type": "conductor", "material": "none", "specular_reflectance": reflectance}


def _conductor(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    result: dict[str, Any] = {"type": "conductor", "eta": _rgb(material.eta), "k": _rgb(material.k)}
    return result | _ggx("roughconductor", material) if material.is_rough else result


def _glass(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    transmittance = _color(mi, material.albedo, material.albedo_texture, notes)
    result: dict[str, Any] = {"type": "dielectric", "int_ior": material.ior, "ext_ior": 1.0,
                              "specular_transmittance": transmittance}
    if material.thin:
        if material.is_rough:
            notes.add("a thin pane with roughness (smooth)", f"material {material.name!r}")
        return result | {"type": "thindielectric"}
    return result | _ggx("roughdielectric", material) if material.is_rough else result


def _ggx(plugin: str, material: Material) -> dict[str, Any]:
    return {"type": plugin, "distribution": "ggx", "alpha": material.roughness**2}


def _metallic_roughness(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    notes.add("metallic_roughness (Mitsuba's principled BSDF)", f"material {material.name!r}")
    result: dict[str, Any] = {
        "type": "principled", "base_color": _color(mi, material.albedo, material.albedo_texture, notes),
        "roughness": _channel(mi, material.metallic_roughness_texture, 1, material.roughness, notes),
        "eta": max(material.ior, 1.001),
    }
    if material.transmission > 0.0:
        result["spec_trans"] = _channel(mi, material.transmission_texture, 0, material.transmission, notes)
        if material.thin:
            return result | {"type": "principledthin"}
    return result | {"metallic": _channel(mi, material.metallic_roughness_texture, 2, material.metallic, notes)}


BSDFS: dict[str, Callable[[Any, Material, Any], dict[str, Any]]] = {
    "diffuse": _diffuse, "mirror": _mirror, "conductor": _conductor, "glass": _glass,
    "metallic_roughness": _metallic_roughness,
}


# --- textures ---------------------------------------------------------------------------------------------------------


def _rgb(color: Color) -> dict[str, Any]:
    return {"type": "rgb", "value": list(color)}


def _color(mi: Any, factor: Color, texture: Texture | Checkerboard | None, notes: Any) -> dict[str, Any]:
    """factor times the texture's RGB, linear."""
    if texture is None:
        return _rgb(factor)
    if isinstance(texture, Checkerboard):
        return _checkerboard(mi, factor, texture)
    return _bitmap(mi, texture, linear_rgb(texture) * np.asarray(factor, np.float32), notes)


def _channel(mi: Any, texture: Texture | None, channel: int, factor: float, notes: Any) -> Any:
    """factor times one channel (0 to 1, never sRGB-encoded)."""
    if texture is None:
        return factor
    values = texture.image[..., channel : channel + 1].astype(np.float32) / 255.0
    return _bitmap(mi, texture, values * np.float32(factor), notes)


def _checkerboard(mi: Any, factor: Color, texture: Checkerboard) -> dict[str, Any]:
    # Mitsuba's board has two squares to one unit of its coordinates, and color0 in the one at the origin.
    first, second = (_rgb(np.multiply(color, factor).tolist()) for color in (texture.color_a, texture.color_b))
    to_uv = mi.ScalarTransform3f().scale([0.5 * texture.scale, 0.5 * texture.scale])
    return {"type": "checkerboard", "color0": first, "color1": second, "to_uv": to_uv}


def linear_rgb(texture: Texture) -> np.ndarray:
    """(H, W, 3) float32 linear RGB of the texels (IEC 61966-2-1 where the texture is sRGB-encoded)."""
    steps = np.arange(256, dtype=np.float64) / 255.0
    if texture.srgb:
        steps = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    return steps.astype(np.float32)[texture.image[..., :3]]


def _bitmap(mi: Any, texture: Texture, values: np.ndarray, notes: Any, filter_type: str = "bilinear") -> dict[str, Any]:
    """Texel values (H, W, C) float32, looked up as the texture says; row 0 is at v = 0 in both programs."""
    if texture.wrap[0] != texture.wrap[1]:
        notes.add("wrap that differs between the axes (that of u for both)", f"texture {texture.name!r}")
    to_uv = np.vstack([texture.uv_transform, (0.0, 0.0, 1.0)])
    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(values, np.float32)), "raw": True,
            "filter_type": filter_type, "wrap_mode": texture.wrap[0], "to_uv": mi.ScalarTransform3f(to_uv)}


def _normal_map(mi: Any, material: Material, notes: Any) -> dict[str, Any]:
    texture = material.normal_texture
    assert texture is not None
    normals = texture.image[..., :3].astype(np.float32) / 255.0 * 2.0 - 1.0
    normals[..., :2] *= material.normal_scale
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return _bitmap(mi, texture, 0.5 * normals + 0.5, notes)


def _opacity(mi: Any, material: Material, notes: Any) -> Any:
    """None where opaque; a number or a bitmap else. A cut-out with a texture is cut texel by texel."""
    if material.alpha_mode == "opaque":
        return None
    texture = material.albedo_texture if isinstance(material.albedo_texture, Texture) else None
    if texture is None:
        return material.alpha if material.alpha_mode == "blend" else float(material.alpha >= material.alpha_cutoff)
    alpha = texture.image[..., 3:4].astype(np.float32) / 255.0 * np.float32(material.alpha)
    if material.alpha_mode == "blend":
        return _bitmap(mi, texture, alpha, notes)
    notes.add("alpha mask (cut at whole texels)", f"material {material.name!r}")
    return _bitmap(mi, texture, (alpha >= material.alpha_cutoff).astype(np.float32), notes, filter_type="nearest")

