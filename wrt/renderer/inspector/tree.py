"""The tree of rays of a pixel: Inspection, Sample, Ray, Light and ShadowPart. A pixel is a mean of samples, a sample a sum over rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.types import JsonObject, PathLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wrt.scene.cameras import CameraKind
    from wrt.scene.model import Scene


@dataclass(frozen=True, eq=False)
class Place:
    """A ray, and what it hits. Vectors are (3,) float32 in world space, or colours.

    - origin, direction, t_min, t_max, exclude: the ray as it was traced; exclude is the prim_id that it ignores, or -1.
    - t: distance of the hit in units of the direction's length; inf on a miss, NaN if the ray was not traced.
    - prim_id, object, material: of the hit; -1, "" and "" without one. Shapes without a name are called after their index.
    """

    origin: np.ndarray
    direction: np.ndarray
    t_min: float
    t_max: float
    exclude: int
    t: float
    prim_id: int
    object: str
    material: str

    @property
    def end(self) -> np.ndarray:
        """The hit point, computed from t; the end of the segment if that is nearer. Infinite after a miss of a ray without end."""
        return self.origin + np.float32(min(self.t, self.t_max)) * self.direction


@dataclass(frozen=True, eq=False)
class Light:
    """A light that a surface asks, or would ask.

    - light: the light's name. value: radiance that the surface reflects if nothing occludes the light.
    - transmittance: share of the light that arrives. radiance: value times transmittance. All (3,) float32.
    - state: "seen", "dimmed" (by surfaces that let a part through), "blocked", "cut" (too many such surfaces), or "dark": it cannot
      light this point, because it is behind the surface or shines elsewhere, so that no ray is traced.
    - parts: the shadow ray from surface to surface. An opaque surface that blocks is any one on the way, not always the nearest.
    """

    light: str
    state: str
    value: np.ndarray
    transmittance: np.ndarray
    radiance: np.ndarray
    parts: tuple[Place, ...]


@dataclass(frozen=True, eq=False)
class Ray(Place):
    """A ray of a path. Vectors are (3,) float32; point and normals are NaN without a hit.

    - kind: "camera", "reflected", "refracted", "transmitted" (through thin glass), or "onward" (straight through a blended surface).
    - depth: bounces so far. throughput: weight of the ray's radiance in the sample.
    - ended: "missed", "emission" or "absorbed" (a surface that makes no new ray), "continued", "cut by depth", "cut by throughput".
    - point, normal, shading_normal: the hit point, and the unit normals on the ray's side. front: whether the ray meets the front.
    - weight: weight of the surface's light in the sample: the throughput after absorption in glass and transparency.
    - own: radiance of the background, or the surface's emission and ambient term. direct: reflected light of all lights together.
    - radiance: what the ray adds to the sample, weight (own + direct).
    - lights, children: the lights asked at the hit; the rays that begin there, also those cut.
    """

    kind: str
    depth: int
    throughput: np.ndarray
    ended: str
    point: np.ndarray
    normal: np.ndarray
    shading_normal: np.ndarray
    front: bool
    weight: np.ndarray
    own: np.ndarray
    direct: np.ndarray
    radiance: np.ndarray
    lights: tuple[Light, ...]
    children: tuple[Ray, ...]

    def walk(self) -> Iterator[Ray]:
        """Yield the ray and all rays below it, in the order in which the renderer traces them: refracted, reflected, onward."""
        waiting = [self]
        while waiting:
            ray = waiting.pop()
            yield ray
            waiting += ray.children


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of a pixel. root: its camera ray; None where the camera has no ray. radiance: (3,) float32, the sum over its rays."""

    index: int
    root: Ray | None

    @property
    def rays(self) -> tuple[Ray, ...]:
        """All rays of paths, in the order in which they are traced; rays that were cut are among them."""
        return () if self.root is None else tuple(self.root.walk())

    @property
    def radiance(self) -> np.ndarray:
        total = np.zeros(3, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for ray in self.rays:
                total = total + ray.radiance
        return total


@dataclass(frozen=True, eq=False)
class Inspection:
    """The rays of a pixel. `print` shows them as a tree; `radiance` is the sum over the tree.

    Parameters
    ----------
    scene
        The inspected scene, with the settings of the inspection.
    camera
        The camera of the picture.
    pixel, size
        x and y from the top left; width and height of the picture.
    seed
        Seed of the samples.
    samples
        The inspected samples: all samples of the pixel, or one.
    """

    scene: Scene = field(repr=False)
    camera: CameraKind = field(repr=False)
    pixel: tuple[int, int]
    size: tuple[int, int]
    seed: int
    samples: tuple[Sample, ...] = field(repr=False)

    @property
    def radiance(self) -> np.ndarray:
        """The mean of the samples, (3,) float32: the bits of the pixel that `render` returns if all samples are inspected.

        The film keeps a running mean in float32, mean += (sample - mean) / n, to which a sample that is not finite adds black."""
        mean = np.zeros(3, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for n, sample in enumerate(self.samples, 1):
                radiance = sample.radiance
                radiance = radiance if np.isfinite(radiance.sum()) else np.zeros(3, np.float32)
                mean = mean + (radiance - mean) / np.float32(n)
        return mean

    def to_dict(self) -> JsonObject:
        """Return the samples as a JSON object: the fields of Inspection, Sample, Ray and Light, with rays as a flat list.

        A ray has "parent", the index of the ray at whose hit it begins (None for the camera ray), in place of "children".
        Infinity and NaN stay numbers, which JSON lacks: `python -m wrt inspect --json` writes null."""
        head = {"scene": self.scene.name, "camera": self.camera.name, "pixel": list(self.pixel), "size": list(self.size), "seed": self.seed}
        samples = [{"index": each.index, "radiance": each.radiance.tolist(), "rays": _table(each.rays)} for each in self.samples]
        return head | {"radiance": self.radiance.tolist(), "samples": samples}

    def figure(self, view: str = "both", sample: int | None = None) -> Figure:
        """Draw the rays of one sample.

        Parameters
        ----------
        view
            "section": the plane that holds most of the rays, with the outlines of the shapes that it cuts. "picture": the scene from
            the side, with the rays in it. "both": one beside the other.
        sample
            Index of the sample to draw. None: the first.

        Returns
        -------
        Figure
            A figure of matplotlib, which a notebook shows, and `save` writes.

        Raises
        ------
        InputError
            If matplotlib is missing, the view is unknown, the sample was not inspected, or it has no ray.
        """
        from wrt.renderer.inspector.drawing import figure

        return figure(self, view, sample)

    def save(self, path: PathLike, view: str = "both", sample: int | None = None) -> None:
        """Write `figure(view, sample)` to a file: .png, .svg or .pdf. Raises InputError as `figure`, and if the file cannot be written."""
        from wrt.renderer.inspector.drawing import save

        save(self, path, view, sample)

    def __str__(self) -> str:
        from wrt.renderer.inspector.text import tree_text

        return tree_text(self)


def _table(rays: tuple[Ray, ...]) -> list[JsonObject]:
    """Return the fields of each ray. A list has no limit of depth, as nested objects have."""
    parents = {id(child): i for i, ray in enumerate(rays) for child in ray.children}
    rows = []
    for ray in rays:
        row = {each.name: _plain(getattr(ray, each.name)) for each in fields(ray) if each.name != "children"}
        rows.append({"parent": parents.get(id(ray)), **row})
    return rows


def _plain(value: object) -> object:
    if isinstance(value, tuple):
        return [{each.name: _plain(getattr(part, each.name)) for each in fields(part)} for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value
