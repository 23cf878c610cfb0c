"""What a claim is: a published number, its source and set-up, and the function that repeats it. CLAIMS is the registry."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar, cast

import numpy as np

from wrt.core.registry import Registry
from wrt.core.types import PathLike
from wrt.lab.claims.scenes import PATH, Scene, open_scene
from wrt.lab.claims.walks import Rays, Rules, Tree, Walk, build_tree, tree_of, walk
from wrt.scene.mesh import Mesh

T = TypeVar("T")
AGREES = 1.5  # factor within which a repeated number agrees: scenes and cameras are not those of the papers
TTP_RULES = Rules(ordered=False, culled=False)  # the walk of Vulkan-Sim: children unsorted, popped entries not culled


@dataclass(frozen=True)
class Figure:
    """One repeated number of a claim."""

    what: str  # What is counted, with its scene.
    ours: float
    published: float | tuple[float, float] | None = None  # A number or the ends of a range; None for a finding of wrt's own.
    unit: str = ""  # Of both numbers; "ratio" if 1 means no change.
    differences: str = ""  # Of set-up.
    reason: str = ""  # What a measurement says about the difference.

    @property
    def ratio(self) -> float | None:
        """Ours over the published number, or over the nearer end of a range; 1 within the range."""
        if self.published is None:
            return None
        low, high = self.published if isinstance(self.published, tuple) else (self.published, self.published)
        nearer = float(np.clip(self.ours, low, high))
        return 1.0 if self.ours == nearer else self.ours / nearer if nearer != 0.0 else np.inf

    @property
    def verdict(self) -> str:
        """Return "own finding", "differs" or "agrees": within the factor, and for the unit "ratio" on the same side of 1."""
        if self.published is None or self.ratio is None:
            return "own finding"
        low = self.published[0] if isinstance(self.published, tuple) else self.published
        opposite = self.unit == "ratio" and (self.ours - 1.0) * (low - 1.0) < 0.0
        return "agrees" if 1.0 / AGREES <= self.ratio <= AGREES and not opposite else "differs"


@dataclass(frozen=True)
class Claim:
    """A published claim."""

    source: str  # Authors, venue, and the figure or table.
    setup: str  # Of the paper.
    sure: str  # "read" in the original, "quoted" by others, or "abstract" read alone.
    measure: "Callable[[Study], Iterator[Figure]]"  # Yields the repeated numbers.


@dataclass(eq=False)
class Study:
    """What the claims share: scenes, trees and walks, each made once. files: name of a published scene -> the caller's mesh file."""

    files: Mapping[str, Mesh | PathLike] = field(default_factory=dict)
    side: int = 128
    _kept: dict[tuple[object, ...], object] = field(default_factory=dict)

    def keep(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        return cast(T, self._kept[key] if key in self._kept else self._kept.setdefault(key, make()))

    def scene(self, name: str) -> Scene:
        return self.keep(("scene", name), lambda: open_scene(name, self.files.get(name), self.side))

    def tree(self, name: str, width: int, max_leaf: int = 1, bits: int = 32) -> Tree:
        return self.keep(("tree", name, width, max_leaf, bits), lambda: build_tree(self.scene(name).geometry, width, max_leaf, bits))

    def six(self, name: str) -> Tree:
        """Return the tree of bvh6."""
        from wrt.accel.bvh.six import Bvh6

        geometry = self.scene(name).geometry
        return self.keep(("six", name), lambda: tree_of(geometry, Bvh6(geometry).decoded()))

    def ttp(self, name: str, workload: str = PATH, rules: Rules = TTP_RULES) -> Walk:
        """Return the logged walk of bvh6 by the rays of a workload."""
        return self.keep(("ttp", name, workload, rules), lambda: walk(self.six(name), self.rays(name, workload), rules, log=True))

    def rays(self, name: str, workload: str = PATH) -> Rays:
        return self.scene(name).workloads[workload]

    def differences(self, name: str, theirs: str) -> str:
        """Say in words what differs between a published scene and ours. theirs: the published scene."""
        scene = self.scene(name)
        kind = "a generated scene in its place" if not scene.given else "another version" if name == "sponza" else "the caller's file"
        return (f"scene {scene.shown}: {len(scene.geometry)} triangles, {kind} (theirs: {theirs}); own camera, "
                f"{scene.side} x {scene.side} pixels")


CLAIMS: Registry[Claim] = Registry("claim", {
    name: f"wrt.lab.claims.counted:{name.upper().replace('-', '_')}"
    for name in ("ttp-nodes", "ttp-breadth", "ttp-queue", "coop-rt", "repacking", "cwbvh", "eight-bits", "machines", "turing")},
    "wrt.claims")
