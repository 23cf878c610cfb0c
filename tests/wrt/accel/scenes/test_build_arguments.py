"""wrt.build: what it takes, and what it says of anything else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from wrt.core.errors import InputError


def test_a_path_is_built_as_its_mesh_is(tmp_path: Path) -> None:
    path = tmp_path / "box.obj"
    path.write_text(BOX_OBJ)
    o, d = np.random.default_rng(0).normal(size=(2, 200, 3)) * [[[5.0]], [[1.0]]]
    expected = wrt.build(wrt.load_mesh(path), "brute_force").closest_hit(o, d)
    assert 0 < (expected.prim_id >= 0).sum() < 200
    for given in (path, str(path)):
        assert np.array_equal(wrt.build(given).closest_hit(o, d).prim_id, expected.prim_id)


@pytest.mark.parametrize(("arguments", "message"), [
    ((None,), "mesh must be a Mesh, a Scene, the path of a mesh or scene file, .*, got None"),
    ((np.zeros((3, 3)),), r"mesh must be a Mesh, .*, got an array \(3, 3\) of float64"),
    (((np.eye(3),),), "mesh must be .* a pair .vertices, faces., got"), ((wrt.Camera(),), "mesh must be .*, got a Camera"),
    (("nothing.glb",), "nothing.glb: no such file"), (("nothing.ply",), "nothing.ply: no such file"),
    (("scene.toml",), "scene.toml: no such file"), ((wrt.Mesh(np.eye(3), [[0, 1, 2]]), 5), "accel must be a str, got 5"),
    ((wrt.Mesh(np.eye(3), [[0, 1, 2]]), "bvh", 5), "device must be a str, got 5"),
], ids=str)
def test_anything_else_is_refused_by_name(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        wrt.build(*arguments)
