"""Conversion of cameras between a scene and the browser's viewport, and from a camera to a table of a TOML scene file.

viser's camera looks along +z with +y down (OpenCV's convention). wrt's camera looks along -z with +y up. The viewport's space is the
scene's space divided by `unit`, because viser's controls suit a scene of about size 1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.defaults import bounding_sphere
from wrt.scene.model import Scene

if TYPE_CHECKING:
    import viser

PARALLEL = 0.999  # Largest |cosine| between the view direction and +y for which +y can be the up direction.
NO_FOCUS = Camera().focus_distance  # Focus distance of a camera whose scene sets no focus.
LEVEL = 1e-6  # Largest |y| of the x axis of an upright camera.


def unit_of(scene: Scene, camera: CameraKind) -> float:
    """Return the viewport's unit in scene units: the distance from the camera to the point that it orbits."""
    return float(np.linalg.norm(orbited_point(scene, camera) - camera.camera_to_world[:3, 3]))


def orbited_point(scene: Scene, camera: CameraKind) -> np.ndarray:
    """Return the point (3,) on the camera's axis that the camera orbits, in world space.

    It is the point in focus. If the camera has no focus, it is the point nearest to the middle of the scene. If that middle is behind
    the camera, it is the point at the default focus distance."""
    origin, forward = camera.camera_to_world[:3, 3], -camera.camera_to_world[:3, 2]
    distance = _focus(camera)
    if distance == NO_FOCUS and (scene.objects or scene.spheres):
        middle, radius = bounding_sphere(scene)
        along = float((middle - origin) @ forward)
        distance = along if along > 1e-3 * radius else distance
    return origin + distance * forward


def up_of(camera: CameraKind) -> np.ndarray:
    """Return the axis (3,) that the viewport rotates about: +y for an upright camera, else the camera's up vector."""
    right, up, back = camera.camera_to_world[:3, :3].T
    upright = abs(right[1]) < LEVEL and up[1] > 0.0 and abs(back[1]) < PARALLEL
    return np.array([0.0, 1.0, 0.0]) if upright else up


def from_viewport(camera: CameraKind, viewport: viser.CameraHandle, unit: float) -> CameraKind:
    """Return the camera with the viewport's pose. A perspective camera gets the viewport's angle of view, too."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(viewport.wxyz, -1)).as_matrix() * (1.0, -1.0, -1.0)
    with np.errstate(over="ignore"):  # the camera's constructor refuses infinite values
        pose[:3, 3] = np.asarray(viewport.position, np.float64) * unit
    if isinstance(camera, Camera):
        camera = replace(camera, fov_y=float(viewport.fov), least_fov_x=0.0)
    return replace(camera, camera_to_world=pose)


def _focus(camera: CameraKind) -> float:
    return camera.focus_distance if isinstance(camera, Camera) else NO_FOCUS


def camera_toml(camera: CameraKind, name: str = "view") -> str:
    """Return the camera as a table of a TOML scene file, exact up to the rounding of float64."""
    pose = camera.camera_to_world
    origin, up = pose[:3, 3], pose[:3, 1]
    reach = max(_focus(camera), 1e-3 * float(np.abs(origin).max()))  # a nearer target would lose digits of the direction
    values = {"position": origin, "target": origin - reach * pose[:3, 2], "up": up, **camera.as_in_files()}
    lines = [f"[cameras.{name}]", f'type = "{camera.kind}"', *(f"{key} = {_number(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _number(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"[{', '.join(map(_number, value))}]"
    return repr(value if isinstance(value, int) else float(value) + 0.0)  # + 0.0 turns -0.0 into 0.0
