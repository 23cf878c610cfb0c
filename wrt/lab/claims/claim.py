"""`python -m wrt bench claims`: published claims about ray tracing hardware, repeated with exact counts.

A claim is a published number, its source and set-up, and the function that repeats it. CLAIMS is the registry."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar, cast

import numpy as np

from wrt.core.registry import Registry
from wrt.core.types import PathLike
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, tabled
from wrt.lab.claims import Claims as Plan
from wrt.lab.claims.scenes import PATH, Scene, open_scene, scene_files
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
    published: float | tuple[float, float]  # A number or the ends of a range.
    unit: str = ""  # Of both numbers; "ratio" if 1 means no change.
    differences: str = ""  # Of set-up.
    reason: str = ""  # What a measurement says about the difference.

    @property
    def ratio(self) -> float:
        """Ours over the published number, or over the nearer end of a range; 1 within the range."""
        nearer = float(np.clip(self.ours, *np.broadcast_to(self.published, 2)))
        return 1.0 if self.ours == nearer else self.ours / nearer if nearer != 0.0 else np.inf

    @property
    def verdict(self) -> str:
        """Return "differs" or "agrees": within the factor AGREES, and for the unit "ratio" on the same side of 1."""
        opposite = self.unit == "ratio" and (self.ours - 1.0) * (np.min(self.published) - 1.0) < 0.0
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

    def ttp(self, name: str, workload: str = PATH) -> Walk:
        """Return the logged walk of bvh6 by the rays of a workload."""
        return self.keep(("ttp", name, workload), lambda: walk(self.six(name), self.rays(name, workload), TTP_RULES))

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
    for name in ("ttp-nodes", "coop-rt", "cwbvh", "eight-bits")},
    "wrt.claims")

TITLE = "Published claims, repeated"
COLUMNS: Columns = {"claim": "{claim}", "what": "{what}", "unit": "{unit}", "ours": "{ours:.4g}",
                    "published": lambda row: shown(row.published), "ratio": "{ratio:.2f}", "verdict": "{verdict}"}
LEGEND = f"""\
published: a number, or the two ends of a range; ratio: ours over it, 1 within a range. agrees: within a factor of {AGREES:g},
and on the same side of 1 for a unit of ratio. differs: the list of sources says what a measurement shows about it. In brackets after a
source: read in the original, quoted by others, or the abstract alone. Generated scenes stand in for scenes without a file. Nothing is
timed: equal options give equal rows."""


def shown(published: float | tuple[float, float]) -> str:
    """Write a published number or range."""
    return " to ".join(f"{value:.4g}" for value in np.atleast_1d(published))


def groups(plan: Plan) -> Groups:
    study = Study(scene_files(plan.scene), plan.side)
    return (partial(claim_rows, study, name) for name in dict.fromkeys(plan.names) or CLAIMS)


def claim_rows(study: Study, name: str) -> list[Row]:
    claim = CLAIMS[name]
    return [Row(claim=name, **vars(figure), ratio=figure.ratio, verdict=figure.verdict, source=claim.source, setup=claim.setup,
                sure=claim.sure) for figure in claim.measure(study)]


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return the table of numbers, and a list with the source and set-up of each claim, and what differs for each number."""
    lines = []
    for (claim, source, sure, setup), group in grouped(rows, "claim", "source", "sure", "setup").items():
        lines.append(f"- **{claim}**: {source} ({sure}). Published set-up: {setup}.")
        for (differences, reason), same in grouped(group, "differences", "reason").items():
            texts = (differences, f"measured: {reason}" if reason else "")
            lines.append(f"  - *{'; '.join(row.what for row in same)}*: {'; '.join(filter(None, texts))}")
    agree = facts(rows, plan)["agree"]
    return [tabled(COLUMNS, rows, "Compared numbers", f"{agree} of {len(rows)} numbers agree."),
            Part("Sources, differences of set-up, and what explains them", "\n".join(lines))]


def line(row: Row) -> str:
    return f"{row.claim}: {row.what}: {row.ours:.4g} {row.unit}, published {shown(row.published)}: {row.verdict}"


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {"compared": len(rows), "agree": sum(row.verdict == "agrees" for row in rows)}
