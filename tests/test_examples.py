"""The programs of docs/examples.md run, are short, and find what they claim; a DataLoader's workers query a pickled structure."""

import linecache
import re
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from wrt.scene.shapes import icosphere

PAGE = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
PROGRAMS = dict(re.findall(r"^## (.*?)\n.*?^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))


def executed(title: str) -> dict[str, Any]:
    if "import torch" in PROGRAMS[title]:
        pytest.importorskip("torch", reason="torch is not installed")
    names: dict[str, Any] = {}
    linecache.cache[title] = len(PROGRAMS[title]), None, PROGRAMS[title].splitlines(True), title  # Warp reads the text of kernels
    exec(compile(PROGRAMS[title], title, "exec"), names)
    return names


@pytest.mark.parametrize("title", PROGRAMS)
def test_programs_have_at_most_thirty_lines(title: str) -> None:
    assert PROGRAMS[title].count("\n") <= 30


def test_the_lidar_sees_room_and_pillar() -> None:
    names = executed("A robot's LiDAR")
    cloud, pillar = names["cloud"], names["seen"] == 1
    walls = np.abs(np.abs(cloud) - (10.0, 10.0, 1.0))
    assert pillar.any() and cloud.shape == (16, 1808, 3)
    assert (np.minimum(walls.min(axis=-1), np.abs(cloud[..., 2] - 3.0))[~pillar] < 0.15).all()   # noise of 0.02
    assert ((cloud[pillar] > (2.85, 0.85, -1.15)) & (cloud[pillar] < (4.15, 2.15, 3.15))).all()


def test_the_height_scan_sees_the_ground_and_not_the_robot() -> None:
    names = executed("A quadruped's height scan")
    x, y, _ = np.moveaxis(names["origins"], -1, 0)
    assert names["scan"].shape == (256, 11, 17)
    assert np.abs(0.5 - names["scan"] - 0.1 * np.sin(2.0 * x) * np.cos(3.0 * y)).max() < 0.002  # of facets
    own = names["accel"].closest_hit(names["origins"], (0.0, 0.0, -1.0), world=np.arange(256)[:, None, None])
    assert (own.t - 0.3 < 0.1).any(axis=(1, 2)).all()  # without `exclude`, each robot sees its trunk


def test_each_environment_sees_its_own_ball() -> None:
    names = executed("4,096 environments")
    depth, height = names["depth"], names["matrices"][:, 2, 3]
    assert depth.shape == (4096, 16, 16)
    top = 6.0 - height - 0.5  # depth of the highest point of each ball
    assert (depth.min(axis=(1, 2)) > top - 1e-3).all() and np.median(depth.min(axis=(1, 2)) - top) < 0.1


def test_cameras_of_a_graph_see_the_balls_where_they_are() -> None:
    names = executed("Depth cameras in a captured graph")
    images, seen, count = names["images"], names["images"].object.numpy() == 1, names["count"]
    depth = images.depth.numpy()
    assert seen.any(axis=(1, 2)).all() and np.allclose(depth[~seen], 4.0, atol=1e-5)
    assert (np.abs(depth.min(axis=(1, 2)) - 2.7) < 0.02).all()
    place = names["bodies"].numpy()[:, :2] * (1.0, -1.0) / 3.0 * 40.0 + (31.5, 23.5)  # the pixel of each ball's centre
    rows, columns = np.round(place[:, 1]).astype(int), np.round(place[:, 0]).astype(int)
    assert seen[np.arange(count), rows, columns].all()
    assert np.allclose(names["phase"].numpy(), np.linspace(0.0, 6.28, count) + 1.1, atol=1e-4)


def test_the_depth_camera_measures_a_torus() -> None:
    names = executed("A depth camera with distortion")
    assert names["error"] < 1e-6 and 0.005 < 1.0 - names["seen"].sum() / names["hits"].hit.sum() < 0.015
    assert 2.0 < names["points"][:, 2].min() < names["points"][:, 2].max() < 6.0


def test_the_pose_is_fitted_to_the_depth_picture() -> None:
    names = executed("Training with wrt in the loop")
    assert (names["pose"] - names["truth"])[3:].detach().norm() < 0.05


class Pictures:
    """Data set of depth pictures: picture i is of a ball seen from the distance 2 + i."""

    def __init__(self, accel: Any) -> None:
        self.accel = accel

    def __len__(self) -> int:
        return 8

    def __getitem__(self, i: int) -> np.ndarray:
        x = np.linspace(-0.3, 0.3, 16, dtype=np.float32)
        directions = np.stack([*np.meshgrid(x, x), np.full((16, 16), -1.0, np.float32)], axis=-1)
        return self.accel.closest_hit(np.float32([0.0, 0.0, 2.0 + i]), directions, threads=1).t


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_workers_of_a_data_loader_have_the_pictures_of_this_process(method: str) -> None:
    """spawn pickles the structure, fork copies the process."""
    data = pytest.importorskip("torch.utils.data", reason="torch is not installed")
    pictures = Pictures(wrt.build(icosphere(3)))
    expected = np.stack([pictures[i] for i in range(len(pictures))])
    loader = data.DataLoader(pictures, batch_size=4, num_workers=2, multiprocessing_context=method)
    found = np.concatenate([batch.numpy() for batch in loader])
    assert np.isfinite(expected).any() and found.tobytes() == expected.tobytes()
