"""The tree of rays of a pixel, and its text. A pixel is a mean of samples, and a sample is a sum over rays."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from wrt.core.types import JsonObject

AMBIENT = "ambient term"  # name of the light that stands for the ambient term, with ambient occlusion


@dataclass(frozen=True, eq=False)
class Place:
    """A ray, and what it hits. Vectors are (3,) float32 in world space, or colours.

    - origin, direction, t_min, t_max, exclude: the traced ray; exclude is the prim_id that it ignores, or -1.
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

    - light: the light's name, "background" or AMBIENT. value: radiance that the surface reflects if nothing occludes the light.
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

    - kind: "camera", "reflected", "coated" (by a clear coat), "refracted", "transmitted" (through thin glass), or "onward" (straight
      through a blended surface).
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
    children: "tuple[Ray, ...]"

    def walk(self) -> "Iterator[Ray]":
        """Yield the ray and all rays below it, in the order in which the renderer traces them: refracted, reflected, coated, onward."""
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


def as_table(rays: tuple[Ray, ...]) -> list[JsonObject]:
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


# --- text ----------------------------------------------------------------------------------------------------------------


def ray_lines(ray: Ray, first: str, below: str) -> Iterator[str]:
    """Yield the lines of a ray and of everything that begins at its hit. first, below: indents of the first line and of the others."""
    waiting: list[tuple[Ray | Light, str, str]] = [(ray, first, below)]
    while waiting:
        item, first, below = waiting.pop()
        yield first + (describe_ray(item) if isinstance(item, Ray) else describe_light(item))
        items: tuple[Ray | Light, ...] = (*item.lights, *item.children) if isinstance(item, Ray) else ()
        waiting += [(each, below + ("└─ " if last else "├─ "), below + ("   " if last else "│  "))
                    for each, last in zip(items[::-1], [True] + [False] * (len(items) - 1), strict=False)]


def describe_ray(ray: Ray) -> str:
    through = "" if ray.kind == "camera" else f", throughput {color(ray.throughput)}"
    if ray.ended.startswith("cut"):
        return f"{ray.kind}{through}: {ray.ended}"
    if ray.ended == "missed":
        return f"{ray.kind}{through}: missed, background adds {color(ray.radiance)}"
    end = {"emission": ", ends at its emission", "absorbed": ", ends here"}.get(ray.ended, "")
    adds = f", adds {color(ray.radiance)}" if ray.radiance.any() else ""
    return f"{ray.kind}{through}: t {ray.t:.4g}, {at(ray)}{'' if ray.front else ' from behind'}{adds}{end}"


def describe_light(light: Light) -> str:
    stops = [part for part in light.parts if math.isfinite(part.t)]
    by = ", ".join(f"{at(part)} at {part.t * float(np.linalg.norm(part.direction)):.4g}" for part in stops)
    by = f" by {by}" if by else ""
    adds = f", reflects {color(light.radiance)}" if light.radiance.any() else ""
    return f"light {light.light}: {light.state}{by}{adds}"


def at(place: Place) -> str:
    return f"{place.object} ({place.material})" if place.material else place.object


def color(value: np.ndarray) -> str:
    """Return the three components, or one number if they are equal."""
    return f"{value[0]:.4g}" if value[0] == value[1] == value[2] else " ".join(f"{each:.4g}" for each in value)
