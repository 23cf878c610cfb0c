"""`wrt.tune`: find the fastest structure on a device, and on CUDA its best block size and place for the stack."""

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
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.bench.visibility import terrain
from wrt.lab.hard_cases.contestants import Own

STRUCTURES = ("bvh8", "bvh2", "bvh4", "bvh8c")  # The default first.
CELLS = 320  # Of a side of the terrain: 204,800 triangles, far more than a GPU's L1 holds.
KINDS = ("primary", "shadow", "diffuse")  # Of a picture.
FAST, SLOW = 1 << 20, 1 << 15  # Rays on CUDA, and on the CPU.
FEWEST, MOST = 3, 100  # runs
MARGIN = 1.03  # times as fast as the default: less may be noise
COLUMNS: Columns = {"structure": "{accel}", "block": "{block}", "stack": "{stack}", "rays": "{kind}",
                    "Mray/s": lambda row: spread(row.mrays), "times as fast as the default": "{speed:.2f}"}
LEGEND = """\
Rays and answers are on the device; median of the runs in turn, quartiles in brackets. The last column is the geometric mean over the
kinds of rays. Block and stack are settings of wrt.core.cuda."""


class Choice(NamedTuple):
    """A name in ACCELERATORS, and settings of wrt.core.cuda."""

    accel: str = STRUCTURES[0]
    block_dim: int = cuda.BLOCK_DIMS[0]
    stack: str = cuda.STACKS[0]


DEFAULT = Choice()


@dataclass(frozen=True)
class Tuning:
    """The fastest choice (`best`), the speed of each measured choice over the default's, and the rows of measurements."""

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
        Time to measure, in all. Compiling and building come before and take longer.

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
    """Tune as `tune` and return all measurements; on CUDA also those of the fastest structure with each block size and stack."""
    there = start(as_one(device, str, "device"))
    if not as_one(seconds, (int, float), "seconds") > 0.0:
        raise InputError(f"must be more than 0, got {seconds}", argument="seconds")
    geometry = Geometry.of(terrain(CELLS))
    rays = ray_sets(build(geometry, DEFAULT.accel, device), FAST if there.is_cuda else SLOW)
    phases = 2 if there.is_cuda else 1
    rows, speeds = measure([Choice(accel) for accel in STRUCTURES], geometry, rays, there, seconds / phases, clock)
    best = fastest(speeds)
    if there.is_cuda:
        others = [DEFAULT, *(Choice(best.accel, block, stack) for block in cuda.BLOCK_DIMS for stack in cuda.STACKS)]
        more = measure(list(dict.fromkeys(others)), geometry, rays, there, seconds / phases, clock)
        rows, speeds = rows + more[0], speeds | more[1]
        best = fastest(more[1])
    return Tuning(device, best, machine_line(f"Warp {wp.__version__}", device=device), speeds, rows)


def measure(choices: list[Choice], geometry: Geometry, rays: Mapping[str, RaySet], device: Device, seconds: float,
            clock: Callable[[], float]) -> tuple[list[Row], dict[Choice, float]]:
    """Measure all choices, the default first; return the rows and each choice's speed over the default's."""
    jobs: dict[tuple[Choice, str], Callable[[], None]] = {}
    for accel in dict.fromkeys(choice.accel for choice in choices):
        own = Own(structure=accel, device=device.alias)
        own.prepare(geometry)
        for kind in KINDS:
            search = own.search(rays[kind], thread_count(None))
            jobs |= {(choice, kind): partial(ask, choice, search, device) for choice in choices if choice.accel == accel}
    once = sum(float(taken.sum()) for taken in alternate(jobs, 1, clock).values())
    taken = alternate(jobs, min(max(int(seconds / once), FEWEST), MOST), clock)
    middle = {key: float(np.median(each)) for key, each in taken.items()}
    speeds = {choice: float(np.exp(np.mean([np.log(middle[choices[0], kind] / middle[choice, kind]) for kind in KINDS])))
              for choice in choices}
    rows = [Row(accel=choice.accel, block=choice.block_dim if device.is_cuda else "",
                stack=choice.stack if device.is_cuda else "", kind=kind, rays=len(rays[kind]),
                mrays=(len(rays[kind]) / each / 1e6).tolist(), speed=speeds[choice]) for (choice, kind), each in taken.items()]
    return rows, speeds


def fastest(speeds: Mapping[Choice, float]) -> Choice:
    """Return the fastest choice, or the default if no other is faster by MARGIN. speeds: over the default's."""
    best = max(speeds, key=lambda choice: speeds[choice])
    return best if speeds[best] >= MARGIN else DEFAULT


def ask(choice: Choice, search: Callable[[], object], device: Device) -> None:
    before = cuda.block_dim, cuda.stack
    cuda.block_dim, cuda.stack = choice.block_dim, choice.stack
    try:
        search()
        wp.synchronize_device(device)
    finally:
        cuda.block_dim, cuda.stack = before
