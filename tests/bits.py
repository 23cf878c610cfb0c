"""Hash the pixels of the shipped scenes, and the hits of structures and of moving worlds.

`python -m tests.bits > tests/bits.txt` stores the hashes."""

from __future__ import annotations

import math
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)
import warp as wp

import wrt
from tests import device
from tests.data import ROOT
from wrt.core.device import block_dim, load_kernel
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.scene import shapes

STORED = Path(__file__).with_suffix(".txt")
SCENES = sorted((ROOT / "scenes").glob("*.toml"))
RAYS = 20_000
NAMES = {f"{name}{end}".encode() for end in ("", "f") for name in (
    "acos", "asin", "atan", "atan2", "cbrt", "cos", "cosh", "exp", "exp2", "expm1", "hypot", "log", "log10", "log1p", "log2", "pow",
    "sin", "sincos", "sinh", "tan", "tanh")}


def digest(*arrays: np.ndarray) -> str:
    return sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:32]


def pixels(scene: Path) -> str:
    return digest(wrt.render(scene, size="64x36", spp=4, seed=3).pixels)


def kernels(scene: Path) -> list[Any]:
    """Return the kernels that `pixels` runs."""
    found: list[Any] = plan_of(wrt.load_scene(scene), Options(device=device.NAME)).kernels
    return found


def library_calls(kernel: Any) -> set[str]:
    """Return the functions of NAMES that a kernel's object file calls: C libraries differ in how they round their results."""
    load_kernel(kernel, DEVICE)
    folder = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(block_dim(DEVICE))
    files = [path for path in folder.iterdir() if path.suffix in (".o", ".cubin")]  # several where there are several GPUs
    assert files
    return {name.decode() for path in files for name in NAMES & set(path.read_bytes().split(b"\0"))}


def hits(accel: str) -> str:
    """Return a hash of the hits of random and primary rays on a torus."""
    mesh = shapes.torus(1.0, 0.4, 64, 32)
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(RAYS, 3)) * 2.0
    directions = rng.normal(size=(RAYS, 3)) * 0.4 - origins
    structure = wrt.build(mesh, accel)
    hit = structure.closest_hit(origins, directions)
    assert (hit.prim_id >= 0).mean() > 0.3
    seen = structure.closest_hit(*primary_rays(160, 90))
    occluded = structure.any_hit(origins, directions, t_max=0.9)
    return digest(hit.t, hit.u, hit.v, hit.prim_id, seen.t, seen.u, seen.v, seen.prim_id, occluded)


def moving_worlds(kind: str = "bvh8", order: str = "given", rebuilt: bool = False, threads: int | None = None) -> str:
    """Return a hash of depth and ids in three worlds of moving bodies, after each of four steps.

    order: of the bodies of a step: "given", "reversed", "twice" (first to places of another step), or "in place" (all at once).
    rebuilt: a new structure for each step. Poses and rays are multiples of 2^-10, so that no function of a library plays a part.
    """
    scene = wrt.Scene(tuple(wrt.Object(mesh) for mesh in (
        shapes.icosphere(2), shapes.box((-0.5, -0.3, -0.4), (0.5, 0.3, 0.4)), shapes.torus(0.5, 0.2, 24, 12))))
    rng, found = np.random.default_rng(4), []
    matrices = rng.integers(-1024, 1024, (4, 9, 3, 4)) / 1024.0 + 1.5 * np.eye(3, 4)
    origins = (rng.integers(-1024, 1024, (RAYS, 3)) / 256.0).astype(np.float32)
    directions = (rng.integers(-1024, 1024, (RAYS, 3)) / 1024.0 - origins).astype(np.float32)
    ids = np.arange(9)[::-1 if order == "reversed" else 1]
    accel = wrt.build([scene] * 3, kind, threads=threads)
    for step in range(4):
        if rebuilt:
            accel = wrt.build([scene] * 3, kind, threads=threads)
        if order == "twice":
            accel.move(ids, matrices[(step + 2) % 4])
        if order == "in place":
            accel.move(wp.array(matrices[step], dtype=wp.float64, device=DEVICE))
        else:
            accel.move(ids, matrices[step][ids])
        hit = accel.closest_hit(origins, directions, world=np.arange(RAYS) % 3, threads=threads)
        assert (hit.prim_id >= 0).mean() > 0.3
        found += [hit.t, hit.object, hit.prim_id, hit.u, hit.v]
    return digest(*found)


def primary_rays(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions, (N, 3) float32, of a pinhole camera. Computed in float64, so that no device code plays a part."""
    pose = wrt.Camera.look_at((0.0, 2.0, 4.0), (0.0, 0.0, 0.0)).camera_to_world
    tan_y = math.tan(0.5 * 0.6)
    x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * tan_y * width / height
    y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * tan_y
    directions = x[None, :, None] * pose[:3, 0] + y[:, None, None] * pose[:3, 1] - pose[:3, 2]
    directions = (directions / np.linalg.norm(directions, axis=2, keepdims=True)).reshape(-1, 3).astype(np.float32)
    return np.tile(pose[:3, 3].astype(np.float32), (len(directions), 1)), directions


def stored() -> dict[str, str]:
    return dict(line.split() for line in STORED.read_text().splitlines())


def main() -> None:
    print("hits", hits("bvh8"))
    print("moving_worlds", moving_worlds(), flush=True)
    for scene in SCENES:
        print(scene.stem, pixels(scene), flush=True)


if __name__ == "__main__":
    main()
