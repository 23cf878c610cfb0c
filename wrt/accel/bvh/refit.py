"""Binary trees that follow their vertices."""

from __future__ import annotations

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import launch, start, upload
from wrt.kernels.build.refit import refit
from wrt.kernels.traverse.bvh2 import Bvh2Node


def refit_nodes(nodes: np.ndarray, order: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Copies of Bvh2Node records, a parent before its children, whose boxes fit the geometry as it is now; order: (R,) int32, the
    prim_id of each primitive that the leaves name. Boxes of spatial splits become those of the whole triangles."""
    cpu = start("cpu")
    lo, hi = geometry.bounds()
    device_nodes = upload(nodes.copy(), Bvh2Node, cpu)
    launch(refit, 1, device_nodes, upload(order.copy(), wp.int32, cpu), upload(lo, wp.vec3, cpu), upload(hi, wp.vec3, cpu))
    return np.asarray(device_nodes.numpy()).copy()
