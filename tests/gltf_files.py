"""Build small glTF files: arrays become accessors, and the JSON is a plain dict that a test may change."""

from __future__ import annotations

import base64
import io
import json
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.errors import SceneWarning
from wrt.io.gltf.reader import load_gltf

COMPONENT = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
KIND = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


class GltfFile:
    """The JSON and the buffer of a glTF file. Methods append to both, and return the index of the new item in its JSON array."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}}
        self.binary = bytearray()

    def add(self, array: str, item: dict[str, Any]) -> int:
        self.json.setdefault(array, []).append(item)
        return len(self.json[array]) - 1

    def view(self, data: bytes, **rest: Any) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        start = len(self.binary)
        self.binary += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data), **rest})

    def accessor(self, values: Any, dtype: str = "float32", **rest: Any) -> int:
        array = np.ascontiguousarray(values, dtype=dtype)
        width = array.shape[1] if array.ndim == 2 else 1
        return self.add("accessors", {"bufferView": self.view(array.tobytes()), "componentType": COMPONENT[dtype],
                                      "count": len(array), "type": KIND[width], **rest})

    def primitive(self, vertices: Any = TRIANGLE, indices: Any = None, **rest: Any) -> dict[str, Any]:
        item = {"attributes": {"POSITION": self.accessor(vertices)}, **rest}
        return item if indices is None else {**item, "indices": self.accessor(indices, "uint32")}

    def mesh(self, *primitives: dict[str, Any], **rest: Any) -> int:
        return self.add("meshes", {"primitives": list(primitives), **rest})

    def node(self, **fields: Any) -> int:
        """Add a node: a root of the default scene, unless another node lists it as a child."""
        return self.add("nodes", fields)

    def image(self, pixels: np.ndarray, format: str = "PNG") -> int:
        view = self.view(encode(pixels, format))
        return self.add("images", {"bufferView": view, "mimeType": f"image/{format.lower()}"})

    def write(self, folder: Path, name: str = "file.glb") -> Path:
        """Write a .glb, or a .gltf with its buffer as a data: URI; return the path."""
        document = dict(self.json)
        if self.binary:
            document.setdefault("buffers", [{"byteLength": len(self.binary)}])
        path = folder / name
        if path.suffix == ".glb":
            path.write_bytes(pack_glb(json.dumps(document).encode(), bytes(self.binary)))
            return path
        if self.binary and "uri" not in document["buffers"][0]:
            encoded = base64.b64encode(bytes(self.binary)).decode()
            document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + encoded
        path.write_text(json.dumps(document))
        return path


def pack_glb(text: bytes, binary: bytes = b"") -> bytes:
    chunks = b""
    for kind, data, pad in ((b"JSON", text, b" "), (b"BIN\0", binary, b"\0")):
        data += pad * (-len(data) % 4)
        chunks += struct.pack("<I", len(data)) + kind + data if data else b""
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def encode(pixels: np.ndarray, format: str = "PNG") -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format)
    return stream.getvalue()


def one_triangle(**primitive: Any) -> GltfFile:
    """Return a file with one node that shows one triangle; keywords become fields of its primitive."""
    file = GltfFile()
    file.node(mesh=file.mesh(file.primitive(**primitive), name="thing"), name="place")
    return file


def one_material(material: dict[str, Any]) -> GltfFile:
    """Return a file with one quad with texture coordinates and that material."""
    file = GltfFile()
    quad = file.primitive([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [0, 1, 2, 0, 2, 3],
                          material=file.add("materials", material))
    quad["attributes"]["TEXCOORD_0"] = file.accessor([[0, 1], [1, 1], [1, 0], [0, 0]])
    file.node(mesh=file.mesh(quad))
    return file


def with_light(light: Any, **node: Any) -> GltfFile:
    """Return a file with a triangle, and a node with that punctual light; keywords become fields of the light's node."""
    file = one_triangle()
    file.json["extensions"] = {"KHR_lights_punctual": {"lights": [light]}}
    file.node(extensions={"KHR_lights_punctual": {"light": 0}}, **node)
    return file


def load_warned(path: Path, **options: Any) -> tuple[Any, list[str]]:
    """Return the scene of a glTF file, and the texts of its warnings; all warnings must be SceneWarnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load_gltf(path, **options)
    assert all(w.category is SceneWarning for w in caught)
    return scene, [str(w.message) for w in caught]


def rich_file() -> GltfFile:
    """Return a small file that uses nearly every feature that the reader supports."""
    file = with_light({"type": "spot", "spot": {"innerConeAngle": 0.1}}, translation=[0, 1, 0], rotation=[0, 0, 0, 1])
    rows, values = file.view(bytes([1])), file.view(np.ones(3, np.float32).tobytes())
    texture = {"index": file.add("textures", {"source": file.image(np.zeros((2, 2, 4), np.uint8)), "sampler": 0})}
    file.add("samplers", {"wrapS": 33071})
    material = file.add("materials", {
        "pbrMetallicRoughness": {"baseColorTexture": {
            **texture, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}},
        "alphaMode": "MASK", "alphaCutoff": 0.4, "emissiveFactor": [1, 0, 0], "normalTexture": {**texture, "scale": 2},
        "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_ior": {"ior": 1.4},
                       "KHR_materials_volume": {"thicknessFactor": 1, "attenuationDistance": 2}}})
    primitive = file.primitive([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [0, 1, 2, 3], mode=5, material=material)
    file.json["accessors"][primitive["attributes"]["POSITION"]]["sparse"] = {
        "count": 1, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}}
    primitive["attributes"]["TEXCOORD_0"] = file.accessor([[0, 0], [9, 0], [0, 9], [9, 9]], "uint8", normalized=True)
    instances = {"TRANSLATION": file.accessor(TRIANGLE)}
    leaf = file.node(mesh=file.mesh(primitive), extensions={"EXT_mesh_gpu_instancing": {"attributes": instances}})
    file.node(children=[leaf], matrix=np.eye(4).ravel().tolist())
    file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}))
    file.json |= {"scenes": [{"nodes": [0, 1, 3, 4]}], "scene": 0, "extensionsUsed": ["KHR_materials_ior"]}
    return file
