"""The shipped scenes load and render, and together need every feature of the renderer."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import wrt
from tests.data import ROOT
from wrt.accel.queries.lists import list_hits
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.snapshot import Structure, any_hit_kernel, closest_hit_kernel
from wrt.accel.structures import ACCELERATORS
from wrt.cli.common import depth_hint
from wrt.core.device import start
from wrt.kernels.shade.features import Features
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.renderer.plan import aov_kernel, features_of, render_kernel, switches
from wrt.scene.cameras import CAMERAS
from wrt.scene.model import Scene

SCENES = sorted((ROOT / "scenes").glob("*.toml"))


@cache
def load(path: Path) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a shipped scene must load without warnings
        return wrt.load_scene(path)


def features(path: Path) -> set[Features]:
    scene = load(path)
    return {features_of(scene, camera, instanced_meshes(scene)) for camera in scene.cameras}


@pytest.mark.parametrize("name", switches(Features()))
def test_every_feature_has_a_scene_that_needs_it(name: str) -> None:
    assert any(switches(f)[name] for path in SCENES for f in features(path)), f"no scene in scenes/ needs {name}"


def without(features: Features, name: str) -> Features:
    """Return the features with one switch off."""
    if hasattr(features, name):
        return replace(features, **{name: False})
    return replace(features, materials=tuple(kind for kind in features.materials if kind != name),
                   lights=tuple(kind for kind in features.lights if f"{kind}_lights" != name),
                   background="constant" if features.background == name else features.background)


@pytest.mark.parametrize("kind", CAMERAS)
def test_every_kind_of_camera_has_a_scene(kind: str) -> None:
    assert any(isinstance(camera, CAMERAS[kind]) for path in SCENES for camera in load(path).cameras)


@pytest.mark.parametrize("name", switches(Features()))
def test_every_feature_changes_the_code_of_a_scene_that_needs_it(name: str) -> None:
    start("cpu")
    needed = next(f for path in SCENES for f in features(path) if switches(f)[name])
    codes = [render_kernel(f, Structure(ACCELERATORS["bvh"], Units(spheres=f.spheres, instances=f.instances))).module.hash_module()
             for f in (needed, without(needed, name))]
    assert codes[0] != codes[1]


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_scene_begins_with_a_comment_and_has_the_common_size(path: Path) -> None:
    assert path.read_text().startswith("# ")
    assert load(path).settings.size == (640, 360)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_scene_renders(path: Path) -> None:
    film = wrt.render(load(path), spp=2, size=(64, 36))
    assert film.stats["not_finite"] == 0
    assert np.isfinite(film.pixels).all() and (film.pixels >= 0.0).all()
    assert film.pixels.max() > 0.0
    visibly_cut = depth_hint(film.stats, load(path).settings.max_depth) is not None
    assert visibly_cut == (path.stem in ("frosted", "metallic_roughness"))  # as docs/concepts.md says


# Compiling takes seconds each. These four scenes together need most features; each is compiled for the camera that needs most of
# them, and the first also for Hopper (sm_90). The slow tests compile all scenes and cameras.
COMPILED = ("metallic_roughness", "environment", "instances", "lens")


@pytest.mark.parametrize(("path", "every"), [
    *(pytest.param(path, False, id=path.stem) for path in SCENES if path.stem in COMPILED),
    *(pytest.param(path, True, id=f"{path.stem}-every-camera", marks=pytest.mark.slow) for path in SCENES)])
def test_kernels_compile_for_turing_and_some_for_hopper(path: Path, every: bool, tmp_path: Path) -> None:
    start("cpu")
    archs = [75, 90] if path.stem == COMPILED[0] else [75]
    variants = sorted(features(path), key=lambda variant: sum(switches(variant).values()), reverse=True)
    for variant in variants if every else variants[:1]:
        kernel = render_kernel(variant, Structure(ACCELERATORS["bvh"], Units(spheres=variant.spheres, instances=variant.instances)))
        binaries = wp.compile_aot_module(kernel.module, arch=archs, module_dir=tmp_path)
        assert [Path(binary).stat().st_size > 10_000 for binary in binaries] == [True] * len(archs)


def test_the_other_kernels_compile_for_turing_and_one_for_hopper(tmp_path: Path) -> None:
    start("cpu")
    variant = Features(spheres=True, textures=True, smooth=True, cutout=True)
    kernels = [aov_kernel(variant, Structure(ACCELERATORS["bvh"], Units(spheres=True)))]
    kernels += [make(Structure(ACCELERATORS[name], Units(spheres=True)))
                for name in ("bvh", "brute_force") for make in (closest_hit_kernel, any_hit_kernel)]
    kernels += [closest_hit_kernel(Structure(ACCELERATORS["bvh"], Units(triangle=name))) for name in RAY_TRIANGLE]
    kernels += [closest_hit_kernel(Structure(ACCELERATORS["bvh"], Units(box=name))) for name in RAY_AABB]
    kernels.append(list_hits(Structure(ACCELERATORS["bvh"]), True))
    for i, kernel in enumerate(kernels):
        archs = [75] if i else [75, 90]
        assert len(wp.compile_aot_module(kernel.module, arch=archs, module_dir=tmp_path)) == len(archs)
