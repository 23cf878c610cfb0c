"""Objects of glTF files that wrt reads: one table declares their keys, and each JSON value is checked against it.

A key's entry is its type (int, float, str, bool), or its default, whose type it has. [entry] is an array; {str: entry} is an object with
any keys; a tuple is an array of as many numbers, of its values by default or of (float, ...) without a default; a dictionary is an object.
A missing object has the defaults of its keys; it is None if one of them is needed. Keys that wrt does not read are not in the table.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, NamedTuple

from wrt.core.checks import short
from wrt.core.errors import InputError


class Needed(NamedTuple):
    """An entry whose key must be there."""

    entry: Any


WHITE, ANY = (1.0, 1.0, 1.0), {str: Any}
NAMED = {"name": str, "extensions": ANY}
TEXTURE = {"index": Needed(int), "texCoord": 0, "extensions": ANY}
OF_SPARSE = {"bufferView": Needed(int), "byteOffset": 0}
PRIMITIVE = {"attributes": Needed({str: int}), "indices": int, "material": int, "mode": 4, "targets": [{str: int}], "extensions": ANY}
FILE = {"asset": Needed({"version": Needed(str), "minVersion": str}), "scene": int, "extensions": ANY, "extensionsRequired": [str]}
# Items of the arrays of a file.
ITEMS: dict[str, dict[str, Any]] = {
    "accessors": {
        "bufferView": int, "byteOffset": 0, "componentType": Needed(int), "normalized": False, "count": Needed(int), "type": Needed(str),
        "sparse": {"count": Needed(int), "indices": Needed(OF_SPARSE | {"componentType": Needed(int)}), "values": Needed(OF_SPARSE)}},
    "bufferViews": {"buffer": Needed(int), "byteOffset": 0, "byteLength": Needed(int), "byteStride": int},
    "buffers": {"uri": str, "byteLength": Needed(int)},
    "cameras": NAMED | {
        "type": Needed(str), "perspective": {"yfov": Needed(float)}, "orthographic": {"xmag": Needed(float), "ymag": Needed(float)}},
    "images": {"name": str, "uri": str, "bufferView": int},
    "materials": NAMED | {
        "pbrMetallicRoughness": {"baseColorFactor": (*WHITE, 1.0), "baseColorTexture": TEXTURE, "metallicFactor": 1.0,
                                 "roughnessFactor": 1.0, "metallicRoughnessTexture": TEXTURE},
        "normalTexture": TEXTURE | {"scale": 1.0}, "emissiveTexture": TEXTURE, "emissiveFactor": (0.0, 0.0, 0.0),
        "alphaMode": "OPAQUE", "alphaCutoff": 0.5, "doubleSided": False},
    "meshes": NAMED | {"primitives": [PRIMITIVE]},
    "nodes": NAMED | {
        "camera": int, "children": [int], "skin": int, "mesh": int, "weights": [float], "matrix": (float,) * 16,
        "rotation": (0.0, 0.0, 0.0, 1.0), "scale": WHITE, "translation": (0.0, 0.0, 0.0)},
    "samplers": {"wrapS": 10497, "wrapT": 10497, "magFilter": int},
    "scenes": NAMED | {"nodes": [int]},
    "skins": {"joints": [int], "inverseBindMatrices": int},
    "textures": NAMED | {"sampler": int, "source": int},
}
EXTENSIONS: dict[str, dict[str, Any]] = {
    "KHR_texture_transform": {"offset": (0.0, 0.0), "rotation": 0.0, "scale": (1.0, 1.0), "texCoord": int},
    "EXT_texture_webp": {"source": Needed(int)},
    "EXT_texture_avif": {"source": Needed(int)},
    "KHR_materials_transmission": {"transmissionFactor": 0.0, "transmissionTexture": TEXTURE},
    "KHR_materials_volume": {"thicknessFactor": 0.0, "attenuationDistance": math.inf, "attenuationColor": WHITE},
    "KHR_materials_ior": {"ior": 1.5},
    "KHR_materials_specular": {"specularFactor": 1.0, "specularTexture": TEXTURE, "specularColorFactor": WHITE,
                               "specularColorTexture": TEXTURE},
    "KHR_materials_pbrSpecularGlossiness": {
        "diffuseFactor": (*WHITE, 1.0), "diffuseTexture": TEXTURE, "specularFactor": WHITE, "glossinessFactor": 1.0,
        "specularGlossinessTexture": TEXTURE},
    "KHR_materials_clearcoat": {
        "clearcoatFactor": 0.0, "clearcoatTexture": TEXTURE, "clearcoatRoughnessFactor": 0.0, "clearcoatRoughnessTexture": TEXTURE,
        "clearcoatNormalTexture": TEXTURE},
    "KHR_materials_emissive_strength": {"emissiveStrength": 1.0},
    "KHR_materials_unlit": {},
    "KHR_lights_punctual": {"light": Needed(int)},  # of a node
    "EXT_mesh_gpu_instancing": {"attributes": {str: int}},
    "KHR_node_visibility": {"visible": True},
}
LIGHTS = {"lights": [ANY]}  # KHR_lights_punctual of a file; a light that no node shows cannot refuse the file
LIGHT = {"type": Needed(str), "name": str, "color": WHITE, "intensity": 1.0, "range": float,
         "spot": {"innerConeAngle": 0.0, "outerConeAngle": math.pi / 4}}
_SCALARS: dict[Any, tuple[str, Any]] = {
    int: ("an integer", (int,)), float: ("a number", (int, float)), str: ("a string", (str,)), bool: ("true or false", (bool,)),
}


def read(entry: Any, raw: Any, place: str) -> Any:
    """Convert a JSON value by its entry in the table; an object becomes a namespace.

    null counts as a missing key. Raises InputError with the place of a value of another type, of a number that is not finite, or of a
    needed key that is missing."""
    if isinstance(entry, Needed):
        return read(entry.entry, raw, place)
    if isinstance(entry, dict):
        if not isinstance(raw, dict):
            raise _wrong("an object", raw, place)
        if str in entry:
            return raw if entry is ANY else {key: read(entry[str], each, f"{place}.{key}") for key, each in raw.items()}
        return _object(entry, raw, place)
    if isinstance(entry, list | tuple):
        if not isinstance(raw, list):
            raise _wrong("an array", raw, place)
        values = [read(float if isinstance(entry, tuple) else entry[0], each, f"{place}[{i}]") for i, each in enumerate(raw)]
        if isinstance(entry, tuple) and len(values) != len(entry):
            raise InputError(f"must hold {len(entry)} numbers, got {len(values)}", place=place)
        return values
    return _scalar(entry if isinstance(entry, type) else type(entry), raw, place)


def _object(entry: dict[str, Any], raw: dict[str, Any], place: str) -> SimpleNamespace:
    there = {key: raw[key] for key in entry if raw.get(key) is not None}
    for key, each in entry.items():
        if isinstance(each, Needed) and key not in there:
            raise InputError("is required", place=_join(place, key))
    return SimpleNamespace(**{key: read(each, there[key], _join(place, key)) if key in there else _default(each)
                              for key, each in entry.items()})


def _default(entry: Any) -> Any:
    if isinstance(entry, type):
        return None
    if isinstance(entry, tuple):
        return None if float in entry else list(entry)
    if isinstance(entry, list):
        return []
    if not isinstance(entry, dict):
        return entry
    if str in entry:
        return {}
    return None if any(isinstance(each, Needed) for each in entry.values()) else _object(entry, {}, "")


def _scalar(kind: Any, raw: Any, place: str) -> Any:
    expected, accepted = _SCALARS[kind]
    if kind is int and isinstance(raw, float) and raw.is_integer():
        raw = int(raw)  # JSON has one kind of number
    if not isinstance(raw, accepted) or (isinstance(raw, bool) and kind is not bool):
        raise _wrong(expected, raw, place)
    if kind is int and not -(1 << 63) <= raw < 1 << 63:
        raise _wrong("an integer of at most 64 bits", raw, place)
    if kind is float:
        try:
            raw = float(raw)
        except OverflowError:  # an integer beyond float64
            raw = math.inf
        if not math.isfinite(raw):
            raise _wrong("a finite number", raw, place)
    return raw


def _join(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _wrong(expected: str, raw: Any, place: str) -> InputError:
    return InputError(f"must be {expected}, got {short(raw)}", place=place or None)
