"""Measurements of speed and error."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wrt.lab import STRUCTURES, OnScene, Plan, option, the_device, the_seed, the_threads

QUERY_KINDS = ("primary", "shadow", "diffuse", "random", "inward", "points", "tiles")
THREAD_CHOICES = ("one", "all", "both")


@dataclass(frozen=True)
class Queries(Plan):
    """Compare CONTESTANTS on the same rays. Measure build time, memory, steps a ray, speed, and the answers that differ.

    A contestant is a structure of wrt or another library, with options after colons: bvh8, bvh2:builder=sweep, bvh8:triangle=plane,
    grid:density=4, embree, embree:mode=fast, warp, open3d, trimesh. Times and answers relate to the first one. Default: all structures
    but brute_force, and the installed libraries."""

    COMMAND, STUDY = "bench queries", "wrt.lab.bench.queries"
    QUICK = {"contestants": ("bvh8", "bvh2", "warp"), "number": 20_000, "runs": 3}
    contestants: Sequence[str] = option(())
    meshes: Sequence[Any] = option((), "Mesh files  [default: a terrain of 18,432 triangles]")
    rays: Sequence[str] = option(QUERY_KINDS[:4], "Kinds of queries: primary, shadow, diffuse, random and inward rays; points: closest"
                                 " points; tiles: pictures of 64x64 pixels in many small worlds",
                                 of=("kind of query", f"{__name__}:QUERY_KINDS"))
    number: int = option(100_000, "Number of rays of each kind, and 50 times the number of points", (1, 2**28))
    runs: int = option(7, "Timed runs of each contestant, alternating", (1, 1000))
    builds: int = option(1, "Timed builds of each contestant", (1, 100))
    threads: str = option("one", "CPU threads: one (measures CPU time), all (measures wall-clock time) or both; wrt and Open3D use several",
                          of=("number of threads", f"{__name__}:THREAD_CHOICES"))
    device: str = the_device()
    seed: int = the_seed()
    worlds: int = option(64, "Number of worlds for the kind tiles", (1, 2**20))
    stadium: bool = option(False, "Put each mesh into a stadium a thousand times its size, and trace the same rays")

    def __post_init__(self) -> None:
        from wrt.lab.bench.contestants import contestant

        super().__post_init__()
        for name in self.contestants:
            contestant(name, self.device).require()


@dataclass(frozen=True)
class Visibility(Plan):
    """Compare rasterising with ray casting. As triangles and pixels grow: the time of both, and the pixels where they differ."""

    COMMAND, STUDY = "bench visibility", "wrt.lab.bench.visibility"
    QUICK = {"size": 128, "max_size": 512, "max_triangles": 50_000, "runs": 5}
    size: int = option(512, "Side of the square picture, in pixels, while the number of triangles grows", (1, 16384))
    max_size: int = option(1024, "Largest side, in pixels, of the sweep over picture sizes, which starts at 64", (64, 16384))
    max_triangles: int = option(1_500_000, "Subdivide surfaces up to this number of triangles", (1, 2**30))
    runs: int = option(7, "Timed runs of each method, alternating", (1, 1000))
    accel: str = option("bvh", "Acceleration structure", of=STRUCTURES)


@dataclass(frozen=True)
class Error(OnScene):
    """Render SCENE with various values of each setting. Compare time and error of the pictures with a converged reference."""

    COMMAND, STUDY, QUICK = "bench error", "wrt.lab.bench.error", {"max_spp": 4, "repeats": 3}
    knobs: Sequence[str] = option((), "Settings to vary: sampler, max_depth, triangle, ... (an unknown name lists them)  [default: all]",
                                  of=("knob", "wrt.lab.bench.error:KNOBS"))
    max_spp: int = option(64, "Largest number of samples per pixel, after 1, 2, 4, ...", (1, 1 << 16))
    repeats: int = option(8, "Seeds for each picture; their spread gives the confidence intervals", (3, 1000))  # 2 seeds have no spread
    reference_spp: int | None = option(None, "Samples per pixel of 8 reference pictures each  [default: 8 times --max-spp]", (1, 1 << 24))
    seed: int = the_seed()
    device: str = the_device()
    threads: int | None = the_threads()

    @property
    def levels(self) -> list[int]:
        return [1 << i for i in range(self.max_spp.bit_length())]
