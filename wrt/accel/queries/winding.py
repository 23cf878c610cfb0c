"""Winding numbers of a mesh around points."""

from __future__ import annotations

from typing import overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.hit_points import device_scene
from wrt.accel.queries.rays import vectors
from wrt.core.arrays import to_tensor_like
from wrt.core.device import launch_on, upload
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpArray
from wrt.kernels.query import FARTHEST
from wrt.kernels.winding import wind

POINTS_PER_LAUNCH = 256


@overload
def winding_number(accel: Accelerator, points: NumpyLike | WarpArray, threads: int | None = None) -> npt.NDArray[np.float64]: ...
@overload
def winding_number(accel: Accelerator, points: TensorT, threads: int | None = None) -> TensorT: ...
def winding_number(accel: Accelerator, points: ArrayLike, threads: int | None = None) -> object:
    """Compute the generalized winding number of a mesh at each point: the sum of its triangles' solid angles over 4 pi.

    For a closed mesh whose triangles face outwards it is 1 inside and 0 outside, with an error below 1e-9. Overlapping parts add
    up, and parts that face inwards count negative. Around an open mesh it changes smoothly: above 0.5 a point is mostly inside. On
    a triangle it lies between the values of both sides. A point takes some 40 ns per triangle.

    Parameters
    ----------
    accel : Accelerator
        Structure over one mesh without spheres.
    points : (N, 3) array_like
        Points, converted to float32.
    threads : int, optional
        Threads on the CPU; one per core by default.

    Returns
    -------
    (N,) float64
        Array of NumPy, or of the library of `points`: PyTorch, JAX.

    Raises
    ------
    InputError
        For other structures, and for points that are not finite.

    References
    ----------
    Jacobson, Kavan and Sorkine-Hornung 2013, "Robust Inside-Outside Segmentation using Generalized Winding Numbers".
    """
    snapshot = snapshot_of(accel)
    rows, give, device = vectors(points, "points", FARTHEST), to_tensor_like(points), snapshot.device
    turns = wp.empty(len(rows), dtype=wp.vec3d, device=device)
    launch_on(device, wind, len(rows), device_scene(snapshot).surfaces, upload(rows, wp.vec3, device), turns, None,
              threads=thread_count(threads), step=POINTS_PER_LAUNCH)
    re, im, whole = turns.numpy().reshape(-1, 3).T
    out = whole + np.arctan2(im, re) / (2.0 * np.pi)
    return out if give is None else give(upload(out, wp.float64, device))
