"""Kernels in other environments: two copies of Warp, cold processes at once."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp
from PIL import Image

from tests.command_line import without_compiling
from tests.data import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="mounts and links as Linux does")]

QUERY = """
import sys, numpy as np, wrt
print(float(wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), sys.argv[1]).closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t[0]))
"""
ANSWER = "0.3333333432674408\n"
OWN_KERNEL = """
import sys, tempfile, warp as wp
from pathlib import Path
import wrt
from wrt.core.device import start
start("cpu")
file = Path(sys.argv[1])
file.write_text("import warp as wp\\n@wp.kernel\\ndef double_it(a: wp.array(dtype=float)):\\n    a[wp.tid()] *= 2.0\\n")
sys.path.insert(0, str(file.parent))
import own
a = wp.array([1.0, 2.0], dtype=float, device="cpu")
wp.launch(own.double_it, dim=2, inputs=[a], device="cpu")
print(a.numpy().tolist())
"""
LEFTOVER = re.compile(r"wp_\w+_p\d+_t\d+|precompiled-\w+-.*")
RENDER = ["-m", "wrt", "render", "--spp", "1", "--size", "24x16", "-q"]


def command(*arguments: str, path: Path = ROOT) -> list[str]:
    return ["env", f"PYTHONPATH={path}:{ROOT}", "WARP_CACHE_PATH=" + os.environ["WARP_CACHE_PATH"], sys.executable, *arguments]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "cache"))
    return tmp_path / "cache"


def leftovers(cache: Path) -> list[Path]:
    return [path for path in cache.glob("*/*") if LEFTOVER.fullmatch(path.name)]


def test_two_copies_of_warp_share_a_cache_without_a_word(tmp_path: Path, cache: Path):
    """Clang's precompiled headers of one copy do not work for the other."""
    home = Path(warp.__file__).parent
    copy = tmp_path / "second" / "warp"
    shutil.copytree(home, copy, ignore=shutil.ignore_patterns("bin", "tests", "examples", "__pycache__"))
    (copy / "bin").symlink_to(home / "bin")  # 360 MB
    where = subprocess.run(command("-c", "import warp; print(warp.__file__)", path=copy.parent), capture_output=True, text=True)
    assert where.stdout == f"{copy / '__init__.py'}\n"
    for turn, name in enumerate(("bvh", "brute_force", "grid", "bvh4", "kdtree", "octree")):
        if turn == 4:
            for header in (copy / "native").glob("*.h"):
                header.touch()  # as an installation anew does
        path = (ROOT, copy.parent)[turn % 2]
        done = subprocess.run(command("-c", QUERY, name, path=path), capture_output=True, text=True)
        assert (done.returncode, done.stdout, without_compiling(done.stderr)) == (0, ANSWER, "")
    for path in (ROOT, copy.parent):
        done = subprocess.run(command("-c", OWN_KERNEL, str(tmp_path / "own.py"), path=path), capture_output=True, text=True)
        assert (done.returncode, done.stdout.splitlines()[-1:], without_compiling(done.stderr)) == (0, ["[2.0, 4.0]"], "")
    for path, scene in ((ROOT, "whitted"), (copy.parent, "lens"), (ROOT, "frosted")):
        done = subprocess.run(command(*RENDER, f"scenes/{scene}.toml", "-o", str(tmp_path / "a.png"), path=path), cwd=ROOT,
                              capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
    assert not leftovers(cache)


def test_eight_processes_that_start_cold_at_once(tmp_path: Path, cache: Path):
    queries = [command("-c", QUERY, name) for name in ("bvh", "bvh", "grid", "kdtree")]
    renders = [command(*RENDER, "scenes/whitted.toml", "-o", str(tmp_path / f"{i}.png")) for i in range(4)]
    running = [subprocess.Popen(each, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
               for each in (*queries, *renders)]
    done = [(*each.communicate(timeout=600), each.returncode) for each in running]
    assert [(without_compiling(err), code) for _, err, code in done] == [("", 0)] * 8
    assert [out for out, _, _ in done[:4]] == [ANSWER] * 4
    assert len({Image.open(tmp_path / f"{i}.png").tobytes() for i in range(4)}) == 1
    assert not leftovers(cache)
