"""Little address space is one message, not a traceback, and not the end by OpenBLAS or LLVM."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import ROOT
from wrt.core import address_space
from wrt.core.address_space import require_modules, require_scipy, require_warp, room_to_compile
from wrt.core.errors import InputError
from wrt.renderer import render as rendering

resource = pytest.importorskip("resource", reason="needs a system with limits")
pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="what is taken is read from /proc")
WAY_OUT = "are left: raise its limit (ulimit -v)"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def limited(mebibytes: int, *command: object) -> subprocess.CompletedProcess[str]:
    """A Python process that may have so much address space."""
    program = ("import os, resource, sys; resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]) << 20,) * 2);"
               " os.execv(sys.executable, [sys.executable, *sys.argv[2:]])")
    return subprocess.run([sys.executable, "-c", program, str(mebibytes), *map(str, command)], env=ENVIRONMENT,
                          capture_output=True, text=True)


@pytest.mark.parametrize("mebibytes", [100, 150, 200, 300, 400])
def test_a_render_in_little_address_space_is_one_message(mebibytes: int, tmp_path: Path) -> None:
    """However many cores there are: each takes some more."""
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    done = limited(mebibytes, "-m", "wrt", "render", tmp_path / "box.obj", "--size", "16x9", "--spp", 1, "-o", tmp_path / "a.png")
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1, done
    assert done.stderr.startswith("error: ") and "MiB of address space" in done.stderr and WAY_OUT in done.stderr
    assert not (tmp_path / "a.png").exists()


def test_what_needs_little_works_in_little() -> None:
    for arguments in (("--version",), ("--help",)):
        done = limited(100, "-m", "wrt", *arguments)
        assert done.returncode == 0 and done.stderr == "", done


@pytest.mark.parametrize(("name", "outcome"), [
    ("InputError", "there"), ("Mesh", "refused: NumPy and what else is imported takes ")])
def test_the_package_says_it_too(name: str, outcome: str) -> None:
    done = limited(100, "-c", "import wrt\ntry:\n wrt." + name + "; print('there')\n"
                   "except wrt.InputError as error:\n print('refused:', error)")
    assert done.returncode == 0 and done.stdout.startswith(outcome) and done.stderr == "", done


COMPILING = """
import numpy as np, resource, wrt
from wrt.core.device import start
accel = wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force")
start("cpu")
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (60 << 20),) * 2)
try:
    print(accel.closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t)
except wrt.InputError as error:
    print(error)
"""


def test_a_compiler_without_room_is_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LLVM would end the process. What is compiled already needs no room."""
    monkeypatch.setitem(ENVIRONMENT, "WARP_CACHE_PATH", str(tmp_path))
    for room, told in (("60", f"compiling a kernel takes {address_space.LLVM >> 20} MiB of address space, and "), ("600", "[0.333"),
                       ("60", "[0.333")):
        done = subprocess.run([sys.executable, "-c", COMPILING.replace("60 << 20", f"{room} << 20")], env=ENVIRONMENT,
                              capture_output=True, text=True)
        assert done.returncode == 0 and done.stdout.startswith(told) and done.stderr == "", done


@pytest.mark.parametrize(("left", "threads", "refused"), [
    (float("inf"), 1000, []), (2**31, 4, []), (500 << 20, 100, ["Warp"]), (200 << 20, 1, ["Warp"]),
    (2**26, 1, ["Warp", "compiling"]),
])
def test_how_much_is_left_decides(left: float, threads: int, refused: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address_space, "address_space", lambda: left)
    told = []

    def compile() -> None:
        with room_to_compile():
            assert address_space._compiler.locked() is (left < float("inf"))

    for ask in (lambda: require_warp(threads), compile):
        try:
            ask()
        except InputError as error:
            told.append(str(error).split()[0])
            assert WAY_OUT in str(error)
    assert told == refused and not address_space._compiler.locked()


def test_a_way_out_is_fewer_threads_of_openblas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address_space, "address_space", lambda: 230 << 20)
    monkeypatch.setattr(address_space, "_settle", lambda: None)
    monkeypatch.delitem(sys.modules, "numpy")
    monkeypatch.delitem(sys.modules, "scipy", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)))
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    for name in ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"takes 490 MiB .*, and 230 are left: .*; OPENBLAS_NUM_THREADS=1 makes it less$"):
        require_modules()
    with pytest.raises(InputError, match=r"^SciPy takes 380 MiB .*, and 230 are left: .*; OPENBLAS_NUM_THREADS=1 makes it less$"):
        require_scipy()
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    require_modules()
    require_scipy()
    monkeypatch.setattr(address_space, "address_space", lambda: 0)
    monkeypatch.setitem(sys.modules, "numpy", np)
    require_modules()  # it is imported: what else is takes little


PRODUCT = """
import wrt.core.address_space as space
space.require_modules()
import numpy as np
before = space.address_space()
np.ones((512, 512)) @ np.ones((512, 512))
print(before - space.address_space() < 16 << 20)
"""


def test_openblas_has_its_buffer_before_it_is_needed() -> None:
    """It asks for one with its first large product, and for ever, where there is no room."""
    done = limited(4000, "-c", PRODUCT)
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", ""), done


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), MemoryError("of some kind"),
                                   RuntimeError("Failed to allocate 4096 bytes on device 'cpu'")])
def test_what_runs_out_later_is_one_message_too(error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> wrt.Film:
        raise error

    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    monkeypatch.setattr(rendering, "render", fail)
    done = command("render", "box.obj", "-o", "a.png")
    assert (done.code, done.errors) == (2, [f"error: not enough memory: {error}"])
    monkeypatch.setattr(address_space, "address_space", lambda: 3 << 20)
    monkeypatch.setattr("wrt.cli.main.require_modules", lambda: None)
    assert "(3 MiB of address space are left: raise its limit, ulimit -v)" in command("render", "box.obj", "-o", "a.png").err


def test_other_errors_are_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.obj").write_text(BOX_OBJ)

    def fail(*arguments: object, **options: object) -> wrt.Film:
        raise RuntimeError("a defect")

    monkeypatch.setattr(rendering, "render", fail)
    with pytest.raises(RuntimeError, match="a defect"):
        command("render", "box.obj", "-o", "a.png")
