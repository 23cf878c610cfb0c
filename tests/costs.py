"""Compare the work of a ray with tests/costs.txt: `python -m tests.costs`; `--write` renews the file.

Times depend on the machine and its load; these figures do not. wrt's counters give nodes, boxes and triangles a ray. Valgrind's
callgrind gives the instructions, for kernels compiled for x86-64-v3 (AVX2) on every machine. Meshes and rays are drawn here.
The command exits with 1 if a ray of the default structure visits more nodes, boxes or triangles than the file says, or takes over 3 %
more instructions. Instructions of calls with one ray are mostly Python's: another Python or NumPy asks for `--write`.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp

import wrt
from tests.structures import STRUCTURES
from wrt.accel.base import Accelerator
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

STORED = Path(__file__).with_suffix(".txt")
DEFAULT = "bvh8"
SLACK = 1.03  # Largest ratio of instructions to the stored ones.
SIDE = 160  # Primary rays in a row.
LARGE = SIDE * SIDE  # Rays of each kind.
OTHERS = 4  # Structures other than the default one trace LARGE / OTHERS of the rays, because Valgrind is slow.
FEW, MANY = 10, 40  # Calls with one ray.
COUNTED = "nodes", "boxes", "primitives"
FLAGS = "-target-cpu x86-64-v3"  # Instead of -march=native, because Valgrind has no AVX-512.
Costs = dict[str, list[float]]  # "structure mesh kind" -> nodes, boxes and triangles a ray (NaN: not counted), instructions a ray


class Rays(NamedTuple):
    origins: np.ndarray  # (N, 3) float32
    directions: np.ndarray  # (N, 3) float32, of any length
    t_max: float


# --- meshes and rays: only sums, products, quotients and square roots, whose bits are the same on every machine ------------


@cache
def meshes() -> dict[str, Mesh]:
    """Return a height field of 51,200 triangles, and 60 balls of 1,280 triangles each, some of which overlap; both of size 2."""
    rng = np.random.default_rng(5)
    heights = rng.uniform(-0.4, 0.4, (161, 161))
    for _ in range(3):  # smooth
        heights[1:-1, 1:-1] = 0.25 * (heights[:-2, 1:-1] + heights[2:, 1:-1] + heights[1:-1, :-2] + heights[1:-1, 2:])
    x, z = np.mgrid[:161, :161] / 80.0 - 1.0
    i, j = np.mgrid[:160, :160].reshape(2, -1)
    a, b, c, d = (161 * (i + k) + j + m for k, m in ((0, 0), (0, 1), (1, 1), (1, 0)))
    field = Mesh(np.stack([x, heights, z], axis=-1).reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    ball = icosphere(3)
    centers, radii = rng.uniform(-0.8, 0.8, (60, 1, 3)), rng.uniform(0.05, 0.3, (60, 1, 1))
    faces = np.arange(60)[:, None, None] * len(ball.vertices) + ball.faces
    return {"field": field, "balls": Mesh((centers + radii * ball.vertices).reshape(-1, 3), faces.reshape(-1, 3))}


@cache
def rays(name: str) -> dict[str, Rays]:
    """Return LARGE rays of each kind for the mesh of this name.
    primary: through the pixels of a picture, row by row; bounce: from the surface into its upper hemisphere; any: from there to a light."""
    mesh, rng = meshes()[name], np.random.default_rng(7)
    y, x = np.mgrid[:SIDE, :SIDE].reshape(2, -1) / (SIDE / 2) - 1.0
    camera = Rays(np.broadcast_to(np.float32([0.1, 0.9, 2.4]), (LARGE, 3)).copy(),
                  np.stack([0.4 * x, 0.4 * y - 0.4, np.full(LARGE, -1.0)], axis=1).astype(np.float32), np.inf)
    corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), LARGE)]].astype(np.float64)
    (u, v), begin = rng.uniform(0.0, 0.5, (2, LARGE, 1)), corners[:, 0]
    normals = np.cross(corners[:, 1] - begin, corners[:, 2] - begin)
    normals /= np.sqrt(normals[:, 0] ** 2 + normals[:, 1] ** 2 + normals[:, 2] ** 2)[:, None]
    points = begin + u * (corners[:, 1] - begin) + v * (corners[:, 2] - begin) + 1e-4 * normals
    light = np.float32([0.5, 2.0, 0.7]) - points.astype(np.float32)
    return {"primary": camera,
            "bounce": Rays(points.astype(np.float32), (normals + rng.uniform(-0.7, 0.7, (LARGE, 3))).astype(np.float32), np.inf),
            "any": Rays(points.astype(np.float32), light, 1.0)}


# --- counters ----------------------------------------------------------------------------------------------------------------


def counters(accel: Accelerator, rays: Rays) -> list[float]:
    """Return nodes, boxes and triangles a ray, for closest hits, rounded to what the file stores."""
    found = accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, counters=True).counters
    return [round(float(getattr(found, name).sum(dtype=np.int64)) / len(rays.origins), 3) for name in COUNTED]


def kinds_of(structure: str) -> list[tuple[str, str]]:
    """Return names of mesh and kind of rays to measure: all for the default structure, two for the others."""
    kinds = ("primary", "bounce", "any", "all", "points", "one") if structure == DEFAULT else ("primary", "bounce")
    return [(mesh, kind) for mesh in (meshes() if structure == DEFAULT else ("balls",)) for kind in kinds]


def counted(structure: str, folder: Path | None = None) -> Costs:
    """Return the counters of a structure; save its trees in the folder."""
    out: Costs = {}
    accels = {mesh: wrt.build(meshes()[mesh], structure) for mesh in dict(kinds_of(structure))}
    for mesh, kind in kinds_of(structure):
        if folder is not None:
            accels[mesh].save(folder / f"{structure}-{mesh}.accel")
        closest = kind in ("primary", "bounce")
        out[f"{structure} {mesh} {kind}"] = counters(accels[mesh], rays(mesh)[kind]) if closest else [np.nan] * len(COUNTED)
    return out


# --- instructions ------------------------------------------------------------------------------------------------------------


def calls(accel: Accelerator, mesh: str, kind: str, n: int) -> Callable[[], object]:
    """Return the work of n rays of a kind: one call, or for the kind "one" n calls."""
    o, d, t_max = rays(mesh)[{"all": "bounce", "points": "bounce", "one": "primary"}.get(kind, kind)]
    if kind == "points":
        return lambda: wrt.closest_points(accel, o[:n] + 0.2 * d[:n], threads=1)
    if kind == "one":
        single = [(o[i : i + 1].copy(), d[i : i + 1].copy()) for i in range(0, LARGE, LARGE // MANY)][:n]
        return lambda: [accel.closest_hit(*ray, threads=1) for ray in single]
    work = {"any": accel.any_hit, "all": partial(wrt.all_hits, accel)}.get(kind, accel.closest_hit)
    return lambda: work(o[:n], d[:n], 0.0, t_max, threads=1)


class Callgrind:
    """Requests of a program to the Valgrind that runs it, as valgrind.h and callgrind.h define them for x86-64."""

    DUMP, ZERO, START, STOP = ((ord("C") << 24) + (ord("T") << 16) + i for i in (3, 1, 4, 5))
    # mov rax, rdi; xor edx, edx; four rotations of rdi that together do nothing; xchg rbx, rbx; mov rax, rdx; ret
    CODE = bytes.fromhex("4889f8 31d2 48c1c703 48c1c70d 48c1c73d 48c1c733 4887db 4889d0 c3")

    def __init__(self) -> None:
        self.page = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
        self.page.write(self.CODE)
        address = ctypes.addressof(ctypes.c_char.from_buffer(self.page))
        self.call = ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_void_p)(address)

    def request(self, number: int, argument: int = 0) -> None:
        words = (ctypes.c_uint64 * 6)(number, argument)
        self.call(ctypes.addressof(words))

    def count(self, name: str, work: Callable[[], object]) -> None:
        """Run the work, and write a file whose trigger is `name`."""
        text = ctypes.create_string_buffer(name.encode())
        work()  # loads kernels
        for number in (self.START, self.ZERO):
            self.request(number)
        work()
        self.request(self.DUMP, ctypes.addressof(text))
        self.request(self.STOP)


def run_counted(folder: Path, structures: Sequence[str]) -> None:
    """Run everything that is to be counted; called under callgrind. folder: of the trees, because Valgrind cannot run some builders."""
    callgrind = Callgrind()
    gc.disable()
    for structure in structures:
        accels = {mesh: wrt.load_accel(folder / f"{structure}-{mesh}.accel", meshes()[mesh]) for mesh in dict(kinds_of(structure))}
        for mesh, kind in kinds_of(structure):
            for n in sizes(structure, kind):
                callgrind.count(f"{structure} {mesh} {kind} {n}", calls(accels[mesh], mesh, kind, n))


def sizes(structure: str, kind: str) -> tuple[int, int]:
    """Return the rays of two runs. The difference of their instructions is the cost of rays without the cost of a call."""
    if kind == "one":
        return FEW, MANY
    most = LARGE if (structure, kind == "points") == (DEFAULT, False) else LARGE // OTHERS
    return most // 4, most


def instructions(folder: Path, structures: Sequence[str]) -> dict[str, float]:
    """Return instructions a ray, by the names of Costs."""
    command = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={folder / 'counts'}", sys.executable, "-m",
               "tests.costs", "--structures", ",".join(structures), "--inside", str(folder)]
    done = subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": "0"}, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"Valgrind could not run the queries:\n{done.stderr[-3000:]}")
    found: dict[str, int] = {}
    for path in folder.glob("counts.*"):
        text = path.read_text()
        name, total = re.search(r"^desc: Trigger: Client Request: (.*)$", text, re.M), re.search(r"^totals: (\d+)", text, re.M)
        if name and total:
            found[name[1]] = int(total[1])
    out = {}
    for name in dict.fromkeys(each.rpartition(" ")[0] for each in found):
        structure, _, kind = name.split()
        few, many = sizes(structure, kind)
        out[name] = (found[f"{name} {many}"] - found[f"{name} {few}"]) / (many - few)
    return out


def missing() -> str:
    """Return why instructions cannot be counted here, or an empty text."""
    if shutil.which("valgrind") is None:
        return "needs valgrind"
    info = Path("/proc/cpuinfo")
    if platform.machine() != "x86_64" or not info.exists() or not re.search(r"\bavx2\b", info.read_text()):
        return "needs Linux on a processor with AVX2"
    return ""


# --- the file ----------------------------------------------------------------------------------------------------------------


def versions() -> str:
    return f"Python {platform.python_version()}, NumPy {np.__version__}, Warp {wp.__version__}"


def stored() -> Costs:
    lines = [line.split() for line in STORED.read_text().splitlines() if not line.startswith(("#", "structure"))]
    return {" ".join(line[:3]): [np.nan if cell == "-" else float(cell) for cell in line[3:]] for line in lines}


def text(costs: Costs) -> str:
    head = [f"# Work of a ray; `python -m tests.costs` compares, with --write it writes. {versions()}",
            f"{'structure':11} {'mesh':6} {'rays':8} {'nodes':>8} {'boxes':>8} {'triangles':>9} {'instructions':>12}"]
    for name, values in costs.items():
        cells = ["-" if np.isnan(value) else f"{value:.3f}" for value in values[:3]] + [f"{values[3]:.0f}"]
        head.append("{:11} {:6} {:8} {:>8} {:>8} {:>9} {:>12}".format(*name.split(), *cells))
    return "\n".join(head) + "\n"


def compared(costs: Costs, before: Costs) -> Iterator[tuple[str, bool]]:
    """Yield a line for each cost that differs from the stored one, and whether it is a regression of the default structure."""
    same = versions() in STORED.read_text()
    for name, values in costs.items():
        if name.endswith(" one") and not same:
            yield f"{name}: not compared, because the file is not of {versions()}", False
            continue
        old = before.get(name, [np.nan] * 4)
        if np.isnan(old[3]):
            yield f"{name}: not in the file", name.startswith(f"{DEFAULT} ")
        for what, new, was in zip((*COUNTED, "instructions"), values, old, strict=True):
            more = new > was * (SLACK if what == "instructions" else 1.0)
            if more or new < was / (SLACK if what == "instructions" else 1.0):
                yield f"{name}: {what} {was:g} -> {new:g} ({new / was - 1:+.1%})", bool(more) and name.startswith(f"{DEFAULT} ")


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.costs", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write tests/costs.txt anew")
    parser.add_argument("--structures", default=",".join([DEFAULT, *(name for name in STRUCTURES if name not in (DEFAULT, "brute_force"))]),
                        help="names of structures  [default: all but brute_force]")
    parser.add_argument("--if-possible", action="store_true", help="exit with 0 instead of 2 where instructions cannot be counted")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    structures = options.structures.split(",")
    if reason := missing():
        print(f"not run: {reason}")
        return 0 if options.if_possible else 2
    wp.config.cpu_compiler_flags = str(wp.config.cpu_compiler_flags).replace("-march=native", FLAGS)
    if options.inside:
        run_counted(options.inside, structures)
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        costs: Costs = {}
        for structure in structures:
            costs |= counted(structure, folder)
        for each, figure in instructions(folder, structures).items():
            costs[each].append(round(figure))
    if options.write:
        STORED.write_text(text({**stored(), **costs}))
    print(text(costs), end="")
    worse = [regression for line, regression in compared(costs, stored()) if not print(line)]
    return int(any(worse))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
