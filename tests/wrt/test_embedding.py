"""wrt in programs that change process-wide settings, call it from their own threads, or call it while Python exits."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.command_line import without_compiling
from tests.data import ROOT
from wrt.kernels.build.volumes import fit_kdops
from wrt.scene.shapes import icosphere

SCENE = ROOT / "scenes" / "whitted.toml"
BALL = icosphere(3)
# Prints the sum of a query's distances and the sum of a picture, which have the same bits on every CPU.
WORK = f"""
import threading, numpy as np, wrt
from wrt.scene.shapes import icosphere
wrt.build, wrt.render  # which imports the standard pool: Python does not let it be imported while it ends
def work(threads=2):
    ball, rays = icosphere(3), np.random.default_rng(0).normal(size=(50000, 3))
    accel = wrt.build((ball.vertices, ball.faces), NAME, threads=threads)
    found = accel.closest_hit(rays, -rays, threads=threads)
    picture = wrt.render({str(SCENE)!r}, spp=2, size=(40, 30), threads=threads)
    print(repr(float(found.t.sum())), repr(float(picture.pixels.sum())))
"""


def printed(code: str, name: str = "bvh") -> list[str]:
    """Run the code in a new process and return the lines that it prints. It must succeed and print nothing on stderr."""
    done = subprocess.run([sys.executable, "-c", f"NAME = {name!r}\n{WORK}\n{code}"], capture_output=True, text=True, timeout=600,
                          check=False, cwd=ROOT)
    assert (done.returncode, without_compiling(done.stderr)) == (0, "")
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def expected() -> str:
    return printed("work()")[0]


# Settings of wp.config that change bits, or print lines for each value that is not finite.
SETTINGS = {"mode": "debug", "optimization_level": 0, "verify_fp": True, "verify_autograd_array_access": True, "max_unroll": 1,
            "cpu_compiler_flags": "-march=native -O1 -ffast-math", "enable_vector_component_overwrites": True}


def test_settings_of_warp_are_not_for_kernels_of_wrt(expected: str) -> None:
    assert printed(f"import warp as wp; vars(wp.config).update({SETTINGS}); work(1)") == [expected]


@pytest.mark.parametrize("decorator", [wp.kernel, wrt.kernel])
def test_settings_of_warp_are_for_kernels_of_the_user(decorator: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    query, before = wrt.ray_query("bvh2"), fit_kdops.module.resolve_options(wp.config)
    for name, value in SETTINGS.items():
        monkeypatch.setattr(wp.config, name, value)

    @decorator  # type: ignore[untyped-decorator]
    def mine(world: query.World, t: wp.array(dtype=float)) -> None:  # type: ignore[name-defined, valid-type]
        t[0] = query.closest_hit(world, query.ray(wp.vec3(0.0, 0.0, 3.0), wp.vec3(0.0, 0.0, -1.0))).t

    options = mine.module.resolve_options(wp.config)
    assert "-ffast-math" in options.pop("cpu_compiler_flags") and SETTINGS.items() - options.items() == {
        ("cpu_compiler_flags", SETTINGS["cpu_compiler_flags"])}
    assert fit_kdops.module.resolve_options(wp.config) == before


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("before", [False, True])
def test_what_is_asked_while_python_ends_is_answered(threads: int, before: bool, expected: str) -> None:
    code = f"import atexit; atexit.register(work, {threads}); {f'work({threads})' if before else ''}"
    assert printed(code) == [expected] * (1 + before)


def test_threads_that_outlive_the_main_thread_are_answered(expected: str) -> None:
    code = """if True:
        def wait_and_work():
            threading.main_thread().join()
            work()
        threading.Thread(target=wait_and_work).start()
    """
    assert printed(code) == [expected]


def test_arrays_of_structs_are_made_and_read_without_parsing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """NumPy parses the layout of a struct, and two threads that parse at once make CPython 3.11 raise SystemError.

    Kernels are made under a lock.
    """
    def work() -> None:
        for name in wrt.ACCELERATORS:
            accel = wrt.build((BALL.vertices, BALL.faces), name)
            accel.closest_hit(BALL.vertices, -BALL.vertices, counters=name != "bvh2_sphere")
        accel = wrt.build((BALL.vertices, BALL.faces), "bvh2", builder="sbvh")
        accel.save(tmp_path / "ball.accel")
        wrt.load_accel(tmp_path / "ball.accel", (BALL.vertices, BALL.faces)).refit(np.float32(2.0) * BALL.vertices)
        wrt.render(ROOT / "scenes" / "instances.toml", spp=1, size=(16, 12))

    work()
    parsed, parse = list[Any](), ast.parse
    with monkeypatch.context() as patch:
        patch.setattr(ast, "parse", lambda *arguments, **named: (parsed.append(arguments), parse(*arguments, **named))[1])
        work()
    assert not parsed


@pytest.mark.parametrize("kib", [64, 512])
@pytest.mark.parametrize("where", ["there", "here"])
def test_small_stacks_of_threads_are_not_for_kernels(kib: int, where: str, expected: str) -> None:
    call = "thread = threading.Thread(target=work); thread.start(); thread.join()" if where == "there" else "work()"
    assert printed(f"threading.stack_size({kib} << 10); {call}; print(threading.stack_size() >> 10)") == [expected, str(kib)]


@pytest.mark.parametrize("name", ["bvh2_kdop", "kdtree"])
def test_a_thread_with_a_small_stack_builds_and_asks(name: str, expected: str) -> None:
    code = "threading.stack_size(64 << 10); thread = threading.Thread(target=work); thread.start(); thread.join()"
    assert printed(code, name) == [expected]


def test_a_small_stack_of_the_main_thread(expected: str) -> None:
    done = subprocess.run(["sh", "-c", f"ulimit -s 256; exec {sys.executable} -c \"$CODE\""], check=True, capture_output=True,
                          text=True, timeout=600, cwd=ROOT, env={**os.environ, "CODE": f"NAME = 'bvh'\n{WORK}\nwork()"})
    assert done.stdout.splitlines() == [expected]
