"""The rays of a sample over a picture of the scene from the side, so that the eye sees them in space."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from wrt.accel.scenes.build import build
from wrt.renderer.inspector.marks import draw_stroke, label_points
from wrt.renderer.inspector.strokes import Stroke, frame_points, strokes_of
from wrt.renderer.inspector.tree import InspectedPixel, Sample
from wrt.renderer.render import render
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE, MOST_SPP = (960, 540), 64
FOV = math.radians(34.0)
FILLED = 0.84  # share of the picture's width or height that the rays may fill
# Candidates for the side camera: angles around the camera's up and above its horizon, in degrees.
AROUND, ABOVE = (-120, -90, -60, -40, 40, 60, 90, 120), (10, 30, 50)
STEPS = 96  # parts of a line that are drawn as hidden or not


class SideView:
    """A camera beside the rays, and the opaque surfaces of the scene, which hide rays."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self.camera = camera
        objects = tuple(thing for thing in scene.objects if not all(map(_see_through, thing.materials)))
        spheres = tuple(sphere for sphere in scene.spheres if not _see_through(sphere.material))
        self.accel = build(replace(scene, objects=objects, spheres=spheres)) if objects or spheres else None

    def aimed(self, camera: Camera) -> "SideView":
        view = object.__new__(SideView)
        view.camera, view.accel = camera, self.accel
        return view

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixel coordinates of points (N, 3), (N, 2); NaN behind the camera."""
        to_camera = np.linalg.inv(self.camera.camera_to_world)
        x, y, z = (points @ to_camera[:3, :3].T + to_camera[:3, 3]).T
        scale = 0.5 * SIZE[1] / math.tan(0.5 * self.camera.fov_y)
        depth = np.where(z < 0.0, -z, np.nan)
        return np.stack([0.5 * SIZE[0] + scale * x / depth, 0.5 * SIZE[1] - scale * y / depth], axis=1)

    def hidden(self, points: np.ndarray) -> np.ndarray:
        """Return for each point (N, 3) whether an opaque surface is before it, (N,) bool. Glass hides nothing."""
        return self.hidden_from(np.broadcast_to(self.camera.camera_to_world[:3, 3], points.shape), points)

    def hidden_from(self, eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the same as `hidden`, but from an eye of its own for each point, (N, 3)."""
        if self.accel is None:
            return np.zeros(len(points), bool)
        return np.asarray(self.accel.any_hit(eyes, points - eyes, t_max=0.998))


def _see_through(material: Material) -> bool:
    return material.is_clear or material.alpha_mode == "blend"


def side_camera(inspection: InspectedPixel, sample: Sample, strokes: list[Stroke]) -> SideView:
    """Return the candidate from which the rays are longest in the picture, without hidden parts and weighted by throughput."""
    pose, points = inspection.camera.camera_to_world, frame_points(sample)
    view = SideView(inspection.scene, Camera(fov_y=FOV))
    paths = [stroke for stroke in strokes if not stroke.is_shadow]
    lines = np.array([np.linspace(stroke.start, stroke.end, 17) for stroke in paths])
    weights = np.sqrt([stroke.weight for stroke in paths])[:, None]
    best, found = -1.0, view
    back = -sample.rays[0].direction.astype(np.float64)
    up = pose[:3, 1]
    back = back - (back @ up) * up
    back = back / np.linalg.norm(back) if np.linalg.norm(back) > 1e-3 else pose[:3, 2]
    for around in AROUND:
        for above in ABOVE:
            turn, rise = math.radians(around), math.radians(above)
            level = math.cos(turn) * back + math.sin(turn) * np.cross(up, back)
            candidate = view.aimed(framed(points, math.cos(rise) * level + math.sin(rise) * up, up))
            seen = ~candidate.hidden(lines[:, 1:].reshape(-1, 3)).reshape(len(lines), -1)
            flat = candidate.project(lines.reshape(-1, 3)).reshape(*lines.shape[:2], 2)
            seen &= in_picture(flat[:, 1:]) & in_picture(flat[:, :-1])
            score = float((weights * np.where(seen, np.linalg.norm(np.diff(flat, axis=1), axis=2), 0.0)).sum())
            if score > best:
                best, found = score, candidate
    return found


def in_picture(flat: np.ndarray, beyond: float = 0.0) -> np.ndarray:
    """Return whether points (..., 2) are in the picture, or beyond its edges by at most that share of its size; NaN is not."""
    return np.asarray((np.abs(flat / SIZE - 0.5) <= 0.5 + beyond).all(axis=-1))


def framed(points: np.ndarray, towards_eye: np.ndarray, up: np.ndarray) -> Camera:
    """Return a camera in the direction `towards_eye` from the points (N, 3), from which all of them fill the picture."""
    axes = Camera.look_at(towards_eye, (0.0, 0.0, 0.0), up).camera_to_world[:3, :3]
    seen = points @ axes
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    away = np.abs(seen - middle)
    tan_y = FILLED * math.tan(0.5 * FOV)
    distance = (seen[:, 2] - middle[2] + np.maximum(away[:, 0] / (tan_y * SIZE[0] / SIZE[1]), away[:, 1] / tan_y)).max()
    return Camera.look_at(axes @ (middle + [0.0, 0.0, distance]), axes @ middle, up, fov_y=FOV)


def draw_picture(axes: "Axes", inspection: InspectedPixel, sample: Sample) -> None:
    """Render the scene from the side, and draw the rays over the picture. Parts behind opaque surfaces are faint."""
    extent = float(np.ptp(frame_points(sample), axis=0).max())
    strokes = strokes_of(sample, extent)
    view = side_camera(inspection, sample, strokes)
    picture = render(inspection.scene, camera=view.camera, size=SIZE, spp=min(inspection.scene.settings.spp, MOST_SPP)).to_srgb8()
    axes.imshow(picture, extent=(0.0, SIZE[0], SIZE[1], 0.0), interpolation="lanczos")
    axes.set(xlim=(0.0, SIZE[0]), ylim=(SIZE[1], 0.0), xticks=[], yticks=[])
    axes.set_axis_off()
    for stroke in strokes:
        points = np.linspace(stroke.start, stroke.end, STEPS + 1)
        flat = view.project(points)
        kept = np.flatnonzero(in_picture(flat, 0.2))  # a line may leave the picture, even behind the camera
        if len(kept) > 1:
            part = stroke if kept[-1] == STEPS else stroke._replace(mark="", goes_on=False)
            points, flat = points[kept], flat[kept]
            draw_stroke(axes, part, flat, view.hidden(0.5 * (points[1:] + points[:-1])))
    label_points(axes, sample, strokes, view.project)
