"""Mitsuba in a process of its own: the variant llvm_ad_rgb needs an LLVM library, and what ends that process ends nothing else."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from tests.mitsuba_oracle import render_mitsuba
from tests.refused import refused
from wrt.lab.mitsuba import VARIANTS
from wrt.lab.mitsuba import process as mitsuba_process
from wrt.lab.mitsuba.process import PATH_VARIABLE, Job, MitsubaProcess, llvm_missing
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


@pytest.mark.parametrize(("named", "said"), [(None, "is not set"), ("/nowhere/libLLVM.so", "names no file: /nowhere/libLLVM.so"),
                                             (__file__, "LLVM")])
def test_the_llvm_variant_needs_a_library(named: str | None, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    monkeypatch.delenv(PATH_VARIABLE, raising=False)
    if named:
        monkeypatch.setenv(PATH_VARIABLE, named)
    with refused(what=said):
        MitsubaProcess(JOB._replace(variant="llvm_ad_rgb"))


@pytest.fixture
def library() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    if reason := llvm_missing():
        pytest.skip(reason)


def test_both_variants_draw_the_same_light(library: None) -> None:
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


def test_a_process_that_ends_is_told() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    with MitsubaProcess(JOB) as process:
        with refused(what="its process ended"):
            process._ask(os._exit, 3)


def test_a_scene_that_mitsuba_cannot_draw_is_an_input_error_of_the_scene() -> None:
    pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')
    shiny = replace(SCENE, spheres=(Sphere((0.0, 0.0, 0.0), 0.5, Material(specular=(0.5, 0.5, 0.5))),))
    with refused(what="not translatable exactly: Blinn-Phong", place="Mitsuba: material ''"):
        MitsubaProcess(JOB._replace(scene=shiny))


def test_missing_mitsuba_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_process.importlib.util, "find_spec", lambda name: None)
    for variant in VARIANTS:
        with refused(what="Mitsuba 3"):
            MitsubaProcess(JOB._replace(variant=variant))
