"""Use wrt for hours, in random order, and check every answer: `python -m tests.soak --hours 1 --seed 0`.

Steps: queries, refits, moved instances, renders and saved files. An answer must have the bits of a new structure, or of the first answer.
The program ends with exit code 1 at the first wrong answer, or if the process has grown too much. The limit `--growth` is for the line
through the memory of the last two thirds of the run.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests import bits
from tests.data import ROOT
from tests.placed import place
from tests.structures import STRUCTURES
from tests.wrt.accel.test_move import matrices
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, merged, teapot, torus

import wrt  # isort: skip

MESHES = (icosphere(3), torus(1.0, 0.4, 48, 24), teapot(8), merged([icosphere(2), torus(2.0)], ""))
SCENES = [ROOT / "scenes" / f"{name}.toml" for name in ("whitted", "instances", "textures", "cornell_box", "glass_sky", "moving")]


def resident() -> float:
    """Return the memory of this process in MiB, after garbage and, with glibc, the free pages of malloc are given back."""
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


class Soak:
    """The steps, each a method that takes no argument and raises AssertionError at a wrong answer."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.random, self.folder = random.Random(seed), folder
        self.first: dict[Any, bytes] = {}  # the first answer to a question
        self.steps = (self.query, self.refit, self.move, self.file, self.render)
        self.flat = [(mesh, build(mesh, "bvh")) for mesh in MESHES]
        balls, rings = Geometry.of(icosphere(2)), Geometry.of(torus(segments=12, tube_segments=8))
        self.crowd = build(place(*((rings if i % 3 else balls, matrix) for i, matrix in enumerate(matrices(24, 1)))), "bvh8")

    def same(self, question: Any, found: bytes) -> None:
        assert self.first.setdefault(question, found) == found, f"another answer than at first: {question}"

    def hits(self, accel: Any, rays: int, n: int = 2000) -> bytes:
        """Return the bits of hits of n random rays, which depend on `rays`."""
        rng = np.random.default_rng(rays)
        origins = rng.normal(scale=4.0, size=(n, 3))
        directions = rng.normal(scale=0.8, size=(n, 3)) - origins
        hits = accel.closest_hit(origins, directions, threads=self.random.choice((1, 2, None)))
        occluded = accel.any_hit(origins, directions)
        assert np.array_equal(occluded, hits.prim_id >= 0)
        return bits.digest(hits.t, hits.u, hits.v, hits.prim_id).encode()

    def query(self) -> None:
        """All structures, built anew, have the same hits."""
        mesh, rays = self.random.randrange(len(MESHES)), self.random.randrange(8)
        self.same(("hits", mesh, rays), self.hits(build(MESHES[mesh], self.random.choice(STRUCTURES)), rays))

    def refit(self) -> None:
        """A structure that has been refitted many times has the hits of a new one."""
        mesh, accel = self.random.choice(self.flat)
        waves = 0.3 * np.sin(3.0 * mesh.vertices[:, ::-1] + self.random.uniform(0.0, 6.0))
        vertices = (mesh.vertices * self.random.uniform(0.5, 2.0) + waves).astype(np.float32)
        accel.refit(vertices, rebuild_at=self.random.choice((1.5, np.inf)))
        rays = self.random.randrange(1000)
        assert self.hits(accel, rays) == self.hits(build(Mesh(vertices, mesh.faces), "bvh2"), rays), "a refit changed the hits"

    def move(self) -> None:
        rows = self.random.sample(range(24), self.random.randint(1, 24))
        self.crowd.move(rows, matrices(24, self.random.randrange(1000))[rows], rebuild_at=self.random.choice((1.2, np.inf)))
        rays = self.random.randrange(1000)
        assert self.hits(self.crowd, rays) == self.hits(build(self.crowd.geometry, "bvh8"), rays), "a move changed the hits"

    def file(self) -> None:
        path, mesh, rays = self.folder / "a.accel", self.random.randrange(len(MESHES)), self.random.randrange(8)
        build(MESHES[mesh], self.random.choice(STRUCTURES)).save(path, mesh=True)
        self.same(("hits", mesh, rays), self.hits(wrt.load_accel(path), rays))
        path.unlink()

    def render(self) -> None:
        scene, seed = self.random.choice(SCENES), self.random.randrange(3)
        film = wrt.render(scene, size=(64, 36), spp=2, seed=seed, threads=self.random.choice((1, 2)))
        self.same(("pixels", scene.stem, seed), bits.digest(film.pixels).encode())


def slope(seconds: list[float], memory: list[float], first: int = 1, end: int = 3) -> tuple[float, float]:
    """Return the slope in MiB per hour, and the growth in MiB, of a line through the thirds first .. end - 1 of the samples."""
    x, y = (values[len(values) * first // 3 : len(values) * end // 3] for values in (seconds, memory))
    if len(x) < 2:
        return 0.0, 0.0
    per_second = float(np.polyfit(x, y, 1)[0])
    return 3600.0 * per_second, per_second * (x[-1] - x[0])


def run(seconds: float, seed: int, growth: float, report: Callable[[str], None]) -> int:
    """Soak, report one line a minute, and return the exit code."""
    done, times, memory, begin = Counter[str](), list[float](), list[float](), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(seed, Path(folder))
        try:
            for step in dict.fromkeys(soak.steps):  # each kind once, so that kernels are loaded before memory is measured
                step()
            while not times or times[-1] < seconds:
                step = soak.random.choice(soak.steps)
                step()
                done[step.__name__] += 1
                memory.append(resident())
                times.append(time.monotonic() - begin)
                if len(times) == 1 or times[-1] // 60 > times[-2] // 60:
                    report(f"{times[-1]:.0f} s: {done.total()} steps, {memory[-1]:.0f} MiB")
        except AssertionError as error:
            report(f"seed {seed}, step {done.total() + 1}: {error}")
            return 1
    per_hour, grown = slope(times, memory)
    report(f"{done.total()} steps in {times[-1]:.0f} s, all right: {', '.join(f'{count} {name}' for name, count in sorted(done.items()))}")
    report(f"memory: {memory[0]:.0f} MiB after warming up, {memory[-1]:.0f} at the end, slope {per_hour:+.1f} MiB per hour,"
           f" by thirds {', '.join(f'{slope(times, memory, third, third + 1)[0]:+.1f}' for third in range(3))}")
    if grown > growth:
        report(f"the process grew by {grown:.0f} MiB, more than {growth:.0f}")
        return 1
    return 0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--growth", type=float, default=32.0, help="largest growth of memory in MiB  [default: 32]")
    options = parser.parse_args()
    if not (options.hours > 0.0 and options.growth > 0.0):
        parser.error("--hours and --growth must be above 0")
    sys.exit(run(3600.0 * options.hours, options.seed, options.growth, lambda line: print(line, flush=True)))


if __name__ == "__main__":
    main()
