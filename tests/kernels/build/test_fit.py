"""Boxes from the leaves up, by as many threads as there are nodes: what makes that right on a GPU is in the machine code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.bvh.builders import BvhOptions, build_binary
from wrt.accel.bvh.refit import Fitting, parents_of, tree_of
from wrt.accel.geometry import Geometry
from wrt.core.device import upload
from wrt.kernels.build import fit, lbvh
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.scene.shapes import torus


def test_boxes_hold_what_is_below_and_room_is_left_as_it_was() -> None:
    mesh = torus(1.0, 0.4, 40, 20)
    geometry = Geometry(mesh.vertices, mesh.faces, np.array([[0.0, 0.0, 3.0, 0.5]], np.float32))
    tree = build_binary(geometry, BvhOptions(), 1)
    nodes = tree.nodes.copy()
    for end in ("lo_0", "hi_0", "lo_1", "hi_1"):
        nodes[end] = 7.0
    there = upload(nodes, Bvh2Node, DEVICE)
    fitting = Fitting(DEVICE, len(geometry), len(nodes))
    linked = tree_of(fitting, there, parents_of(there), upload(tree.order, wp.int32, DEVICE))
    for _ in range(2):  # the second time as the first
        fitting.refit(linked, geometry.on(DEVICE))
        assert there.numpy().tobytes() == tree.nodes.tobytes()
        assert not fitting.arrived.numpy().any()
    below = fitting.below.numpy()
    assert below["size"][0] == len(geometry) and (below["used"][0], below["height"][0]) == (len(nodes), tree.depth)


def test_a_gpu_waits_for_what_others_have_written_and_reads_it_past_its_own_cache(tmp_path: Path) -> None:
    (ptx,) = wp.compile_aot_module(fit.fit.module, arch=75, module_dir=tmp_path, use_ptx=True)
    text = Path(ptx).read_text()
    assert len(re.findall(r"\batom\.global\.add", text)) == 1
    assert len(re.findall(r"\bmembar\.gl|\bfence\.\w+\.gpu", text)) == 2  # before others are told, and after
    assert len(re.findall(r"\bld\.volatile", text)) >= 2 * 11  # of both children all that they tell


def test_they_compile_for_hopper(tmp_path: Path) -> None:
    for kernel in (fit.fit, lbvh.emit):
        (binary,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path)
        assert Path(binary).stat().st_size > 5000
