"""Default camera and lights, so that a file that holds only shapes can be rendered."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from wrt.core.checks import listed
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import Material
from wrt.scene.model import Scene
from wrt.scene.size import require_size
from wrt.scene.values import BLACK, LUMINANCE, SMALLEST

FOV_Y = math.radians(40.0)
_THREE_QUARTER = np.array([0.62, 0.42, 1.0])  # direction from the scene to the camera; the front of glTF is +z, up is +y
_MARGIN = 1.05  # radius of the sphere in view, in radii of the scene's bounding sphere

# A white surface that faces the key light and the sky has a radiance near 1.
_KEY_IRRADIANCE = 1.7
DARK = 0.01  # a lower radiance counts as unlit; a display shows it as code 25 of 255
_SKY = GradientBackground(bottom=(0.22, 0.21, 0.20), top=(0.50, 0.60, 0.75))


def bounding_sphere(scene: Scene) -> tuple[np.ndarray, float]:
    """Return the centre (3,) of the scene's box, and the radius of the smallest sphere around it that holds all shapes.

    Raises InputError if the scene has no shapes."""
    low, high = scene.bounds()
    center = 0.5 * low + 0.5 * high
    radius = max((math.dist(sphere.center, center) + sphere.radius for sphere in scene.spheres), default=0.0)
    for points, transform in scene.outlines():
        points = points @ transform[:3, :3].T + (transform[:3, 3] - center)
        radius = max(radius, math.sqrt(float(np.max(np.einsum("ij,ij->i", points, points)))))
    return center, radius


def frame_camera(scene: Scene, aspect: float = 16.0 / 9.0) -> Camera:
    """Return a pinhole camera in three-quarter view that sees the whole bounding sphere of the scene.

    aspect: width / height of the picture. The vertical angle of view is 40 degrees. The camera is so far away that the sphere
    fits into the narrower of the vertical and the horizontal angle. Raises InputError if the scene has no shapes."""
    center, radius = bounding_sphere(scene)
    half_angle = math.atan(math.tan(0.5 * FOV_Y) * min(aspect, 1.0))
    radius = max(radius, 1e-9 * float(np.abs(center).max()), SMALLEST)  # a single point has none
    distance = _MARGIN * radius / math.sin(half_angle)
    position = center + distance * _THREE_QUARTER / np.linalg.norm(_THREE_QUARTER)
    return Camera.look_at(position, center, fov_y=FOV_Y, focus_distance=distance, name="framing")


def is_lit(scene: Scene) -> bool:
    """Return True if the scene has a light, a background, an ambient term or enough emission.

    Emission is enough if it would light the scene's bounding sphere, if that were white, to a mean radiance of DARK or more."""
    if scene.lights or scene.background != ConstantBackground(BLACK) or scene.ambient != BLACK:
        return True
    power = _emitted_power(scene)
    return power > 0.0 and power >= DARK * 4.0 * math.pi * bounding_sphere(scene)[1] ** 2


def _emitted_power(scene: Scene) -> float:
    """Return emitted luminance times area, summed over the surfaces whose emission lights other surfaces."""

    def radiance(material: Material) -> float:
        return float(LUMINANCE @ material.emission) * (1 + material.two_sided) * material.lights_others

    power = sum(4.0 * math.pi * sphere.radius**2 * radiance(sphere.material) for sphere in scene.spheres)
    for thing in scene.objects:
        emitted = np.array([radiance(material) for material in thing.materials])
        if emitted.any():
            a, b, c = np.moveaxis((thing.mesh.vertices @ thing.transform[:3, :3].T)[thing.mesh.faces], 1, 0)
            of_face = emitted[0 if thing.face_material is None else thing.face_material]
            power += float(np.sum(of_face * 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)))
    return power


def emission_named(scene: Scene) -> str:
    """Return "the emission of ..." with the names of the materials whose emission lights other surfaces; "" without such materials."""
    names = [material.name for material in scene.materials if material.lights_others]
    return f"the emission of {listed(names)}" if names else ""


def stage(scene: Scene) -> tuple[Scene, list[str]]:
    """Return the scene with a camera and lights, and a sentence on each addition.

    A scene without a camera gets one that frames it. A scene that is not lit (`is_lit`) gets a key light from above the first camera's
    right shoulder and a pale sky. Raises InputError for a scene without cameras and shapes, and for a scene that is too small."""
    require_size(scene)
    added = []
    if not scene.cameras:
        scene = replace(scene, cameras=(frame_camera(scene),))
        added.append("it has no camera: a camera that frames the scene was added")
    if not is_lit(scene):
        right, up, back = scene.cameras[0].camera_to_world[:3, :3].T
        direction = -(back + 0.6 * up + 0.4 * right)
        key = DirectionalLight(tuple(direction), (_KEY_IRRADIANCE,) * 3, name="key light")
        scene = replace(scene, lights=(key,), background=_SKY)
        weak = emission_named(scene)
        lacks = f"no lights but {weak}, which is too weak to light it" if weak else "no lights"
        added.append(f"it has {lacks}: a key light from above the camera's shoulder and a pale sky were added")
    return scene, added
