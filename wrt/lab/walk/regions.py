"""Regions of space that the steps of a walk are about: half spaces that bound boxes and cells, and spheres."""

from dataclasses import dataclass

import numpy as np

from wrt.kernels.traverse import steps as of

AXES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class Region:
    """The points p with normals @ p + offsets <= 0, or, if the radius is above 0, a sphere.

    normals: (K, 3); offsets: (K,); float64. center, radius: of a sphere.
    """

    normals: np.ndarray
    offsets: np.ndarray
    center: np.ndarray
    radius: float = 0.0

    @classmethod
    def box(cls, lo: np.ndarray, hi: np.ndarray, radius: float = 0.0) -> "Region":
        lo, hi = lo.astype(np.float64), hi.astype(np.float64)
        with np.errstate(invalid="ignore"):
            return cls(AXES, np.concatenate([-hi, lo]), 0.5 * (lo + hi), radius)

    def cut(self, normal: np.ndarray, offset: float) -> "Region":
        """Return the part on the side of a plane where dot(normal, p) + offset <= 0."""
        return Region(np.append(self.normals, [normal.astype(np.float64)], axis=0), np.append(self.offsets, offset), self.center)

    def interval(self, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
        """Return t where the line enters and leaves; the first is greater if it misses."""
        o, d = origin.astype(np.float64), direction.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if self.radius > 0.0:
                a, b = d @ d, d @ (self.center - o)
                root = b * b - a * (np.sum((self.center - o) ** 2) - self.radius**2)
                return (float((b - np.sqrt(root)) / a), float((b + np.sqrt(root)) / a)) if root >= 0.0 else (np.inf, -np.inf)
            height, slope = self.normals @ o + self.offsets, self.normals @ d
            t = -height / slope
        if (height[slope == 0.0] > 0.0).any() or self.radius < 0.0:
            return np.inf, -np.inf
        return float(t[slope < 0.0].max(initial=-np.inf)), float(t[slope > 0.0].min(initial=np.inf))


def regions_of(steps: np.ndarray) -> list[Region | None]:
    """Return the region of each step, None for pushes, pops, tests and what has no recorded bounds. steps: of one ray."""
    known: dict[tuple[int, int], Region] = {}
    node: tuple[int, int] | None = None
    out: list[Region | None] = []
    for step in steps:
        kind, key = step["kind"], (int(step["index"]), int(step["count"]))
        if kind == of.NODE:
            node = (key[0], int(of.INNER))
            key = node
        elif kind == of.BOX:
            known[key] = Region.box(step["lo"], step["hi"], float(step["edges"][0]))
        elif kind == of.CELL:
            known[key] = Region.box(step["lo"], step["hi"])
        elif kind == of.PART and node in known:
            known[key] = known[node].cut(step["lo"], float(step["hi"][0]))
        elif kind == of.PLANE and node is not None:
            key = node
        out.append(known.get(key) if kind in (of.NODE, of.BOX, of.CELL, of.PART, of.PLANE, of.LEAF) else None)
    return out
