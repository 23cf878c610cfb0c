"""Use wrt for hours, in random order, and check every answer: `python -m tests.soak --hours 1 --seed 0`.

Steps: queries, refits, moved instances, renders, saved files, processes that are killed while they save or render, and strangers at the
viewer. An answer must have the bits of a new structure, or of the first answer. The program ends with exit code 1 at the first wrong
answer, or if the process has grown too much. The limit `--growth` is for the line through the memory of the last two thirds of the run.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests import bits, device
from tests.data import ROOT
from tests.placed import place
from tests.structures import STRUCTURES
from tests.trust import record
from tests.wrt.accel.test_move import matrices
from tests.wrt.viewer.client import Client, answer
from tests.wrt.viewer.test_access import Served, attempts
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.picture.image import read_channels
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, merged, teapot, torus

import wrt  # isort: skip

MESHES = (icosphere(3), torus(1.0, 0.4, 48, 24), teapot(8), merged([icosphere(2), torus(2.0)], ""))
SCENES = [ROOT / "scenes" / f"{name}.toml" for name in ("whitted", "instances", "textures", "cornell_box", "glass_sky", "moving")]
SAVE = """
import sys, wrt
from wrt.scene.shapes import torus
accel = wrt.build(torus(1.0, 0.4, 400, 200), "bvh8")
accel.save(sys.argv[1], mesh=True)
print("saved", flush=True)
while True:
    accel.save(sys.argv[1], mesh=True)
"""
BAD_REQUESTS = (b"", b"\r\n\r\n", b"GET", b"GET / HTTP/1.1\r\nHost: ", b"\x16\x03\x01\x02\x00\x01", b"GET /" + b"a" * 9000, b"\x00" * 5000)


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
        self.served = Served()
        common: list[Callable[[], None]] = [self.query, self.refit, self.move, self.file, self.render, self.stranger]
        self.steps = common * 4 + [self.killed_save, self.killed_render]
        self.flat = [(mesh, build(mesh, "bvh")) for mesh in MESHES]
        balls, rings = Geometry.of(icosphere(2)), Geometry.of(torus(segments=12, tube_segments=8))
        self.crowd = build(place(*((rings if i % 3 else balls, matrix) for i, matrix in enumerate(matrices(24, 1)))), "bvh8")

    def close(self) -> None:
        self.served.page.close()
        self.served.page.thread.join()

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

    def stranger(self) -> None:
        """Requests without access get nothing; half a request disturbs nobody; the page still answers with a picture."""
        port, token = self.served.port, self.served.token
        for target, headers in self.random.sample(attempts(port, token), 5):
            assert answer(port, target, headers).startswith(b"HTTP/1.1 403 "), f"access without a token: {target} {headers}"
        with socket.create_connection(("127.0.0.1", port), timeout=60.0) as connection, contextlib.suppress(ConnectionError):
            request = self.random.choice([*BAD_REQUESTS, f"GET /{token}/ HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n".encode()])
            connection.sendall(request[: self.random.randint(0, len(request))])
        browser = Client(self.served.page.url)
        try:
            browser.open()
            browser.move(self.random.uniform(-1.0, 1.0))
            assert browser.picture().startswith((b"\x89PNG", b"\xff\xd8", b"RIFF"))
        finally:
            browser.socket.close()

    def run_and_kill(self, seconds: float, *command: object) -> None:
        """Run a command of Python, wait for its first line, and kill it (-9) after some seconds."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=self.folder,
                              env=environment) as running:
            assert running.stdout is not None
            if "-c" in command:
                running.stdout.readline()
            time.sleep(seconds)
            running.kill()

    def killed_save(self) -> None:
        path = self.folder / "killed.accel"
        self.run_and_kill(self.random.uniform(0.0, 0.3), "-c", SAVE, path)
        self.same("killed save", self.hits(wrt.load_accel(path), 0))
        self.clear("killed.accel")

    def killed_render(self) -> None:
        """A render that is killed and resumed, perhaps several times, writes the picture of one that runs to its end."""
        scene = SCENES[0]
        words = ("-m", "wrt", "render", scene, "--size", "64x36", "--spp", 256, "-q", "--device", device.NAME, "-o", "a.exr",
                 "--checkpoint", "0.05s", "--resume")
        for _ in range(self.random.randint(0 if "killed render" not in self.first else 1, 2)):
            self.run_and_kill(self.random.uniform(0.5, 4.0), *words)
        subprocess.run([sys.executable, *map(str, words)], cwd=self.folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True,
                       capture_output=True)
        picture = read_channels(self.folder / "a.exr")
        self.same("killed render", bits.digest(*(picture[name] for name in sorted(picture))).encode())
        self.clear("a.exr")

    def clear(self, *expected: str) -> None:
        """Empty the folder. A kill may leave temporary files of wrt, and nothing else but what is expected."""
        for path in self.folder.iterdir():
            assert path.name in expected or path.name.startswith(".wrt-"), f"left behind: {path.name}"
            path.unlink()


def slope(seconds: list[float], memory: list[float], first: int = 1, end: int = 3) -> tuple[float, float]:
    """Return the slope in MiB per hour, and the growth in MiB, of a line through the thirds first .. end - 1 of the samples."""
    x, y = (values[len(values) * first // 3 : len(values) * end // 3] for values in (seconds, memory))
    if len(x) < 2:
        return 0.0, 0.0
    per_second = float(np.polyfit(x, y, 1)[0])
    return 3600.0 * per_second, per_second * (x[-1] - x[0])


def run(seconds: float, seed: int, growth: float, report: Callable[[str], None], records: bool = False) -> int:
    """Soak, report one line a minute, and return the exit code. records: store the figures in tests/trust.json."""
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
        finally:
            soak.close()
    per_hour, grown = slope(times, memory)
    report(f"{done.total()} steps in {times[-1]:.0f} s, all right: {', '.join(f'{count} {name}' for name, count in sorted(done.items()))}")
    report(f"memory: {memory[0]:.0f} MiB after warming up, {memory[-1]:.0f} at the end, slope {per_hour:+.1f} MiB per hour,"
           f" by thirds {', '.join(f'{slope(times, memory, third, third + 1)[0]:+.1f}' for third in range(3))}")
    if grown > growth:
        report(f"the process grew by {grown:.0f} MiB, more than {growth:.0f}")
        return 1
    if records:
        record("soak", f"{done.total():,} steps in {times[-1] / 60.0:.0f} minutes", f"0 wrong answers, {per_hour:+.1f} MiB per hour")
    return 0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--growth", type=float, default=32.0, help="largest growth of memory in MiB  [default: 32]")
    parser.add_argument("--record", action="store_true", help="store the figures in tests/trust.json")
    options = parser.parse_args()
    if not (options.hours > 0.0 and options.growth > 0.0):
        parser.error("--hours and --growth must be above 0")
    sys.exit(run(3600.0 * options.hours, options.seed, options.growth, lambda line: print(line, flush=True), options.record))


if __name__ == "__main__":
    main()
