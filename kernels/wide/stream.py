"""The traversal of bvh8, with its kernels for many rays on the CPU."""

from typing import Any

from wrt.kernels.query import RayArrays
from wrt.kernels.traverse.common import Units
from wrt.kernels.wide import batch, instances
from wrt.kernels.wide.batch import PACKETS, SLOTS
from wrt.kernels.wide.layout import LANES, SLOT_SIZE, STACK_WORDS, WIDTH
from wrt.kernels.wide.nodes import ROW_PADS
from wrt.kernels.wide.packets import REPORT_SIZE
from wrt.kernels.wide.traverse import WideTraversal


class BatchTraversal(WideTraversal):
    """The traversal for plain nodes (not compressed) with 8 children (bvh8). It also has a kernel for many rays."""

    stream_block = PACKETS * LANES
    # Lengths of the arrays in Scratch. Instances need twice the stacks and slots, and packets in the spaces of placements.
    stream_sizes = instances.FILTERS + instances.FILTERS_SIZE, 2 * STACK_WORDS * SLOTS, 2 * SLOT_SIZE * SLOTS, REPORT_SIZE

    def __init__(self) -> None:
        super().__init__(WIDTH)

    def make_stream(self, units: Units, any_hit: bool, rays_struct: Any = RayArrays, accepts: Any = None) -> Any:
        """Return the kernel of batch.make_kernel or instances.make_kernel, or None if the units have no vectorised form.
        Instances have none for cut-outs and lists. They have none for other box tests, whose rounding kernels.traverse.instances.enter
        does not cover."""
        if units.triangle != "watertight" or units.box not in ROW_PADS or units.observer or units.resumes:
            return None
        if not units.instances:
            return batch.make_kernel(units, any_hit, rays_struct, accepts)
        if accepts is not None or units.lists or units.box != "conservative":
            return None
        return instances.make_kernel(units, any_hit, rays_struct)
