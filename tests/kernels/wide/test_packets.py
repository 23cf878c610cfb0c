"""Packets: sixteen lanes return the bits that the scalar units return for each ray."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, cpu_only, floats, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from tests.kernels.wide.plain_rows import make_plain_rows
from wrt.accel.queries.rays import is_valid
from wrt.kernels.query import FARTHEST, LARGEST, RayArrays, direction_scale, load_ray
from wrt.kernels.structs import NO_HIT, Hit, Primitive, Surfaces, kernel
from wrt.kernels.traverse.common import Units, make_intersect, make_probe, no_hit
from wrt.kernels.wide import packets
from wrt.kernels.wide.batch import PACKETS, SLOTS
from wrt.kernels.wide.lanes import LANE_PAD, row_type
from wrt.kernels.wide.layout import (
    BEAM,
    COHERENT,
    ENTRY,
    ENTRY_RAYS,
    FIELDS,
    LANES,
    PACKET_SIZE,
    REFUSED,
    SLOT_SIZE,
    STACK_SIZE,
    STACK_WORDS,
    WIDTH,
)
from wrt.kernels.wide.packets import Scratch, WideBvh, packet_kernel
from wrt.kernels.wide.references import EMPTY
from wrt.kernels.wide.traverse import lane_ray

pytestmark = cpu_only
EXCLUDE = LANES * FIELDS.index("exclude")
NOTHING = wp.constant(99)
CHILDREN = np.array([-3, -2, -1, 1, 2, 3, 4, 5], np.int32)  # References of a node to leaves and nodes; none is EMPTY.
PRIM_IDS = np.array([3, 1, 4, 0, 5, 9, 2, 6], np.int32)
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1e-40, -1e-40, 3e38, -3e38, np.inf, -np.inf, np.nan], np.float32)


@wp.struct
class Lanes:
    """The results of the packet functions, by packet and then by ray."""

    state: wp.array(dtype=wp.int32)
    meets: wp.array(dtype=wp.int32)
    children: wp.array2d(dtype=wp.uint32)
    children_any: wp.array2d(dtype=wp.uint32)
    reaching: wp.array(dtype=wp.int32)
    begun: wp.array(dtype=wp.int32)
    walk: wp.array2d(dtype=wp.int32)
    begun_any: wp.array(dtype=wp.int32)
    walk_any: wp.array2d(dtype=wp.int32)
    missed: wp.array(dtype=wp.int32)
    missed_any: wp.array(dtype=wp.int32)


set_up, set_up_any = packets.make_set_up(RayArrays), packets.make_set_up(RayArrays, any_hit=True)
children, children_any = packets.make_children(False), packets.make_children(True)
triangles, triangles_any = packets.make_triangles(False), packets.make_triangles(True)
BELOW = wp.constant(2)  # Number of entries on the stack before a test.


@wp.func
def lead_to(scratch: Scratch, slot: int, node: int):
    """Go on to `node` with an empty stack."""
    scratch.slots[slot * SLOT_SIZE + 1] = node
    scratch.slots[slot * SLOT_SIZE + 2] = slot * STACK_WORDS


def make_walk(any_hit):
    begin, step, pop = packets.make_steps(any_hit)

    @wp.func
    def walk(accel: WideBvh, scratch: Scratch, node: int, empty: int, column: int, reach: float, ray: int,
             begun: wp.array(dtype=wp.int32), missed: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.int32)):
        """Store the next reference, or NOTHING: at the root; after steps into `node` and `empty`; and after a step into `node` and
        each of the following pops."""
        next = begin(accel, scratch, ray, column)
        begun[ray] = wp.where(next == EMPTY, NOTHING, next)
        lead_to(scratch, ray, node)
        next = step(accel, scratch, ray)
        if next != EMPTY:
            scratch.slots[ray * SLOT_SIZE + 1] = empty
            next = step(accel, scratch, ray)
        missed[ray] = wp.where(next == EMPTY, NOTHING, next)
        lead_to(scratch, ray, node)
        next = step(accel, scratch, ray)
        out[ray, 0] = wp.where(next == EMPTY, NOTHING, next)
        for k in range(WIDTH):
            if next != EMPTY:
                next = pop(accel, scratch, ray, reach)
            out[ray, k + 1] = wp.where(next == EMPTY, NOTHING, next)

    return walk


walk, walk_any = make_walk(False), make_walk(True)


@wp.func
def with_stack(scratch: Scratch, stack: wp.array(dtype=wp.uint32)):
    own = Scratch()
    own.packets = scratch.packets
    own.stacks = stack
    own.slots = scratch.slots
    return own


@packet_kernel
def by_packets(rays: RayArrays, count: int, reach: float, empty: int, accel: WideBvh, nodes: wp.array2d(dtype=wp.float32),
               scratch: Scratch, out: Lanes):
    """Test packet i with node i of accel (`nodes`), and a slot for each ray. Only the first `count` rays of a packet are active."""
    i = wp.tid()
    base = PACKET_SIZE * i
    set_up_any(rays, LANES * i, count, LANE_PAD, False, scratch, base)  # Sets the field `margin`, too.
    active = set_up(rays, LANES * i, count, LANE_PAD, False, scratch, base)
    out.state[i] = active
    mask = active & wp.static(COHERENT - 1)
    root = WideBvh()
    root.nodes = nodes[i]
    out.meets[i] = packets.rays_meeting_root(root, scratch, base, mask)
    out.reaching[i] = packets.rays_reaching(0.5, scratch, base)
    if active >= COHERENT:
        size = children(accel, with_stack(scratch, out.children[i]), base, i, mask, BELOW)
        size_any = children_any(accel, with_stack(scratch, out.children_any[i]), base, i, mask, BELOW)
        out.children[i, 3] = wp.uint32(size)
        out.children_any[i, 3] = wp.uint32(size_any)
    for j in range(LANES):
        ray = LANES * i + j
        walk(root, scratch, 0, empty - i, base + j, reach, ray, out.begun, out.missed, out.walk)
        walk_any(root, scratch, 0, empty - i, base + j, reach, ray, out.begun_any, out.missed_any, out.walk_any)


@packet_kernel
def triangles_by_packets(accel: WideBvh, state: wp.array(dtype=wp.int32), in_row: int, any_hit: bool, scratch: Scratch,
                         found: wp.array(dtype=wp.int32)):
    i = wp.tid()
    mask = state[i] & wp.static(COHERENT - 1)
    if any_hit:
        found[i] = triangles_any(accel, 80 * i, in_row, mask, scratch, PACKET_SIZE * i)
    else:
        found[i] = triangles(accel, 80 * i, in_row, mask, scratch, PACKET_SIZE * i)


ray_triangles, ray_triangles_any = packets.make_ray_triangles(False, True), packets.make_ray_triangles(True, False)


@packet_kernel
def triangles_ray_by_ray(accel: WideBvh, state: wp.array(dtype=wp.int32), in_row: int, any_hit: bool, scratch: Scratch,
                         found: wp.array(dtype=wp.int32)):
    """Store in `found` the lane of the hit triangle, or -1."""
    i = wp.tid()
    for j in range(LANES):
        column = PACKET_SIZE * i + j
        lane = int(-1)
        if (state[i] >> j) & 1 != 0:
            if any_hit:
                lane = ray_triangles_any(accel, 80 * i, (1 << in_row) - 1, scratch, column)
            else:
                lane = ray_triangles(accel, 80 * i, (1 << in_row) - 1, scratch, column)
        found[LANES * i + j] = lane


@cache
def scalar_kernel():
    row = row_type(WIDTH)
    probe_of, intersect = make_probe(Units()), make_intersect(Units())
    children = make_plain_rows(WIDTH, False)

    @wp.struct
    class Scalars:
        rows: wp.array2d(dtype=wp.float32)
        bits: wp.array2d(dtype=wp.int32)
        entries: wp.array(dtype=row)
        entered: wp.array(dtype=wp.int32)
        hits: wp.array(dtype=Hit)

    @wp.func
    def put(rows: wp.array2d(dtype=wp.float32), i: int, first: int, v: wp.vec3):
        for k in range(3):
            rows[i, first + k] = v[k]

    @kernel
    def scalars(rays: RayArrays, nodes: wp.array(dtype=wp.float32), rows: wp.array(dtype=wp.float32), surfaces: Surfaces,
                in_row: int, exclude: wp.array(dtype=wp.int32), out: Scalars):
        i = wp.tid()
        ray = load_ray(rays, i)
        ray.exclude_plus_one = exclude[i]
        probe = probe_of(ray)
        lanes = lane_ray(probe, LANE_PAD)
        best = no_hit(ray)
        best.t = wp.where(best.t < LARGEST, best.t, LARGEST)
        put(out.rows, i, 0, ray.origin)
        put(out.rows, i, 3, probe.box.inv_dir)
        put(out.rows, i, 6, lanes.far_inv_dir)
        out.rows[i, 9] = lanes.box.t_min
        out.rows[i, 10] = best.t
        put(out.rows, i, 11, ray.direction)
        put(out.rows, i, 14, lanes.origin)
        put(out.rows, i, 17, wp.vec3(probe.triangle.shear_x, probe.triangle.shear_y, probe.triangle.shear_z))
        out.bits[i, 0] = probe.triangle.kx + 4 * probe.triangle.ky + 16 * probe.triangle.kz
        out.bits[i, 1] = 8 * lanes.near_x
        out.bits[i, 2] = 8 * lanes.near_y
        out.bits[i, 3] = 8 * lanes.near_z
        out.rows[i, 20] = direction_scale(rays.direction[i])
        node = 64 * (i / LANES)
        entries, entered = children(nodes, node, lanes, best.t)
        out.entries[i] = entries
        out.entered[i] = entered
        for j in range(in_row):
            k = 80 * (i / LANES) + j
            triangle = Primitive()
            triangle.v0 = wp.vec3(rows[k], rows[k + 8], rows[k + 16])
            triangle.v1 = wp.vec3(rows[k + 24], rows[k + 32], rows[k + 40])
            triangle.v2 = wp.vec3(rows[k + 48], rows[k + 56], rows[k + 64])
            triangle.prim_id = wp.cast(rows[k + 72], wp.int32)
            best = intersect(probe, surfaces, triangle, best)
        out.hits[i] = best

    return Scalars, scalars


class Both:
    """Results of packet functions and of scalar units for rays (16 n, 3), with a node and a row of triangles for each packet."""

    def __init__(self, rays, nodes, corners, count=LANES, any_hit=False, reach=LARGEST, in_row=WIDTH, exclude=None):
        self.rays = RayArrays()
        self.rays.origin, self.rays.direction, self.rays.t_min, self.rays.t_max = (
            vec3s(rays[0]), vec3s(rays[1]), floats(rays[2]), floats(rays[3]))
        n = len(rays[0]) // LANES
        self.n = n
        rows = np.concatenate([corners.astype(np.float32).reshape(n, 72),
                               np.tile(PRIM_IDS.view(np.float32), (n, 1))], axis=1)
        never = np.full((1, WIDTH, 3), np.inf, np.float32)
        nodes, rows = floats(np.concatenate([nodes, plain_nodes(never, -never)]).reshape(-1)), floats(rows.reshape(-1))
        lanes = Lanes()
        for name, length in (("state", n), ("meets", n), ("reaching", n), ("begun", n * LANES), ("begun_any", n * LANES),
                             ("missed", n * LANES), ("missed_any", n * LANES),
                             ("walk", (n * LANES, WIDTH + 1)), ("walk_any", (n * LANES, WIDTH + 1))):
            setattr(lanes, name, zeros(length, wp.int32))
        lanes.children, lanes.children_any = (zeros((n, ENTRY * (BELOW + WIDTH)), wp.uint32) for _ in range(2))
        accel, scratch = WideBvh(), Scratch()
        accel.nodes, accel.primitives = nodes, rows
        scratch.packets = packet = zeros(n * PACKET_SIZE)
        scratch.stacks, scratch.slots = zeros(n * LANES * STACK_WORDS, wp.uint32), zeros(n * LANES * SLOT_SIZE, wp.int32)
        launch(by_packets, n, self.rays, count, reach, n, accel, nodes.reshape((n + 1, 8 * WIDTH)), scratch, lanes)
        self.state, self.meets, self.reaching = (getattr(lanes, name).numpy() for name in ("state", "meets", "reaching"))
        self.stacks = [array.numpy().reshape(n, BELOW + WIDTH, ENTRY) for array in (lanes.children, lanes.children_any)]
        self.begun, self.walk = lanes.begun.numpy(), lanes.walk.numpy()
        self.begun_any, self.walk_any = lanes.begun_any.numpy(), lanes.walk_any.numpy()
        self.missed, self.missed_any = lanes.missed.numpy(), lanes.missed_any.numpy()
        self.set_up = packet.numpy().reshape(n, PACKET_SIZE).copy()
        exclude = np.zeros(n * LANES, np.int32) if exclude is None else exclude.astype(np.int32)
        packet.numpy().reshape(n, PACKET_SIZE)[:, EXCLUDE : EXCLUDE + LANES] = exclude.view(np.float32).reshape(n, LANES)
        one_by_one, self.lanes = wp.clone(packet), zeros(n * LANES, wp.int32)
        scratch.packets = one_by_one
        launch(triangles_ray_by_ray, n, accel, lanes.state, in_row, any_hit, scratch, self.lanes)
        scratch.packets = packet
        self.one_by_one = one_by_one.numpy().reshape(n, PACKET_SIZE)
        found = zeros(n, wp.int32)
        launch(triangles_by_packets, n, accel, lanes.state, in_row, any_hit, scratch, found)
        self.found, self.after = found.numpy(), packet.numpy().reshape(n, PACKET_SIZE)

        out_type, scalars = scalar_kernel()
        out = out_type()
        m = n * LANES
        out.rows, out.bits = zeros((m, 21)), zeros((m, 4), wp.int32)
        out.entries, out.hits = zeros(m, row_type(WIDTH)), zeros(m, Hit)
        out.entered = zeros(m, wp.int32)
        launch(scalars, m, self.rays, nodes, rows, Surfaces(), in_row, wp.array(exclude, dtype=wp.int32, device=DEVICE), out)
        self.scalar = out

    def lane_rows(self, of, names):
        """Return the values of the fields `names` by ray, (16 n, len(names)), from the packets."""
        table = of[:, : LANES * len(FIELDS)].reshape(self.n, len(FIELDS), LANES)
        return np.stack([table[:, FIELDS.index(name)].reshape(-1) for name in names], axis=1)

    @property
    def active(self):
        """Return the mask of active rays, (n, 16) bool."""
        return (self.state[:, None] >> np.arange(LANES) & 1).astype(bool)


def same(a, b):
    """Check that the bits are equal, or both values are NaN."""
    np.testing.assert_array_equal(np.where(np.isnan(a), np.float32(np.nan), a).view(np.int32),
                                  np.where(np.isnan(b), np.float32(np.nan), b).view(np.int32))


def plain_nodes(lo, hi):
    n = len(lo)
    nodes = np.zeros((n, 8, WIDTH), np.float32)
    nodes[:, 0:6:2], nodes[:, 1:6:2] = lo.transpose(0, 2, 1), hi.transpose(0, 2, 1)
    nodes[:, 6] = CHILDREN.view(np.float32)
    return nodes


def random_case(rng, n, coherent):
    """Return rays around one ray for each packet (random rays unless `coherent`), and boxes and triangles near their paths."""
    spread = np.where(rng.random((n, 1, 1)) < 0.5, 0.02, 0.3) if coherent else 1.0
    origin = rng.normal(size=(n, 1, 3)) + spread * rng.normal(size=(n, LANES, 3)) * (rng.random((n, 1, 1)) < 0.7)
    towards = rng.normal(size=(n, 1, 3)) if coherent else 0.0
    direction = towards + spread * rng.normal(size=(n, LANES, 3))
    way = direction[:, :1] if coherent else 0.0
    center = origin[:, :1] + way * rng.random((n, WIDTH, 1)) * 2.0 + 0.3 * rng.normal(size=(n, WIDTH, 3))
    half = 0.3 * rng.random((n, WIDTH, 3))
    corners = (center[..., None] + 0.4 * rng.normal(size=(n, WIDTH, 3, 3))).transpose(0, 3, 2, 1)
    t_min = np.where(rng.random((n, LANES)) < 0.5, 0.0, 0.2 * rng.random((n, LANES)))
    t_max = np.where(rng.random((n, LANES)) < 0.5, np.inf, t_min + rng.exponential(1.0, (n, LANES)))
    rays = origin.reshape(-1, 3), direction.reshape(-1, 3), t_min.reshape(-1), t_max.reshape(-1)
    return rays, plain_nodes((center - half).astype(np.float32), (center + half).astype(np.float32)), corners


def special_case(rng, n):
    """Return rays, boxes and triangles with zeros of both signs, denormals, overflow, infinities and NaN."""
    direction = rng.choice(SPECIAL[:7], (n * LANES, 3))
    direction[~direction.any(axis=1)] = 1.0
    alike = rng.random(n * LANES) < 0.5  # Otherwise almost no packet has a beam.
    direction[alike] = np.abs(direction[alike])
    ends = np.array([0.0, -0.0, 0.5, 1.0, 1e30, 3.4e38, -np.inf, np.inf], np.float32)
    rays = rng.choice(SPECIAL, (n * LANES, 3), p=[0.17, 0.1] + [0.08] * 9 + [0.01]), direction, rng.choice(ends[:4], n * LANES), \
        rng.choice(ends, n * LANES)
    return rays, plain_nodes(rng.choice(SPECIAL, (n, WIDTH, 3)), rng.choice(SPECIAL, (n, WIDTH, 3))), rng.choice(SPECIAL, (n, 72))


def underflow_case(rng, n):
    """Return rays that start in faces of the triangles' boxes. A direction component is so small that the shear underflows."""
    size = 10.0 ** rng.uniform(-20.0, 0.0, (n, 1, 1))
    origin = rng.integers(-2, 3, (n, LANES, 3)) * size
    slow = 10.0 ** rng.uniform(-45.0, -15.0, (n, LANES, 2)) * rng.choice([-1.0, 1.0], (n, 1, 2))
    direction = np.concatenate([slow, rng.choice([-1.0, 1.0], (n, 1, 1)) * np.ones((n, LANES, 1))], axis=2)
    direction *= 10.0 ** rng.uniform(-20.0, 20.0, (n, 1, 1))
    low = -rng.integers(0, 3, (n, WIDTH, 3)) * size
    corners = rng.integers(-3, 4, (n, 3, 3, WIDTH)) * size[..., None]
    rays = origin.reshape(-1, 3), direction.reshape(-1, 3), np.zeros(n * LANES), np.full(n * LANES, np.inf)
    return rays, plain_nodes(low.astype(np.float32), (low + size).astype(np.float32)), corners


def limit_case(rng, n):
    """Return rays at the limits of what a query accepts, and beside them."""
    def beside(limit):
        limit = np.float32(limit)
        with np.errstate(over="ignore"):
            values = np.array([np.nextafter(limit, np.float32(0.0)), limit, np.nextafter(limit, np.float32(np.inf))])
        return np.concatenate([values, -values])

    def choose(values, shape, rest):
        return np.where(rng.random(shape) < 0.2, rng.choice(values, shape), rest)

    (_, _, t_min, t_max), boxes, corners = special_case(rng, n)
    origin = choose(beside(FARTHEST), (n * LANES, 3), 1.0)
    direction = choose(np.concatenate([beside(LARGEST), beside(0.0)]), (n * LANES, 3), 0.0)
    return (origin, direction, choose(beside(0.0), n * LANES, t_min), choose([np.nan], n * LANES, t_max)), boxes, corners


def edge_case(rng, n):
    """Return rays past edges, corners and the interiors of triangles far smaller or larger than their distance. Their segments end near
    the hits. Some run along axes, others have a tiny component."""
    size = 10.0 ** rng.uniform(-6.0, 3.0, (n, 1, 1, 1))
    corners = rng.normal(size=(n, 1, WIDTH, 3)) + size * rng.normal(size=(n, 3, WIDTH, 3)) * rng.choice([1.0, 1.0, 1e-3], (n, 1, WIDTH, 3))
    weights = rng.dirichlet([1.0, 1.0, 1.0], (n, LANES)) * (rng.random((n, LANES, 3)) < 0.7)
    weights[~weights.any(axis=2)] = 1.0
    weights += rng.choice([0.0, 1e-7, -1e-7, 1e-6], (n, LANES, 3))
    weights /= weights.sum(axis=2, keepdims=True)
    aimed = corners.astype(np.float32).astype(np.float64)[np.arange(n)[:, None], :, rng.integers(0, WIDTH, (n, LANES))]
    target = np.einsum("nlc,nlck->nlk", weights, aimed)
    direction = rng.normal(size=(n, LANES, 3)) * 10.0 ** rng.uniform(-3.0, 3.0, (n, 1, 1))
    direction *= rng.choice([1.0, 1.0, 0.0, 1e-10, 1e-14, 1e-25], (n, LANES, 3))
    direction[~direction.any(axis=2)] = 1.0
    segment = np.zeros((n, LANES)), np.full((n, LANES), np.inf)
    for ends in segment:
        near_hit = 1.0 + rng.normal(size=(n, LANES)) * 10.0 ** rng.uniform(-8.0, -3.0, (n, LANES))
        ends[:] = np.where(rng.random((n, LANES)) < 0.3, near_hit, ends)
    rays = [(target - direction).reshape(-1, 3), direction.reshape(-1, 3), segment[0].reshape(-1), segment[1].reshape(-1)]
    boxes = plain_nodes(*(corners.min(axis=1).astype(np.float32), corners.max(axis=1).astype(np.float32)))
    return rays, boxes, corners.transpose(0, 1, 3, 2)


CASES = {"coherent": lambda rng: random_case(rng, 2000, True), "incoherent": lambda rng: random_case(rng, 1000, False),
         "special": lambda rng: special_case(rng, 3000), "underflow": lambda rng: underflow_case(rng, 3000)}
EDGES = CASES | {"edges": lambda rng: edge_case(rng, 6000)}


@cache
def case(name):
    return Both(*CASES[name](np.random.default_rng(len(name))))


@pytest.mark.parametrize("name", CASES)
def test_set_up_is_that_of_the_scalar_units(name):
    both = case(name)
    names = [name for name in FIELDS if name not in ("axes", "u", "v", "prim_id", "near_x", "near_y", "near_z", "exclude", "margin",
                                                       "root")]
    same(both.lane_rows(both.set_up, names), both.scalar.rows.numpy())
    bits = both.lane_rows(both.set_up, ["axes", "near_x", "near_y", "near_z"]).view(np.int32)
    np.testing.assert_array_equal(bits, both.scalar.bits.numpy())
    t_min, t = both.lane_rows(both.set_up, ["t_min", "t"]).T
    np.testing.assert_array_equal(both.active.reshape(-1), t >= t_min)
    np.testing.assert_array_equal(both.reaching[:, None] >> np.arange(LANES) & 1, (t >= 0.5).reshape(-1, LANES))


@pytest.mark.parametrize("name", [*CASES, "limits"])
def test_invalid_rays_are_those_of_the_check_of_arrays(name):
    # The check of arrays decides. A ray that set_up reports and the check accepts costs time only, so no query would show it.
    both = case(name) if name in CASES else Both(*limit_case(np.random.default_rng(0), 500))
    given = [getattr(both.rays, of).numpy() for of in ("origin", "direction", "t_min", "t_max")]
    refused = both.set_up[:, REFUSED].view(np.int32)[:, None] >> np.arange(LANES) & 1
    np.testing.assert_array_equal(refused.reshape(-1) == 0, is_valid(*given))
    assert name != "limits" or 0.1 < refused.mean() < 0.9


@pytest.mark.parametrize("name", CASES)
def test_packets_with_a_beam_go_the_same_way(name):
    both = case(name)
    negative = (both.lane_rows(both.set_up, ["inverse_x", "inverse_y", "inverse_z"]) < 0.0).reshape(-1, LANES, 3)
    some, all_of = ((negative | ~both.active[..., None]).all(axis=1), (negative & both.active[..., None]).any(axis=1))
    expected = both.active.any(axis=1) & (some == all_of).all(axis=1)
    np.testing.assert_array_equal(both.state >= COHERENT, expected)
    assert expected.any() == (name != "incoherent")


@pytest.mark.parametrize("name", CASES)
def test_a_beam_enters_what_one_of_its_rays_enters(name):
    # For each ray, the masks of entered children equal the box unit's results. So does rays_meeting_root for all children together.
    both = case(name)
    entered = both.scalar.entered.numpy().reshape(-1, LANES, 1) >> np.arange(WIDTH) & 1
    entered = entered.astype(bool) & both.active[..., None]
    np.testing.assert_array_equal(both.meets[:, None] >> np.arange(LANES) & 1, entered.any(axis=2))
    coherent = both.state >= COHERENT
    expected = (entered << np.arange(LANES)[:, None]).sum(axis=1)
    first = np.where(entered, both.scalar.entries.numpy().reshape(-1, LANES, WIDTH), np.inf).min(axis=1)
    for i in np.flatnonzero(coherent):
        for stack, any_hit in zip(both.stacks, (False, True), strict=True):
            size = stack[i, 0, 3]  # The result of `children`, stored in an unused entry.
            assert (stack[i, BELOW:size, ENTRY_RAYS] > 0).all()
            assert not stack[i, :BELOW, :3].any() and not stack[i, size:].any()
            references, begins = stack[i, BELOW:size, 0].view(np.int32), stack[i, BELOW:size, 1].view(np.float32)
            child = np.searchsorted(CHILDREN, references)
            np.testing.assert_array_equal(CHILDREN[child], references)
            masks = np.zeros(WIDTH, int)
            masks[child] = stack[i, BELOW:size, ENTRY_RAYS]
            np.testing.assert_array_equal(masks, expected[i])
            assert (begins <= first[i, child]).all()
            assert (np.diff(child) > 0).all() if any_hit else (np.diff(begins) <= 0).all()


@pytest.mark.parametrize("name", CASES)
def test_a_beam_has_the_ends_of_all_its_rays(name):
    both = case(name)
    beam = {word: both.set_up[:, first : first + 3] for word, first in BEAM.items()}
    origin, inverse = (both.lane_rows(both.set_up, [f"{of}_{axis}" for axis in "xyz"]).reshape(-1, LANES, 3)
                       for of in ("origin", "inverse"))
    coherent = np.flatnonzero(both.state >= COHERENT)
    assert (len(coherent) > 0) == (name != "incoherent")
    for i in coherent:
        o, r = origin[i][both.active[i]], inverse[i][both.active[i]]
        down = (r < 0.0).all(axis=0)
        ends = {"near_origin": np.where(down, o.min(0), o.max(0)), "far_origin": np.where(down, o.max(0), o.min(0)),
                "largest": np.where(down, r.min(0), r.max(0)), "smallest": np.where(down, r.max(0), r.min(0))}
        with np.errstate(over="ignore"):
            ends |= {f"far_{word}": np.float32(LANE_PAD) * ends[word] for word in ("largest", "smallest")}
        for word, expected in ends.items():
            np.testing.assert_array_equal(beam[word][i], expected, err_msg=word)
        np.testing.assert_array_equal(beam["near_row"][i], 2 * np.arange(3) + down)


def walked(both, reach=np.inf):
    """Return the children of each ray's node in the order of a step and pops, (16 n, 9), and the mask of entered children.

    The children begin at most at `reach`, sorted by their keys."""
    entered = (both.scalar.entered.numpy()[:, None] >> np.arange(WIDTH) & 1).astype(bool)
    entries = np.where(entered, both.scalar.entries.numpy(), np.inf)
    keys = np.where(entered, (entries.view(np.int32) & ~15 | np.arange(WIDTH) + 8).astype(np.int64), 2**40)
    order = np.argsort(keys, axis=1)
    begins = (np.take_along_axis(keys, order, axis=1).clip(0, 2**31 - 1) & ~15).astype(np.int32).view(np.float32)
    within = np.take_along_axis(entered, order, axis=1) & ((begins <= reach) | (np.arange(WIDTH) == 0))  # The first child is not popped.
    return np.concatenate([np.where(within, CHILDREN[order], NOTHING), np.full((len(order), 1), NOTHING)], axis=1), entered


@pytest.mark.parametrize("name", CASES)
def test_a_step_and_pops_lead_from_the_near_to_the_far(name):
    both = case(name)
    expected, entered = walked(both)
    np.testing.assert_array_equal(np.where(entered.any(axis=1, keepdims=True), both.walk, NOTHING), expected)
    assert (both.walk[~entered.any(axis=1), 0] == NOTHING).all()
    np.testing.assert_array_equal(both.missed, both.walk[:, 1])  # A node without an entered child leads to a pop.

    # A key is at most t of the entry, and hardly less. So no child that begins before the hit is dropped.
    entries = both.scalar.entries.numpy()[entered]
    begins = (entries.view(np.int32) & ~15).view(np.float32).astype(np.float64)
    assert (begins <= entries).all() and (begins >= entries * (1.0 - 2.0**-19) - 2.0**-144).all()


@pytest.mark.parametrize("name", CASES)
def test_any_hit_takes_all_children_from_the_last_to_the_first(name):
    both = case(name)
    entered = (both.scalar.entered.numpy()[:, None] >> np.arange(WIDTH) & 1).astype(bool)
    order = np.argsort(np.where(entered, WIDTH - 1 - np.arange(WIDTH), WIDTH), axis=1)
    expected = np.where(np.take_along_axis(entered, order, axis=1), CHILDREN[order], NOTHING)
    some = entered.any(axis=1)
    np.testing.assert_array_equal(both.begun_any, expected[:, 0])
    np.testing.assert_array_equal(both.walk_any[some, :WIDTH], expected[some])
    assert (both.walk_any[some, WIDTH] == NOTHING).all() and (both.walk_any[~some, 0] == NOTHING).all()
    np.testing.assert_array_equal(both.missed_any, both.walk_any[:, 1])


@pytest.mark.parametrize("reach", [0.0, 0.5])
def test_pops_drop_what_begins_beyond_the_hit(reach):
    both = Both(*CASES["coherent"](np.random.default_rng(3)), reach=reach)
    expected, entered = walked(both, reach)
    np.testing.assert_array_equal(both.walk[entered.any(axis=1)], expected[entered.any(axis=1)])
    assert (expected[:, 1] != NOTHING).any() and (expected[:, 1:-1] != NOTHING).sum() < (entered.sum(axis=1) - 1).clip(0).sum()


@pytest.mark.parametrize("name", CASES)
def test_rays_begin_with_the_nearest_child_of_the_root(name):
    both = case(name)
    expected, _ = walked(both)
    np.testing.assert_array_equal(both.begun, expected[:, 0])


def assert_rows_as_the_unit(both, any_hit):
    """Check the hits of triangles, found by packets and ray by ray, against the scalar unit's hits."""
    hits, active = both.scalar.hits.numpy(), both.active.reshape(-1)
    found = (hits["prim_id"] != NO_HIT) & active
    np.testing.assert_array_equal((both.found[:, None] >> np.arange(LANES) & 1).reshape(-1), found)
    lane = both.lanes.numpy()
    np.testing.assert_array_equal(lane >= 0, found)
    if not any_hit:
        np.testing.assert_array_equal(PRIM_IDS[lane[found]], hits["prim_id"][found])
        for packet in (both.after, both.one_by_one):
            np.testing.assert_array_equal(both.lane_rows(packet, ["prim_id"]).view(np.int32)[active, 0], hits["prim_id"][active])
            same(both.lane_rows(packet, ["t", "u", "v"])[active], np.stack([hits["t"], hits["u"], hits["v"]], axis=1)[active])
    return found


@pytest.mark.parametrize("name", CASES)
def test_triangles_are_hit_as_the_unit_hits_them(name):
    found = assert_rows_as_the_unit(case(name), False)
    assert (name == "special") or 0.05 < found.mean() < 0.95


def test_any_hit_leaves_nothing_within_reach():
    both = Both(*CASES["coherent"](np.random.default_rng(5)), any_hit=True)
    found = (both.scalar.hits.numpy()["prim_id"] != NO_HIT) & both.active.reshape(-1)
    t, before = both.lane_rows(both.after, ["t"])[:, 0], both.lane_rows(both.set_up, ["t"])[:, 0]
    np.testing.assert_array_equal(t, np.where(found, -np.inf, before))
    np.testing.assert_array_equal(both.lane_rows(both.after, ["prim_id"]).view(np.int32)[:, 0] != NO_HIT, found)
    np.testing.assert_array_equal(both.lanes.numpy() >= 0, found)
    same(both.lane_rows(both.one_by_one, ["t"])[:, 0], t)


@pytest.mark.parametrize("name", EDGES)
def test_any_hit_rays_hit_where_the_unit_hits(name):
    # Most hits are certain in float32 (packet.h: sure_hits), which must not accept more than the unit.
    found = assert_rows_as_the_unit(Both(*EDGES[name](np.random.default_rng(12)), any_hit=True, in_row=1), True)
    assert (name == "special") or 0.01 < found.mean() < 0.95


@pytest.mark.parametrize("any_hit", [False, True])
def test_a_primitive_that_is_left_out_is_not_hit(any_hit):
    rays, nodes, corners = CASES["coherent"](np.random.default_rng(8))
    nearest = Both(rays, nodes, corners).scalar.hits.numpy()["prim_id"]
    exclude = np.where(nearest != NO_HIT, nearest + 1, 0)
    found = assert_rows_as_the_unit(Both(rays, nodes, corners, any_hit=any_hit, exclude=exclude), any_hit)
    assert 0 < found.sum() < (nearest != NO_HIT).sum()


@pytest.mark.parametrize("any_hit", [False, True])
@pytest.mark.parametrize("in_row", [1, 3, 7])
def test_what_is_behind_the_last_triangle_of_a_row_is_not_hit(in_row, any_hit):
    rays, nodes, corners = CASES["coherent"](np.random.default_rng(9))
    assert assert_rows_as_the_unit(Both(rays, nodes, corners, any_hit=any_hit, in_row=in_row), any_hit).any()


@pytest.mark.parametrize("count", [1, 7, 15])
def test_lanes_beyond_the_last_ray_are_not_active(count):
    rays, nodes, corners = random_case(np.random.default_rng(6), 500, True)
    part, whole = Both(rays, nodes, corners, count), Both(rays, nodes, corners)
    assert not part.active[:, count:].any()
    np.testing.assert_array_equal(part.active[:, :count], whole.active[:, :count])
    names = [name for name in FIELDS if name not in ("u", "v", "prim_id")]
    there = np.arange(len(rays[0])) % LANES < count
    same(part.lane_rows(part.set_up, names)[there], whole.lane_rows(whole.set_up, names)[there])


def test_constants_fit_each_other():
    assert ENTRY * (STACK_SIZE + 1) <= STACK_WORDS  # The size of a packet's stack and of a ray's stack.
    assert SLOTS <= 31 and PACKETS * LANES == 64 and COHERENT == 1 << LANES  # Widths of the masks of slots, of waiting rays and of lanes.
