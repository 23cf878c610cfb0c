"""Fitting boxes from the leaves up, with a thread for each node. The machine code has the memory order that a GPU needs."""

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


def test_boxes_bound_their_subtrees_and_a_refit_can_be_repeated() -> None:
    mesh = torus(1.0, 0.4, 40, 20)
    geometry = Geometry(mesh.vertices, mesh.faces, np.array([[0.0, 0.0, 3.0, 0.5]], np.float32))
    tree = build_binary(geometry, BvhOptions(), 1)
    nodes = tree.nodes.copy()
    for end in ("lo_0", "hi_0", "lo_1", "hi_1"):
        nodes[end] = 7.0
    there = upload(nodes, Bvh2Node, DEVICE)
    fitting = Fitting(DEVICE, len(geometry), len(nodes))
    linked = tree_of(fitting, there, parents_of(there), upload(tree.order, wp.int32, DEVICE))
    for _ in range(2):  # A repeated refit gives the same boxes.
        fitting.refit(linked, geometry.on(DEVICE))
        assert there.numpy().tobytes() == tree.nodes.tobytes()
        assert not fitting.arrived.numpy().any()
    summaries = fitting.summaries.numpy()
    assert summaries["size"][0] == len(geometry)
    assert (summaries["inner_nodes"][0], summaries["height"][0]) == (len(nodes), tree.depth)


def test_on_a_gpu_fences_order_the_writes_and_reads_bypass_the_l1_cache(tmp_path: Path) -> None:
    (ptx,) = wp.compile_aot_module(fit.fit.module, arch=75, module_dir=tmp_path, use_ptx=True)
    text = Path(ptx).read_text()
    assert len(re.findall(r"\batom\.global\.add", text)) == 1
    assert len(re.findall(r"\bmembar\.gl|\bfence\.\w+\.gpu", text)) == 2  # After the writes, and before the reads.
    assert len(re.findall(r"\bld\.volatile", text)) >= 2 * 11  # The summaries of both children.


def test_they_compile_for_hopper(tmp_path: Path) -> None:
    for kernel in (fit.fit, lbvh.write_nodes):
        (binary,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path)
        assert Path(binary).stat().st_size > 5000
