"""`devices --check` of a CPU; tests/virtual_gpu checks virtual GPUs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command_line import wrt as run
from wrt.accel.queries.answers import Hits
from wrt.lab import device_check
from wrt.lab.device_check import different, structures
from wrt.renderer.render import render

FLOOR = """
[cameras.main]
position = [0, 2, 3]
target = [0, 0, 0]
[[quads]]
corner = [-1, 0, 1]
edge_u = [2, 0, 0]
edge_v = [0, 0, -2]
material = "floor"
[materials.floor]
albedo = 0.5
[[lights]]
type = "point"
position = [2, 3, 4]
intensity = [9, 9, 9]
"""
WORDS = "devices", "--check", "--device", "cpu", "--rays", "300", "-q", "--scene"


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a small scene; reduce the meshes, rays and structures that are compared."""
    (tmp_path / "floor.toml").write_text(FLOOR, encoding="utf-8")
    monkeypatch.setattr(device_check, "MESHES", {"ball": device_check.MESHES["ball"]})
    monkeypatch.setattr(device_check, "HARD_CASES", {name: device_check.HARD_CASES[name] for name in ("C_spheres", "I_rays_not_finite")})
    monkeypatch.setattr(device_check, "structures", lambda: ["bvh8", "brute_force"])
    return tmp_path / "floor.toml"


def test_on_a_cpu_structures_agree_and_nothing_is_compared_with_itself(scene: Path) -> None:
    result = run(*WORDS, str(scene), "--json")
    assert result.code == 0, result.err
    data = json.loads(result.out)
    assert data["differ"] == 0 and data["machine"].startswith("cpu: ")
    compared = {(row["part"], row["what"], row["against"]): row["count"] for row in data["rows"]}
    assert compared == {("hits", "brute_force", "bvh8"): 4 * 17**2, ("hits", "bvh2, 1 hard cases", "bvh8"): 2000,
                        ("pixels", "floor", "bvh2"): 64 * 36}


def test_one_wrong_bit_is_reported(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bit is wrong in the first hits of brute force, which are those of primary rays."""
    make, wrong = device_check.build, []

    def build(*arguments: Any, **options: Any) -> Any:
        accel = make(*arguments, **options)
        if accel.name == "brute_force":
            ask = accel.closest_hit

            def closest_hit(*rays: Any) -> Hits:
                hits = ask(*rays)
                if not wrong:
                    hits.v.view(np.int32)[7] ^= 1
                    wrong.append(hits)
                return hits

            accel.closest_hit = closest_hit
        return accel

    monkeypatch.setattr(device_check, "build", build)
    result = run(*WORDS, str(scene))
    assert result.code == 1 and "\n1 result differs.\n" in result.out
    table = [[cell.strip() for cell in line.split("|")] for line in result.out.splitlines() if line.startswith("|")]
    assert [cells[5:7] for cells in table if cells[2] == "brute_force"] == [["1", "ball, primary"]]


def test_bits_are_compared_and_not_numbers() -> None:
    a = np.array([[0.0, 1.0], [np.nan, 2.0], [3.0, 4.0]], np.float32)
    b = a.copy()
    assert not different(a, b).any()
    b[0, 0], b[2, 1] = -0.0, np.nextafter(np.float32(4.0), np.float32(5.0))
    assert different(a, b).tolist() == [True, False, True]


def test_without_scene_files_a_built_in_scene_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"whitted", "lens"} <= device_check.scenes().keys() and set(structures()) >= {"bvh8", "bsp", "brute_force"}
    monkeypatch.setattr(device_check, "FOLDER", tmp_path)
    (scene,) = device_check.scenes().values()
    film = render(scene, size=(64, 36), spp=1)
    assert 0.02 < film.pixels.mean() < 5.0 and film.stats["not_finite"] == 0


@pytest.mark.parametrize(("words", "message"), [
    (("--device", "cuda:7", "--check"), "no device 'cuda:7'; there is cpu"),
    (("--device", "cpu"), "--device, --scene and --rays need --check"),
    (("--check", "--device", "cpu", "--rays", "0"), "rays must be"),
])
def test_wrong_options_are_refused(words: tuple[str, ...], message: str) -> None:
    result = run("devices", *words)
    assert result.code == 2 and message in result.err
