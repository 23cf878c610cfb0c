"""Claims about stacks and early ends: short stacks, prediction of hits, and a bound for the k nearest hits."""

from collections.abc import Iterator

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import launch, on_host, start
from wrt.kernels.structs import Surfaces
from wrt.kernels.study import k_hits as k_kernels
from wrt.kernels.study import wide_short_stack as short_kernels
from wrt.kernels.study.tree_walk import QUEUE, Work
from wrt.lab.bench.rays import unit
from wrt.lab.claims.claim import TTP_RULES, Claim, Figure, Study
from wrt.lab.claims.scenes import AO, Scene
from wrt.lab.claims.walks import RAYS_PER_LAUNCH, Rays, Rules, Tree, build_tree, upload_rays, walk
from wrt.lab.rtcore.warps import WARP, longest_of
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

ENTRIES = (0, 1, 2, 3, 4, 5, 6, 8)
FULL = short_kernels.CAPACITY


def short_walk(tree: Tree, rays: Rays, entries: int) -> np.ndarray:
    """Trace rays with a stack of `entries` entries, 0 to FULL, and restarts; return their counts, (N,) records of tree_walk.Work."""
    out = wp.zeros(len(rays), dtype=Work, device=start("cpu"))
    launch(short_kernels.walk_short, len(rays), tree.data, Surfaces(), upload_rays(rays), entries, out)
    return on_host(out).copy()


def short_stack(study: Study) -> Iterator[Figure]:
    """Compare the nodes a ray of short stacks with those of a full stack, and primitive tests with and without culling at the pop."""
    name = "sponza"
    rays, said = study.rays(name), study.differences(name, "their own scenes")
    for label, width, bits in (("bvh4", 4, 32), ("bvh8c", 8, 8)):
        tree = study.tree(name, width, width, bits)
        nodes = {entries: float(short_walk(tree, rays, entries)["inner"].mean()) for entries in (*ENTRIES, FULL)}
        curve = ", ".join(f"{entries}: {mean / nodes[FULL]:.2f}" for entries, mean in nodes.items() if entries < FULL)
        yield Figure(f"nodes with 5 entries over a full stack, {label}", nodes[5] / nodes[FULL], 1.0, "ratio",
                     f"{said}; published as 'close to a full stack', compared with 1; nodes read again after a restart count",
                     f"by entries: {curve}",
                     factor=1.1)
    plain, culled = (walk(study.tree(name, 8, 8, 8), rays, Rules(True, each)).counts["tests"].mean() for each in (False, True))
    yield Figure("primitive tests that culling of popped leaves saves, bvh8c", 100.0 * float(1.0 - culled / plain), (0.0, 14.0), "%",
                 f"{said}; published as 'up to 14 %'; ours culls inner nodes too", f"{plain:.2f} tests a ray without, {culled:.2f} with"
                                                                                   " culling")


TABLE_ENTRIES, CELLS, SECTORS, GO_UP = 1024, 32, 8, 2  # entries of a predictor's table; cells of origins and of directions along an axis


def keys_of(rays: Rays, bounds: tuple[np.ndarray, np.ndarray], cells: int = CELLS, sectors: int = SECTORS) -> np.ndarray:
    """Return the cell of each ray's origin and direction as one number, (N,) int64: the key under which a table stores a hit."""
    lo, hi = bounds
    cell = np.clip((rays.origins - lo) / (hi - lo) * cells, 0, cells - 1).astype(np.int64)
    sector = np.clip((unit(rays.directions.astype(np.float64)) + 1.0) * 0.5 * sectors, 0, sectors - 1).astype(np.int64)
    key = np.zeros(len(rays), np.int64)
    for column, size in zip((*cell.T, *sector.T), (cells,) * 3 + (sectors,) * 3, strict=True):
        key = key * size + column
    return key


def predicted(keys: np.ndarray, hit: np.ndarray, pending: int) -> np.ndarray:
    """Return the prediction for each ray, (N,) int32; 0 for none. hit: reference that a ray stores in the table at its end, 0 for none.
    An entry holds its key. `pending` rays run at a time: a ray sees what rays stored that began at least so many rays before."""
    place = keys * 2654435761 % (1 << 32) * TABLE_ENTRIES >> 32
    table, owner, out = np.zeros(TABLE_ENTRIES, np.int32), np.full(TABLE_ENTRIES, -1, np.int64), np.zeros(len(keys), np.int32)
    for first in range(0, len(keys), pending):
        rows = slice(first, first + pending)
        out[rows] = np.where(owner[place[rows]] == keys[rows], table[place[rows]], 0)
        stored = hit[rows] != 0
        table[place[rows][stored]], owner[place[rows][stored]] = hit[rows][stored], keys[rows][stored]
    return out


def prediction(study: Study) -> Iterator[Figure]:
    """Count repeated reads of nodes by occlusion rays, and the nodes that a table of predicted hits saves."""
    name = "sponza"
    rays = study.rays(name, AO)
    part = rays.part(rays.kind == 1)
    tree = study.six(name)
    log = walk(tree, part, TTP_RULES, log=True)
    # Reads that repeat a node that an earlier ray read, among as many rays as a multiprocessor holds.
    window = np.arange(len(part)) // (8 * WARP)
    seen = np.unique(window[log.owner] * (1 << 40) + log.address)
    repeats, everywhere = 1.0 - len(seen) / len(log.fetch), 1.0 - len(np.unique(log.address)) / len(log.fetch)
    said = study.differences(name, "seven scenes of up to 3.6 million triangles")
    yield Figure("reads of a node that repeat an earlier one, occlusion rays", 100.0 * everywhere, 88.0, "%",
                 f"{said}; over all rays of the picture", f"among 8 warps at a time {repeats:.1%}", factor=1.25)
    parent = np.zeros(tree.nodes, np.int32)
    of_row = np.zeros(len(tree.wide.order), np.int32)
    node, slot = np.nonzero(tree.wide.children)
    child = tree.wide.children[node, slot].astype(np.int64)
    parent[child[child > 0]] = node[child > 0]
    of_row[(-1 - child[child < 0]) >> 6] = node[child < 0]
    leaf = log.counts["leaf"].astype(np.int64)
    hit = np.where(leaf < 0, of_row[np.where(leaf < 0, (-1 - leaf) >> 6, 0)], 0).astype(np.int32)
    for _ in range(GO_UP - 1):
        hit = parent[hit]
    geometry = study.scene(name).geometry
    low, high = (np.asarray(each) for each in geometry.bounds())
    gains, tried, right = [], np.zeros(len(part), bool), np.zeros(len(part), bool)
    for cells, sectors in ((CELLS // 2, SECTORS // 2), (CELLS, SECTORS)):
        start_at = predicted(keys_of(part, (low.min(axis=0), high.max(axis=0)), cells, sectors), hit, 8 * WARP)
        tried = start_at != 0
        first = walk(tree, part, TTP_RULES, starts=start_at)
        right = tried & (first.counts["prim_id"] >= 0)
        nodes = np.where(right, first.fetches, np.where(tried, first.fetches, 0) + log.fetches)
        gains.append(float(log.fetches.mean() / nodes.mean()))
    yield Figure("gain by prediction, occlusion rays", 100.0 * (gains[-1] - 1.0), 26.0, "%",
                 f"{said}; fewer nodes in place of less time; one table of {TABLE_ENTRIES} entries for all rays, 8 warps at a time; cells"
                 f" of {CELLS} along"
                 f" an axis; a prediction is the node {GO_UP} levels above the leaf; the table holds whole keys",
                 f"{np.mean(log.counts['prim_id'] >= 0):.0%} of the rays hit; {np.mean(tried):.0%} have a prediction,"
                 f" {right.sum() / max(tried.sum(), 1):.0%} of these are right; with half as many cells along each axis the gain is"
                 f" {gains[0] - 1.0:+.1%}")


def cloud(count: int = 4000, seed: int = 0) -> Mesh:
    """Return overlapping ellipsoids of 20 triangles each around the surface of a sphere: the proxies of a cloud of Gaussians."""
    rng, ball = np.random.default_rng(seed), icosphere(0)
    centre = unit(rng.normal(size=(count, 3))) * rng.normal(1.0, 0.15, size=(count, 1))
    axes = np.exp(rng.normal(-2.6, 0.5, size=(count, 3)))
    turn, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    points = np.einsum("nij,nvj->nvi", turn, ball.vertices[None].astype(np.float64) * axes[:, None]) + centre[:, None]
    faces = ball.faces[None] + len(ball.vertices) * np.arange(count)[:, None, None]
    return Mesh(points.reshape(-1, 3), faces.reshape(-1, 3), name="cloud")


def k_walk(tree: Tree, rays: Rays, bounded: bool) -> np.ndarray:
    """Find the 16 nearest hits of rays; return their counts, see kernels.study.k_hits. bounded: drop nodes behind the last of them."""
    cpu, n = start("cpu"), len(rays)
    out, given = wp.zeros(n, dtype=Work, device=cpu), upload_rays(rays)
    scratch = wp.empty(RAYS_PER_LAUNCH * int(QUEUE), dtype=wp.uint64, device=cpu)
    launch(k_kernels.walk_k_hits, n, tree.data, Surfaces(), given, int(bounded), None, scratch, out, step=RAYS_PER_LAUNCH)
    return on_host(out).copy()


def k_hits(study: Study) -> Iterator[Figure]:
    """Compare nodes of a query for the 16 nearest hits with and without the bound, and the lanes that are active."""
    scene = Scene("cloud", "cloud", False, cloud(), study.side)
    geometry = Geometry.of(scene.mesh)
    tree, rays = build_tree(geometry, 6), scene.workloads["path tracing"]
    camera = rays.part((rays.kind == 0) & (rays.depth == 0))
    free, bound = (k_walk(tree, camera, each) for each in (False, True))
    nodes = [each["inner"].astype(np.float64) + each["leaves"] for each in (free, bound)]
    said = (f"scene: {len(geometry)} triangles, a generated cloud of ellipsoids of 20 triangles in place of reconstructed Gaussians;"
            " camera rays,"
            f" {study.side} x {study.side}; 6 children; a node counts, in place of treelets of 256")
    gain = float(nodes[0].mean() / nodes[1].mean())
    yield Figure("nodes of the 16 nearest hits without the bound over with it", gain, (1.2, 1.9), "ratio", said,
                 f"{nodes[0].mean():.0f} nodes without, {nodes[1].mean():.0f} with the bound; {np.mean(bound['prim_id'] == 16):.0%} of"
                 " the rays have 16 hits")
    active = float(nodes[1].sum() / (WARP * longest_of(nodes[1], camera.warp).sum()))
    mixed = np.random.default_rng(0).permutation(nodes[1])
    apart = float(mixed.sum() / (WARP * longest_of(mixed, camera.warp).sum()))
    yield Figure("active lanes of the 16 nearest hits", 100.0 * active, (27.5, 40.1), "%", said,
                 f"our camera rays are coherent: with the same rays in random warps {apart:.1%} are active")


SHORT_STACK = Claim("Vaidyanathan, Woop, Benthin: Wide BVH Traversal with a Short Stack, HPG 2019, doi 10.2312/hpg.20191190, abstract",
                    "wide and compressed nodes, 5 entries and a restart trail", "abstract", short_stack)
PREDICTION = Claim("Liu et al.: Intersection Prediction for Accelerated GPU Ray Tracing, MICRO 2021",
                   "ambient occlusion; a table of 5.5 KB for each SM, keyed by a hash of origin and direction; gain in time",
                   "quoted", prediction)
K_HITS = Claim("GauTracer (2026), Figures 13 and 14", "the 16 nearest hits; 6 children; treelets of 256 nodes of 64 bytes", "read", k_hits)
