"""If memory does not suffice, a command ends with one message, and Python gets a MemoryError."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.data import ROOT
from wrt.io.mesh_file import load_mesh
from wrt.io.meshes import ply
from wrt.scene.shapes import icosphere

LIMITED = """
import json, resource, sys, warnings
from pathlib import Path
from tests.command_line import wrt
warnings.simplefilter("ignore")
small, large, *arguments = sys.argv[1:]
sound = wrt(*(each.replace("FILE", small) for each in arguments))  # imports, compiles
assert sound.code == 0, sound.err
before = set(Path().iterdir())
size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + (64 << 20)
resource.setrlimit(resource.RLIMIT_AS, (size, size))
code, err = wrt(*(each.replace("FILE", large) for each in arguments))[::2]
print(json.dumps([code, err, sorted(map(str, set(Path().iterdir()) - before))]))
"""


def obj(path: Path, n: int) -> None:
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * n)


def stl(path: Path, n: int) -> None:
    triangle = np.zeros(1, "12f4, u2")
    triangle["f0"][0, 3:] = [0, 0, 0, 1, 0, 0, 0, 1, 0]
    path.write_bytes(bytes(80) + n.to_bytes(4, "little") + triangle.tobytes() * n)


def png(path: Path, n: int) -> None:
    side = int(n**0.5)
    Image.fromarray(np.zeros((side, side, 3), np.uint8)).save(path, compress_level=1)


@pytest.mark.parametrize(("write", "suffix", "n", "command"), [
    (obj, ".obj", 3_000_000, ("render", "FILE", "-o", "new.png", "--size", "8x8", "--spp", "1")),
    (obj, ".obj", 3_000_000, ("build", "FILE", "-o", "new.accel")),
    (stl, ".stl", 1_000_000, ("info", "FILE")),
    (png, ".png", 80_000_000, ("compare", "FILE", "FILE")),
], ids=["render", "build", "stl", "png"])
def test_a_command_ends_with_one_message(write, suffix: str, n: int, command: tuple[str, ...], tmp_path: Path) -> None:
    """Each file needs a large array. TOML files are left out, because their parts are small: Python 3.11 may lack the 32 bytes
    that it takes to leave a function, and then it tries for ever."""
    write(tmp_path / f"small{suffix}", 20)
    write(tmp_path / f"large{suffix}", n)
    done = subprocess.run([sys.executable, "-c", LIMITED, f"small{suffix}", f"large{suffix}", *command], cwd=tmp_path,
                          env={**os.environ, "PYTHONPATH": str(ROOT)},
                          capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    code, err, new = json.loads(done.stdout.splitlines()[-1])
    assert code == 2 and new == []
    assert err.startswith("error: not enough memory") and err.count("\n") == 1


def test_python_gets_a_memory_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail(path: Path) -> None:
        raise MemoryError("no room")

    obj(tmp_path / "a.obj", 1)
    monkeypatch.setattr("wrt.io.meshes.obj.read_file", fail)
    with pytest.raises(MemoryError, match="no room"):
        load_mesh(tmp_path / "a.obj")


def test_lists_of_one_length_are_counted_once(tmp_path: Path) -> None:
    """The lengths of rows of one byte must not take eight bytes each."""
    import tracemalloc

    header = ("ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
              "element face 1\nproperty list uchar int vertex_indices\n"
              "element junk 4000000\nproperty list uchar uchar a\nend_header\n")
    body = icosphere(0).vertices[:3].tobytes() + b"\3" + np.arange(3, dtype=np.int32).tobytes() + bytes(4_000_000)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    tracemalloc.start()
    try:
        assert len(ply.read(tmp_path / "a.ply").faces) == 1
        assert tracemalloc.get_traced_memory()[1] < 3 * 4_000_000
    finally:
        tracemalloc.stop()
