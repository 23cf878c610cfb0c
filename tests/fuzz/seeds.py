"""Valid files to damage: small, generated here, and together with nearly every feature that the readers support."""

from __future__ import annotations

import io
import json
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from docs.site.scene_format import EXAMPLE
from tests.command_line import BOX_OBJ
from tests.gltf_files import one_triangle, rich_file
from wrt.picture.image import encode_png, write_exr, write_image

SIDE_FILES = ("a.png", "sky.hdr", "sky.exr", "box.obj", "ball.ply", "part.stl", "thing.glb", "thing.gltf")


class Seed(NamedTuple):
    """The suffix and the bytes of a file."""

    suffix: str
    data: bytes


def side_files(folder: Path) -> None:
    """Write the files that the scenes refer to."""
    (folder / "a.png").write_bytes(_png())
    (folder / "sky.hdr").write_bytes(_linear(".hdr"))
    (folder / "sky.exr").write_bytes(_linear(".exr"))
    (folder / "box.obj").write_text(BOX_OBJ)
    (folder / "ball.ply").write_bytes(ply()[0].data)
    (folder / "part.stl").write_bytes(stl()[0].data)
    rich_file().write(folder, "thing.glb")
    one_triangle().write(folder, "thing.gltf")


# --- scenes -----------------------------------------------------------------------------------------------------------

SCENE = """\
title = "what needs other files"
ambient = 0.1
include = ["thing.glb", {file = "thing.gltf", transform = {translate = [0, 1, 0], axis = [0, 1, 0], angle = 30}}]

[cameras.lens]
matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 5, 0, 0, 0, 1]
aperture_radius = 0.05
blades = 6

[background]
type = "environment"
file = "sky.hdr"
rotation = 20
scale = 0.5

[materials]
floor = {albedo = 0.5, albedo_texture = {checkerboard = {color_a = 0.8, color_b = [0.1, 0.2, 0.3], scale = 2}}}
metal = {kind = "conductor", metal = "gold", roughness = 0.2}
leaf = {albedo_texture = {file = "a.png", wrap = "clamp", scale = 2, rotation = 20, offset = [-0.1, 0.2]}, alpha_mode = "mask"}
rough = {kind = "metallic_roughness", metallic_roughness_texture = {file = "a.png"}, normal_texture = {file = "a.png"}}
lamp = {albedo = 0, emission = 5, two_sided = true, alpha = 0.5, alpha_mode = "blend"}

[override]
"material 0" = {kind = "mirror", albedo = 0.9}

[[meshes]]
file = "box.obj"
material = "leaf"
parts = [{first = 0, count = 4, material = "lamp"}]
smooth = true

[[meshes]]
file = "ball.ply"
material = "rough"
instances = [{translate = [1, 0, 0]}, {translate = [2, 0, 0], scale = [1, 2, 1]}]
motion = [{translate = [0, 0, 0]}, {translate = [0, 1, 0], rotate = [0, 90, 0]}]

[[meshes]]
shape = {kind = "lathe", profile = [[0, 0], [1, 0], [1, 1], [0, 1]], segments = 8}
morph = {shape = {kind = "lathe", profile = [[0, 0], [2, 0], [1, 1], [0, 1]], segments = 8}}
material = "metal"

[[meshes]]
shape = {kind = "tube", points = [[0, 0, 0], [0, 1, 0], [0.5, 1.5, 0]], radius = [0.1, 0.2, 0.1], segments = 6}
material = "metal"

[[meshes]]
file = "part.stl"
material = "floor"

[[lights]]
type = "spot"
position = [0, 3, 0]
direction = [0, -1, 0]
intensity = [5, 5, 4]
inner = 10
outer = 20
"""


def scenes() -> list[Seed]:
    return [Seed(".toml", SCENE.encode()), Seed(".toml", EXAMPLE.encode())]


@cache
def gltf() -> list[Seed]:
    with tempfile.TemporaryDirectory() as name:
        paths = [rich_file().write(Path(name), "a.glb"), rich_file().write(Path(name), "a.gltf"),
                 one_triangle().write(Path(name), "b.gltf")]
        document = json.loads(paths[1].read_text())
        document["images"] = [{"uri": "a.png"}]
        outside = Seed(".gltf", json.dumps(document).encode())
        return [*(Seed(path.suffix, path.read_bytes()) for path in paths), outside]


# --- meshes -----------------------------------------------------------------------------------------------------------


def obj() -> list[Seed]:
    rich = (
        "mtllib a.mtl\no first\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0 0.5 0.5 0.5\nv 0.5 0.2 0\nvt 0 0\nvt 1 0 0\nvt 1 1\n"
        "vn 0 0 1\nvn 0 1 0\nusemtl red\nf 1/1/1 2/2/1 3/3/2\ns off\nusemtl blue\nf 1//1 3//1 4//2\ng a b\n"
        "f -5/-3 -4/-2 \\\n -1/-1\nf 1 2 3 5 4\nl 1 2\np 1\n# end\n"
    )
    star = "".join(f"v {np.cos(a) * r:.4f} {np.sin(a) * r:.4f} 0\n"
                   for a, r in zip(np.arange(20) * np.pi / 10, [1, 0.4] * 10, strict=True))
    return [Seed(".obj", text.encode()) for text in (BOX_OBJ, rich, f"{star}f {' '.join(map(str, range(1, 21)))}\n")]


@cache
def ply() -> list[Seed]:
    """Return text files, and binary files in both byte orders; with quads, uvs of vertices and faces, and other elements."""
    corners = [(0, 0, 0, 0, 0, 1, 0, 0), (1, 0, 0, 0, 0, 1, 1, 0), (1, 1, 0, 0, 0, 1, 1, 1), (0, 1, 0, 0, 0, 1, 0, 1)]
    names = ("x", "y", "z", "nx", "ny", "nz", "s", "t")

    def header(form: str, uvs: bool) -> str:
        rows = "".join(f"property float {name}\n" for name in names[: 8 if uvs else 6])
        texcoord = "" if uvs else "property list uchar float texcoord\n"
        return (
            f"ply\nformat {form} 1.0\ncomment made here\nelement vertex 4\n{rows}element face 2\n"
            f"property list uchar int vertex_indices\n{texcoord}element edge 1\nproperty double w\nproperty ushort k\nend_header\n"
        )

    text = header("ascii", True) + "".join(" ".join(map(str, row)) + "\n" for row in corners) + "3 0 1 2\n4 0 1 2 3\n0.5 7\n"
    uv = "6 0 0 1 0 1 1\n"
    text_uv = header("ascii", False) + "".join(" ".join(map(str, row[:6])) + "\n" for row in corners)
    text_uv += f"3 0 1 2 {uv}3 0 2 3 {uv}0.5 7\n"
    binary = []
    for form, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        for faces in ([(0, 1, 2), (0, 2, 3)], [(0, 1, 2), (0, 1, 2, 3)]):
            body = np.array(corners, order + "f4").tobytes()
            body += b"".join(bytes([len(face)]) + np.array(face, order + "i4").tobytes() for face in faces)
            edge = np.array(0.5, order + "f8").tobytes() + np.array(7, order + "u2").tobytes()
            binary.append(Seed(".ply", header(form, True).encode() + body + edge))
    return [Seed(".ply", text.encode()), Seed(".ply", text_uv.encode()), *binary]


@cache
def stl() -> list[Seed]:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], "<f4")
    record = np.zeros(2, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corners"] = corners
    binary = b"made here".ljust(80) + np.uint32(2).tobytes() + record.tobytes()
    facets = ["facet normal 0 0 1\n outer loop\n" + "".join(f"  vertex {x:g} {y:g} {z:g}\n" for x, y, z in each)
              + " endloop\nendfacet\n" for each in corners]
    text = f"solid one\n{facets[0]}endsolid one\nsolid two\n{facets[1]}{facets[0]}endsolid two\n"
    return [Seed(".stl", binary), Seed(".stl", text.encode())]


# --- pictures ---------------------------------------------------------------------------------------------------------


def _picture(height: int = 5, width: int = 8) -> np.ndarray:
    return np.random.default_rng(0).random((height, width, 3)).astype(np.float32)


def _png(bits: type = np.uint8) -> bytes:
    return encode_png((_picture() * np.iinfo(bits).max).astype(bits))


def _linear(suffix: str, **options: int) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / f"a{suffix}"
        write_image(path, _picture(), **options)
        return path.read_bytes()


@cache
def images() -> list[Seed]:
    from PIL import Image

    rgba = np.dstack([(_picture() * 255).astype(np.uint8), np.full((5, 8), 99, np.uint8)])
    seeds = [Seed(".png", _png()), Seed(".png", _png(np.uint16)), Seed(".exr", _linear(".exr")),
             Seed(".exr", _linear(".exr", bits=16)), Seed(".hdr", _linear(".hdr"))]
    for suffix, form, mode in (
            (".png", "PNG", "RGBA"), (".png", "PNG", "P"), (".png", "PNG", "1"), (".png", "PNG", "I;16"), (".jpg", "JPEG", "RGB"),
            (".jpg", "JPEG", "CMYK"), (".webp", "WEBP", "RGBA"), (".bmp", "BMP", "RGB"), (".tga", "TGA", "RGBA"),
            (".png", "GIF", "P"), (".png", "AVIF", "RGB"), (".png", "TIFF", "RGB"), (".png", "PPM", "RGB")):
        buffer = io.BytesIO()
        picture = Image.fromarray(rgba)
        picture = Image.fromarray(rgba[..., 0].astype(np.uint16) * 257) if mode == "I;16" else picture.convert("RGB").convert(mode)
        picture.save(buffer, form)
        seeds.append(Seed(suffix, buffer.getvalue()))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "a.exr"
        red, green, blue = np.moveaxis(_picture(), 2, 0)
        write_exr(path, {"depth.Z": red, "R": red, "G": green, "B": blue}, {"note": "x"})
        seeds.append(Seed(".exr", path.read_bytes()))
    return seeds
