"""A pixel's rays as text: one line for each ray and each light, indented as a tree."""

import math
from collections.abc import Iterator

import numpy as np

from wrt.renderer.inspector.tree import InspectedPixel, Light, Place, Ray

MOST = 4  # samples that are printed


def tree_text(inspection: InspectedPixel) -> str:
    """Return the trees of the first MOST samples, below a line with the pixel's radiance."""
    (x, y), (width, height), samples = inspection.pixel, inspection.size, inspection.samples
    of = f"sample {samples[0].index}" if len(samples) == 1 else f"the mean of {len(samples)} samples"
    lines = [f"pixel {x},{y} of {width}x{height}, {inspection.scene.name or 'scene'}: radiance {color(inspection.radiance)}, {of}"]
    for sample in samples[:MOST]:
        if len(samples) > 1:
            lines.append(f"sample {sample.index}: radiance {color(sample.radiance)}")
        lines += ["the camera has no ray here"] if sample.root is None else ray_lines(sample.root, "", "")
    if len(samples) > MOST:
        lines.append(f"and {len(samples) - MOST} more samples")
    return "\n".join(lines)


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
