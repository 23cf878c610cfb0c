"""Schema of glTF documents: JSON values become dataclass instances, each value checked against its declared type.

pygltflib has the dataclasses of core glTF; this file has the dataclasses of the extensions that wrt reads. The decoder of pygltflib is
not used: it turns 1.5 and "1" into the index 1, and its errors name no place in the file.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from dataclasses import dataclass, field
from typing import Any

from wrt.core.checks import short
from wrt.core.errors import InputError

# --- the extensions that wrt reads ------------------------------------------------------------------------------------


@dataclass
class TextureInfo:
    index: int
    texCoord: int = 0
    extensions: dict[str, Any] = field(default_factory=dict)


@dataclass
class TextureTransform:
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    rotation: float = 0.0
    scale: list[float] = field(default_factory=lambda: [1.0, 1.0])
    texCoord: int | None = None


@dataclass
class TextureSource:
    source: int


@dataclass
class Transmission:
    transmissionFactor: float = 0.0
    transmissionTexture: TextureInfo | None = None


@dataclass
class Volume:
    thicknessFactor: float = 0.0
    attenuationDistance: float = math.inf
    attenuationColor: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])


@dataclass
class Ior:
    ior: float = 1.5


@dataclass
class Specular:
    specularFactor: float = 1.0
    specularTexture: TextureInfo | None = None
    specularColorFactor: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    specularColorTexture: TextureInfo | None = None


@dataclass
class SpecularGlossiness:
    diffuseFactor: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0, 1.0])
    diffuseTexture: TextureInfo | None = None
    specularFactor: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    glossinessFactor: float = 1.0
    specularGlossinessTexture: TextureInfo | None = None


@dataclass
class Clearcoat:
    clearcoatFactor: float = 0.0
    clearcoatTexture: TextureInfo | None = None
    clearcoatRoughnessFactor: float = 0.0
    clearcoatRoughnessTexture: TextureInfo | None = None
    clearcoatNormalTexture: TextureInfo | None = None


@dataclass
class EmissiveStrength:
    emissiveStrength: float = 1.0


@dataclass
class Unlit:
    pass


@dataclass
class SpotCone:
    innerConeAngle: float = 0.0
    outerConeAngle: float = math.pi / 4


@dataclass
class PunctualLight:
    type: str
    name: str | None = None
    color: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    intensity: float = 1.0
    range: float | None = None
    spot: SpotCone | None = None


@dataclass
class PunctualLights:
    lights: list[dict[str, Any]] = field(default_factory=list)  # a light that no node shows cannot refuse the file


@dataclass
class PunctualLightOfNode:
    light: int


@dataclass
class DracoMesh:
    bufferView: int
    attributes: dict[str, int] = field(default_factory=dict)


@dataclass
class MeshoptView:
    buffer: int
    byteLength: int
    byteStride: int
    count: int
    mode: str
    byteOffset: int = 0
    filter: str = "NONE"


@dataclass
class Instancing:
    attributes: dict[str, int] = field(default_factory=dict)


@dataclass
class Visibility:
    visible: bool = True


# --- parts of a node that are read by themselves ----------------------------------------------------------------------


@dataclass
class Children:
    children: list[int] = field(default_factory=list)


@dataclass
class Weights:
    weights: list[float] = field(default_factory=list)


# --- checking ---------------------------------------------------------------------------------------------------------

# Fields that the specification requires, although pygltflib gives them the default None.
_REQUIRED = {
    "Accessor": ("componentType", "count", "type"), "Sparse": ("count", "indices", "values"),
    "AccessorSparseIndices": ("bufferView", "componentType"), "AccessorSparseValues": ("bufferView",),
    "BufferView": ("buffer", "byteLength"), "Buffer": ("byteLength",), "Camera": ("type",), "Perspective": ("yfov",),
    "Orthographic": ("xmag", "ymag"),
    "Primitive": ("attributes",), "TextureInfo": ("index",), "NormalMaterialTexture": ("index",), "Asset": ("version",),
    "GLTF2": ("asset",),
}
# Fields that wrt never reads, so that no mistake in them refuses a file. `Document.item` reads the arrays of GLTF2, item by item.
_UNREAD = {
    "Accessor": ("min", "max"), "BufferView": ("target",), "Image": ("mimeType",), "Material": ("occlusionTexture",),
    "Mesh": ("weights",), "Orthographic": ("xmag", "zfar", "znear"), "Perspective": ("aspectRatio", "zfar", "znear"),
    "Sampler": ("input", "interpolation", "minFilter", "output"), "Skin": ("skeleton",),
    "GLTF2": ("accessors", "animations", "asset", "bufferViews", "buffers", "cameras", "extensionsUsed", "images", "materials", "meshes",
              "nodes", "samplers", "scenes", "skins", "textures"),
}
_SCALARS: dict[Any, tuple[str, tuple[type, ...]]] = {
    int: ("an integer", (int,)), float: ("a number", (int, float)), str: ("a string", (str,)),
    bool: ("true or false", (bool,)),
}


def read_as(hint: Any, raw: object, place: str) -> Any:
    """Convert the JSON value `raw` to the type `hint`: a scalar, a list, a dict, or a dataclass of this file or of pygltflib.

    Unknown keys and `extras` are left out; null counts as a missing key. Raises InputError with the place of a value of another type, of
    a number that is not finite, or of a required key that is missing."""
    hint = _without_none(hint)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in _SCALARS:
        return _scalar(hint, raw, place)
    if origin is list:
        if not isinstance(raw, list):
            raise _wrong("an array", raw, place)
        return [read_as(arguments[0], item, f"{place}[{i}]") for i, item in enumerate(raw)]
    if not isinstance(raw, dict):
        raise _wrong("an object", raw, place)
    if origin is dict:
        return raw if arguments[1] is Any else {k: read_as(arguments[1], v, f"{place}.{k}") for k, v in raw.items()}
    if hint.__name__ == "Attributes":  # accessors by name, in the only class of pygltflib that is no dataclass
        return {k: read_as(int, v, f"{place}.{k}") for k, v in raw.items()}
    return _object(hint, raw, place)


def exactly(values: list[float], count: int, place: str) -> list[float]:
    """Return `values` unchanged. Raises InputError at `place` unless there are `count` values."""
    if len(values) != count:
        raise InputError(f"must hold {count} numbers, got {len(values)}", place=place)
    return values


def _object(cls: Any, raw: dict[str, Any], place: str) -> Any:
    for name in _required(cls):
        if raw.get(name) is None:
            raise InputError("is required", place=_join(place, name))
    return cls(**{name: read_as(hint, raw[name], _join(place, name)) for name, hint in _fields(cls).items() if raw.get(name) is not None})


@functools.cache
def _fields(cls: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.name not in ("extras", *_UNREAD.get(cls.__name__, ()))}


@functools.cache
def item_type(array: str) -> Any:
    """Return the class of pygltflib for the items of an array of a glTF file."""
    import pygltflib

    return typing.get_args(typing.get_type_hints(pygltflib.GLTF2)[array])[0]


@functools.cache
def _required(cls: Any) -> tuple[str, ...]:
    without_default = tuple(f.name for f in dataclasses.fields(cls)
                            if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING)
    return without_default + _REQUIRED.get(cls.__name__, ())


def _scalar(hint: Any, raw: Any, place: str) -> Any:
    expected, accepted = _SCALARS[hint]
    if hint is int and isinstance(raw, float) and raw.is_integer():
        raw = int(raw)  # JSON has one kind of number
    fits = isinstance(raw, accepted) and (hint is bool or not isinstance(raw, bool))
    if not fits:
        raise _wrong(expected, raw, place)
    if hint is int and not -(1 << 63) <= raw < 1 << 63:
        raise _wrong("an integer of at most 64 bits", raw, place)
    if hint is float:
        try:
            number = float(raw)
        except OverflowError:  # an integer beyond float64
            number = math.inf
        if not math.isfinite(number):
            raise _wrong("a finite number", raw, place)
        return number
    return raw


def _without_none(hint: Any) -> Any:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return next(argument for argument in typing.get_args(hint) if argument is not type(None))
    return hint


def _join(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _wrong(expected: str, raw: Any, place: str) -> InputError:
    return InputError(f"must be {expected}, got {short(raw)}", place=place or None)
