"""Parameters of the model of the RT core: published and assumed values with their sources."""

from dataclasses import dataclass

from wrt.lab.rtcore.caches import Cache

PUBLISHED, DERIVED, ASSUMED = "published", "derived", "assumed"
TURING = "NVIDIA Turing GPU Architecture, WP-09183-001 (2018)"
PASCAL = "NVIDIA GeForce GTX 1080 Ti, product data (2017)"
ARC = "Intel Arc B580, product data as printed in reviews (2024)"
RDNA = "AMD Radeon RX 9070, product data as printed in reviews (2025)"
VULKAN_SIM = "Vulkan-Sim, configs/tested-cfgs/SM75_RTX2060/gpgpusim.config (Saed et al., MICRO 2022)"


# Name, value as the source states it, status (derived: computed from published values), values in sweeps, source.
PARAMETERS = (
    ("RTX 2080 Ti: SMs, RT cores", "68, one RT core in each SM", PUBLISHED, "", TURING),
    ("RTX 2080 Ti: clock", "1.545 GHz (boost)", PUBLISHED, "", TURING),
    ("RTX 2080 Ti: DRAM", "616 GB/s", PUBLISHED, "", TURING),
    ("RTX 2080 Ti: L2", "5632 KB", PUBLISHED, "", TURING),
    ("Turing: L1 with shared memory", "96 KB in each SM", PUBLISHED, "", TURING),
    ("RTX 2080 Ti: rays", "10 Grays/s claimed", PUBLISHED, "", TURING),
    ("RTX 2080 Ti: clocks a ray and RT core", "10.5", DERIVED, "", "68 x 1.545 GHz / 10 Grays/s"),
    ("GTX 1080 Ti: rays in software", "1.1 Grays/s claimed", PUBLISHED, "", TURING),
    ("GTX 1080 Ti: FP32 lanes, clock", "28 SMs x 128, 1.582 GHz (boost)", PUBLISHED, "", PASCAL),
    ("GTX 1080 Ti: instructions of a lane a ray", "5154", DERIVED, "", "28 x 128 x 1.582 GHz / 1.1 Grays/s"),
    ("RTX 2060: SMs, clock", "30, 1.365 GHz (base)", PUBLISHED, "", VULKAN_SIM),
    ("RTX 2060: DRAM, L2", "336 GB/s, 3 MB", PUBLISHED, "", "NVIDIA GeForce RTX 2060, product data (2019)"),
    ("Arc B580: Xe cores, clock, DRAM", "20, 2.67 GHz, 456 GB/s", PUBLISHED, "", ARC),
    ("Arc B580: L2", "18 MB", PUBLISHED, "", "Chips and Cheese, Intel's Battlemage Architecture (2025)"),
    ("Arc B580: L1 with local memory", "256 KB in each Xe core", PUBLISHED, "", ARC),
    ("Arc B580: what holds nodes", "all of the L1; the unit's own cache of 16 KB is left out", ASSUMED, "", "no source for the L1's share"),
    ("Arc B580: tests a clock and unit", "18 boxes (3 pipelines of 6), 2 triangles", PUBLISHED, "", "Chips and Cheese, Arc B580 (2025)"),
    ("RX 9070: compute units, clock, DRAM", "56, 2.52 GHz (boost), 640 GB/s", PUBLISHED, "", RDNA),
    ("RX 9070: L2, L0", "8 MB, 32 KB in each compute unit; there is no L1", PUBLISHED, "", "AMD ROCm documentation, GPU specifications"),
    ("RX 9070: Infinity Cache", "left out (it has 64 MB)", ASSUMED, "", "the model has two levels of caches"),
    ("RX 9070: tests a clock and unit", "8 boxes or 2 triangles", PUBLISHED, "", "Chips and Cheese, RDNA 4's raytracing (2025)"),
    ("RX 9070: boxes and triangles", "both in the same clock", ASSUMED, "", "the model's units are independent"),
    ("Arc B580, RX 9070: all below", "as Turing", ASSUMED, "", "no source; the claims of nodes and tests do not use them"),
    ("cache line", "128 bytes", PUBLISHED, "", VULKAN_SIM),
    ("L2: ways", "16", ASSUMED, "", VULKAN_SIM),
    ("L1: ways", "4", ASSUMED, "", "no source; Vulkan-Sim has a fully associative L1"),
    ("L1: lines a clock", "1", ASSUMED, "0.5, 1, 2", "128 bytes a clock, as from Turing's L1 to an SM"),
    ("L2: bytes a clock and SM", "32", ASSUMED, "16, 32, 64", "no source; Vulkan-Sim's crossbar has flits of about this size"),
    ("R_box: boxes a clock and RT core", "4", ASSUMED, "1, 2, 4, 8", "never published; RayFlex (2024) has 4"),
    ("R_tri: triangles a clock and RT core", "1", ASSUMED, "0.5, 1, 2", "never published; RayFlex (2024) has 1"),
    ("node: children", "2", ASSUMED, "every structure of the registry", "never published"),
    ("warps at a time in an RT core", "4", ASSUMED, "2, 4, 8, 16, 32", VULKAN_SIM + "; Arches: 64 rays"),
    ("latency of a box operation", "8 clocks", ASSUMED, "3, 8, 13", VULKAN_SIM + "; Arches: 3, GauTracer: 13"),
    ("latency of a triangle test", "8 clocks", ASSUMED, "8, 22, 37", VULKAN_SIM + "; Arches: 22, GauTracer: 37"),
    ("latency of the L1", "20 clocks", ASSUMED, "", VULKAN_SIM),
    ("latency of the L2, beyond the L1's", "160 clocks", ASSUMED, "", VULKAN_SIM),
    ("latency of DRAM, beyond the L2's", "100 clocks", ASSUMED, "", VULKAN_SIM),
    ("L2 at the beginning", "empty", ASSUMED, "empty, warm", "warm: the L2 has seen the same rays once before"),
)


@dataclass(frozen=True)
class Core:
    """Assumptions about one RT core and its memory; PARAMETERS has the sources.
    - boxes, triangles: tests a clock; warps: warps at a time; warm: the L2 has seen the same rays before.
    - *_latency: clocks; an access to DRAM takes the sum of all three levels. l1_lines, l2_bytes: lines and bytes a clock."""

    boxes: float = 4.0
    triangles: float = 1.0
    warps: int = 4
    box_latency: float = 8.0
    triangle_latency: float = 8.0
    l1_latency: float = 20.0
    l2_latency: float = 160.0
    dram_latency: float = 100.0
    l1_lines: float = 1.0
    l2_bytes: float = 32.0
    warm: bool = False


BASE = Core()

@dataclass(frozen=True)
class Gpu:
    """A GPU. sms: number of SMs; clock: Hz (RTX 2060: base, others: boost); dram: bytes a second; l1: cache of each SM; core: of each SM.
    An SM stands for a part with one ray tracing unit: a Xe core by Intel, a compute unit by AMD."""

    name: str
    sms: int
    clock: float
    dram: float
    l1: Cache
    l2: Cache
    core: Core = BASE


GPUS = {
    "rtx2080ti": Gpu("RTX 2080 Ti", 68, 1.545e9, 616e9, Cache(96 << 10, 4), Cache(5632 << 10, 16)),
    "rtx2060": Gpu("RTX 2060", 30, 1.365e9, 336e9, Cache(96 << 10, 4), Cache(3 << 20, 16)),
    "arcb580": Gpu("Arc B580", 20, 2.67e9, 456e9, Cache(256 << 10, 4), Cache(18 << 20, 16), Core(boxes=18.0, triangles=2.0)),
    "rx9070": Gpu("RX 9070", 56, 2.52e9, 640e9, Cache(32 << 10, 4), Cache(8 << 20, 16), Core(boxes=8.0, triangles=2.0)),
}


# Field of Core -> its values in sweeps. Fields vary one at a time for the sensitivity, those of model.RANGE together for the range.
SWEEPS: dict[str, tuple[float, ...]] = {
    "boxes": (1.0, 2.0, 4.0, 8.0),
    "triangles": (0.5, 1.0, 2.0),
    "warps": (2, 4, 8, 16, 32),
    "box_latency": (3.0, 8.0, 13.0),
    "triangle_latency": (8.0, 22.0, 37.0),
    "l1_lines": (0.5, 1.0, 2.0),
    "l2_bytes": (16.0, 32.0, 64.0),
    "warm": (False, True),
}
