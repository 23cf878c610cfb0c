"""Parameters of the model of the RT core. Those without a source are assumed; docs/rt_core.md has a table."""

from dataclasses import dataclass

from wrt.lab.rtcore.caches import Cache


@dataclass(frozen=True)
class Core:
    """Assumptions about one RT core and its memory. Latencies are in clocks; an access to DRAM takes the sum of all three levels.
    Vulkan-Sim: Saed et al., MICRO 2022, configs/tested-cfgs/SM75_RTX2060. Sources that differ from the values are in comments."""

    boxes: float = 4.0  # Tests a clock; never published. RayFlex (2024) has 4.
    triangles: float = 1.0  # Tests a clock; never published. RayFlex (2024) has 1.
    warps: int = 4  # Warps at a time: Vulkan-Sim. Arches: 64 rays.
    box_latency: float = 8.0  # Vulkan-Sim. Arches: 3, GauTracer: 13.
    triangle_latency: float = 8.0  # Vulkan-Sim. Arches: 22, GauTracer: 37.
    l1_latency: float = 20.0  # Vulkan-Sim.
    l2_latency: float = 160.0  # Beyond the L1's: Vulkan-Sim.
    dram_latency: float = 100.0  # Beyond the L2's: Vulkan-Sim.
    l1_lines: float = 1.0  # Lines a clock: 128 bytes, as from Turing's L1 to an SM.
    l2_bytes: float = 32.0  # Bytes a clock and SM. Vulkan-Sim's crossbar has flits of about this size.
    warm: bool = False  # The L2 has seen the same rays before.


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


# Published, but for the ways of the caches (L2: Vulkan-Sim; L1: assumed). NVIDIA Turing GPU Architecture, WP-09183-001 (2018), has the
# RTX 2080 Ti, and claims 10 Grays/s: 10.5 clocks a ray and RT core. Arc B580 and RX 9070: product data as printed in reviews, and
# Chips and Cheese (2025). The L1 of the Arc counts as a cache of nodes. The RX 9070 tests 8 boxes or 2 triangles, its L1 here is the L0,
# and its Infinity Cache is left out.
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
