"""Mitsuba's variant llvm_ad_rgb: which LLVM library it gets, and that what ends its process ends nothing else."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.mitsuba_oracle import render_mitsuba
from wrt.core.errors import InputError
from wrt.lab.mitsuba import process as mitsuba_process
from wrt.lab.mitsuba.process import PATH_VARIABLE, Job, MitsubaProcess, NotAvailable, candidates, llvm_library, trial
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Scene, Sphere
from wrt.scene.settings import Settings

SCENE = Scene(
    spheres=(Sphere((0.0, 0.0, 0.0), 0.5, Material("glass", albedo=(0.9, 0.6, 0.9))),
             Sphere((0.7, 0.0, -0.5), 0.4, Material("mirror", albedo=(0.3, 0.8, 0.7)))),
    cameras=(Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov_y=0.8),), background=ConstantBackground((0.5, 1.0, 2.0)),
    settings=Settings(size=(24, 16), filter="box", min_throughput=0.0))
JOB = Job("scalar_rgb", SCENE, 0, "path", 2)


@pytest.fixture
def library() -> str:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    try:
        return llvm_library()
    except NotAvailable as error:
        pytest.skip(str(error))


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, the only one where libraries are looked for."""
    monkeypatch.delenv(mitsuba_process.PATH_VARIABLE, raising=False)
    monkeypatch.setattr(mitsuba_process, "PLACES", (str(tmp_path),))
    monkeypatch.setattr(mitsuba_process.ctypes.util, "find_library", lambda name: None)
    return tmp_path


# --- which library ----------------------------------------------------------------------------------------------------


def test_the_newest_library_comes_first_and_each_once(places: Path) -> None:
    for name in ("libLLVM-9.so.1", "libLLVM-16.so.1", "libLLVM.so.19.1", "libLLVM-14.so.1", "libLLVMCore.so.16", "libLLVM-17.txt"):
        (places / name).write_text("")
    (places / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (places / "libLLVM-14.0.6.so.1").symlink_to("libLLVM-14.so.1")
    assert [Path(path).name for path in candidates()] == ["libLLVM.so.19.1", "libLLVM-16.so.1", "libLLVM-14.so.1", "libLLVM-9.so.1"]


def test_what_the_linker_finds_is_tried_too(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (places / "libLLVM-18.so.1").write_text("")
    monkeypatch.setattr(mitsuba_process.ctypes.util, "find_library", lambda name: "libLLVM.so.20.1")
    assert candidates() == ["libLLVM.so.20.1", str(places / "libLLVM-18.so.1")]
    monkeypatch.setattr(mitsuba_process.ctypes.util, "find_library", lambda name: "libLLVM-18.so.1")
    assert candidates() == [str(places / "libLLVM-18.so.1")]


def test_a_library_that_is_named_is_the_only_one(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (places / "libLLVM.so.19.1").write_text("")
    monkeypatch.setenv(mitsuba_process.PATH_VARIABLE, "/nowhere/libLLVM.so")
    assert candidates() == ["/nowhere/libLLVM.so"]


def test_the_next_one_is_taken_where_one_ends_its_process(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("libLLVM-16.so.1", "libLLVM-15.so.1", "libLLVM-14.so.1"):
        (places / name).write_text("")
    monkeypatch.setattr(mitsuba_process, "TRIAL", f"import os\nif 'libLLVM-16' in os.environ['{PATH_VARIABLE}']: os.abort()")
    assert Path(llvm_library()).name == "libLLVM-15.so.1"


def test_every_library_is_named_with_what_came_of_it(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotAvailable, match=f"no LLVM library .* found.*{PATH_VARIABLE}"):
        llvm_library()
    for name in ("libLLVM-16.so.1", "libLLVM-15.so.1"):
        (places / name).write_text("")
    monkeypatch.setattr(mitsuba_process, "TRIAL", f"import os\nif 'libLLVM-16' in os.environ['{PATH_VARIABLE}']: os.abort()\n"
                                       "raise ImportError('it lacks what is needed')")
    with pytest.raises(NotAvailable, match=r"-16\.so\.1: ended by SIGABRT.*; .*-15\.so\.1: exit code 1 \(ImportError: it lacks"):
        llvm_library()


def test_a_trial_sees_no_kernels_of_another_library_and_ends() -> None:
    assert trial("x", f"import os; assert os.listdir(os.environ['{mitsuba_process.CACHE_VARIABLE}']) == []", 60.0) is None
    assert trial("x", "import time; time.sleep(60)", 0.5) == "not done after 0.5 s"


def test_what_is_no_library_fails_the_trial(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    (tmp_path / "libLLVM.so").write_text("not a library")
    reason = trial(str(tmp_path / "libLLVM.so"), mitsuba_process.TRIAL, mitsuba_process.TRIAL_SECONDS)
    assert reason is not None and "libLLVM.so" in reason


# --- its process ------------------------------------------------------------------------------------------------------


def test_both_variants_draw_the_same_light(library: str) -> None:
    with MitsubaProcess(JOB) as scalar, MitsubaProcess(JOB._replace(variant="llvm_ad_rgb")) as compiled:
        (_, one), (seconds, other) = scalar.render(256, 3), compiled.render(256, 3)
        assert scalar.load_seconds > 0.0 and seconds > 0.0
        assert one.shape == other.shape == (16, 24, 3) and one.dtype == other.dtype == np.float32
        assert not np.array_equal(one, other)  # another variant, another sequence of random numbers
        np.testing.assert_allclose(one.mean((0, 1)), other.mean((0, 1)), rtol=5e-3)
        assert not np.array_equal(other, compiled.render(256, 4)[1])  # another seed


def test_a_process_draws_what_is_drawn_here() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    with MitsubaProcess(JOB) as process:
        np.testing.assert_array_equal(process.render(1, 5)[1], render_mitsuba(SCENE, spp=1, seed=5, integrator="path").pixels)


def test_a_process_that_ends_is_told_with_its_reason() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    with MitsubaProcess(JOB) as process:
        os.kill(process._process.pid, signal.SIGABRT)
        with pytest.raises(NotAvailable, match="its process ended by SIGABRT"):
            process.render(1, 0)


def test_a_scene_that_mitsuba_cannot_draw_is_an_input_error_of_the_scene() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    shiny = replace(SCENE, spheres=(Sphere((0.0, 0.0, 0.0), 0.5, Material(specular=(0.5, 0.5, 0.5))),))
    with pytest.raises(InputError, match="not translatable exactly: Blinn-Phong") as caught:
        MitsubaProcess(JOB._replace(scene=shiny))
    assert not isinstance(caught.value, NotAvailable)


def test_missing_mitsuba_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_process.importlib.util, "find_spec", lambda name: None)
    for variant in mitsuba_process.VARIANTS:
        with pytest.raises(InputError, match="Mitsuba 3 is not usable"):
            MitsubaProcess(JOB._replace(variant=variant))


def test_python_integrators_are_for_the_scalar_variant() -> None:
    with pytest.raises(NotAvailable, match="whitted"):
        MitsubaProcess(JOB._replace(variant="llvm_ad_rgb", integrator="whitted"))
