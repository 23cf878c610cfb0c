"""WRT_MEMORY is kept: a process that reads a hostile file takes no more than half as much again, or refuses it with one message.

`pytest -m slow -n 0 -s tests/wrt/test_memory_kept.py` prints the table of peaks.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.data import ROOT
from tests.fuzz.seeds import Seed, side_files
from tests.grown import GROWN, png_chunk

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK),
                                                   reason="needs /proc to measure a peak")]
MOST = 400  # MiB, as WRT_MEMORY
NO_PICTURE = ("image: PNG frames", "image: HDR header", "image: HDR settings")  # to what reads pictures; all others are read
ADDRESSES = 6 << 30  # that a child may have at most, be it in the wrong

CHILD = """
import json, re, resource, sys, time
from pathlib import Path

def status(key):
    return int(re.search(rf"^{key}:\\s+(\\d+)", Path("/proc/self/status").read_text(), re.M)[1]) * 1024

resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
start = status("VmHWM")
import warnings
warnings.simplefilter("ignore")
from tests.command_line import wrt
command, *files = sys.argv[2:]
begin = time.process_time()
result = wrt(command, *files)
print(json.dumps({"start": start, "peak": status("VmHWM"), "seconds": time.process_time() - begin,
                  "code": result.code, "err": result.err}))
"""


def kept(*arguments: str | Path) -> dict:
    """What a wrt command in a process of its own took, in MiB beyond an interpreter's start, and said."""
    environment = os.environ | {"WRT_MEMORY": f"{MOST}M", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", CHILD, str(ADDRESSES), *map(str, arguments)], cwd=ROOT, env=environment,
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"exit code {done.returncode}: {done.stderr[-2000:]}"
    told = json.loads(done.stdout)
    taken = (told["peak"] - told["start"]) / 2**20
    size = sum(Path(each).stat().st_size for each in arguments[1:])
    said = "read" if told["code"] == 0 else told["err"].strip().split("\n")[0]
    print(f"{size / 1e6:8.2f} MB {taken:6.0f} MiB {told['seconds']:6.1f} s  {said[-100:]}", flush=True)
    assert told["code"] in (0, 2) and "Traceback" not in told["err"]
    assert told["code"] == 0 or told["err"].startswith("error: ")
    assert taken <= 1.5 * MOST, told["err"]
    return told


@pytest.mark.parametrize("name", GROWN)
def test_a_file_that_repeats_one_thing(name: str, tmp_path: Path) -> None:
    seed = GROWN[name](6_000_000)
    side_files(tmp_path)
    path = tmp_path / f"a{seed.suffix}"
    path.write_bytes(seed.data)
    if seed.suffix in (".png", ".hdr"):
        told = kept("compare", path, path)
        assert "cannot be read as an image" in told["err"] if name in NO_PICTURE else told["code"] == 0
    else:
        kept("validate", as_scene(path))


def as_scene(path: Path) -> Path:
    """A scene that shows a mesh file."""
    if path.suffix in (".toml", ".gltf", ".glb"):
        return path
    scene = path.with_suffix(".toml")
    scene.write_text(f'materials.m = {{}}\n[[meshes]]\nfile = "{path.name}"\nmaterial = "m"\n')
    return scene


@pytest.mark.parametrize("size", [10_000, 20_000, 40_000, 200_000])
def test_a_dotted_key(size: int, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(GROWN["toml: dotted key"](size).data)
    assert "a key of more than 16 parts" in kept("validate", tmp_path / "a.toml")["err"]


@pytest.mark.parametrize("size", [10_000_000, 50_000_000])
@pytest.mark.parametrize("name", ["obj: face line", "obj: continued face", "ply: binary faces of 255", "gltf: base64",
                                  "gltf: empty nodes"])
def test_larger_ones(name: str, size: int, tmp_path: Path) -> None:
    seed: Seed = GROWN[name](size)
    (tmp_path / f"a{seed.suffix}").write_bytes(seed.data)
    kept("validate", as_scene(tmp_path / f"a{seed.suffix}"))


def black(width: int, height: int, bits: int = 8, kind: int = 2) -> bytes:
    """A PNG of zeros, whatever its channels."""
    import struct

    row = bytes(1 + width * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[kind] * bits // 8)
    packer = zlib.compressobj()
    data = b"".join([*(packer.compress(row) for _ in range(height)), packer.flush()])
    palette = png_chunk(b"PLTE", bytes(3)) if kind == 3 else b""
    return (b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)) + palette
            + png_chunk(b"IDAT", data) + png_chunk(b"IEND", b""))


@pytest.mark.parametrize(("width", "height", "bits", "kind"), [
    (11000, 11000, 8, 2), (11000, 11000, 16, 6), (1800, 1800, 8, 2), (1800, 1800, 16, 2), (1800, 1800, 8, 3), (1800, 1800, 16, 4),
    (1800, 1800, 16, 0), (10000, 100, 8, 2), (4, 30000, 8, 6),
])
def test_pictures_that_are_compared(width: int, height: int, bits: int, kind: int, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(black(width, height, bits, kind))
    told = kept("compare", tmp_path / "a.png", tmp_path / "b.png")
    assert (told["code"] == 0) == (width * height < 10_000_000)
    if told["code"]:
        assert f"{width}x{height} takes " in told["err"]


def shapes() -> dict[str, Callable[[], str]]:
    kinds = ("kind='torus',segments=2048,tube_segments=2048", "kind='icosphere',subdivisions=9", "kind='teapot',segments=1400")
    return {kind.split("'")[1]: (lambda kind=kind: f"materials.m={{}}\n[[meshes]]\nmaterial='m'\nsmooth=true\nshape={{{kind}}}\n")
            for kind in kinds}


@pytest.mark.parametrize("name", shapes())
def test_shapes_by_formula(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(shapes()[name]())
    kept("validate", tmp_path / "a.toml")
