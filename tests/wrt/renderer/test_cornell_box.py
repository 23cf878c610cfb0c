"""A box from the data set through a TOML scene: groups of an OBJ file as materials, one of them a lamp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.cornell_box import cornell_box
from tests.data import data_path
from wrt.io.load import load_scene
from wrt.picture.film import Film
from wrt.renderer.render import render
from wrt.scene.model import Scene

SIZE = (48, 48)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    data_path("scenes/cornell_box_obj/cornell_box.obj")
    path: Path = tmp_path_factory.mktemp("scene") / "cornell_box.toml"
    path.write_text(cornell_box())
    return load_scene(path)


@pytest.fixture(scope="module")
def film(scene: Scene) -> Film:
    return render(scene, size=SIZE, spp=256, aov=("material_id",))


def test_each_group_has_its_material(scene: Scene, film: Film) -> None:
    names = [scene.materials[i].name for i in film.aov["material_id"][24, [2, 24, 45]]]
    assert names == ["red", "white", "green"]
    lamp = film.aov["material_id"] == [m.name for m in scene.materials].index("lamp")
    assert lamp.any() and 8.5 < film.pixels[lamp][:, 0].max() <= 17.0 * (1.0 + 1e-5)  # seen at a grazing angle, the lamp fills no pixel


def test_light_agrees_with_mitsuba(scene: Scene, film: Film) -> None:
    pytest.importorskip("mitsuba")
    from tests.mitsuba_oracle import render_mitsuba

    theirs = render_mitsuba(scene, size=SIZE, spp=256, integrator="direct")
    lit = np.maximum(film.pixels, theirs.pixels).max(axis=-1) < 1.0  # without the lamp's pixels, which are mostly noise of its edges
    assert lit.mean() > 0.97
    np.testing.assert_allclose(film.pixels[lit].mean(0), theirs.pixels[lit].mean(0), rtol=5e-3)
    variance = theirs.variance + film.variance
    noisy = variance > 1e-8
    z = ((film.pixels - theirs.pixels) / np.sqrt(np.where(noisy, variance, 1.0)))[noisy]
    assert noisy.mean() > 0.5 and abs(z.mean()) < 0.2 and (np.abs(z) > 5.0).mean() < 2e-3
