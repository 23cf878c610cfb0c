"""On the CPU, the kernel reads a sensor's rays and writes hits in the memory of the caller's arrays: shown by addresses."""

from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import cpu_only
from wrt.accel.queries import batches
from wrt.scene.shapes import icosphere

pytestmark = cpu_only
SIZE = 300, 200
K = [[300.0, 0.0, 149.5], [0.0, 300.0, 99.5], [0.0, 0.0, 1.0]]


def address(array: Any) -> int:
    """Return the address of the first number of an array of NumPy, Warp or torch."""
    for name in ("data_ptr", "ptr"):
        if hasattr(array, name):
            value = getattr(array, name)
            return int(value() if callable(value) else value)
    return int(array.ctypes.data)


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Return a list that receives, for each query of all rays of a picture, the addresses that its kernel reads and writes."""
    out: list[list[int]] = []

    def pack(kind: Any, rays: list[np.ndarray], results: list[np.ndarray]) -> Any:
        if len(rays[0]) == SIZE[0] * SIZE[1]:
            out.append([array.ctypes.data for array in (*rays[:2], *results)])
        return packed(kind, rays, results)

    packed = batches.pack
    monkeypatch.setattr(batches, "pack", pack)
    return out


@pytest.mark.parametrize("library", ["numpy", "warp", "torch"])
def test_rays_and_hits_are_used_in_place(launched: list[list[int]], library: str) -> None:
    if library == "torch":
        torch = pytest.importorskip("torch", reason="torch is not installed: wrt does not need it")
        like, kind = torch.zeros(1), torch.Tensor
    else:
        like, kind = (None, np.ndarray) if library == "numpy" else (wp.zeros(1, dtype=float, device="cpu"), wp.array)
    pose = np.eye(4)
    pose[2, 3] = -4.0
    sensor = wrt.sensors.pinhole(K, SIZE, pose, like=like)
    accel = wrt.build(icosphere(3))
    hits = accel.closest_hit(sensor.origins, sensor.directions)
    occluded = accel.any_hit(sensor.origins, sensor.directions)
    assert all(isinstance(array, kind) for array in (sensor.origins, sensor.directions, hits.t, hits.prim_id, occluded))
    rays = [address(sensor.origins), address(sensor.directions)]
    assert launched == [[*rays, *(address(array) for array in (hits.t, hits.u, hits.v, hits.prim_id))], [*rays, address(occluded)]]
    again = accel.closest_hit(sensor.origins, sensor.directions, out=hits)
    assert launched[2] == launched[0] and address(again.t) == address(hits.t)
    assert address(sensor.picture(hits.t)) == address(hits.t) and 0.05 < np.asarray(occluded).mean() < 0.9
