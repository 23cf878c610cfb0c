"""The formats to fuzz: for each, valid files, functions that damage them, and a function that reads them."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from tests.fuzz import seeds
from tests.fuzz.mutate import BYTES, INTEGERS, TEXT, mutate, mutate_tree
from tests.fuzz.seeds import Seed
from tests.gltf_files import pack_glb
from wrt.core.errors import InputError
from wrt.core.files import CHECKSUM_BYTES


@dataclass(frozen=True)
class Format:
    """A format of files, and how to test its reader."""

    seeds: Callable[[], list[Seed]]  # Returns valid files.
    damaged: Callable[[Seed, Seed, Random], Seed]  # Returns a damaged copy of the first file, sometimes with parts of the second.
    read: Callable[[Path], object]  # Any exception but InputError is a defect.
    names_sizes: bool = False  # A small file may ask for much memory (image sizes, subdivisions): MemoryError is no defect.


def make_case(form: Format, rng: Random) -> Seed:
    """Return a damaged file."""
    sound = form.seeds()
    return form.damaged(rng.choice(sound), rng.choice(sound), rng)


# --- scenes -----------------------------------------------------------------------------------------------------------


@cache
def toml_words() -> list[str]:
    """Return every key and every choice of the schema of scene files, and file names."""
    from wrt.io.load import schema

    found: set[str] = set()
    stack: list[Any] = [schema()]
    while stack:
        value = stack.pop()
        if isinstance(value, dict):
            found |= set(value.get("properties", {})) | {each for each in value.get("enum", []) if isinstance(each, str)}
            found |= {value["const"]} if isinstance(value.get("const"), str) else set()
            stack += value.values()
        elif isinstance(value, list):
            stack += value
    return sorted(found) + list(seeds.SIDE_FILES) + ["../a.png", "/dev/zero", "/dev/stdin", ".", "nowhere.obj", "pipe"]


def toml_text(value: Any) -> str:
    """Return a value as inline TOML; values without a TOML type become strings."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml_text(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    if isinstance(value, int | float):
        return repr(value)
    return json.dumps(value if isinstance(value, str) else str(value))


def damaged_toml(seed: Seed, other: Seed, rng: Random) -> Seed:
    import tomllib

    if rng.random() < 0.4:
        return Seed(".toml", mutate(seed.data, rng, TEXT + BYTES[:2], other.data))
    tree = mutate_tree(tomllib.loads(seed.data.decode()), rng, toml_words())
    if not isinstance(tree, dict):
        return seed
    return Seed(".toml", "\n".join(f"{json.dumps(key)} = {toml_text(value)}" for key, value in tree.items()).encode())


GLTF_WORDS = (
    "POSITION", "NORMAL", "TEXCOORD_0", "TANGENT", "TRANSLATION", "ROTATION", "SCALE", "byteOffset", "byteLength", "byteStride",
    "count", "sparse", "normalized", "componentType", "type", "mode", "indices", "uri", "bufferView", "extensions", "matrix",
    "children", "mesh", "camera", "weights", "translation", "rotation", "scale", "KHR_texture_transform",
    "EXT_mesh_gpu_instancing", "KHR_materials_unlit", "KHR_lights_punctual", "VEC2", "VEC4", "MAT4", "point", "directional",
    "a.png", "../a.png", "thing.glb", "/dev/zero", "pipe", "http://example.org/a.png",
    "data:application/octet-stream;base64,AAAA", "data:image/png;base64,!", "%00", "%2e%2e/a.png", ".",
)


def damaged_gltf(seed: Seed, other: Seed, rng: Random) -> Seed:
    """Damage the JSON, the buffer, or any bytes of the file. After damage to JSON or buffer, the sizes of the container are right."""
    glb = seed.suffix == ".glb"
    if rng.random() < 0.2:
        return Seed(seed.suffix, mutate(seed.data, rng, BYTES if glb else TEXT + BYTES[:2], other.data))
    tree, binary = gltf_parts(seed)
    if rng.random() < 0.8:
        return gltf_of(seed.suffix, mutate_tree(tree, rng, GLTF_WORDS), binary)
    return gltf_of(seed.suffix, tree, mutate(binary, rng, BYTES), True)


def gltf_parts(seed: Seed) -> tuple[Any, bytes]:
    """Return the JSON and the buffer of a valid file."""
    if seed.suffix == ".gltf":
        tree = json.loads(seed.data)
        return tree, base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2])
    length = struct.unpack_from("<I", seed.data, 12)[0]
    return json.loads(seed.data[20 : 20 + length]), seed.data[28 + length :]


def gltf_of(suffix: str, tree: Any, binary: bytes, encode: bool = False) -> Seed:
    """Return a file with this JSON and buffer; encode: write the buffer into the JSON of a .gltf."""
    if encode and suffix == ".gltf":
        tree["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(binary).decode()
    text = json.dumps(tree).encode()
    return Seed(suffix, pack_glb(text, binary) if suffix == ".glb" else text)


def read_scene(path: Path) -> object:
    from wrt.io.load import load_scene

    return load_scene(path)


# --- meshes -----------------------------------------------------------------------------------------------------------


def damaged_mesh(seed: Seed, other: Seed, rng: Random) -> Seed:
    text = b"\0" not in seed.data or rng.random() < 0.3
    return Seed(seed.suffix, mutate(seed.data, rng, TEXT + BYTES[:2] if text else BYTES, other.data))


def read_mesh(path: Path) -> object:
    from wrt.io.mesh_file import load_mesh

    return load_mesh(path)


# --- pictures ---------------------------------------------------------------------------------------------------------


def damaged_image(seed: Seed, other: Seed, rng: Random) -> Seed:
    if seed.data[:4] == b"\x89PNG" and rng.random() < 0.7:
        return Seed(seed.suffix, damaged_png(seed.data, rng))
    suffix = seed.suffix if rng.random() < 0.95 else other.suffix
    steps = TEXT + BYTES if seed.suffix == ".hdr" else BYTES
    return Seed(suffix, mutate(seed.data, rng, steps, other.data))


def damaged_png(data: bytes, rng: Random) -> bytes:
    """Change, delete or duplicate chunks; the checksums are right."""
    chunks = png_chunks(data)
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(chunks))
        kind, body = chunks[i]
        what = rng.randrange(8)
        if kind == b"IHDR" and what < 6:
            fields = list(struct.unpack(">IIBBBBB", body.ljust(13, b"\0")[:13]))
            j = rng.randrange(7)
            fields[j] = rng.choice(INTEGERS) & (0xFFFFFFFF if j < 2 else 0xFF) if rng.random() < 0.5 else rng.randrange(20)
            body = struct.pack(">IIBBBBB", *fields)
        elif what < 3:
            kind = rng.choice((b"IDAT", b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"iTXt", b"tEXt", b"acTL", b"fcTL", b"fdAT", b"gAMA",
                               b"eXIf", b"IEND"))
        elif what == 3 and kind == b"IDAT":
            with contextlib.suppress(zlib.error):
                body = zlib.compress(mutate(zlib.decompress(body), rng, BYTES))
        elif what == 4:
            chunks.insert(rng.randrange(len(chunks)), (kind, body))
        elif what == 5 and len(chunks) > 1:
            del chunks[i]
            continue
        else:
            body = mutate(body, rng, BYTES)
        chunks[i] = (kind, body)
    return png_of(chunks)


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    chunks, begin = [], 8
    while begin + 8 <= len(data):
        length = struct.unpack_from(">I", data, begin)[0]
        chunks.append((data[begin + 4 : begin + 8], data[begin + 8 : begin + 8 + length]))
        begin += 12 + length
    return chunks


def png_of(chunks: list[tuple[bytes, bytes]]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks)


def read_picture(path: Path) -> object:
    """Read the file as an environment and as a texture; raise InputError if both refuse it, or if memory ran out."""
    from wrt.picture.decode import decode_rgba8
    from wrt.picture.image import read_image

    results: list[object] = []
    for read in (read_image, lambda path: decode_rgba8(path.read_bytes())):
        try:
            results.append(read(path))
        except InputError as error:
            results.append(error)
    refused = [result for result in results if isinstance(result, InputError)]
    by_memory = [error for error in refused if isinstance(error.__cause__, MemoryError)]
    if len(refused) == len(results) or by_memory:
        raise (by_memory or refused)[0]
    return results


# --- checked files ----------------------------------------------------------------------------------------------------


ACCEL_WORDS = "bvh2", "bvh4", "bvh8", "bvh8c", "grid", "kdtree", "octree", "brute_force", "fast"


def damaged_checked(seed: Seed, other: Seed, rng: Random) -> Seed:
    """Damage the header or the arrays, usually with a right checksum, as an attacker would write it."""
    if rng.random() < 0.05:
        return Seed(seed.suffix, mutate(seed.data, rng, BYTES, other.data))
    magic, header, body = seed.data.split(b"\n", 2)
    body = body[:-CHECKSUM_BYTES]
    if rng.random() < 0.3:
        tree = mutate_tree(json.loads(header), rng, ("order",))
        header = json.dumps(tree).encode() if rng.random() < 0.9 else mutate(header, rng, TEXT)
    else:
        body = damaged_numbers(body, rng) if rng.random() < 0.8 else mutate(body, rng, BYTES)
    return signed(seed.suffix, magic, header, body)


def damaged_accel(seed: Seed, other: Seed, rng: Random) -> Seed:
    """Damage any bytes of an archive, or its header or an array, with right checksums, as an attacker would write it."""
    if rng.random() < 0.1:
        return Seed(seed.suffix, mutate(seed.data, rng, BYTES, other.data))
    with np.load(io.BytesIO(seed.data)) as file:
        arrays = dict(file)
    if rng.random() < 0.3:
        words = (*ACCEL_WORDS, "order", *arrays)
        header = mutate_tree(json.loads(str(arrays["header"])), rng, words)
        arrays["header"] = np.array(json.dumps(header))
    else:
        name = rng.choice(list(arrays))
        data = arrays[name].tobytes()
        data = damaged_numbers(data, rng) if rng.random() < 0.8 else mutate(data, rng, BYTES)
        kind = arrays[name].dtype if rng.random() < 0.9 else np.dtype(rng.choice(("u1", "<i4", "<f4", ">i4", "<i8")))
        array = np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], kind)
        arrays[name] = array.reshape(arrays[name].shape) if array.size == arrays[name].size else array
        if rng.random() < 0.05:
            del arrays[name]
    file = io.BytesIO()
    np.savez(file, **arrays)
    return Seed(seed.suffix, file.getvalue())


def signed(suffix: str, *parts: bytes) -> Seed:
    data = b"\n".join(parts)
    return Seed(suffix, data + zlib.crc32(data).to_bytes(CHECKSUM_BYTES, "big"))


def damaged_numbers(body: bytes, rng: Random) -> bytes:
    """Replace some 4-byte numbers: by other numbers of the same array, by neighbours, by extremes."""
    numbers = np.frombuffer(body[: len(body) // 4 * 4], "<u4").copy()
    for _ in range(rng.choice((1, 1, 1, 2, 5, 50)) if len(numbers) else 0):
        i = rng.randrange(len(numbers))
        special = (0, 1, 0xFFFFFFFF, 0x80000000, 0x7FFFFFFF, 0x7F800000, 0xFF800000, 0x7FC00000, 0x00000001, rng.randrange(200))
        numbers[i] = rng.choice((numbers[rng.randrange(len(numbers))], int(numbers[i]) + 1 & 0xFFFFFFFF,
                                 int(numbers[i]) - 1 & 0xFFFFFFFF, int(numbers[i]) ^ 1 << rng.randrange(32), rng.choice(special)))
    return numbers.tobytes() + body[len(numbers) * 4 :]


@cache
def ball() -> Any:
    from wrt.scene.shapes import icosphere

    return icosphere(1)


@cache
def rays() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return (2.0 * rng.normal(size=(24, 3))).astype(np.float32), rng.normal(size=(24, 3)).astype(np.float32)


@cache
def accel_seeds() -> list[Seed]:
    from wrt.accel.scenes.build import build
    from wrt.accel.structures import ACCELERATORS

    found = []
    with tempfile.TemporaryDirectory() as name:
        for accel in sorted({cls.name for cls in ACCELERATORS.values()}):
            for triangle in ("watertight", "moeller_trumbore"):
                path = Path(name) / "a.accel"
                build(ball(), accel, threads=1, triangle=triangle).save(path)
                found.append(Seed(".accel", path.read_bytes()))
        for accel in ("bvh2", "bvh8"):
            build(ball(), accel, threads=1).save(path, mesh=True)
            found.append(Seed(".accel", path.read_bytes()))
        build(scene(), threads=1).save(path, mesh=True)
        found.append(Seed(".accel", path.read_bytes()))
    return found


def scene() -> Any:
    """A scene with names, normals, texture coordinates and materials of faces."""
    from wrt.scene.materials import Material
    from wrt.scene.mesh import Mesh
    from wrt.scene.model import Object, Scene

    vertices, faces = ball().vertices, ball().faces
    mesh, shared = Mesh(vertices, faces, vertices, vertices[:, :2]), Material()
    pattern = Object(mesh, (shared, Material()), face_material=np.arange(len(faces)) % 2, name="a")
    return Scene((pattern, Object(ball(), (Material(),), name="b")))


def read_accel(path: Path) -> object:
    """Load the structure, trace rays and ask for all that hits know: only these show a bad reference."""
    accel = load_accel_only(path)
    hits = accel.closest_hit(*rays())
    for name in ("point", "normal", "shading_normal", "uv", "object", "material", "face"):
        with contextlib.suppress(InputError):  # the scene has none
            getattr(hits, name)
    return hits


def load_accel_only(path: Path) -> Any:
    from wrt.accel.scenes.build import load_accel

    holds_scene = b"mesh.vertices" in path.read_bytes()
    return load_accel(path, None if holds_scene else ball(), threads=1)


IDENTITY = {"seed": 0, "crop": [0, 0, 6, 4], "scene": "x", "kernels": "y"}


def checkpoint_of(path: Path, groups: int) -> tuple[Any, Any]:
    from wrt.core.device import start
    from wrt.renderer.checkpoint import Checkpoint
    from wrt.renderer.film import DeviceFilm
    from wrt.scene.settings import Settings

    film = DeviceFilm(Settings(size=(6, 4)), (0, 0, 6, 4), start("cpu"), 0, groups)
    return film, Checkpoint(path, 60.0, {**IDENTITY, "groups": groups}, resume=True)


@cache
def checkpoint_seeds() -> list[Seed]:
    found = []
    for groups in (1, 4):
        with tempfile.TemporaryDirectory() as name:
            film, checkpoint = checkpoint_of(Path(name) / "a.checkpoint", groups)
            rng = np.random.default_rng(0)
            for label, array in film.arrays():
                film.put(array, np.full((4, 6), 3) if label.startswith("samples") else rng.random(film.view(array).shape) * 9)
            checkpoint.save(film, 1.5)
            found.append(Seed(f".checkpoint{groups}", checkpoint.path.read_bytes()))
    return found


def read_checkpoint(path: Path) -> object:
    film, checkpoint = checkpoint_of(path, int(path.suffix[-1]))
    checkpoint.restore(film)
    return film.pixels_and_variance()


# --- pictures of damaged scenes ---------------------------------------------------------------------------------------


def scene_seeds() -> list[Seed]:
    return seeds.scenes() + seeds.gltf()


def damaged_scene(seed: Seed, other: Seed, rng: Random) -> Seed:
    """Damage a scene; take parts only from a scene of the same format."""
    if other.suffix != seed.suffix:
        other = seed
    return damaged_toml(seed, other, rng) if seed.suffix == ".toml" else damaged_gltf(seed, other, rng)


def render_scene(path: Path) -> object:
    """Render 8x8 pixels of the scene; pixels that are not finite are a defect.

    All scenes with the same background share a kernel with nearly all features, to save compile time. That kernel needs normals,
    so scenes without normals get zeros.
    """
    from dataclasses import fields
    from unittest import mock

    from wrt.kernels.shade.features import Features
    from wrt.renderer import plan
    from wrt.renderer.plan import STACK_STEP
    from wrt.renderer.render import render
    from wrt.scene.lights import EMISSIVE, LIGHTS
    from wrt.scene.materials import MATERIALS

    scene = load_scene_with_normals(path)
    switches = {each.name: True for each in fields(Features) if each.type is bool}
    switches |= dict.fromkeys(("instances", "independent", "schlick", "counting"), False)
    features = Features(**switches, materials=tuple(MATERIALS), lights=(*LIGHTS, *EMISSIVE), background=scene.background.kind,
                        stack_size=9 * STACK_STEP)
    with mock.patch.object(plan, "features_of", lambda *arguments: features):
        film = render(scene, size=(8, 8), spp=1, instancing="never", threads=1, aov=("depth", "normal"))
    if not np.isfinite(film.pixels).all() or np.isnan(film.aov["depth"]).any() or not np.isfinite(film.aov["normal"]).all():
        raise ArithmeticError("the picture is not finite")
    return film


def load_scene_with_normals(path: Path) -> Any:
    from wrt.io.load import load_scene

    scene = load_scene(path)
    if scene.objects and all(thing.mesh.normals is None for thing in scene.objects):
        first = scene.objects[0]
        mesh = replace(first.mesh, normals=np.zeros_like(first.mesh.vertices))
        scene = replace(scene, objects=(replace(first, mesh=mesh, motion=None), *scene.objects[1:]))
    return scene


# A run without --format takes FORMATS; SLOW_FORMATS also render.
FORMATS: dict[str, Format] = {
    "toml": Format(seeds.scenes, damaged_toml, read_scene, names_sizes=True),
    "gltf": Format(seeds.gltf, damaged_gltf, read_scene, names_sizes=True),
    "obj": Format(seeds.obj, damaged_mesh, read_mesh),
    "ply": Format(seeds.ply, damaged_mesh, read_mesh),
    "stl": Format(seeds.stl, damaged_mesh, read_mesh),
    "image": Format(seeds.images, damaged_image, read_picture, names_sizes=True),
    "accel": Format(accel_seeds, damaged_accel, read_accel),
    "checkpoint": Format(checkpoint_seeds, damaged_checked, read_checkpoint),
}
SLOW_FORMATS = {"render": Format(scene_seeds, damaged_scene, render_scene, names_sizes=True)}
ALL_FORMATS = {**FORMATS, **SLOW_FORMATS}
