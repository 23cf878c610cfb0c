"""Compile kernels ahead of time, for containers and the workers of a cluster."""

from functools import partial

import numpy as np

from wrt.accel.scenes.build import build
from wrt.core.device import load_kernel, start
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.threads import run_all
from wrt.core.warp_private import short_name
from wrt.renderer.film_arrays import OF_AOVS
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.scene.model import Scene
from wrt.scene.shapes import icosphere


def compile_queries(accel: str, device: str = DEFAULT_DEVICE) -> list[str]:
    """Compile the kernels that build and query an acceleration structure; return their names. Raises InputError for an unknown name."""
    structure = build(icosphere(2), accel, device)
    rays = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    structure.closest_hit(*rays)
    structure.any_hit(*rays)
    return ["closest_hit", "any_hit"]


def compile_picture(scene: Scene, accel: str, device: str = DEFAULT_DEVICE, threads: int = 1) -> list[str]:
    """Compile the kernels that render a scene with all AOVs; return their names. Raises InputError if the scene cannot be rendered."""
    target = start(device)
    kernels = plan_of(scene, Options(accel=accel, device=device, aov=tuple(OF_AOVS))).kernels
    run_all([partial(load_kernel, kernel, target) for kernel in kernels], threads)
    return [short_name(kernel) for kernel in kernels]
