"""Plans of the measurements. A field of a Plan is an argument in Python and an option on the command line.

This module imports nothing heavy, because the command line reads all plans for its help."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar

# Names that an option accepts: what messages call such a name, and the table of the names.
STRUCTURES = ("structure", "wrt.accel.structures:ACCELERATORS")
KINDS = ("kind of ray", "wrt.lab.bench.rays:RAY_KINDS")
GPUS = ("GPU", "wrt.lab.rtcore.parameters:GPUS")
THREAD_CHOICES = ("one", "all", "both")
PEER_KINDS = ("primary", "shadow", "diffuse", "random", "points", "tiles")
THREADS = "Number of CPU threads  [default: all cores]"
RAY_SEED = "Seed of the random rays"
INSIDE = "Put the camera at the centre of the mesh's bounding box, as in a room"
MODELLED = "GPU to model: rtx2080ti, rtx2060, arcb580 or rx9070"


def option(default: Any, text: str = "", between: tuple[int, int] | None = None, of: tuple[str, str] | None = None) -> Any:
    """Return a field of a Plan.
    - text: help of the option; "" makes the field a positional argument. between: lowest and highest value (None is always allowed).
    - of: for a field of names: what messages call such a name, and the table of the names as "module:TABLE"."""
    return field(default=default, metadata={"text": text, "between": between, "of": of})


def the_meshes(default: object = ()) -> Sequence[object]:
    return option(default)


def the_kinds(*default: str) -> Sequence[str]:
    return option(default or ("primary", "shadow", "diffuse", "random"), "Kinds of rays: primary, shadow, diffuse, random", of=KINDS)


@dataclass(frozen=True)
class Plan:
    """Options of a measurement. Raise InputError for a number out of its range and for an unknown name.

    COMMAND: name of the command; STUDY: module that measures; QUICK: values that replace the defaults under --quick;
    OUTPUT: help of -o."""

    COMMAND: ClassVar[str] = ""
    STUDY: ClassVar[str] = ""
    QUICK: ClassVar[Mapping[str, Any]] = {}
    OUTPUT: ClassVar[str] = "Write the tables as Markdown (.md), or the rows as .csv or .json"

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
    """Compare rasterising with ray casting. As triangles and pixels grow: the time of both, and the pixels where they differ.

    MESHES: mesh files; default: a sphere and a terrain."""

    COMMAND, STUDY = "bench visibility", "wrt.lab.bench.visibility"
    QUICK = {"size": 128, "max_size": 512, "max_triangles": 50_000, "runs": 5}
    meshes: Sequence[Any] = the_meshes()
    size: int = option(512, "Side of the square picture, in pixels, while the number of triangles grows", (1, 16384))
    max_size: int = option(1024, "Largest side, in pixels, of the sweep over picture sizes, which starts at 64", (64, 16384))
    max_triangles: int = option(1_500_000, "Subdivide meshes up to this number of triangles", (1, 2**30))
    runs: int = option(7, "Timed runs of each method, alternating", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)
    device: str = option("cpu", "Device to measure on: cpu, cuda:0, ... (`wrt devices` lists them)")
    threads: int | None = option(None, THREADS)


@dataclass(frozen=True)
class Units(Plan):
    """Compare the default triangle and box tests with the others. Columns: ratios of times, with their spread, on one thread.

    MESHES: mesh files; default: a sphere, a terrain and a teapot."""

    COMMAND, STUDY, QUICK = "bench units", "wrt.lab.bench.units", {"rays": 1 << 14, "runs": 5}
    meshes: Sequence[Any] = the_meshes()
    rays: int = option(2**17, "Number of rays of each kind", (1, 2**28))
    runs: int = option(9, "Timed runs of each test, alternating", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)
    seed: int = option(0, RAY_SEED)


@dataclass(frozen=True)
class Peers(Plan):
    """Compare wrt with other ray libraries. They are Embree (robust, fast, in packets), Open3D, trimesh, Warp and tinybvh. All
    get the same rays and points. Columns: nanoseconds a ray, ratios of the speeds, and the number of answers that differ.

    MESHES: mesh files; default: a sphere."""

    COMMAND, STUDY, QUICK = "bench peers", "wrt.lab.bench.peers", {"rays": 20_000, "runs": 5}
    OUTPUT = "Write the tables as Markdown (.md), the figures as .csv or .json, or a bar chart as .svg or .png"
    meshes: Sequence[Any] = the_meshes()
    structures: Sequence[str] = option(("bvh",), "Structures of wrt to measure; ratios relate to the first one", of=STRUCTURES)
    rivals: Sequence[str] = option((), "Libraries to compare with: embree, embree_fast, embree16, embree16_incoherent, warp, open3d,"
                                           " trimesh  [default: all installed]", of=("rival", "wrt.lab.hard_cases.contestants:RIVALS"))
    tinybvh: str | None = option(None, "Also compare with tinybvh: the folder with its header tiny_bvh.h, which a C++ compiler compiles")
    kinds: Sequence[str] = option(PEER_KINDS[:-1], "Kinds: primary, shadow, diffuse, random rays; points: closest points;"
                                                   " tiles: pictures of 64x64 pixels in many small worlds",
                                  of=("kind of query", f"{__name__}:PEER_KINDS"))
    rays: int = option(100_000, "Number of rays of each kind, and 50 times the number of points", (1, 2**28))
    worlds: int = option(64, "Number of worlds for the kind tiles", (1, 2**20))
    runs: int = option(7, "Timed runs of each library, alternating", (1, 1000))
    seed: int = option(0, "Seed of the random rays and worlds")
    threads: str = option("both", "CPU threads: one (measures CPU time), all (measures wall-clock time) or both",
                          of=("number of threads", f"{__name__}:THREAD_CHOICES"))
    device: str = option("cpu", "Device to measure on: cpu, cuda:0, ... (`wrt devices` lists them)")

    def __post_init__(self) -> None:
        from wrt.core.errors import InputError
        from wrt.lab.hard_cases.contestants import RIVALS

        super().__post_init__()
        for name in self.rivals:
            if not RIVALS[name].is_installed():
                raise InputError(f"{name} is not installed", hint='pip install "wrt[peers]"')
            if self.device != "cpu" and not RIVALS[name].on_gpu:
                raise InputError(f"{name} runs on the CPU only, not on {self.device}", argument="rivals")
        if self.device != "cpu" and self.tinybvh is not None:
            raise InputError(f"tinybvh runs on the CPU only, not on {self.device}", argument="tinybvh")


@dataclass(frozen=True)
class HardCases(Plan):
    """Run the hard cases on wrt and other ray libraries. Count rays lost, hits invented and wrong triangles, and measure the error of t.

    CASES: names such as E_grid, or letters of groups such as E; default: all that need no spheres and no t_min."""

    COMMAND, STUDY, QUICK = "bench hard-cases", "wrt.lab.hard_cases.comparison", {"rays": 100}
    cases: Sequence[str] = option(())
    libraries: Sequence[str] = option((), "Libraries to test: wrt, embree, ... (an unknown name lists them)  [default: all installed]",
                                      of=("library", "wrt.lab.hard_cases.libraries:LIBRARIES"))
    rays: int = option(1000, "Number of rays of each case", (1, 2**40))
    seed: int = option(0, RAY_SEED)


@dataclass(frozen=True)
class Closed(Plan):
    """Test which points are inside of closed meshes. Rays through corners and edges must cross an even number of times.
    Open3D and trimesh answer too, if installed.

    MESHES: closed mesh files, in addition to seven built-in meshes."""

    COMMAND, STUDY, QUICK = "bench closed", "wrt.lab.bench.closed", {"points": 1000, "rays": 1000, "others": 1000}
    meshes: Sequence[Any] = the_meshes()
    points: int = option(10_000, "Number of points for each mesh", (1, 2**28))
    rays: int = option(10_000, "Number of rays for each mesh", (1, 2**28))
    others: int = option(10_000, "Most points and rays for another library (trimesh without Embree: a hundredth); 0: none", (0, 2**28))
    seed: int = option(0, "Seed of the random points and rays")


@dataclass(frozen=True)
class Accel(Plan):
    """Compare all structures. Columns: build time, memory, traversal steps and time, and the number of answers that differ (must be 0).

    MESHES: mesh files; default: a terrain that grows from a thousand triangles on."""

    COMMAND, STUDY, QUICK = "bench accel", "wrt.lab.bench.accel", {"rays": 20_000, "runs": 3, "max_triangles": 20_000}
    meshes: Sequence[Any] = the_meshes()
    structures: Sequence[str] = option((), "Structures to measure  [default: all but brute_force]", of=STRUCTURES)
    kinds: Sequence[str] = the_kinds()
    rays: int = option(100_000, "Number of rays of each kind", (1, 2**28))
    runs: int = option(5, "Timed runs of each structure, alternating", (1, 1000))
    builds: int = option(1, "Timed builds of each structure", (1, 100))
    max_triangles: int = option(1_000_000, "Largest number of triangles of the terrain, if no MESHES are given", (1000, 2**28))
    threads: int = option(1, "Number of CPU threads that trace (builds use all cores)")
    seed: int = option(0, RAY_SEED)
    stadium: bool = option(False, "Put each mesh into a stadium a thousand times its size, and trace the same rays")


@dataclass(frozen=True)
class Bvh(Plan):
    """Compare builders of binary BVHs over MESHES. Columns: quality, time, memory. Also compare boxes, spheres and 14-DOPs on one tree."""

    COMMAND, STUDY, QUICK = "bench bvh", "wrt.lab.bench.bvh", {"rays": 1 << 14, "builds": 1, "runs": 3}
    meshes: Sequence[Any] = the_meshes(MISSING)
    builders: Sequence[str] = option((), "Builders to measure  [default: all]", of=("builder", "wrt.accel.bvh.builders:BVH_BUILDERS"))
    rays: int = option(2**18, "Number of rays into each mesh", (1, 2**26))
    builds: int = option(3, "Timed builds of each builder, after a first one that is not timed", (1, 100))
    runs: int = option(7, "Timed runs of each bounding volume, alternating", (1, 1000))
    threads: int | None = option(None, "Number of CPU threads that build  [default: all cores]")
    seed: int = option(0, RAY_SEED)


@dataclass(frozen=True)
class RtCore(Plan):
    """Model the RT core on MESHES. Find what limits it, a range of rays a second, and which assumption changes that range most.

    A trace that --trace or wrt.trace wrote (.npz) can stand in place of a mesh."""

    COMMAND, STUDY, QUICK = "bench rtcore", "wrt.lab.rtcore.meshes", {"rays": 1 << 12}
    meshes: Sequence[Any] = the_meshes(MISSING)
    structures: Sequence[str] = option((), "Structures to model  [default: every BVH]", of=STRUCTURES)
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**16, "Number of rays of each kind", (1, 2**22))
    gpu: str = option("rtx2080ti", MODELLED, of=GPUS)
    seed: int = option(0, RAY_SEED)
    inside: bool = option(False, INSIDE)
    trace: str = option("", "Write the trace of one mesh, structure and kind of ray to a .npz file  [default: none]")


@dataclass(frozen=True)
class Claims(Plan):
    """Repeat published claims about ray tracing hardware. By exact counts: the published number, wrt's, their ratio, and what differs.

    NAMES: claims; default: all. Without files, generated scenes stand in for the published ones."""

    COMMAND, STUDY = "bench claims", "wrt.lab.bench.claims"
    QUICK = {"side": 48, "names": ("ttp-nodes", "rules", "coop-rt", "cwbvh", "short-stack")}
    OUTPUT = "Write the tables as Markdown (.md), the figures as .csv or .json, or charts as .svg or .png"
    names: Sequence[str] = option((), of=("claim", "wrt.lab.claims.claim:CLAIMS"))
    scene: Sequence[str] = option((), "Published scenes that you have, as bunny=FILE,sponza=FILE,conference=FILE")
    side: int = option(128, "Side of the square pictures, in pixels", (8, 1024))

    def __post_init__(self) -> None:
        from wrt.lab.claims.scene_files import scene_files

        super().__post_init__()
        scene_files(self.scene)


@dataclass(frozen=True)
class Float64(Plan):
    """Count the triangle tests on MESHES that need float64. A GPU runs the watertight test. Count the rays with such a test, too."""

    COMMAND, STUDY, QUICK = "bench float64", "wrt.lab.rtcore.hard_tests", {"rays": 1 << 12}
    meshes: Sequence[Any] = the_meshes(MISSING)
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**16, "Number of rays of each kind", (1, 2**22))
    seed: int = option(0, RAY_SEED)
    inside: bool = option(False, INSIDE)


@dataclass(frozen=True)
class Pictures(Plan):
    """Render SCENES by waves of samples and one ray at a time. The CPU uses waves. Compare nanoseconds a sample on one thread, and
    count the pixels that differ (must be 0)."""

    COMMAND, STUDY, QUICK = "bench pictures", "wrt.lab.bench.pictures", {"size": "160x90", "spp": 4, "runs": 3}
    scenes: Sequence[Any] = option(MISSING)
    size: str = option("640x360", "Width x height of each picture, in pixels")
    spp: int = option(16, "Samples per pixel", (1, 1 << 16))
    runs: int = option(5, "Timed runs of each way to render, alternating", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)


@dataclass(frozen=True)
class WhatIf(Plan):
    """Change one part of the RT core's design, and compare costs. Both designs trace the same rays through MESH.

    STUDY names the part. "width": children, format and bounding volume of a node. "stack": entries of a short stack with restarts.
    "planes": bits of a box plane. "order": order of children, early stop. "sorting": order of the rays. "rates": tests a clock."""

    COMMAND, STUDY, QUICK = "whatif", "wrt.lab.rtcore.whatif", {"rays": 1 << 12}
    study: str = option(MISSING, of=("study", "wrt.lab.rtcore.whatif:STUDIES"))
    mesh: Any = option(MISSING)  # noqa: RUF009
    kinds: Sequence[str] = the_kinds("primary", "diffuse")
    rays: int = option(2**15, "Number of rays of each kind", (1, 2**22))
    gpu: str = option("rtx2080ti", MODELLED, of=GPUS)
    seed: int = option(0, RAY_SEED)
    inside: bool = option(False, INSIDE)


@dataclass(frozen=True)
class Error(Plan):
    """Settings to vary in a study of error, and how often each picture is rendered."""

    QUICK = {"max_spp": 4, "repeats": 3}
    knobs: Sequence[str] = option((), "Settings to vary: sampler, max_depth, triangle, ... (an unknown name lists them)  [default: all]",
                                  of=("knob", "wrt.lab.bench.error:KNOBS"))
    max_spp: int = option(64, "Largest number of samples per pixel, after 1, 2, 4, ...", (1, 1 << 16))
    repeats: int = option(8, "Seeds for each picture; their spread gives the confidence intervals", (3, 1000))  # 2 seeds have no spread
    reference_spp: int | None = option(None, "Samples per pixel of 8 reference pictures each  [default: 8 times --max-spp]", (1, 1 << 24))
    row_limit: float = option(120.0, "Leave out a picture whose seeds together would take longer than this time  [default: 120s]")

    @property
    def levels(self) -> list[int]:
        return [1 << i for i in range(self.max_spp.bit_length())]


@dataclass(frozen=True)
class Mitsuba(Plan):
    """Options of a comparison with Mitsuba 3 at equal error."""

    QUICK = {"spp": 8, "repeats": 3, "rival_limit": 5.0, "starts": 1}
    spp: int = option(64, "Samples per pixel of wrt; Mitsuba takes as many as it needs for the same error", (1, 1 << 16))
    repeats: int = option(7, "Pictures of each renderer, alternating, each with its own seed", (3, 1000))
    reference_spp: int | None = option(None, "Samples per pixel of 8 reference pictures each  [default: 8 times --spp]")
    rival_limit: float = option(60.0, "Longest time for a picture by Mitsuba  [default: 60s]")
    integrator: str = option("auto", "Integrator of Mitsuba: auto, path, volpath, direct or whitted (in Python, scalar_rgb only)",
                             of=("integrator", "wrt.lab.mitsuba.translate:INTEGRATORS"))
    variants: Sequence[str] = option(("scalar_rgb", "llvm_ad_rgb"), "Variants of Mitsuba; llvm_ad_rgb needs an LLVM library",
                                     of=("variant of Mitsuba", "wrt.lab.mitsuba.process:VARIANTS"))
    starts: int = option(3, "Number of timed runs of whole processes; 0 skips them")
    seed: int = option(0, "Seed from which the seeds of all pictures follow")


@dataclass(frozen=True)
class Stability(Plan):
    """Run the hard cases on the intersection tests. Count rays lost, and measure errors and speed.

    CASES: names such as E_grid, or letters of groups such as E; default: all."""

    COMMAND = "stability"
    QUICK = {"rays": 300, "sample": 300, "runs": 3}
    cases: Sequence[str] = option(())
    rays: int = option(10_000, "Number of rays of each case for the default tests", (1, 2**40))
    sample: int = option(10_000, "Number of these rays that the oracle judges, and that the other tests and libraries trace", (1, 2**40))
    peers: bool = option(False, "Also test Embree (robust, fast, in packets), Warp's mesh_query_ray and Open3D, if installed")
    seed: int = option(0, RAY_SEED)
    threads: int | None = option(None, "Number of CPU threads for the rays beyond the sample  [default: all cores]")
    runs: int = option(7, "Timed runs of each test and library, alternating", (1, 1000))
