"""Files that repeat one piece, as long as wanted: what shows time or memory that grows faster than the file does.

Each maker in GROWN takes a number of bytes and gives a file of about that size, the same bytes each time.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from tests.fuzz.seeds import Seed
from tests.gltf_files import pack_glb

Maker = Callable[[int], Seed]


def repeated(suffix: str, piece: str, size: int, before: str = "", after: str = "") -> Seed:
    """`piece` again and again; {i} in it is the number of the repetition, from 1."""
    if "{i}" not in piece:
        times = max(1, size // len(piece.encode()))
        return Seed(suffix, (before + piece * times + after).encode())
    head, *rest = piece.split("{i}")
    parts, length, i = [before], 0, 0
    while length < size:
        i += 1
        parts.append(head + "".join(str(i) + each for each in rest))
        length += len(parts[-1])
    return Seed(suffix, "".join([*parts, after]).encode())


# --- TOML -------------------------------------------------------------------------------------------------------------

BALL = '[[spheres]]\ncenter = [0, 0, -3]\nradius = 1\nmaterial = "m"\n'
MESH = "materials.m = {}\n[[meshes]]\nmaterial = 'm'\n"
TOML = {
    "dotted key": ("a.", "", "a = 1"),
    "dotted key, quoted": ('"a".', "", "a = 1"),
    "dotted keys": ("k{i}.a.b.c.d.e = 1\n", "", ""),
    "dotted keys of two": ("k{i}.a=1\n", "", ""),
    "dotted header": ("a.", "[", "a]"),
    "dotted header and keys": ("k{i} = 1\n", "[a.b.c.d.e.f.g.h]\n", ""),
    "headers": ("[k{i}]\n", "", ""),
    "headers of arrays": ("[[k{i}]]\n", "", ""),
    "keys": ("k{i}=1\n", "", ""),
    "keys of arrays": ("k{i}=[]\n", "", ""),
    "long key": ("a", "", " = 1"),
    "comments": ("#\n", "", BALL),
    "long comment": ("#", "", "\n" + BALL),
    "blank lines": ("\n", "", BALL),
    "string": ("a", 'title = "', '"\n' + BALL),
    "string of escapes": ("\\n", 'title = "', '"\n' + BALL),
    "string of lines": ("a\n", 'title = """', '"""\n' + BALL),
    "string of quotes": ('""\\"', 'title = """', ' """\n' + BALL),
    "literal string of lines": ("''a\n", "title = '''", "'''\n" + BALL),
    "string past the BMP": ("\U0001f600", 'title = "', '"\n' + BALL),
    "numbers": ("1.5, ", "x = [", "]"),
    "integers": ("{i}, ", "x = [", "]"),
    "arrays": ("[],", "x = [", "]"),
    "tables in arrays": ("{{}},".replace("{{", "{").replace("}}", "}"), "x = [", "]"),
    "inline table": ("k{i}=1,", "x = {", "a=1}"),
    "inline table of arrays": ("k{i}=[],", "x = {", "a=1}"),
    "inline table of dotted keys": ("k{i}.a=1,", "x = {", "a=1}"),
    "nested arrays": ("[", "x = ", ""),
    "digits": ("1", "x = ", ""),
    "digits with marks": ("1_", "x = ", "1"),
    "float": ("1", "x = 0.", ""),
    "hexadecimal": ("f", "x = 0x", ""),
    "spheres": (BALL, "materials.m = {}\n", ""),
    "spheres, inline": ('{center=[0,0,-3],radius=1,material="m"},', "materials.m = {}\nspheres=[", "]"),
    "spheres without anything": ("[[spheres]]\n", "", ""),
    "meshes without anything": ("{},", "meshes=[", "]"),
    "spheres of no material": (BALL.replace('"m"', '"k{i}"'), "materials.m = {}\n", ""),
    "unknown keys": ("k{i}=1\n", BALL, ""),
    "materials": ("k{i}={{}}\n".replace("{{", "{").replace("}}", "}"), "[materials]\n", ""),
    "cameras": ("k{i}={position=[0,0,1],target=[0,0,0]}\n", "materials.m = {}\n" + BALL + "[cameras]\n", ""),
    "points of a tube": ("[{i},0,0],", MESH + "shape = {kind='tube',segments=3,points=[", "]}"),
    "instances": ("{},", MESH + "shape={kind='prism'}\ninstances=[", "]"),
    "parts": ("{first=0,count=1,material='m'},", MESH + "file='box.obj'\nparts=[", "]"),
    "includes": ("'thing.gltf',", "include = [", "]"),
    "lights": ("{type='point',position=[0,1,0],intensity=1},", "materials.m = {}\nlights = [", "]\n" + BALL),
}

# --- meshes -----------------------------------------------------------------------------------------------------------

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n"
OBJ = {
    "positions": ("v 0 0 0\n", "", "f 1 2 3\n"),
    "positions of many digits": ("v 10.123456 -20.123456 30.123456\n", "", "f 1 2 3\n"),
    "texture coordinates": ("vt 0\n", CORNERS, "f 1 2 3\n"),
    "faces": ("f 1 2 3\n", CORNERS, ""),
    "relative faces": ("f -3 -2 -1\n", CORNERS, ""),
    "faces of four": ("f 1 2 3 1\n", CORNERS, ""),
    "faces of one": ("f 1\n", CORNERS, "f 1 2 3\n"),
    "face line": (" 1 2 3", CORNERS + "f", "\n"),
    "face line of slashes": (" 1/1/1 2/1/1 3/1/1", CORNERS + "f", "\n"),
    "relative face line": (" -3 -2 -1", CORNERS + "f", "\n"),
    "face line of different corners": (" 1/{i}", CORNERS + "f", "\n"),
    "positions and faces": ("v {i} 0 1\nv {i} 1 0\nv {i} 0 0\nf -3 -2 -1\n", "", ""),
    "different corners": ("vt {i} 0\nf 1/{i} 2/{i} 3/{i}\n", CORNERS.replace("vt 0 0\n", ""), ""),
    "continued lines": ("\\\n", CORNERS + "f 1 2 3 ", "\n"),
    "continued face": ("1 2 3 \\\n", CORNERS + "f ", "\n"),
    "continued comment": ("# \\\n", CORNERS + "f 1 2 3\n# ", "\n"),
    "blank lines": ("\n", CORNERS, "f 1 2 3\n"),
    "spaces": (" ", CORNERS + "f 1 2 3", "\n"),
    "comments": ("#\n", CORNERS, "f 1 2 3\n"),
    "long comment": ("# ", CORNERS, "\nf 1 2 3\n"),
    "lines past latin-1": ("\u0800 \n", CORNERS, "f 1 2 3\n"),
    "groups": ("g\n", CORNERS, "f 1 2 3\n"),
    "group names": ("g {i}\n", CORNERS, "f 1 2 3\n"),
    "group of a long name": ("g", CORNERS, "\nf 1 2 3\n"),
    "groups of a face": ("g {i}\nf 1 2 3\n", CORNERS, ""),
    "materials": ("usemtl {i}\nf 1 2 3\nusemtl 1\n", CORNERS, ""),
    "numbers of a position": (" 1", "v 0 0 0", "\n" + CORNERS + "f 1 2 3\n"),
}


def ply_header(vertices: int, faces: int, extra: str = "", form: str = "ascii", count: str = "uint", index: str = "int") -> str:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return (f"ply\nformat {form} 1.0\n{extra}element vertex {vertices}\n{axes}element face {faces}\n"
            f"property list {count} {index} vertex_indices\nend_header\n")


PLY_CORNERS = "0 0 0\n1 0 0\n0 1 0\n"


def ply_rows(size: int, piece: str, corners: str = PLY_CORNERS) -> Seed:
    times = max(1, size // len(piece))
    return Seed(".ply", (ply_header(3, times) + corners + piece * times).encode())


def ply_vertices(size: int) -> Seed:
    times = max(3, size // 6)
    return Seed(".ply", (ply_header(times, 1) + "0 1 2\n" * times + "3 0 1 2\n").encode())


def ply_long_face(size: int) -> Seed:
    times = max(1, size // 6)
    return Seed(".ply", (ply_header(3, 1) + PLY_CORNERS + str(3 * times) + " " + "0 1 2 " * times + "\n").encode())


def ply_mixed(size: int) -> Seed:
    times = max(1, size // 15)
    return Seed(".ply", (ply_header(3, 2 * times) + PLY_CORNERS + "3 0 1 2\n1 0\n" * times).encode())


def ply_binary(size: int, sizes: tuple[int, ...]) -> Seed:
    """Faces of such sizes by turns, an index a byte."""
    rows = b"".join(bytes([n]) + bytes(i % 3 for i in range(n)) for n in sizes)
    times = max(1, size // len(rows))
    header = ply_header(3, times * len(sizes), "", "binary_little_endian", "uchar", "uchar")
    return Seed(".ply", header.encode() + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + rows * times)


def ply_properties(size: int) -> Seed:
    """Rows of many properties, half of them in the header."""
    times = max(1, min(size // 40, 25_000))
    extra = f"element thing {max(1, size // 4 // times)}\n" + "".join(f"property char p{i}\n" for i in range(times))
    body = b"\0" * (times * max(1, size // 4 // times))
    header = ply_header(3, 1, extra, "binary_little_endian", "uchar", "uchar")
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    return Seed(".ply", header.encode() + body + corners + bytes([3, 0, 1, 2]))


def ply_header_lines(size: int, piece: str) -> Seed:
    extra = piece * max(1, min(size, 1 << 19) // len(piece))
    return Seed(".ply", (ply_header(3, 1, extra) + PLY_CORNERS + "3 0 1 2\n").encode())


def ply_strips(size: int) -> Seed:
    times = max(1, size // 9)
    header = ply_header(3, 1).replace("element face", "element tristrips")
    return Seed(".ply", (header + PLY_CORNERS + str(4 * times) + " " + "0 1 2 -1 " * times + "\n").encode())


PLY: dict[str, Maker] = {
    "vertices": ply_vertices,
    "faces": partial(ply_rows, piece="3 0 1 2\n"),
    "faces of many lengths": ply_mixed,
    "long face": ply_long_face,
    "binary faces": partial(ply_binary, sizes=(3,)),
    "binary faces of 255": partial(ply_binary, sizes=(255,)),
    "binary faces of many lengths": partial(ply_binary, sizes=(3, 4, 1)),
    "properties": ply_properties,
    "comments": partial(ply_header_lines, piece="comment\n"),
    "elements": partial(ply_header_lines, piece="element x 0\nproperty int a\n"),
    "strips": ply_strips,
}

FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
SHORT_FACET = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
STL = {
    "facets": (FACET, "solid a\n", "endsolid a\n"),
    "bare facets": (SHORT_FACET, "solid a\n", "endsolid a\n"),
    "solids": ("solid\nendsolid\n", f"solid\n{FACET}endsolid\n", ""),
    "solids of a facet": (f"solid\n{SHORT_FACET}endsolid\n", "", ""),
    "solids of names": ("solid a_{i}\nendsolid\nsolid a\nendsolid\n", f"solid\n{FACET}endsolid\n", ""),
    "blank lines": ("\n", "solid\n" + FACET, "endsolid\n"),
    "lines of spaces": ("  \n", "solid\n" + FACET, "endsolid\n"),
    "long line": (" ", "solid\n" + FACET, "endsolid\n"),
}


def stl_binary(size: int) -> Seed:
    times = max(1, size // 50)
    record = np.zeros(1, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corners"] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    return Seed(".stl", b"made here".ljust(80) + np.uint32(times).tobytes() + record.tobytes() * times)


# --- glTF -------------------------------------------------------------------------------------------------------------

TRIANGLE = base64.b64encode(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()).decode()
ACCESSOR = '{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}'
PRIMITIVE = '{"attributes":{"POSITION":0}}'


def gltf(size: int, array: str, piece: str, **others: str) -> Seed:
    """A triangle, with `piece` repeated behind an array's own items, or where an @ stands; others: in place of usual members."""
    members = {
        "asset": '{"version":"2.0"}', "scenes": '[{"nodes":[0]}]', "nodes": '[{"mesh":0}]',
        "meshes": f'[{{"primitives":[{PRIMITIVE}]}}]', "accessors": f"[{ACCESSOR}]",
        "bufferViews": '[{"buffer":0,"byteLength":36}]', "buffers": f'[{{"byteLength":36,"uri":"data:;base64,{TRIANGLE}"}}]',
        **others,
    }
    own = members.get(array, "[]")
    more = repeated("", piece, size).data.decode().rstrip(",")
    members[array] = own.replace("@", more) if "@" in own else own[:-1] + ("," if own != "[]" else "") + more + "]"
    return Seed(".gltf", ("{" + ",".join(f'"{key}":{value}' for key, value in members.items()) + "}").encode())


def gltf_chain(size: int) -> Seed:
    times = max(1, size // 22)
    nodes = "[" + ",".join(f'{{"children":[{i + 1}]}}' for i in range(times)) + ',{"mesh":0}]'
    return gltf(0, "extras", "0,", nodes=nodes)


def gltf_children(size: int) -> Seed:
    times = max(1, size // 12)
    nodes = '[{"children":[' + ",".join(map(str, range(1, times + 1))) + "]}," + ",".join(['{"mesh":0}'] * times) + "]"
    return gltf(0, "extras", "0,", nodes=nodes)


def gltf_product(size: int) -> Seed:
    """As many nodes as primitives of their mesh."""
    times = max(1, size // 45)
    nodes = "[" + ",".join(['{"mesh":0}'] * times) + "]"
    primitives = ",".join([PRIMITIVE] * times)
    return gltf(0, "extras", "0,", nodes=nodes, scenes=json.dumps([{"nodes": list(range(times))}]),
                meshes=f'[{{"primitives":[{primitives}]}}]')


def gltf_large_mesh(size: int) -> Seed:
    """Half of it the positions of one mesh, half of it nodes that show it."""
    count, times = max(3, size // 24) // 3 * 3, max(1, size // 40)
    positions = np.tile(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), (count // 3, 1)).tobytes()
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(times))}], "nodes": [{"mesh": 0}] * times,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "buffers": [{"byteLength": len(positions)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(positions)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
    }
    return Seed(".glb", pack_glb(json.dumps(document).encode(), positions))


def gltf_same_bytes(size: int) -> Seed:
    """Many accessors of one buffer's bytes, each the positions of a mesh."""
    times = max(1, size // 2 // 200)
    count = max(3, size // 2 // 12) // 3 * 3
    positions = np.tile(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), (count // 3, 1)).tobytes()
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": i}} for i in range(times)]}],
        "buffers": [{"byteLength": len(positions)}], "bufferViews": [{"buffer": 0, "byteLength": len(positions)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}] * times,
    }
    return Seed(".glb", pack_glb(json.dumps(document).encode(), positions))


def gltf_data(size: int, payload: str, kind: str = ";base64") -> Seed:
    times = max(9, size // len(payload))
    return gltf(0, "extras", "0,", buffers=f'[{{"byteLength":36,"uri":"data:{kind},{payload * times}"}}]')


def gltf_strip(size: int, mode: int) -> Seed:
    """One strip (or fan, or list) over a byte an index."""
    indices = bytes(i % 3 for i in range(max(3, size)))
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    document = {
        "asset": {"version": "2.0"}, "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "buffers": [{"byteLength": 36 + len(indices)}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": len(indices)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5121, "count": len(indices), "type": "SCALAR"}],
    }
    return Seed(".glb", pack_glb(json.dumps(document).encode(), positions + indices))


def glb_chunks(size: int) -> Seed:
    data = gltf(0, "extras", "0,").data
    data += b" " * (-len(data) % 4)
    body = struct.pack("<I", len(data)) + b"JSON" + data + (struct.pack("<I", 0) + b"xxxx") * max(1, size // 8)
    return Seed(".glb", b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)


EVERY_NODE = '{"mesh":0},'
GLTF: dict[str, Maker] = {
    "empty nodes": partial(gltf, array="nodes", piece="{},"),
    "mesh nodes": partial(gltf, array="nodes", piece=EVERY_NODE, scenes="[]"),
    "named nodes": partial(gltf, array="nodes", piece='{"mesh":0,"name":"n{i}","translation":[{i},0,0]},', scenes="[]"),
    "skinned nodes": partial(gltf, array="nodes", piece='{"mesh":0,"skin":0,"name":"n{i}"},', scenes="[]"),
    "chain of nodes": gltf_chain,
    "children": gltf_children,
    "nodes times primitives": gltf_product,
    "nodes of a large mesh": gltf_large_mesh,
    "accessors": partial(gltf, array="accessors", piece=ACCESSOR + ","),
    "accessors of the same bytes": gltf_same_bytes,
    "primitives": partial(gltf, array="meshes", piece=PRIMITIVE + ",", meshes='[{"primitives":[@]}]'),
    "meshes": partial(gltf, array="meshes", piece='{"primitives":[]},'),
    "materials": partial(gltf, array="materials", piece="{},"),
    "buffer views": partial(gltf, array="bufferViews", piece='{"buffer":0,"byteLength":1},'),
    "empty arrays": partial(gltf, array="extras", piece="[],"),
    "numbers": partial(gltf, array="extras", piece="1.5,"),
    "texts": partial(gltf, array="extras", piece='"k{i}",'),
    "keys": partial(gltf, array="extras", piece='"k{i}":0,', extras="{@}"),
    "text": partial(gltf, array="extras", piece="a", extras='"@"'),
    "text of escapes": partial(gltf, array="extras", piece="\\n", extras='"@"'),
    "text past the BMP": partial(gltf, array="extras", piece="\U0001f600", extras='"@"'),
    "digits": partial(gltf, array="extras", piece="1", extras="1@"),
    "spaces": partial(gltf, array="extras", piece=" ", extras="0@"),
    "extensions": partial(gltf, array="extensions", piece='"k{i}":{{}},'.replace("{{", "{").replace("}}", "}"), extensions="{@}"),
    "extensions used": partial(gltf, array="extensionsUsed", piece='"k{i}",'),
    "animations": partial(gltf, array="animations", piece='{"channels":[],"samplers":[]},'),
    "lights": partial(gltf, array="extensions", piece='{"type":"point"},',
                      extensions='{"KHR_lights_punctual":{"lights":[@]}}'),
    "base64": partial(gltf_data, payload="AAAA"),
    "percent": partial(gltf_data, payload="%41", kind=""),
    "percent in base64": partial(gltf_data, payload="%41AAA"),
    "strip": partial(gltf_strip, mode=5),
    "fan": partial(gltf_strip, mode=6),
    "chunks": glb_chunks,
}

# --- pictures ---------------------------------------------------------------------------------------------------------


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(size: int, kind: bytes, data: bytes, behind: bool = False) -> Seed:
    """A picture of 2x2, with a chunk again and again before or behind its pixels."""
    head = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0))
    more = png_chunk(kind, data)
    pixels = png_chunk(b"IDAT", zlib.compress(bytes(14)))
    parts: Iterable[bytes] = (pixels, more * (size // len(more))) if behind else (more * (size // len(more)), pixels)
    return Seed(".png", head + b"".join(parts) + png_chunk(b"IEND", b""))


def hdr(size: int, piece: str) -> Seed:
    more = piece * (size // len(piece))
    return Seed(".hdr", f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{more}\n-Y 2 +X 2\n".encode() + bytes([1, 1, 1, 128]) * 4)


IMAGES: dict[str, Maker] = {
    "PNG texts": partial(png, kind=b"tEXt", data=b"k\0v"),
    "PNG international texts": partial(png, kind=b"iTXt", data=b"k\0\0\0\0\0v"),
    "PNG chunks": partial(png, kind=b"abCd", data=b""),
    "PNG empty data": partial(png, kind=b"IDAT", data=b"", behind=True),
    "PNG frames": partial(png, kind=b"fcTL", data=bytes(26)),
    "HDR header": partial(hdr, piece="#\n"),
    "HDR settings": partial(hdr, piece="EXPOSURE=1\n"),
}


def _texts(suffix: str, table: dict[str, tuple[str, str, str]]) -> dict[str, Maker]:
    def make(size: int, piece: str, before: str, after: str) -> Seed:
        return repeated(suffix, piece, size, before, after)

    return {f"{suffix[1:]}: {name}": partial(make, piece=piece, before=before, after=after)
            for name, (piece, before, after) in table.items()}


GROWN: dict[str, Maker] = {
    **_texts(".toml", TOML), **_texts(".obj", OBJ), **{f"ply: {name}": make for name, make in PLY.items()},
    **_texts(".stl", STL), "stl: binary": stl_binary, **{f"gltf: {name}": make for name, make in GLTF.items()},
    **{f"image: {name}": make for name, make in IMAGES.items()},
}
