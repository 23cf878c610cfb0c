"""Plans of the measurements: each option is declared once, for Python and for the command line.

A field of a Plan is an option of its command. Nothing heavy is imported here: the command line reads all plans for its help."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar

STRUCTURES = ("structure", "wrt.accel.structures:ACCELERATORS")
KINDS = ("kind of ray", "wrt.lab.bench.rays:RAY_KINDS")
GPUS = ("GPU", "wrt.lab.rtcore.parameters:GPUS")
SOME_THREADS = ("one", "all", "both")
THREADS = "Threads on the CPU  [default: all cores]"
INSIDE = "The camera stands in the middle of the mesh's box, as in a room"
MODELLED = "The GPU to model: rtx2080ti or rtx2060"


def option(default: Any, text: str = "", between: tuple[int, int] | None = None, of: tuple[str, str] | None = None) -> Any:
    """Return a field of a Plan.
    - text: for --help, "" for an argument; between: lowest and highest value (None is always allowed).
    - of: what the value names, and the table of names as "module:TABLE"."""
    return field(default=default, metadata={"text": text, "between": between, "of": of})


def the_meshes(default: object = ()) -> Sequence[object]:
    return option(default)


def the_kinds(*default: str) -> Sequence[str]:
    return option(default or ("primary", "shadow", "diffuse", "random"), "Of rays: primary, shadow, diffuse, random", of=KINDS)


@dataclass(frozen=True)
class Plan:
    """Options of a measurement. Raises InputError for a number out of its range and for an unknown name.

    COMMAND: its command; STUDY: the module that measures it; QUICK: values that replace defaults with --quick."""

    COMMAND: ClassVar[str] = ""
    STUDY: ClassVar[str] = ""
    QUICK: ClassVar[Mapping[str, Any]] = {}

    def __post_init__(self) -> None:
        from wrt.core.checks import as_integer, require_known
        from wrt.core.device import start
        from wrt.core.errors import InputError
        from wrt.core.threads import thread_count

        for each in fields(self):
            value, between, of = getattr(self, each.name), each.metadata["between"], each.metadata["of"]
            if between is not None and value is not None:
                as_integer(value, each.name, *between)
            if of is not None:
                module, table = of[1].split(":")
                for name in (value,) if isinstance(value, str) else value:
                    require_known(name, getattr(importlib.import_module(module), table), of[0], each.name)
            if each.name == "threads" and not isinstance(value, str):
                thread_count(value)
            if each.name == "device":
                start(value)
            if each.name == "cases":
                from wrt.lab.hard_cases.cases import chosen

                chosen(value)
            if isinstance(value, Sequence) and not value and (each.default is MISSING or each.default):
                raise InputError("must name one or more", argument=each.name)


@dataclass(frozen=True)
class Visibility(Plan):
    """Rasterising against ray casting, as triangles and pixels grow: the cost of both, and where they differ.

    MESHES: mesh files; without any, a sphere and a terrain."""

    COMMAND, STUDY = "bench visibility", "wrt.lab.bench.visibility"
    QUICK = {"size": 128, "max_size": 512, "max_triangles": 50_000, "runs": 5}
    meshes: Sequence[Any] = the_meshes()
    size: int = option(512, "Pixels a side as triangles grow", (1, 16384))
    max_size: int = option(1024, "Pixels a side at the end of the sweep from 64 on", (64, 16384))
    max_triangles: int = option(1_500_000, "Meshes are cut finer up to this many", (1, 2**30))
    runs: int = option(7, "Runs of each kind, alternating", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)
    device: str = option("cpu", "cpu, cuda:0, ... (see `devices`)")
    threads: int | None = option(None, THREADS)


@dataclass(frozen=True)
class Units(Plan):
    """The default triangle and box tests beside the others: ratios of their times with their spread, on one thread.

    MESHES: mesh files; without any, a sphere, a terrain and a teapot."""

    COMMAND, STUDY, QUICK = "bench units", "wrt.lab.bench.units", {"rays": 1 << 14, "runs": 5}
    meshes: Sequence[Any] = the_meshes()
    rays: int = option(2**17, "Rays of each kind", (1, 2**28))
    runs: int = option(9, "Runs of each unit, in turn", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)
    seed: int = option(0, "Other rays")


@dataclass(frozen=True)
class Peers(Plan):
    """wrt beside Embree (robust, fast, in packets) and Warp's mesh_query_ray: the same rays in turn, on one thread and on all.
    With ratios, and answers that differ.

    MESHES: mesh files; without any, a sphere."""

    COMMAND, STUDY, QUICK = "bench peers", "wrt.lab.bench.peers", {"rays": 20_000, "runs": 5}
    meshes: Sequence[Any] = the_meshes()
    structures: Sequence[str] = option(("bvh",), "Of wrt, by name; ratios are of the first", of=STRUCTURES)
    rivals: Sequence[str] = option((), "embree, embree_fast, embree16, embree16_incoherent, warp, open3d  [default: all installed]",
                                   of=("rival", "wrt.lab.hard_cases.contestants:PEERS"))
    kinds: Sequence[str] = the_kinds()
    rays: int = option(100_000, "Rays of each kind", (1, 2**28))
    runs: int = option(7, "Runs of each, in turn", (1, 1000))
    seed: int = option(0, "Other rays")
    threads: str = option("both", "one (by its CPU time), all (by the clock) or both", of=("number of threads", f"{__name__}:SOME_THREADS"))

    def __post_init__(self) -> None:
        from wrt.core.errors import InputError
        from wrt.lab.hard_cases.contestants import PEERS

        super().__post_init__()
        for name in self.rivals:
            if not PEERS[name].is_installed():
                raise InputError(f"{name} is not installed", hint='pip install "wrt[peers]"')


@dataclass(frozen=True)
class HardCases(Plan):
    """The hard cases against wrt and other ray libraries: rays lost, invented and given to a wrong triangle, and errors of t.

    CASES: names such as E_grid, or the letters of groups; without any, all."""

    COMMAND, STUDY, QUICK = "bench hard-cases", "wrt.lab.hard_cases.comparison", {"rays": 100}
    cases: Sequence[str] = option(())
    libraries: Sequence[str] = option((), "Which: wrt, embree ... (a wrong name lists them)  [default: all that are installed]",
                                      of=("library", "wrt.lab.hard_cases.libraries:LIBRARIES"))
    rays: int = option(1000, "Rays of each case", (1, 2**40))
    seed: int = option(0, "Other rays")


@dataclass(frozen=True)
class Closed(Plan):
    """Closed meshes: points inside, and rays through corners and edges, which must cross an even number of times.
    Also by Open3D and trimesh, if installed.

    MESHES: closed mesh files, beside seven made meshes."""

    COMMAND, STUDY, QUICK = "bench closed", "wrt.lab.bench.closed", {"points": 1000, "rays": 1000, "others": 1000}
    meshes: Sequence[Any] = the_meshes()
    points: int = option(10_000, "Points of each mesh", (1, 2**28))
    rays: int = option(10_000, "Rays of each mesh", (1, 2**28))
    others: int = option(10_000, "How many the others get at most (trimesh without Embree: a hundredth); 0: none", (0, 2**28))
    seed: int = option(0, "Other points and rays")


@dataclass(frozen=True)
class Accel(Plan):
    """All structures: time to build, memory, steps and time to search, and answers that differ (none may).

    MESHES: mesh files; without any, a terrain that grows from a thousand triangles on."""

    COMMAND, STUDY, QUICK = "bench accel", "wrt.lab.bench.accel", {"rays": 20_000, "runs": 3, "max_triangles": 20_000}
    meshes: Sequence[Any] = the_meshes()
    structures: Sequence[str] = option((), "Which, by name  [default: all but brute_force]", of=STRUCTURES)
    kinds: Sequence[str] = the_kinds()
    rays: int = option(100_000, "Rays of each kind", (1, 2**28))
    runs: int = option(5, "Runs of each structure, alternating", (1, 1000))
    builds: int = option(1, "Builds of each structure", (1, 100))
    max_triangles: int = option(1_000_000, "Without meshes, the terrain grows to this", (1000, 2**28))
    threads: int = option(1, "Threads to search with (builds use all cores)")
    seed: int = option(0, "Other rays")
    stadium: bool = option(False, "Each mesh in a stadium a thousand times its size, with the rays it has alone")


@dataclass(frozen=True)
class Bvh(Plan):
    """Builders of binary BVHs over MESHES: quality, time and memory; and boxes, spheres and 14-DOPs around the same tree."""

    COMMAND, STUDY, QUICK = "bench bvh", "wrt.lab.bench.bvh", {"rays": 1 << 14, "builds": 1, "runs": 3}
    meshes: Sequence[Any] = the_meshes(MISSING)
    builders: Sequence[str] = option((), "Which, by name  [default: all]", of=("builder", "wrt.accel.bvh.builders:BVH_BUILDERS"))
    rays: int = option(2**18, "Rays into each mesh", (1, 2**26))
    builds: int = option(3, "Builds of each builder, after the first", (1, 100))
    runs: int = option(7, "Runs of each volume, alternating", (1, 1000))
    threads: int | None = option(None, "Threads to build with  [default: all cores]")
    seed: int = option(0, "Other rays")


@dataclass(frozen=True)
class RtCore(Plan):
    """The model of the RT core on MESHES: what limits it, rays a second as ranges, and which assumption moves them most."""

    COMMAND, STUDY, QUICK = "bench rtcore", "wrt.lab.rtcore.meshes", {"rays": 1 << 12}
    meshes: Sequence[Any] = the_meshes(MISSING)
    structures: Sequence[str] = option((), "Which, by name  [default: every BVH]", of=STRUCTURES)
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**16, "Rays of each kind", (1, 2**22))
    gpu: str = option("rtx2080ti", MODELLED, of=GPUS)
    seed: int = option(0, "Other rays")
    inside: bool = option(False, INSIDE)


@dataclass(frozen=True)
class Float64(Plan):
    """How many triangle tests, and of how many rays, need float64 if a GPU runs the watertight test on MESHES."""

    COMMAND, STUDY, QUICK = "bench float64", "wrt.lab.rtcore.hard_tests", {"rays": 1 << 12}
    meshes: Sequence[Any] = the_meshes(MISSING)
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**16, "Rays of each kind", (1, 2**22))
    seed: int = option(0, "Other rays")
    inside: bool = option(False, INSIDE)


@dataclass(frozen=True)
class Pictures(Plan):
    """SCENES by waves of samples, as the CPU renders, beside one ray at a time: nanoseconds a sample on one thread, in turn.
    Also the pixels that differ (none may)."""

    COMMAND, STUDY, QUICK = "bench pictures", "wrt.lab.bench.pictures", {"size": "160x90", "spp": 4, "runs": 3}
    scenes: Sequence[Any] = option(MISSING)
    size: str = option("640x360", "Pixels of each picture")
    spp: int = option(16, "Samples a pixel", (1, 1 << 16))
    runs: int = option(5, "Runs of each, in turn", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)


@dataclass(frozen=True)
class WhatIf(Plan):
    """Change one thing of the RT core's design, and count the same rays through MESH again.

    STUDY: width (of nodes, their format and volume), stack (entries, with restarts), planes (bits of a box plane), order (nearer child
    first, early stop), sorting (of rays), rates (boxes a clock against triangles a clock)."""

    COMMAND, STUDY = "whatif", "wrt.lab.rtcore.whatif"
    study: str = option(MISSING, of=("study", "wrt.lab.rtcore.whatif:STUDIES"))
    mesh: Any = option(MISSING)  # noqa: RUF009
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**15, "Rays of each kind", (1, 2**22))
    gpu: str = option("rtx2080ti", MODELLED, of=GPUS)
    seed: int = option(0, "Other rays")
    inside: bool = option(False, INSIDE)


@dataclass(frozen=True)
class Error(Plan):
    """Knobs of a scene to turn, and how often it is rendered."""

    QUICK = {"max_spp": 4, "repeats": 3}
    knobs: Sequence[str] = option((), "Which to turn: sampler, max_depth, triangle ... (a wrong name lists them)  [default: all]",
                                  of=("knob", "wrt.lab.bench.error:KNOBS"))
    max_spp: int = option(64, "Samples a pixel: 1, 2, 4 ... up to this", (1, 1 << 16))
    repeats: int = option(8, "Seeds of each picture, for the intervals", (3, 1000))  # 2 seeds have no spread
    reference_spp: int | None = option(None, "Samples of each of the reference's seeds  [default: 8 times --max-spp]", (1, 1 << 24))
    row_limit: float = option(120.0, "Leave out what would take longer than this, with all its seeds  [default: 120s]")

    @property
    def levels(self) -> list[int]:
        return [1 << i for i in range(self.max_spp.bit_length())]


@dataclass(frozen=True)
class Mitsuba(Plan):
    """Samples and pictures of each renderer."""

    QUICK = {"spp": 8, "repeats": 3, "rival_limit": 5.0, "starts": 1}
    spp: int = option(64, "wrt's samples a pixel; its error is what Mitsuba must reach", (1, 1 << 16))
    repeats: int = option(7, "Pictures of each, alternating, each with its own seed", (3, 1000))
    reference_spp: int | None = option(None, "Samples of each of the reference's 8 seeds  [default: 8 times --spp]")
    rival_limit: float = option(60.0, "No picture of Mitsuba's takes longer  [default: 60s]")
    integrator: str = option("auto", "Mitsuba's: path, volpath, direct or whitted (in Python, scalar_rgb only)",
                             of=("integrator", "wrt.lab.mitsuba.translate:INTEGRATORS"))
    variants: Sequence[str] = option(("scalar_rgb", "llvm_ad_rgb"), "Mitsuba's; llvm_ad_rgb needs an LLVM library",
                                     of=("variant of Mitsuba", "wrt.lab.mitsuba.process:VARIANTS"))
    starts: int = option(3, "How often to time whole processes; 0: not at all")
    seed: int = option(0, "Decides on all seeds")


@dataclass(frozen=True)
class Stability(Plan):
    """The hard cases against the intersection tests: rays lost and errors, with the speed beside them.

    CASES: names such as E_grid, or the letters of groups; without any, all."""

    COMMAND = "stability"
    QUICK = {"rays": 300, "sample": 300, "runs": 3}
    cases: Sequence[str] = option(())
    rays: int = option(10_000, "Rays of each case, for the default", (1, 2**40))
    sample: int = option(10_000, "How many of them the oracle judges, and the other tests and peers get", (1, 2**40))
    peers: bool = option(False, "Also Embree (robust, fast, in packets), Warp's mesh_query_ray and Open3D, where installed")
    seed: int = option(0, "Other rays")
    threads: int | None = option(None, "Threads for the rays beyond the sample  [default: all cores]")
    runs: int = option(7, "Runs of each for the speed, in turn", (1, 1000))
