"""What a scene without a camera or without light gets, so that any file of shapes makes a picture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.model import Scene
from wrt.scene.size import require_size
from wrt.scene.values import BLACK, SMALLEST

FOV_Y = math.radians(40.0)
_THREE_QUARTER = np.array([0.62, 0.42, 1.0])  # from the scene to the camera: glTF's front is +z, its up +y
_MARGIN = 1.05  # of the bounding sphere's radius

# Together they give a white surface that faces both a radiance near 1: the sky lights surfaces too.
_KEY_IRRADIANCE = 1.7
_SKY = GradientBackground(bottom=(0.22, 0.21, 0.20), top=(0.50, 0.60, 0.75))


def bounding_sphere(scene: Scene) -> tuple[np.ndarray, float]:
    """Centre (3,) of the scene's box and the radius of the sphere around it that holds all shapes, in world units.

    Raises InputError where the scene has no shapes.
    """
    low, high = scene.bounds()
    center = 0.5 * low + 0.5 * high
    radius = max((math.dist(sphere.center, center) + sphere.radius for sphere in scene.spheres), default=0.0)
    for points, transform in scene.outlines():
        points = points @ transform[:3, :3].T + (transform[:3, 3] - center)
        radius = max(radius, math.sqrt(float(np.max(np.einsum("ij,ij->i", points, points)))))
    return center, radius


def frame_camera(scene: Scene, aspect: float = 16.0 / 9.0) -> Camera:
    """A pinhole camera in three-quarter view that sees the scene's whole bounding sphere.

    aspect: width / height of the picture. The vertical angle of view is 40 degrees; the narrower of the two angles
    decides the distance. Raises InputError where the scene has no shapes.
    """
    center, radius = bounding_sphere(scene)
    half_angle = math.atan(math.tan(0.5 * FOV_Y) * min(aspect, 1.0))
    radius = max(radius, 1e-9 * float(np.abs(center).max()), SMALLEST)  # a single point has none
    distance = _MARGIN * radius / math.sin(half_angle)
    position = center + distance * _THREE_QUARTER / np.linalg.norm(_THREE_QUARTER)
    return Camera.look_at(position, center, fov_y=FOV_Y, focus_distance=distance, name="framing")


def is_lit(scene: Scene) -> bool:
    """Whether anything in the scene gives light: a light, an emissive surface that lights others, a background."""
    return bool(scene.lights) or scene.background != ConstantBackground(BLACK) or scene.ambient != BLACK or any(
        material.lights_others for material in scene.materials)


def stage(scene: Scene) -> tuple[Scene, list[str]]:
    """The scene with what it lacks to be seen, and a sentence on each thing that was added.

    No camera: one that frames the scene. No light: a directional key light from above the first camera's right
    shoulder, and a pale sky as the background. Raises InputError where a camera is missing and the scene has no shapes, and
    for a scene that is too small to be rendered.
    """
    require_size(scene)
    added = []
    if not scene.cameras:
        scene = replace(scene, cameras=(frame_camera(scene),))
        added.append("it has no camera: one that frames the scene was added")
    if not is_lit(scene):
        right, up, back = scene.cameras[0].camera_to_world[:3, :3].T
        direction = -(back + 0.6 * up + 0.4 * right)
        key = DirectionalLight(tuple(direction), (_KEY_IRRADIANCE,) * 3, name="key light")
        scene = replace(scene, lights=(key,), background=_SKY)
        added.append("it has no lights: a key light from above the camera's shoulder and a pale sky were added")
    return scene, added
