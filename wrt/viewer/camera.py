"""Cameras between a scene and the browser's viewport, and as a table of a scene file.

viser's cameras look along their +z with +y down (OpenCV's convention); ours look along -z with +y up. Its world is ours divided by
`unit`, since its controls are made for things of about its unit's size.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.defaults import bounding_sphere
from wrt.scene.model import Scene

PARALLEL = 0.999  # cosine from which on +y is no up any more
NO_FOCUS = Camera().focus_distance  # what a camera has where nobody set one
LEVEL = 1e-6  # how far a camera's x axis may be from level to count as upright


def unit_of(scene: Scene, camera: CameraKind) -> float:
    """How long one unit of the viewport's world is: the distance from the camera to what it orbits."""
    return float(np.linalg.norm(orbited_point(scene, camera) - camera.camera_to_world[:3, 3]))


def orbited_point(scene: Scene, camera: CameraKind) -> np.ndarray:
    """(3,): what is in focus, which is what the camera looks at; where nobody set a focus, the point of its axis that is nearest
    to the middle of the scene, if it looks that way."""
    origin, forward = camera.camera_to_world[:3, 3], -camera.camera_to_world[:3, 2]
    distance = _focus(camera)
    if distance == NO_FOCUS and (scene.objects or scene.spheres):
        middle, radius = bounding_sphere(scene)
        along = float((middle - origin) @ forward)
        distance = along if along > 1e-3 * radius else distance
    return origin + distance * forward


def up_of(camera: CameraKind) -> np.ndarray:
    """(3,) What the viewport turns about: +y for a camera that stands upright, else the camera's own up."""
    right, up, back = camera.camera_to_world[:3, :3].T
    upright = abs(right[1]) < LEVEL and up[1] > 0.0 and abs(back[1]) < PARALLEL
    return np.array([0.0, 1.0, 0.0]) if upright else up


def from_viewport(camera: CameraKind, viewport: Any, unit: float) -> CameraKind:
    """The camera with the pose and, if it is a perspective one, the angle of view of viser's CameraHandle (wxyz, position, fov)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(viewport.wxyz, -1)).as_matrix() * (1.0, -1.0, -1.0)
    with np.errstate(over="ignore"):  # a camera refuses what is not finite
        pose[:3, 3] = np.asarray(viewport.position, np.float64) * unit
    if isinstance(camera, Camera):
        camera = replace(camera, fov_y=float(viewport.fov))
    return replace(camera, camera_to_world=pose)


def _focus(camera: CameraKind) -> float:
    return camera.focus_distance if isinstance(camera, Camera) else NO_FOCUS


def camera_toml(camera: CameraKind, name: str = "view") -> str:
    """The camera as a table of a TOML scene file; reading it gives the same camera up to rounding of float64."""
    pose = camera.camera_to_world
    origin, up = pose[:3, 3], pose[:3, 1]
    reach = max(_focus(camera), 1e-3 * float(np.abs(origin).max()))  # a nearer target would lose digits
    values = {"position": origin, "target": origin - reach * pose[:3, 2], "up": up,
              **camera.as_in_files()}
    return "\n".join([f"[cameras.{name}]", f'type = "{camera.kind}"',
                      *(f"{key} = {_number(value)}" for key, value in values.items())]) + "\n"


def _number(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"[{', '.join(map(_number, value))}]"
    return repr(value if isinstance(value, int) else float(value) + 0.0)  # no -0.0
