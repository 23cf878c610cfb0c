"""Claims about nodes per ray: the walk of Vulkan-Sim, breadth first against depth first, and what width, order and culling do."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wrt.lab.claims.claim import TTP_RULES, Claim, Figure, Study
from wrt.lab.claims.scenes import BOUNCES, subdivided
from wrt.lab.claims.walks import Rules, tree_of, walk

TTP = "Tozlu, Naithani, Zhou: TTP, ISCA 2026, arXiv 2605.16253"
SETUP = ("LumiBench, path tracing, 128 x 128, one sample a pixel, all rays; nodes of 6 children in 64 bytes, one primitive a leaf; children"
         " unsorted, popped entries not culled; reads of leaves count")
THEIRS = {"bunny": "144k triangles in a scene of LumiBench", "sponza": "Crytek's, 262k triangles"}
MEAN, MOST = {"bunny": 11.3, "sponza": 38.0}, {"bunny": 141.0, "sponza": 335.0}
BREADTH = {"bunny": 10.6, "sponza": 35.5}


def ttp_nodes(study: Study) -> Iterator[Figure]:
    """Count nodes a ray in the walk of Vulkan-Sim, for all rays and for those without shadow rays."""
    for name in ("bunny", "sponza"):
        rays, fetches = study.rays(name), study.ttp(name).fetches
        path = rays.kind == 0
        said = f"{study.differences(name, THEIRS[name])}; up to {BOUNCES} diffuse bounces"
        shadow = float(fetches[~path].mean())
        yield Figure(f"nodes a ray, {name}, camera, bounce and shadow rays", float(fetches.mean()), MEAN[name], "nodes",
                     f"{said}, with shadow rays to one light",
                     reason=f"{np.mean(~path):.0%} of our rays are shadow rays, which end at their first hit: {shadow:.1f} nodes;"
                            f" the others take {fetches[path].mean():.1f}")
        for figure in (Figure(f"nodes a ray, {name}, camera and bounce rays", float(fetches[path].mean()), MEAN[name], "nodes",
                              f"{said}, without shadow rays"),
                       Figure(f"most nodes of a ray, {name}", float(fetches.max()), MOST[name], "nodes", said)):
            yield figure if figure.verdict == "agrees" else replace(figure, reason=finer(study, name))


def finer(study: Study, name: str) -> str:
    """Measure how the nodes a ray grow if every triangle is cut into four, and say so."""

    def measure() -> str:
        from wrt.accel.bvh.six import Bvh6
        from wrt.accel.geometry import Geometry

        geometry, path = Geometry.of(subdivided(study.scene(name).mesh)), study.rays(name).kind == 0
        counts = walk(tree_of(geometry, Bvh6(geometry).decoded()), study.rays(name).part(path), TTP_RULES).fetches
        return (f"the scene's detail: with every triangle cut into four ({len(geometry)} triangles), camera and bounce rays take"
                f" {counts.mean():.1f} nodes, {counts.max()} at most")

    return study.keep(("finer", name), measure)


def ttp_breadth(study: Study) -> Iterator[Figure]:
    """Compare nodes a ray of a queue with those of a stack."""
    for name in ("bunny", "sponza"):
        depth, breadth = study.ttp(name), study.ttp(name, rules=Rules(False, False, True)).fetches
        path, hit = study.rays(name).kind == 0, depth.counts["prim_id"] >= 0

        def grown(chosen: np.ndarray, breadth: np.ndarray = breadth, depth: np.ndarray = depth.fetches) -> float:
            return 100.0 * float(breadth[chosen].mean() / depth[chosen].mean() - 1.0)

        yield Figure(f"nodes that breadth first adds, {name}", grown(path | True), BREADTH[name], "%",
                     study.differences(name, THEIRS[name]),
                     f"only rays that hit grow, so what is in the picture decides: camera and bounce rays that hit"
                     f" {grown(path & hit):+.0f} %, that"
                     f" miss {grown(path & ~hit):+.0f} %, shadow rays that hit {grown(~path & hit):+.0f} %; {np.mean(hit):.0%} of the"
                     " rays hit")


def ttp_queue(study: Study) -> Iterator[Figure]:
    """Count the pops of a queue whose successor already waits, so that it can be prefetched."""
    shares = []
    for name in ("bunny", "sponza"):
        log = study.ttp(name, rules=Rules(False, False, True))
        before = np.cumsum(log.entered) - log.entered
        within = np.arange(len(log.fetch)) - log.first[log.owner]
        waiting = before - before[log.first[log.owner]] - within  # entries in the queue after the pop, before the pushes
        shares.append(float((waiting > 0).mean()))
    yield Figure("pops of a queue after which the next entry waits, mean of two scenes", 100.0 * float(np.mean(shares)), 70.42, "%",
                 f"means of bunny and sponza ({shares[0]:.1%}, {shares[1]:.1%}) instead of 16 scenes;"
                 f" {study.differences('sponza', THEIRS['sponza'])}",
                 reason=f"bunny {shares[0]:.1%}, sponza {shares[1]:.1%}")


WIDTHS = (2, 4, 6, 8)
NAMES = {Rules(False, False): "unsorted", Rules(False, True): "unsorted, culled", Rules(True, False): "sorted",
         Rules(True, True): "sorted, culled"}


def rules(study: Study) -> Iterator[Figure]:
    """Count nodes a ray for widths by order of children by culling, with one primitive a leaf."""
    for name in ("bunny", "sponza"):
        base = None
        for width in WIDTHS:
            for each, said in NAMES.items():
                mean = float(walk(study.tree(name, width), study.rays(name), each).fetches.mean())
                base = base or mean
                yield Figure(f"nodes a ray, {name}, width {width}, {said}", mean, None, "nodes",
                             f"{study.differences(name, THEIRS[name])}; planes of 32 bits; {mean / base:.2f} of width 2 unsorted")


TTP_NODES = Claim(f"{TTP}, Table I", SETUP, "read", ttp_nodes)
TTP_BREADTH = Claim(f"{TTP}, Table I", f"{SETUP}; a queue in place of the stack", "read", ttp_breadth)
TTP_QUEUE = Claim(f"{TTP}, Figure 7", f"{SETUP}; a queue in place of the stack; mean of 16 scenes", "read", ttp_queue)
RULES = Claim("wrt's own: width, order of children and culling", "the rays of ttp-nodes; trees of one builder", "own", rules)
