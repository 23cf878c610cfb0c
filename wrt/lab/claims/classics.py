"""Older claims: builds of k-d trees, and watertight tests."""

from collections.abc import Iterator

import numpy as np

from wrt.accel.cells.trees import KdTree
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.plane_layouts import KD_LEAF
from wrt.lab.bench.meshes import terrain
from wrt.lab.bench.rays import counters_of
from wrt.lab.claims.claim import SAME_SCENE, Claim, Figure, Study
from wrt.scene.shapes import icosphere


def split_references(tree: KdTree) -> int:
    """Sum the number of different primitives in a cell over the cells that the build split."""
    nodes, n = tree.built.arrays["nodes"], len(tree.geometry)
    leaf, first = (nodes["word"] & 3) == KD_LEAF, (nodes["word"] >> 2).astype(np.int64)
    levels, level = [], np.zeros(1, np.int64)
    while len(level):
        levels.append(level)
        level = np.concatenate([first[level[~leaf[level]]] + side for side in (0, 1)])
    parent = np.zeros(len(nodes), np.int64)
    for side in (0, 1):
        parent[first[~leaf] + side] = np.flatnonzero(~leaf)
    total, below = 0, np.zeros(0, np.int64)  # keys of a cell and a primitive in it, for the cells of a level that were split
    for level in reversed(levels):
        total += len(below)
        ends = level[leaf[level]]
        count = nodes["split"][ends].astype(np.int64)
        at = np.repeat(first[ends] - (np.cumsum(count) - count), count) + np.arange(int(count.sum()))
        keys = np.concatenate([below, np.repeat(ends, count) * n + tree.built.order[at]])
        below = np.unique(parent[keys // n] * n + keys % n) if level[0] else keys[:0]
    return total


def kd_build(study: Study) -> Iterator[Figure]:
    """Compare the growth of a k-d build's work with that of N log N."""
    for name, meshes in (("terrain", [terrain(22 << k) for k in range(4)]), ("ball", [icosphere(k) for k in range(3, 7)])):
        size, work = np.array([(len(mesh.faces), split_references(KdTree(Geometry.of(mesh)))) for mesh in meshes], np.float64).T
        exponent, published = (np.log(each[-1] / each[0]) / np.log(size[-1] / size[0]) for each in (work, size * np.log2(size)))
        yield Figure(f"growth of the swept references over that of N log N, {name}",
                     work[-1] / work[0] / ((size * np.log2(size))[-1] / (size * np.log2(size))[0]), 1.0, "factor",
                     f"generated meshes of {size[0]:.0f} to {size[-1]:.0f} triangles (theirs: their own scenes); operations in place of"
                     " time: references of all cells that the build split, each of which it sweeps in six sorted events",
                     f"exponent {exponent:.3f} where N log N has {published:.3f}; references swept for each triangle: "
                     f"{', '.join(f'{each:.1f}' for each in work / size)}", factor=SAME_SCENE)


def watertight(study: Study) -> Iterator[Figure]:
    """Count rays lost at vertices and edges by the triangle tests; the watertight test must lose none."""
    rng, ball = np.random.default_rng(0), icosphere(5)
    count = 4 * study.side**2
    corners = ball.vertices[ball.faces[rng.integers(len(ball.faces), size=count)]].astype(np.float64)
    weight = rng.random(count)[:, None] * (rng.random(count) < 0.5)[:, None]  # half of the rays aim at a vertex, half at a point of an edge
    targets = (1.0 - weight) * corners[:, 0] + weight * corners[:, 1]
    origins = (0.3 * rng.normal(size=(count, 3)) / 3.0).astype(np.float32)  # inside the ball, so that every ray hits it
    directions = (targets - origins).astype(np.float32)
    lost = {}
    for test, box in (("watertight", "conservative"), ("moeller_trumbore", "minmax")):
        accel = build(ball, "bvh2", triangle=test, box=box)
        lost[test] = int((accel.closest_hit(origins, directions).prim_id < 0).sum())
    for test, number in lost.items():
        yield Figure(f"rays lost at vertices and edges, {test}", float(number), 0.0 if test == "watertight" else None, "rays",
                     f"{count} rays from inside a closed ball of {len(ball.faces)} triangles; machine instructions of a test:"
                     " docs/rt_core.md")
    name = "sponza"
    rays = study.rays(name)
    part = rays.part(rays.kind == 0)
    exact, wide = (counters_of(build(study.scene(name).geometry, "bvh2", box=box), part) for box in ("minmax", "conservative"))
    yield Figure("boxes tested a ray, conservative box test over minmax", float(wide.boxes.sum() / exact.boxes.sum()), None, "ratio",
                 f"{study.differences(name, 'their own scenes')}; Ize 2013 widens the interval of each box; triangles tested a ray"
                 f" {wide.primitives.mean():.4f} against {exact.primitives.mean():.4f}")


KD_BUILD = Claim("Wald, Havran: On Building Fast kd-Trees for Ray Tracing, and on Doing That in O(N log N), RT 2006",
                 "splits by the surface area heuristic at exact planes take a time of O(N log N)", "memory", kd_build)
WATERTIGHT = Claim("Woop, Benthin, Wald: Watertight Ray/Triangle Intersection, JCGT 2013; Ize: Robust BVH Ray Traversal, JCGT 2013",
                   "no ray is lost at edges and vertices", "memory", watertight)
