"""Claims about whole GPUs: ratios of tests and of units in use, and NVIDIA's 10 Grays/s."""

from collections.abc import Iterator

from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import counters_of, ray_sets
from wrt.lab.claims.claim import Claim, Figure, Study
from wrt.lab.claims.walks import Rules, walk
from wrt.lab.rtcore.meshes import in_warps
from wrt.lab.rtcore.model import RANGE, predict, sensitivity, span, sweep, trace_rays
from wrt.lab.rtcore.parameters import GPUS


def machines(study: Study) -> Iterator[Figure]:
    """Compare steps a ray, the use of the test units, and boxes for each triangle with counts on two GPUs by other makers."""
    name = "sponza"
    rays = study.rays(name)
    part, core = rays.part(rays.kind == 0), GPUS["arcb580"].core
    arc = counters_of(build(study.scene(name).geometry, "bvh6"), part)
    boxes, triangles = float(arc.boxes.mean()), float(arc.primitives.mean())
    said = f"{study.differences(name, 'a frame of a game, not shared')}; camera and bounce rays, sorted and culled"
    steps = float((arc.nodes + arc.leaves).mean())
    numbers = f"bvh6: {arc.nodes.mean():.1f} nodes, {boxes:.1f} boxes and {triangles:.2f} triangles a ray"
    yield Figure("steps a ray, bvh6", steps, 39.5, "nodes", said, f"{numbers}; without order and culling"
                                                                  f" {study.ttp(name).fetches[rays.kind == 0].mean():.1f}")
    yield Figure("use of the box unit over use of the triangle unit, bvh6", boxes / core.boxes / (triangles / core.triangles), 1.55 / 1.04,
                 "factor", f"{said}; {core.boxes:g} boxes and {core.triangles:g} triangles a clock", numbers)
    for width, bits, published, gpu in ((8, 12, 111.76 / 19.61, "RX 9070"), (4, 32, 38.8 / 10.76, "RX 6900 XT")):
        here, *others = (walk(study.tree(name, width, width, each), part, rules).counts for each, rules in
                         ((bits, Rules()), (8, Rules()), (32, Rules()), (bits, Rules(False, False))))
        eight, full, loose = (counts["boxes"].sum() / counts["tests"].sum() for counts in others)
        yield Figure(f"boxes for each triangle, {width} children as {gpu}", here["boxes"].sum() / here["tests"].sum(), published, "factor",
                     f"{study.differences(name, '3DMark DXR feature test')}; own leaves of up to {width} triangles; planes of {bits} bits,"
                     " no rotated boxes", f"{here['inner'].mean():.1f} nodes, {here['boxes'].mean():.1f} boxes, {here['tests'].mean():.2f}"
                     f" triangles a ray; planes of 8 bits: {eight:.1f}, of 32 bits: {full:.1f}; without order and culling: {loose:.1f}")


def turing(study: Study) -> Iterator[Figure]:
    """Predict rays a second of an RTX 2080 Ti for primary rays, and rank the assumptions by their weight."""
    scene = study.scene("bunny")
    accel = build(scene.geometry, "bvh2")
    rays = in_warps(accel, ray_sets(accel, 4 * scene.side**2))["primary"]
    work, gpu = trace_rays(accel, "primary", rays.origins, rays.directions), GPUS["rtx2080ti"]
    low, high = span(sweep(work, gpu, gpu.core, RANGE))
    weights = ", ".join(f"{name} {factor:.2f}x" for name, factor in sensitivity(work, gpu, gpu.core).items())
    yield Figure("primary rays of an RTX 2080 Ti, bvh2", predict(work, gpu, gpu.core).rays_per_second / 1e9, 10.0, "Grays/s",
                 f"scene {scene.shown}: {len(scene.geometry)} triangles; the rates of the tests are assumed (docs/rt_core.md)",
                 f"range {low / 1e9:.2f} to {high / 1e9:.2f} over {', '.join(RANGE)}; factor of each assumption alone: {weights}")


MACHINES = Claim("Chips and Cheese: Intel Arc B580 (2025-03), AMD RX 9070 (2025-04)",
                 "hardware counters: Arc 39.5 steps a ray, box and triangle units in use 1.55 and 1.04 %; RX 9070 111.76 to 19.61 and RX"
                 " 6900 XT"
                 " 38.8 to 10.76 box and triangle tests", "read", machines)
TURING = Claim("NVIDIA Turing GPU Architecture, WP-09183-001 (2018)", "10 Grays/s, primary rays of simple scenes", "read", turing)
