"""What is at a clicked pixel: the surface there, the rays of the inspector, and the walk of its camera ray, as messages for the page."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np

from wrt.core.packages import needed_by
from wrt.core.types import JsonObject
from wrt.renderer.inspector.assemble import Assembler
from wrt.renderer.inspector.drawing import COLORS, frame_points, strokes_of
from wrt.renderer.inspector.inspect import Inspector
from wrt.renderer.inspector.tree import Light, Ray, Sample, color, describe_light, describe_ray
from wrt.renderer.prepare import Prepared
from wrt.renderer.upload import film_rays
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.viewer.refine import Renderers, View, kind_of

KEPT = ("seed", "device", "threads", "accel_options", "triangle", "box", "instancing")  # Options of the viewer for its inspectors.
MOST_NODES = 500  # Rays and lights of the tree that the page shows.
NEAR = 1e-4  # Smallest depth of a drawn point, over the distance of the line's farther end.
INCHES, DOTS = (4.4, 3.5), 150  # Size of a drawing of a step, and its pixels per inch.


def pick(prepared: Prepared, view: View, x: float, y: float) -> JsonObject | None:
    """Return the surface at a point of the picture, 0 to 1 from the top left corner; None if the ray through it hits nothing.

    distance: along the ray, in scene units."""
    origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
    hits = prepared.accel.closest_hit(origins, directions)
    prim_id = int(hits.prim_id[0])
    if prim_id < 0:
        return None
    names = Assembler(prepared.plan.scene, prepared.arrays.world, prepared.plan.features)
    material = names.materials[names.material_of(np.array([prim_id]))[0]]
    return {"object": names.shapes[names.shape_of(prim_id)], "material": material, "prim": prim_id, "distance": float(f"{hits.t[0]:.5g}")}


class Rays:
    """Inspects clicked pixels of a viewer's scene, and projects the last inspected rays onto pictures from any camera."""

    def __init__(self, renderers: Renderers, report: Callable[[str], None]) -> None:
        self.renderers, self.report = renderers, report
        self.shown: Inspected | None = None
        self._inspectors: dict[object, Inspector] = {}

    def inspect(self, view: View, x: float, y: float, sample: int, spp: int) -> "Inspected":
        """Trace a sample of the pixel at a point of the picture, as `render` would. Raises InputError if the scene cannot be rendered."""
        scene, options, key = self.renderers.scene, self.renderers.options, kind_of(view)
        if key not in self._inspectors:
            self.report("preparing the inspector (first time for this kind of scene) ...")
            chosen: Any = {name: getattr(options, name) for name in KEPT}
            self._inspectors[key] = Inspector(scene, camera=view.camera.opened(), accel=view.accel, **chosen)
        inspector = self._inspectors[key]
        inspector.aim(view.camera, size=view.size, spp=spp, max_depth=view.max_depth)
        pixel = min(int(x * view.size[0]), view.size[0] - 1), min(int(y * view.size[1]), view.size[1] - 1)
        return Inspected(inspector.pixel(pixel, min(sample, spp - 1)).samples[0], pixel)


class Inspected:
    """The rays of one sample of a pixel. nodes: its first MOST_NODES rays and lights, each with the index of its parent, or -1."""

    def __init__(self, sample: Sample, pixel: tuple[int, int]) -> None:
        self.sample, self.pixel = sample, pixel
        self.nodes: list[tuple[int, Ray | Light]] = []
        waiting: list[tuple[int, Ray | Light]] = [] if sample.root is None else [(-1, sample.root)]
        while waiting and len(self.nodes) < MOST_NODES:
            parent, item = waiting.pop()
            if isinstance(item, Ray):
                waiting += [(len(self.nodes), ray) for ray in item.children[::-1]]
                waiting += [(len(self.nodes), light) for light in item.lights[::-1]]
            self.nodes.append((parent, item))
        places = {id(item): i for i, (_, item) in enumerate(self.nodes)}
        strokes = [] if sample.root is None else strokes_of(sample, float(np.ptp(frame_points(sample), axis=0).max()))
        self.lines = [(places[id(item)], stroke) for item, stroke in strokes if id(item) in places]

    def as_json(self) -> JsonObject:
        """Return the tree as a list of nodes; the page indents a node below its parent."""
        nodes = [{"parent": parent, "text": describe_ray(item) if isinstance(item, Ray) else describe_light(item),
                  "color": COLORS[item.kind if isinstance(item, Ray) else "shadow ray" if item.state in ("seen", "dimmed") else "blocked"]}
                 for parent, item in self.nodes]
        return {"pixel": list(self.pixel), "sample": self.sample.index, "radiance": color(self.sample.radiance), "nodes": nodes,
                "more": sum(1 + len(ray.lights) for ray in self.sample.rays) - len(nodes)}

    def overlay(self, camera: CameraKind, size: tuple[int, int]) -> list[JsonObject]:
        """Return the lines in the picture of a camera, with "ends" (x0, y0, x1, y1) from 0 to 1 from the top left corner.

        The list is empty for a camera that does not map lines to lines."""
        if not self.lines or not isinstance(camera, Camera | OrthographicCamera):
            return []
        flat = project(camera, size, np.array([(stroke.start, stroke.end) for _, stroke in self.lines]))
        return [{"node": node, "color": COLORS[stroke.kind], "width": round(stroke.width, 2), "mark": stroke.mark,
                 "dashed": stroke.is_shadow, "ends": np.round(ends, 5).ravel().tolist()}
                for (node, stroke), ends in zip(self.lines, flat, strict=True) if np.isfinite(ends).all()]


def project(camera: Camera | OrthographicCamera, size: tuple[int, int], ends: np.ndarray) -> np.ndarray:
    """Return the places of lines (N, 2, 3) in a picture, (N, 2, 2), 0 to 1 from the top left corner.

    A line is cut at the camera; NaN if all of it is behind the camera."""
    matrix, record = camera.camera_to_world, camera.record(size)
    points = (ends - matrix[:3, 3]) @ matrix[:3, :3]
    depth = -points[..., 2]
    near = NEAR * np.abs(depth).max(axis=1, keepdims=True)
    behind = depth < near
    with np.errstate(all="ignore"):
        share = (depth - near) / (depth - depth[:, ::-1])
        points = np.where(behind[..., None], points + share[..., None] * (points[:, ::-1] - points), points)
    points[behind.all(axis=1)] = np.nan
    if isinstance(camera, OrthographicCamera):
        x, y = points[..., 0] / record["half_width"], points[..., 1] / record["half_height"]
    else:
        x, y = (points[..., i] / (record[name] * -points[..., 2]) for i, name in enumerate(("tan_x", "tan_y")))
    return np.stack([0.5 + 0.5 * x, 0.5 - 0.5 * y], axis=-1)


# (structure, origin, direction) to an object with `steps`, which have a text each, and `draw(axes, step)`, such as wrt.walk.
WalkOf = Callable[[Any, np.ndarray, np.ndarray], Any]


class Walks:
    """The walk of the ray that was clicked last. walk_of: None allows no walks."""

    def __init__(self, walk_of: WalkOf | None) -> None:
        self.walk_of = walk_of
        self._ray: tuple[Any, np.ndarray, np.ndarray] | None = None  # structure, origin, direction
        self._walk: Any = None

    def aim(self, prepared: Prepared, view: View, x: float, y: float) -> None:
        """Choose the ray through a point of the picture, 0 to 1 from the top left corner."""
        origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
        self._ray, self._walk = (prepared.accel, origins[0], directions[0]), None

    def step(self, step: int) -> tuple[JsonObject, bytes] | None:
        """Return a step, or the last one if there are fewer, as a message and as a PNG; None without a ray.

        Raises InputError without matplotlib, and for a structure over instances."""
        if self.walk_of is None or self._ray is None:
            return None
        with needed_by("a drawing"):
            from matplotlib.figure import Figure

        if self._walk is None:
            self._walk = self.walk_of(*self._ray)
        steps, out = self._walk.steps, io.BytesIO()
        step = max(0, min(step, len(steps) - 1))
        figure = Figure(figsize=INCHES, layout="constrained")
        if steps:
            axes = figure.subplots()
            self._walk.draw(axes, step)
            axes.set_title("", loc="left")  # the page has the text
        figure.savefig(out, format="png", dpi=DOTS)
        text = steps[step].text if steps else "the ray meets no node"
        return {"mime": "image/png", "step": step, "last": max(0, len(steps) - 1), "text": text}, out.getvalue()
