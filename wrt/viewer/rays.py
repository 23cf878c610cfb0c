"""What is at a clicked pixel: the surface there, and the rays of the inspector, as JSON for the page."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from wrt.core.types import JsonObject
from wrt.renderer.inspector.assemble import Assembler
from wrt.renderer.inspector.inspect import Inspector
from wrt.renderer.inspector.side_view import SideView
from wrt.renderer.inspector.strokes import COLORS, Stroke, frame_points, strokes_of
from wrt.renderer.inspector.text import color, describe_light, describe_ray
from wrt.renderer.inspector.tree import Light, Ray, Sample
from wrt.renderer.pixel_rays import film_rays
from wrt.renderer.prepare import Prepared
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.viewer.renderers import Renderers, View, kind_of

KEPT = ("seed", "device", "threads", "accel_options", "triangle", "box", "instancing")  # Options of the viewer for its inspectors.
MOST_NODES = 500  # Rays and lights of the tree that the page shows.
PARTS = 32  # Parts of a line that are drawn as hidden or not.
NEAR = 1e-4  # Smallest depth of a drawn point, over the distance of the line's farther end.


@dataclass(frozen=True, eq=False)
class Pick:
    """The surface in the middle of a pixel. distance: along the ray; depth: along the camera's axis, both in scene units."""

    object: str
    material: str
    prim_id: int
    distance: float
    depth: float

    def as_json(self) -> JsonObject:
        return {"object": self.object, "material": self.material, "prim": self.prim_id, "distance": float(f"{self.distance:.5g}"),
                "depth": self.depth}


def pick(prepared: Prepared, view: View, x: float, y: float) -> Pick | None:
    """Return the surface at a point of the picture, 0 to 1 from the top left corner; None if the ray through it hits nothing."""
    origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
    hits = prepared.accel.closest_hit(origins, directions)
    prim_id = int(hits.prim_id[0])
    if prim_id < 0:
        return None
    names = Assembler(prepared.plan.scene, prepared.arrays.world, prepared.plan.features)
    material = names.materials[names.material_of(np.array([prim_id]))[0]]
    distance = float(hits.t[0])
    along = float(directions[0] @ -view.camera.camera_to_world[:3, 2])
    return Pick(names.shapes[names.shape_of(prim_id)], material, prim_id, distance, distance * along)


class Rays:
    """Inspects clicked pixels of a viewer's scene, and projects the last inspected rays onto pictures from any camera."""

    def __init__(self, renderers: Renderers, report: Callable[[str], None]) -> None:
        self.renderers, self.report = renderers, report
        self.shown: Inspected | None = None
        self._inspectors: dict[object, Inspector] = {}
        self._scenery: SideView | None = None  # the scene's opaque surfaces, made at the first inspection

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
        inspection = inspector.pixel(pixel, min(sample, spp - 1))
        if self._scenery is None:
            self._scenery = SideView(scene, Camera())
        return Inspected(inspection.samples[0], pixel, self._scenery)


class Inspected:
    """The rays of one sample of a pixel."""

    def __init__(self, sample: Sample, pixel: tuple[int, int], scenery: SideView) -> None:
        self.sample, self.pixel, self.scenery = sample, pixel, scenery
        self.nodes = nodes_of(sample)
        self.lines = lines_of(sample, self.nodes) if sample.root is not None else []
        steps = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
        self.points = np.array([line.stroke.start + steps * (line.stroke.end - line.stroke.start) for line in self.lines])

    def as_json(self) -> JsonObject:
        """Return the tree as a list of nodes; the page indents a node below its parent."""
        return {"pixel": list(self.pixel), "sample": self.sample.index, "radiance": color(self.sample.radiance),
                "nodes": [{"parent": node.parent, "text": node.text, "kind": node.kind, "color": COLORS[node.kind]} for node in self.nodes],
                "more": max(0, count(self.sample) - len(self.nodes))}

    def overlay(self, camera: CameraKind, size: tuple[int, int]) -> list[JsonObject]:
        """Return the lines in the picture of a camera: for each, the visible and hidden parts [x0, y0, x1, y1, hidden].

        x and y are 0 to 1 from the top left corner. The list is empty for a camera that does not map lines to lines."""
        if not self.lines or not isinstance(camera, Camera | OrthographicCamera):
            return []
        flat = project(camera, size, self.points)
        hidden = self._hidden(camera)
        return [{"node": line.node, "color": COLORS[line.stroke.kind], "width": round(line.stroke.width, 2), "mark": line.stroke.mark,
                 "dashed": line.stroke.is_shadow, "parts": parts(flat[i], hidden[i])} for i, line in enumerate(self.lines)]

    def _hidden(self, camera: CameraKind) -> np.ndarray:
        """Return for the middle of each part of each line whether an opaque surface is before it, (N, PARTS) bool."""
        middles = 0.5 * (self.points[:, 1:] + self.points[:, :-1]).reshape(-1, 3)
        eye = camera.camera_to_world[:3, 3]
        if isinstance(camera, OrthographicCamera):  # its rays start at the plane through the camera
            back = camera.camera_to_world[:3, 2]
            eye = middles - ((middles - eye) @ back)[:, None] * back
        return self.scenery.hidden_from(np.broadcast_to(eye, middles.shape), middles).reshape(len(self.lines), PARTS)


@dataclass(frozen=True)
class Node:
    """A ray or a light in the tree. parent: index of the node at whose hit it begins; -1 for the camera ray. kind: as of a Stroke."""

    parent: int
    text: str
    kind: str
    item: Ray | Light


@dataclass(frozen=True)
class Line:
    """The stroke of a node."""

    node: int
    stroke: Stroke


def count(sample: Sample) -> int:
    return sum(1 + len(ray.lights) for ray in sample.rays)


def nodes_of(sample: Sample) -> list[Node]:
    """Return the first MOST_NODES rays and lights of a sample, each before the rays that begin at its hit."""
    nodes: list[Node] = []
    waiting: list[tuple[Ray | Light, int]] = [] if sample.root is None else [(sample.root, -1)]
    while waiting and len(nodes) < MOST_NODES:
        item, parent = waiting.pop()
        if isinstance(item, Ray):
            begun: tuple[Ray | Light, ...] = (*item.lights, *item.children)
            waiting += [(each, len(nodes)) for each in begun[::-1]]
            nodes.append(Node(parent, describe_ray(item), item.kind, item))
        else:
            kind = "shadow ray" if item.state in ("seen", "dimmed") else "blocked"
            nodes.append(Node(parent, describe_light(item), kind, item))
    return nodes


def lines_of(sample: Sample, nodes: list[Node]) -> list[Line]:
    """Return the strokes of the nodes that have one: strokes_of has one for each ray and for each light that was asked."""
    extent = float(np.ptp(frame_points(sample), axis=0).max())
    rays = sample.rays
    asked: list[Ray | Light] = [light for ray in rays for light in ray.lights if light.parts]
    index_of = {id(node.item): i for i, node in enumerate(nodes)}
    pairs = zip((*asked, *rays), strokes_of(sample, extent), strict=True)
    return [Line(index_of[id(item)], stroke) for item, stroke in pairs if id(item) in index_of]


def project(camera: Camera | OrthographicCamera, size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Return the places of points (N, M, 3) in a picture, (N, M, 2), 0 to 1 from the top left corner; NaN behind the camera."""
    matrix, record = camera.camera_to_world, camera.record(size)
    x, y, z = np.moveaxis((points - matrix[:3, 3]) @ matrix[:3, :3], -1, 0)
    if isinstance(camera, OrthographicCamera):
        scale, depth = (record["half_width"], record["half_height"]), np.where(z < 0.0, 1.0, np.nan)
    else:
        scale = record["tan_x"], record["tan_y"]
        depth = np.where(-z > NEAR * np.abs(z).max(axis=-1, keepdims=True), -z, np.nan)
    return np.stack([0.5 + 0.5 * x / (scale[0] * depth), 0.5 - 0.5 * y / (scale[1] * depth)], axis=-1)


def parts(flat: np.ndarray, hidden: np.ndarray) -> list[list[float]]:
    """Return the runs of equally hidden parts of a line, [x0, y0, x1, y1, hidden], without parts behind the camera.

    flat: (N + 1, 2); hidden: (N,) bool."""
    there = np.isfinite(flat).all(axis=1)
    state = np.where(there[1:] & there[:-1], hidden.astype(int), -1)
    edges = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), len(state)]
    return [[*(round(float(value), 5) for value in (*flat[first], *flat[end])), float(state[first])]
            for first, end in pairwise(edges) if state[first] >= 0]
