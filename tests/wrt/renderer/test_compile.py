"""A render uses the kernels that were compiled ahead of time."""

from __future__ import annotations

from typing import Any

import pytest

from tests.data import ROOT
from tests.device import NAME
from tests.refused import refused
from wrt.core import device
from wrt.io.load import load_scene
from wrt.renderer import prepare
from wrt.renderer.film import OF_AOVS
from wrt.renderer.prepare import compile_picture, compile_queries
from wrt.renderer.render import render


def test_a_render_finds_its_kernels_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(ROOT / "scenes" / "fisheye.toml").with_settings(size=(8, 8), spp=1, max_depth=7)
    names = compile_picture(scene, "bvh")
    assert ({"shade_wave", "begin_wave", "aov_wave", "trace"} if NAME == "cpu" else {"render", "aovs"}) <= set(names)
    asked: list[Any] = []
    monkeypatch.setattr(prepare, "load_kernel", lambda kernel, target: asked.append(kernel))
    render(scene, aov=tuple(OF_AOVS))
    assert len(asked) == len(names) and all(NAME in dict(device._loaded[kernel].devices) for kernel in asked)


def test_queries_of_a_structure_and_wrong_names() -> None:
    assert compile_queries("bvh") == ["closest_hit", "any_hit"]
    with refused("accel", "nosuch"):
        compile_queries("nosuch")
