"""`wrt.tune` with a simulated clock: it returns the fastest choice as arguments for other functions."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import warp as wp

import wrt
from tests import device
from tests.command_line import wrt as run
from tests.refused import refused
from wrt.core import cuda
from wrt.core.device import launch_on, start
from wrt.kernels.traverse.stack import PLACES
from wrt.lab import tune as tuning
from wrt.lab.tune import DEFAULT, Choice, measured, tune
from wrt.scene import shapes
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene

Costs = dict[Choice, float]  # simulated seconds of a query; 1 for a missing choice


@pytest.fixture
def measured_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[Costs], tuning.Tuning]:
    """Return a function that tunes with simulated times, on a small mesh and two structures."""
    for name, value in {"CELLS": 4, "KINDS": ("diffuse",), "FAST": 64, "SLOW": 64, "STRUCTURES": ("bvh8", "bvh2")}.items():
        monkeypatch.setattr(tuning, name, value)
    monkeypatch.setattr(cuda, "BLOCK_DIMS", (64, 32))

    def by(costs: Costs) -> tuning.Tuning:
        search_with, now = tuning.search_with, [0.0]

        def slow(choice: Choice, search: Any) -> None:
            search_with(choice, search)
            now[0] += costs.get(choice, 1.0)

        monkeypatch.setattr(tuning, "search_with", slow)
        return measured(device.NAME, clock=lambda: now[0])

    return by


@pytest.mark.filterwarnings("ignore:the picture is all black:wrt.SceneWarning")
def test_the_fastest_choice_is_returned_as_arguments(measured_by: Callable[[Costs], tuning.Tuning]) -> None:
    there, before = start(device.NAME), (cuda.block_dim, cuda.stack)
    found = measured_by({Choice("bvh2"): 0.5, Choice("bvh2", 32): 0.4, Choice("bvh2", 32, "shared"): 0.25})
    best = Choice("bvh2", 32, "shared") if there.is_cuda else Choice("bvh2")
    assert found.best == best and (cuda.block_dim, cuda.stack) == before
    assert found.speeds[DEFAULT] == 1.0 and found.speeds[best] == (4.0 if there.is_cuda else 2.0)
    assert found.arguments == {"accel": "bvh2", "device": device.NAME}
    accel = wrt.build(shapes.icosphere(2), **found.arguments)
    assert (accel.name, accel.device) == ("bvh2", there)
    scene = Scene(objects=(Object(shapes.icosphere(1), (Material(),)),), cameras=(Camera(),))
    assert wrt.render(scene, size=(4, 4), spp=1, **found.arguments).stats["accel"]["name"] == "bvh2"
    assert f'accel="bvh2", device="{device.NAME}"; for commands --accel bvh2 --device {device.NAME}.' in found.text()


def test_the_default_stays_unless_another_choice_is_clearly_faster(measured_by: Callable[[Costs], tuning.Tuning]) -> None:
    assert measured_by({Choice("bvh2"): 0.98, Choice("bvh2", 32): 0.98, Choice("bvh8", 32): 0.98}).best == DEFAULT


def test_the_default_choice_has_the_default_settings_of_launches() -> None:
    assert DEFAULT == ("bvh8", cuda.block_dim, cuda.stack) and set(cuda.STACKS) == set(PLACES)
    assert wrt.ACCELERATORS["bvh"] is wrt.ACCELERATORS["bvh8"] and set(tuning.STRUCTURES) <= wrt.ACCELERATORS.keys()


def test_the_command_and_the_function_return_the_same_arguments(measured_by: Callable[[Costs], tuning.Tuning]) -> None:
    result = run("devices", "--tune", "--device", device.NAME, "--json")
    assert result.code == 0, result.err
    data = json.loads(result.out)
    assert data["arguments"]["device"] == device.NAME and data["best"]["accel"] == data["arguments"]["accel"]
    assert {row["accel"] for row in data["rows"]} == {"bvh8", "bvh2"} and all(min(row["mrays"]) > 0.0 for row in data["rows"])
    assert data["machine"].startswith(f"{device.NAME}: ")
    text = run("devices", "--tune", "--device", device.NAME)
    assert text.code == 0 and "Fastest: bvh" in text.out
    assert tune(device.NAME).keys() == data["arguments"].keys()


@pytest.mark.parametrize(("words", "message"), [
    (("--tune", "--check"), "give one"), (("--tune", "--rays", "9"), "--device, --scene and --rays need --check"),
    (("--tune", "--device", "cuda:7"), "no device 'cuda:7'")])
def test_wrong_options_are_refused(words: tuple[str, ...], message: str) -> None:
    result = run("devices", *words)
    assert result.code == 2 and message in result.err


def test_zero_seconds_are_refused() -> None:
    with refused("seconds", "more than 0"):
        tune(device.NAME, seconds=0.0)


@wp.kernel(enable_backward=False)
def blocks(out: wp.array(dtype=int), first: int) -> None:
    out[first + wp.tid()] = wp.block_dim()


def test_launches_have_blocks_of_that_size(monkeypatch: pytest.MonkeyPatch) -> None:
    there = start(device.NAME)
    for size in (32, 64):
        out = wp.zeros(100, dtype=int, device=there)
        monkeypatch.setattr(cuda, "block_dim", size)
        launch_on(there, blocks, 100, out, None)
        assert set(out.numpy().tolist()) == {size if there.is_cuda else 1}
