"""`wrt.tune` by a clock of the tests' own: what is found best is kept, and what that changes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests import device
from tests.command_line import wrt as run
from wrt.accel.structures import chosen, stack_on
from wrt.core.device import block_dim, describe_devices, launch_on, start
from wrt.core.errors import InputError
from wrt.core.tuned import DEFAULT, Choice, kept, using
from wrt.lab import tune as tuning
from wrt.lab.tune import tune
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.scene import shapes
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene

Costs = dict[Choice, float]  # seconds of a query; 1 where nothing is said
RAYS = np.zeros((9, 3), np.float32) + np.array([0.1, 0.2, 5.0], np.float32), np.full((9, 3), -1.0, np.float32) * (0.0, 0.0, 1.0)


@pytest.fixture
def tuned_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Costs], Any]:
    """Tunes the device by a clock that says so, over little and between few."""
    monkeypatch.setenv("WRT_CACHE_PATH", str(tmp_path))
    for name, value in {"CELLS": 4, "KINDS": ("diffuse",), "FAST": 64, "SLOW": 64, "STRUCTURES": ("bvh8", "bvh2"),
                        "BLOCK_DIMS": (64, 32)}.items():
        monkeypatch.setattr(tuning, name, value)

    def tuned(costs: Costs) -> Any:
        ask, now = tuning.ask, [0.0]

        def slow(choice: Choice, search: Any, there: Any) -> None:
            ask(choice, search, there)
            now[0] += costs.get(choice, 1.0)

        monkeypatch.setattr(tuning, "ask", slow)
        return tune(device.NAME, clock=lambda: now[0])

    return tuned


def test_the_fastest_is_kept_and_taken(tuned_by: Callable[[Costs], Any]) -> None:
    there = start(device.NAME)
    before = wrt.build(shapes.icosphere(2)).closest_hit(*RAYS)
    assert chosen("bvh", device.NAME) == "bvh8" and kept(there) is None
    tuning_of = tuned_by({Choice("bvh2"): 0.5, Choice("bvh2", 32): 0.4, Choice("bvh2", 32, "local"): 0.25})
    best = Choice("bvh2", 32, "local") if there.is_cuda else Choice("bvh2")
    assert tuning_of.choice == best == kept(there) and tuning_of.path.is_file()
    assert tuning_of.speeds[DEFAULT] == 1.0 and tuning_of.speeds[best] == (4.0 if there.is_cuda else 2.0)
    assert stack_on(device.NAME) == "local" and stack_on("cuda:0", tuned=False) == "shared"
    assert block_dim(there) == (32 if there.is_cuda else 1)
    assert chosen("bvh", device.NAME) == "bvh2" and chosen("bvh4", device.NAME) == "bvh4"
    assert any(line.startswith(f"{device.NAME}: ") and ", tuned: bvh2" in line for line in describe_devices())
    accel = wrt.build(shapes.icosphere(2))
    after = accel.closest_hit(*RAYS)
    assert accel.name == "bvh2" and (after.prim_id >= 0).all()
    for name in ("t", "u", "v", "prim_id"):
        assert getattr(before, name).tobytes() == getattr(after, name).tobytes()
    assert wrt.build(shapes.icosphere(1), "bvh8").name == "bvh8"
    query = wrt.ray_query("bvh", device=device.NAME)
    assert query.World is wrt.ray_query(accel).World is not wrt.ray_query("bvh8").World


def test_what_is_not_clearly_faster_is_not_taken(tuned_by: Callable[[Costs], Any]) -> None:
    assert tuned_by({Choice("bvh2"): 0.98, Choice("bvh2", 32): 0.98, Choice("bvh8", 32): 0.98}).choice == DEFAULT


def test_pictures_take_it_where_they_end_here(tuned_by: Callable[[Costs], Any], tmp_path: Path) -> None:
    scene = Scene(objects=(Object(shapes.icosphere(1), (Material(),)),), cameras=(Camera(),))
    tuned_by({Choice("bvh2"): 0.5, Choice("bvh2", 64, "local"): 0.1})

    def plan(**options: Any) -> Any:
        return plan_of(scene, Options(device=device.NAME, **options))

    assert plan().accel == "bvh2" == plan().structure.accel.name
    assert plan(accel="bvh4").accel == "bvh4" and plan().structure.units.stack == "local"
    # A checkpoint may be gone on with by another device.
    alone = plan(checkpoint=tmp_path / "a.checkpoint")
    assert alone.accel == "bvh8" and alone.structure.units.stack == ("shared" if start(device.NAME).is_cuda else "local")


def test_the_command(tuned_by: Callable[[Costs], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    result = run("devices", "--tune", "--device", device.NAME, "--json")
    assert result.code == 0, result.err
    told = json.loads(result.out)
    (path,) = tmp_path.iterdir()
    assert told["path"] == str(path) and told["choice"].items() <= json.loads(path.read_text()).items()
    assert {row["accel"] for row in told["rows"]} == {"bvh8", "bvh2"} and all(min(row["mrays"]) > 0.0 for row in told["rows"])
    assert told["machine"].startswith(f"{device.NAME}: ")
    text = run("devices", "--tune", "--device", device.NAME)
    assert text.code == 0 and f"kept in {path}" in text.out
    assert f"tuned: {json.loads(path.read_text())['accel']}" in run("devices").out


@pytest.mark.parametrize(("words", "message"), [
    (("--tune", "--check"), "give one"), (("--tune", "--rays", "9"), "--device, --scene and --rays belong to --check"),
    (("--tune", "--device", "cuda:7"), "no device 'cuda:7'")])
def test_mistakes_of_the_command(words: tuple[str, ...], message: str) -> None:
    result = run("devices", *words)
    assert result.code == 2 and message in result.err


def test_mistakes_are_told_before_anything_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WRT_CACHE_PATH", str(tmp_path / "file"))
    monkeypatch.setattr(tuning, "measure", None)
    with pytest.raises(InputError, match="WRT_CACHE_PATH names another folder"):
        tune(device.NAME)
    with pytest.raises(InputError, match="seconds must be more than 0"):
        tune(device.NAME, seconds=0.0)


@wp.kernel(enable_backward=False)
def blocks(out: wp.array(dtype=int), first: int) -> None:
    out[first + wp.tid()] = wp.block_dim()


def test_launches_have_blocks_of_that_size() -> None:
    there = start(device.NAME)
    for size in (32, 64):
        out = wp.zeros(100, dtype=int, device=there)
        with using(there, Choice(block_dim=size)):
            launch_on(there, blocks, 100, out, None)
        assert set(out.numpy().tolist()) == {size if there.is_cuda else 1}
