"""Steps of warps of 32 rays whose walks are logged: one lane per ray, lanes that help each other, and three loops in software.

Help: an idle lane takes any entry that waits in the warp, the bound of Tozlu and Zhou 2025, "CoopRT". Loops: if-if, while-while and
speculative while-while of Aila and Laine 2009, "Understanding the Efficiency of Ray Traversal on GPUs"."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.study.tree_walk import WalkLog
from wrt.kernels.wide.references import leaf_count

LANES = wp.constant(32)
IF_IF, WHILE_WHILE, SPECULATIVE = (wp.constant(loop) for loop in range(3))


@wp.struct
class LaneSteps:
    """Steps that each warp issues, and the lanes that work in them, summed."""

    node: wp.array(dtype=wp.int64)
    test: wp.array(dtype=wp.int64)
    node_lanes: wp.array(dtype=wp.int64)
    test_lanes: wp.array(dtype=wp.int64)
    rounds: wp.array(dtype=wp.int64)  # Iterations of the outer loop.


@kernel
def helped_steps(warp_first: wp.array(dtype=wp.int64), log: WalkLog, push_of: wp.array(dtype=wp.int64), used: wp.array(dtype=wp.int32),
                 scratch: wp.array(dtype=wp.int64), steps: wp.array(dtype=wp.int64)):
    """Count the steps of warp tid if 32 lanes take the entries of all its rays in turn, the oldest first.
    push_of: first entry that each fetch pushes; used: cache_prefetch.Entries.used; scratch: one entry for each fetch."""
    warp = wp.tid()
    tail = log.fetch_first[warp_first[warp]]
    head = tail
    for ray in range(int(warp_first[warp]), int(warp_first[warp + 1])):
        if log.fetch_first[ray + 1] > log.fetch_first[ray]:
            scratch[tail] = (wp.int64(ray) << wp.int64(32))
            tail = tail + wp.int64(1)
    while head < tail:
        steps[warp] += wp.int64(1)
        end = wp.min(tail, head + wp.int64(LANES))
        while head < end:
            owner = scratch[head] >> wp.int64(32)
            fetch = log.fetch_first[owner] + (scratch[head] & wp.int64(0xFFFFFFFF))
            head = head + wp.int64(1)
            for k in range(int(log.entered[fetch])):
                step = used[push_of[fetch] + wp.int64(k)]
                if step >= 0:
                    scratch[tail] = (owner << wp.int64(32)) + wp.int64(step)
                    tail = tail + wp.int64(1)


@wp.struct
class Lane:
    """The state of one ray: its next fetch, and the primitives that its leaf still holds untested."""

    at: wp.int64
    end: wp.int64
    left: int


@wp.func
def take_leaf(lane: Lane, log: WalkLog) -> Lane:
    """Let the lane hold the leaf that is its next fetch."""
    if lane.left == 0 and lane.at < lane.end:
        if log.fetch[lane.at] < 0:
            lane.left = leaf_count(log.fetch[lane.at])
            lane.at = lane.at + wp.int64(1)
    return lane


@wp.func
def at_node(lane: Lane, log: WalkLog) -> bool:
    if lane.at < lane.end:
        return log.fetch[lane.at] >= 0
    return False


@kernel
def loop_steps(warp_first: wp.array(dtype=wp.int64), log: WalkLog, loop: int, lanes: wp.array(dtype=Lane), out: LaneSteps):
    """Count the steps of warp tid under a loop. lanes: scratch, one entry for each ray."""
    warp = wp.tid()
    begin = int(warp_first[warp])
    end = int(warp_first[warp + 1])
    for ray in range(begin, end):
        lane = Lane()
        lane.at = log.fetch_first[ray]
        lane.end = log.fetch_first[ray + 1]
        lanes[ray] = lane
    busy = bool(True)
    while busy:
        out.rounds[warp] += wp.int64(1)
        for ray in range(begin, end):
            lanes[ray] = take_leaf(lanes[ray], log)
        # The loop over nodes: one step, or steps until every lane holds a leaf. A speculative lane goes on while it holds one.
        walking = bool(True)
        while walking:
            active = int(0)
            seeking = int(0)  # Lanes that need a node.
            for ray in range(begin, end):
                seeking += wp.where(lanes[ray].left == 0 and at_node(lanes[ray], log), 1, 0)
            if seeking > 0:
                for ray in range(begin, end):
                    lane = lanes[ray]
                    if at_node(lane, log) and (lane.left == 0 or loop == SPECULATIVE):
                        active += 1
                        lane.at = lane.at + wp.int64(1)
                        lanes[ray] = lane
                out.node[warp] += wp.int64(1)
                out.node_lanes[warp] += wp.int64(active)
            for ray in range(begin, end):
                lanes[ray] = take_leaf(lanes[ray], log)
            walking = seeking > 0 and loop != IF_IF
        # The loop over primitives: one step, or steps until no lane has any left.
        testing = bool(True)
        while testing:
            active = int(0)
            for ray in range(begin, end):
                lane = lanes[ray]
                if lane.left > 0:
                    active += 1
                    lane.left = lane.left - 1
                    lanes[ray] = lane
            if active > 0:
                out.test[warp] += wp.int64(1)
                out.test_lanes[warp] += wp.int64(active)
            testing = active > 0 and loop != IF_IF
        left = int(0)
        for ray in range(begin, end):
            left += wp.where(lanes[ray].left > 0 or lanes[ray].at < lanes[ray].end, 1, 0)
        busy = left > 0
