"""Compare the sum over the inspector's tree with the pixel of `wrt.render`, bit by bit: `python -m tests.inspect_all [PIXELS] [SPP]`.

It inspects random pixels of each scene in scenes/, for every camera."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import wrt
from tests.data import ROOT
from wrt.renderer.inspector.inspect import Inspector

SCENES = sorted((ROOT / "scenes").glob("*.toml"))


def differing_pixels(path: Path, camera: int, pixels: int, spp: int, seed: int = 0) -> tuple[list[tuple[int, int]], int]:
    """Return the pixels whose bits differ from those of a render by waves, and the number of rays in all trees."""
    inspector = Inspector(path, camera=camera, spp=spp, seed=seed)
    width, height = inspector.scene.settings.size
    film = wrt.render(path, camera=camera, spp=spp, seed=seed)
    rng = np.random.default_rng(seed)
    chosen = [divmod(int(at), width)[::-1] for at in rng.choice(width * height, pixels, replace=False)]
    differ, rays = [], 0
    for x, y in chosen:
        found = inspector.pixel((x, y))
        rays += sum(len(sample.rays) + sum(len(light.parts) for ray in sample.rays for light in ray.lights) for sample in found.samples)
        if found.radiance.tobytes() != film.pixels[y, x].tobytes():
            differ.append((x, y))
    return differ, rays


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.inspect_all", description=__doc__)
    parser.add_argument("pixels", type=int, nargs="?", default=1000, help="number of pixels of each scene and camera [default: 1000]")
    parser.add_argument("spp", type=int, nargs="?", default=2, help="samples per pixel [default: 2]")
    options = parser.parse_args()
    pixels, spp = options.pixels, options.spp
    failed = total = 0
    for path in SCENES:
        for camera in range(len(wrt.load_scene(path).cameras)):
            begin = time.perf_counter()
            differ, rays = differing_pixels(path, camera, pixels, spp)
            failed, total = failed + len(differ), total + pixels
            print(f"{path.stem}, camera {camera}: {len(differ)} of {pixels} pixels differ, {rays} rays,"
                  f" {time.perf_counter() - begin:.1f} s {differ[:5] or ''}", flush=True)
    print(f"{failed} of {total} pixels differ")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
