"""`wrt.tune`: find the fastest structure on a device; on CUDA also its best block size and memory for the traversal stack."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core import cuda
from wrt.core.checks import as_one
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import Device, JsonObject
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Row, machine_line, markdown, tabled
from wrt.lab.bench.timing import QUEUE, alternate_on, spread
from wrt.lab.bench.visibility import terrain
from wrt.lab.hard_cases.contestants import Own

STRUCTURES = ("bvh8", "bvh2", "bvh4", "bvh8c")  # The first one is the default.
CELLS = 320  # Cells a side of the terrain: 204,800 triangles, far more than a GPU's L1 holds.
KINDS = ("primary", "shadow", "diffuse")  # Kinds of rays in a picture.
FAST, SLOW = 1 << 20, 1 << 15  # Number of rays on CUDA and on the CPU.
FEWEST, MOST = 3, 100  # Timed runs.
MARGIN = 1.03  # Least speed over the default's that counts as faster; less may be noise.
COLUMNS: Columns = {"structure": "{accel}", "block": "{block}", "stack": "{stack}", "rays": "{kind}",
                    "Mray/s": lambda row: spread(row.mrays), "speed / default": "{speed:.2f}"}
LEGEND = """\
Rays and hits are in device memory. Mray/s: median of alternating runs (on a GPU of 10 calls each), quartiles in brackets. speed / default:
geometric mean over the kinds of rays. block (threads a block) and stack (memory of the traversal stack) are settings of wrt.core.cuda."""


class Choice(NamedTuple):
    """A structure, by its name in ACCELERATORS, with settings of wrt.core.cuda."""

    accel: str = STRUCTURES[0]
    block_dim: int = cuda.BLOCK_DIMS[0]
    stack: str = cuda.STACKS[0]


DEFAULT = Choice()


@dataclass(frozen=True)
class Tuning:
    """Result of `measured`. best: the fastest choice; speeds: choice -> its speed over the default's; rows: all measurements."""

    device: str
    best: Choice
    machine: str
    speeds: Mapping[Choice, float]
    rows: list[Row]

    @property
    def arguments(self) -> dict[str, str]:
        """Arguments for `wrt.build` and `wrt.render`."""
        return {"accel": self.best.accel, "device": self.device}

    def text(self) -> str:
        block = f" in blocks of {self.best.block_dim} threads, stack {self.best.stack}" if self.rows[0].block else ""
        words = ", ".join(f'{name}="{value}"' for name, value in self.arguments.items())
        options = " ".join(f"--{name} {value}" for name, value in self.arguments.items())
        found = f"Fastest: {self.best.accel}{block}. In Python write {words}; for commands {options}."
        return markdown([tabled(COLUMNS, self.rows, "Tuning", f"Machine: {self.machine}\n\n{found}\n\n{LEGEND}")])

    def as_dict(self) -> JsonObject:
        return {"machine": self.machine, "arguments": self.arguments, "best": self.best._asdict(),
                "rows": [row.as_dict() for row in self.rows]}


def tune(device: str, seconds: float = 1.0) -> dict[str, str]:
    """Find the fastest structure on a device.

    Measures bvh8, bvh2, bvh4 and bvh8c. bvh8 is returned unless another one is 3 % faster. Hits and pixels have the same bits with each.

    Parameters
    ----------
    device : str
        Name of the device: "cpu", "cuda:0" ...
    seconds : float
        Total time of the measurements. Compiling and building come before and take longer.

    Returns
    -------
    dict
        Arguments `accel` and `device`, for `wrt.build(mesh, **it)` and `wrt.render(scene, **it)`.

    Raises
    ------
    InputError
        No such device, or seconds not above 0."""
    return measured(device, seconds).arguments


def measured(device: str, seconds: float = 1.0, clock: Callable[[], float] = time.perf_counter) -> Tuning:
    """Measure all structures as `tune` does; on CUDA also measure the fastest one with each block size and stack."""
    target = start(as_one(device, str, "device"))
    if not as_one(seconds, (int, float), "seconds") > 0.0:
        raise InputError(f"must be more than 0, got {seconds}", argument="seconds")
    geometry = Geometry.of(terrain(CELLS))
    rays = ray_sets(build(geometry, DEFAULT.accel, device), FAST if target.is_cuda else SLOW)
    phases = 2 if target.is_cuda else 1
    rows, speeds = measure([Choice(accel) for accel in STRUCTURES], geometry, rays, target, seconds / phases, clock)
    best = fastest(speeds)
    if target.is_cuda:
        others = [DEFAULT, *(Choice(best.accel, block, stack) for block in cuda.BLOCK_DIMS for stack in cuda.STACKS)]
        more = measure(list(dict.fromkeys(others)), geometry, rays, target, seconds / phases, clock)
        rows, speeds = rows + more[0], speeds | more[1]
        best = fastest(more[1])
    return Tuning(device, best, machine_line(f"Warp {wp.__version__}", device=device), speeds, rows)


def measure(choices: list[Choice], geometry: Geometry, rays: Mapping[str, RaySet], device: Device, seconds: float,
            clock: Callable[[], float]) -> tuple[list[Row], dict[Choice, float]]:
    """Measure all choices; return the rows, and choice -> its speed over the speed of the first choice, the default."""
    jobs: dict[tuple[Choice, str], Callable[[], None]] = {}
    for accel in dict.fromkeys(choice.accel for choice in choices):
        own = Own(structure=accel, device=device.alias)
        own.prepare(geometry)
        for kind in KINDS:
            search = own.search(rays[kind], thread_count(None))
            jobs |= {(choice, kind): partial(search_with, choice, search) for choice in choices if choice.accel == accel}
    round_seconds = (1 if device.is_cpu else QUEUE) * sum(float(run.sum()) for run in alternate_on(device, jobs, 1, clock).values())
    runs = alternate_on(device, jobs, min(max(int(seconds / round_seconds), FEWEST), MOST), clock)
    median = {key: float(np.median(each)) for key, each in runs.items()}
    speeds = {choice: float(np.exp(np.mean([np.log(median[choices[0], kind] / median[choice, kind]) for kind in KINDS])))
              for choice in choices}
    rows = [Row(accel=choice.accel, block=choice.block_dim if device.is_cuda else "",
                stack=choice.stack if device.is_cuda else "", kind=kind, rays=len(rays[kind]),
                mrays=(len(rays[kind]) / each / 1e6).tolist(), speed=speeds[choice]) for (choice, kind), each in runs.items()]
    return rows, speeds


def fastest(speeds: Mapping[Choice, float]) -> Choice:
    """Return the fastest choice, or DEFAULT if no choice is MARGIN times as fast. speeds: choice -> speed over the default's."""
    best = max(speeds, key=lambda choice: speeds[choice])
    return best if speeds[best] >= MARGIN else DEFAULT


def search_with(choice: Choice, search: Callable[[], object]) -> None:
    before = cuda.block_dim, cuda.stack
    cuda.block_dim, cuda.stack = choice.block_dim, choice.stack
    try:
        search()
    finally:
        cuda.block_dim, cuda.stack = before
