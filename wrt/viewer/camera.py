"""The camera that a user steers: orbits, pans, dollies and walks, and its table of a TOML scene file."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.defaults import bounding_sphere
from wrt.scene.model import Scene

PARALLEL = 0.999  # Largest |cosine| between the view direction and +y for which +y can be the up direction.
NO_FOCUS = Camera().focus_distance  # Focus distance of a camera whose scene sets no focus.
LEVEL = 1e-6  # Largest |y| of the x axis of an upright camera.
STEEPEST = math.radians(89.0)  # Largest angle of the view above or below the horizon.


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera, the point (3,) that it orbits, which lies on its axis, and the unit vector (3,) that it rotates about."""

    camera: CameraKind
    target: np.ndarray
    up: np.ndarray

    @property
    def distance(self) -> float:
        return math.dist(self.target, self.camera.camera_to_world[:3, 3])  # without overflow

    def placed(self, axes: np.ndarray, target: np.ndarray, distance: float) -> "Pose":
        """Return the pose with other axes (3, 3), target and distance. Raises InputError if a number overflows."""
        pose = np.eye(4)
        pose[:3, :3] = axes
        with np.errstate(over="ignore", invalid="ignore"):  # the camera's constructor refuses values that are not finite
            pose[:3, 3] = target + distance * axes[:, 2]
        return Pose(replace(self.camera, camera_to_world=pose), target, self.up)


def pose_of(scene: Scene, camera: CameraKind) -> Pose:
    """Return a scene's camera as the start of a walk around the scene."""
    return Pose(camera, orbited_point(scene, camera), up_of(camera))


def orbited_point(scene: Scene, camera: CameraKind) -> np.ndarray:
    """Return the point (3,) on the camera's axis that the camera orbits, in world space.

    It is the point in focus. If the camera has no focus, it is the point nearest to the middle of the scene. If that middle is behind
    the camera, it is the point at the default focus distance."""
    origin, forward = camera.camera_to_world[:3, 3], -camera.camera_to_world[:3, 2]
    distance = camera.focus_distance if isinstance(camera, Camera) else NO_FOCUS
    if distance == NO_FOCUS and (scene.objects or scene.spheres):
        middle, radius = bounding_sphere(scene)
        along = float((middle - origin) @ forward)
        distance = along if along > 1e-3 * radius else distance
    return origin + distance * forward


def up_of(camera: CameraKind) -> np.ndarray:
    """Return the axis (3,) that orbits rotate about: +y for an upright camera, else the camera's up vector."""
    right, up, back = camera.camera_to_world[:3, :3].T
    upright = abs(right[1]) < LEVEL and up[1] > 0.0 and abs(back[1]) < PARALLEL
    return np.array([0.0, 1.0, 0.0]) if upright else up


# --- moves ------------------------------------------------------------------------------------------------------------


def orbit(pose: Pose, by: Sequence[float]) -> Pose:
    """Orbit the target. by: the drag in heights of the picture, to the right and down; one height is half a turn."""
    axes = pose.camera.camera_to_world[:3, :3]
    height = math.asin(float(np.clip(axes[:, 2] @ pose.up, -1.0, 1.0)))
    limit = max(STEEPEST, abs(height))
    rise = min(max(height + math.pi * by[1], -limit), limit) - height
    turn = Rotation.from_rotvec(-math.pi * by[0] * pose.up) * Rotation.from_rotvec(-rise * axes[:, 0])
    return pose.placed((turn * Rotation.from_matrix(axes)).as_matrix(), pose.target, pose.distance)


def pan(pose: Pose, by: Sequence[float]) -> Pose:
    """Move the camera so that the target follows a drag. by: as for orbit."""
    axes = pose.camera.camera_to_world[:3, :3]
    shift = view_height(pose) * (by[1] * axes[:, 1] - by[0] * axes[:, 0])
    return pose.placed(axes, pose.target + shift, pose.distance)


def dolly(pose: Pose, by: Sequence[float]) -> Pose:
    """Multiply the distance to the target by exp(by[0]); an orthographic camera's height, too."""
    factor = math.exp(min(max(by[0], -2.0), 2.0))
    moved = pose.placed(pose.camera.camera_to_world[:3, :3], pose.target, max(pose.distance * factor, 1e-12))
    if isinstance(moved.camera, OrthographicCamera):
        moved = replace(moved, camera=replace(moved.camera, height=moved.camera.height * factor))
    return moved


def walk(pose: Pose, by: Sequence[float]) -> Pose:
    """Move camera and target. by: to the right, up and forward, in distances to the target."""
    axes, distance = pose.camera.camera_to_world[:3, :3], pose.distance
    shift = distance * (by[0] * axes[:, 0] + by[1] * pose.up - by[2] * axes[:, 2])
    return pose.placed(axes, pose.target + shift, distance)


def view_height(pose: Pose) -> float:
    """Return the height of the view at the target, in scene units; for a fisheye or a panorama, the distance."""
    camera = pose.camera
    if isinstance(camera, OrthographicCamera):
        return camera.height
    return 2.0 * pose.distance * math.tan(0.5 * camera.fov_y) if isinstance(camera, Camera) else pose.distance


MOVED: dict[str, Callable[[Pose, Sequence[float]], Pose]] = {each.__name__: each for each in (orbit, pan, dolly, walk)}


class Steering:
    """The pose that the user steers, and `start`, to which `reset` returns: a camera of the scene, chosen by name."""

    def __init__(self, scene: Scene, camera: CameraKind) -> None:
        self._scene = scene
        self.names = tuple(each.name or f"camera {i}" for i, each in enumerate(scene.cameras))
        self.name = next((name for name, each in zip(self.names, scene.cameras, strict=True) if each is camera), camera.name)
        self.start = self.pose = pose_of(scene, camera)

    def move(self, kind: str, by: Sequence[float]) -> None:
        """Apply a move of MOVED."""
        self.pose = MOVED[kind](self.pose, by)

    def change(self, **fields: Any) -> None:
        """Change fields of the camera, such as fov_y."""
        self.pose = replace(self.pose, camera=replace(self.pose.camera, **fields))

    def choose(self, name: str) -> None:
        """Go to a camera of the scene."""
        self.name, self.start = name, pose_of(self._scene, self._scene.cameras[self.names.index(name)])
        self.reset()

    def reset(self) -> None:
        self.pose = self.start


# --- scene files ------------------------------------------------------------------------------------------------------


def camera_toml(pose: Pose, name: str = "view") -> str:
    """Return the camera as a table of a TOML scene file."""
    camera, matrix = pose.camera, pose.camera.camera_to_world
    values = {"type": camera.kind, "position": matrix[:3, 3].tolist(), "target": pose.target.tolist(), "up": matrix[:3, 1].tolist()}
    lines = [f"[cameras.{name}]", *(f"{key} = {json.dumps(value)}" for key, value in (values | camera.as_in_files()).items())]
    return "\n".join(lines) + "\n"
