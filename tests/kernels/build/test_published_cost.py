"""Binary trees are as good as those of tinybvh, by the count that tinybvh publishes."""

import pytest

from tests.data import data_path

from tests.kernel_tools import launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.queries.rays import rays_of, rays_on
from wrt.accel.scenes.build import build
from wrt.core.device import upload
from wrt.io.mesh_file import load_mesh
from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.units.box import box_ray, ray_aabb
from wrt.lab.bench.rays import RaySet, inward
from wrt.scene.shapes import icosphere

# Of legocar.obj, by tinybvh: SAH cost and the cost of 262,144 cosine-inward rays, with C_trav = C_int = 1.
PUBLISHED = {"binned": (30.27, 13.4), "sweep": (30.07, 13.5), "sbvh": (29.58, 12.7)}


@kernel
def count_popped(nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), rays: RayArrays, t: wp.array(dtype=wp.float32),
                 prim_id: wp.array(dtype=wp.int32), popped: wp.array(dtype=wp.int32)):
    """Count visits and primitive tests of rays with known closest hits (t, prim_id), as tinybvh counts them.
    Each popped node or leaf counts as a visit, even if it begins behind the closest hit."""
    i = wp.tid()
    box = box_ray(load_ray(rays, i))
    best = float(wp.inf)
    stack = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.vec2i)
    size = int(1)
    while size > 0:
        size = size - 1
        at = stack[size]
        popped[i] = popped[i] + 1 + at[1]
        if at[1] > 0:
            for k in range(at[0], at[0] + at[1]):
                if order[k] == prim_id[i]:
                    best = t[i]
        else:
            node = nodes[at[0]]
            t_0 = ray_aabb(box, node.lo_0, node.hi_0, best)
            t_1 = ray_aabb(box, node.lo_1, node.hi_1, best)
            child_0 = wp.vec2i(node.first_0, node.count_0)
            child_1 = wp.vec2i(node.first_1, node.count_1)
            if t_0 < wp.inf and t_1 < wp.inf:
                stack[size] = wp.where(t_1 < t_0, child_0, child_1)
                stack[size + 1] = wp.where(t_1 < t_0, child_1, child_0)
                size = size + 2
            elif t_0 < wp.inf or t_1 < wp.inf:
                stack[size] = wp.where(t_0 < wp.inf, child_0, child_1)
                size = size + 1


def published_cost(accel, rays: RaySet) -> float:
    """Return the mean over the rays of tinybvh's cost: nodes and leaves popped from the stack, plus triangles tested."""
    hits, out = accel.closest_hit(rays.origins, rays.directions), zeros(len(rays), wp.int32)
    device_rays = rays_on(accel.device, rays_of(rays.origins, rays.directions, 0.0, rays.t_max))
    launch(count_popped, len(rays), accel.data.nodes, upload(accel.built.order.copy(), wp.int32, accel.device), device_rays,
           upload(hits.t, wp.float32, accel.device), upload(hits.prim_id, wp.int32, accel.device), out)
    return float(out.numpy().mean())


def test_the_published_cost_counts_what_was_pushed_in_vain() -> None:
    geometry = Geometry.of(icosphere(3))
    accel, rays = build(geometry, "bvh2"), inward(geometry, 2000)
    c = accel.closest_hit(rays.origins, rays.directions, counters=True).counters
    assert c is not None
    own = float((c.nodes + c.leaves + c.primitives).mean())
    assert own < published_cost(accel, rays) < own + 5.0 * float(c.pushes.mean())
    missing = accel.closest_hit(rays.origins, rays.directions).prim_id < 0  # rays that miss drop nothing
    assert published_cost(accel, rays.part(missing)) == pytest.approx(float((c.nodes + c.leaves + c.primitives)[missing].mean()))


@pytest.mark.slow
@pytest.mark.parametrize("builder", PUBLISHED)
def test_trees_are_as_good_as_published_ones(builder: str) -> None:
    mesh = load_mesh(data_path("meshes/small/legocar.obj"))
    accel = build(mesh, "bvh2", builder=builder)
    sah_cost, cost = PUBLISHED[builder]
    assert accel.stats.sah_cost < 1.05 * sah_cost
    assert published_cost(accel, inward(Geometry.of(mesh), 2**18)) < 1.05 * cost
