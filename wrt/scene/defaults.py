"""Default camera and lights, so that a file that holds only shapes can be rendered."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from wrt.core.checks import as_choice, as_one, listed
from wrt.scene.backgrounds import ConstantBackground, EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import MATERIALS, Material
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import quad
from wrt.scene.values import BLACK, LUMINANCE, SMALLEST, as_number

_THREE_QUARTER = np.array([0.62, 0.42, 1.0])  # Direction from the scene to the camera; the front of glTF is +z, up is +y.
FLAT = (0.2, 0.02, 0.2)  # A subject this thin along x, y or z, relative to its next longer side, is seen face on.
FILL = 0.85  # Of the picture's tighter side, by the subject.
NARROWEST = math.radians(0.001)  # Angle of view.

# A white surface that faces the key light, and the sky or the studio, has a radiance near 1.
_KEY_IRRADIANCE = {"sky": 1.7, "studio": 1.2}
DARK = 0.01  # a lower radiance counts as unlit; a display shows it as code 25 of 255
_SKY = GradientBackground(bottom=(0.22, 0.21, 0.20), top=(0.50, 0.60, 0.75))

FILL_REACH = 0.3  # Radius within which surfaces occlude the fill light, in radii of the scene's bounding sphere.
MATTE = 0.4  # A surface this rough shows no soft boxes, and reflects a pale sky with less noise.
UP = {"x": np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "y": np.eye(4),
      "z": np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])}  # rotations that turn an axis to +y


STUDIO_SIZE = (512, 256)  # pixels of the studio's picture
EDGE = 0.03  # width of a soft box's blurred edge, as a tangent


class SoftBox(NamedTuple):
    """A rectangle of light. toward: its direction for a camera that looks along -z; width, height: half of each, as tangents."""

    toward: tuple[float, float, float]
    width: float
    height: float
    radiance: float


BOXES = (
    SoftBox((0.75, 0.95, 0.85), 0.42, 0.42, 2.2),  # key, above the camera's right shoulder
    SoftBox((-1.0, 0.30, 0.35), 0.24, 0.65, 1.2),  # fill, a strip on the left
    SoftBox((0.45, 0.75, -1.00), 0.60, 0.16, 2.2),  # rim, behind the subject and above the picture
    SoftBox((-0.25, 1.0, 0.0), 0.50, 0.35, 1.0),  # overhead
)
# Radiance of the room from straight below to straight above, by the sine of the elevation.
ELEVATIONS = (-1.0, -0.6, -0.05, 0.15, 1.0)
ROOM = (0.10, 0.20, 0.42, 0.40, 0.16)


@dataclass(frozen=True)
class Staging:
    """What is added to a scene that lacks it.

    Parameters
    ----------
    up
        Axis of a bare mesh that points up in its picture: "x", "y" or "z". Scene files have +y up.
    studio
        Light a scene without lights by a studio if it has glass or smooth surfaces, which reflect its soft boxes. False: by a pale sky.
    floor
        Put a bare mesh on a grey floor.
    fill
        Radiance of an ambient term beside a glTF file's own lights. None: an estimate of the light between surfaces if the file's
        only lights are emissive surfaces, else 0.

    Raises
    ------
    InputError
        If `up` is another text, or `fill` is negative.
    """

    up: str = "y"
    studio: bool = True
    floor: bool = False
    fill: float | None = None

    def __post_init__(self) -> None:
        as_choice(self.up, tuple(UP), "up")
        as_one(self.studio, bool, "studio")
        as_one(self.floor, bool, "floor")
        if self.fill is not None:
            as_number(self.fill, "fill", low=0.0)


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


def frame_camera(scene: Scene) -> Camera:
    """Return a pinhole camera that sees all shapes; in a picture of any aspect ratio they fill FILL of the tighter side.

    The view is three-quarter from above; a flat subject is seen face on (`_view`). The camera stands where the scene's bounding sphere
    subtends 38 degrees, and its angle of view follows from the projected shapes. Raises InputError if the scene has no shapes."""
    center, radius = bounding_sphere(scene)
    radius = max(radius, 1e-9 * float(np.abs(center).max()), SMALLEST)  # a single point has none
    back, up = _view(scene)
    distance = 3.0 * radius
    for _ in range(3):  # each step centres the projected shapes better
        camera = Camera.look_at(center + distance * back, center, up, focus_distance=distance, name="framing")
        low, high = _projected(scene, camera.camera_to_world)
        center = center + camera.camera_to_world[:3, :2] @ (0.5 * distance * (low + high))
    fov_x, fov_y = (max(2.0 * math.atan(half / FILL), NARROWEST) for half in np.maximum(-low, high))
    return replace(camera, fov_y=fov_y, least_fov_x=fov_x)


def _view(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit direction (3,) from the scene to its camera, and the vector (3,) that appears upright."""
    low, high = scene.bounds()
    thin, middle, _ = order = np.argsort(high - low, kind="stable")
    direction, up = _THREE_QUARTER, np.eye(3)[1]
    if (high - low)[thin] <= FLAT[thin] * (high - low)[middle] and (high - low)[order[1]] > 0.0:
        direction, up = np.eye(3)[thin], -np.eye(3)[2] if thin == 1 else up
    return direction / np.linalg.norm(direction), up


def _projected(scene: Scene, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest tangent (2,), to the right and up, of the directions from a camera to the shapes.

    pose: camera_to_world. All shapes must be in front of the camera."""
    view = np.linalg.inv(pose)
    tangents: list[np.ndarray] = []
    for points, transform in scene.outlines():
        matrix = view @ transform
        x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
        tangents += [np.array([each.min(), each.max()]) for each in (x / -z, y / -z)]
    for sphere in scene.spheres:
        center = view[:3, :3] @ sphere.center + view[:3, 3]
        for axis in (0, 1):  # the two tangent lines from the camera to the sphere's shadow on a plane through the camera's axis
            middle = math.atan2(center[axis], -center[2])
            half = math.asin(min(1.0, sphere.radius / math.hypot(center[axis], center[2])))
            tangents.append(np.tan([middle - half, middle + half]))
    both = np.array(tangents).reshape(-1, 2, 2)
    return both[:, :, 0].min(axis=0), both[:, :, 1].max(axis=0)


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

    return _integral(scene, radiance)


def _integral(scene: Scene, value: Callable[[Material], float]) -> float:
    """Return the integral over all surfaces of a value of their material."""
    total = sum(4.0 * math.pi * sphere.radius**2 * value(sphere.material) for sphere in scene.spheres)
    for thing in scene.objects:
        values = np.array([value(material) for material in thing.materials])
        if values.any():
            a, b, c = np.moveaxis((thing.mesh.vertices @ thing.transform[:3, :3].T)[thing.mesh.faces], 1, 0)
            of_face = values[0 if thing.face_material is None else thing.face_material]
            total += float(np.sum(of_face * 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)))
    return total


def emission_named(scene: Scene) -> str:
    """Return "the emission of ..." with the names of the materials whose emission lights other surfaces; "" without such materials."""
    names = [material.name for material in scene.materials if material.lights_others]
    return f"the emission of {listed(names)}" if names else ""


def add_fill(scene: Scene, fill: float | None) -> tuple[Scene, str]:
    """Return a glTF scene that is lit by its own lights with a fill light, and a sentence on it. fill: see Staging.

    The fill light is an ambient term that surfaces nearby occlude. Where emission is the only light, the estimate is emitted power
    over area. This is the radiosity method's ambient term for a mean albedo of 1/2 (Cohen, Chen, Wallace, Greenberg 1988, section 3.3)."""
    lamps = f"it has no lights but {emission_named(scene)}: " if not scene.lights else ""
    if fill is None:
        fill = _emitted_power(scene) / _integral(scene, lambda material: 1.0) if lamps else 0.0
    if fill <= 0.0:
        return scene, f"{lamps}surfaces that it does not reach are black" if lamps else ""
    scene = replace(scene, ambient=(fill,) * 3, ambient_occlusion=FILL_REACH * bounding_sphere(scene)[1])
    return scene, f"{lamps}a fill light of radiance {fill:.2g} was added for light between surfaces (fill=0 or --fill 0: none)"


def expose(scene: Scene) -> tuple[Scene, str]:
    """Return a glTF scene that is lit by its own lights, at the exposure that shows it well, and a sentence on it.

    The exposure is automatic, unless there are unlit surfaces, which keep their colours. Lights, emission and ambient term are then
    multiplied instead, so that a white surface at the centre (one radius away from a light that is nearer) has the radiance 1."""
    lit = [each for each in scene.materials if not each.is_emissive or each.emits_light]
    if len(lit) == len(scene.materials):
        return scene.with_settings(auto_exposure=True), ""
    center, radius = bounding_sphere(scene)
    level = _emitted_power(scene) / _integral(scene, lambda material: 1.0)
    for light in scene.lights:
        distance = max([radius, *(math.dist(place, center) for place in light.places())]) if light.places() else 1.0
        level += float(LUMINANCE @ light.record()["color"]) / distance**2 / math.pi
    if not lit or not level > 0.0:
        return scene, ""

    def scaled(thing: Any, key: str) -> Any:
        return replace(thing, **{key: tuple(value / level for value in getattr(thing, key))})

    new = {id(each): scaled(each, "emission") for each in lit}
    lights = tuple(scaled(each, "irradiance" if isinstance(each, DirectionalLight) else "intensity") for each in scene.lights)
    objects = tuple(replace(each, materials=tuple(new.get(id(m), m) for m in each.materials)) for each in scene.objects)
    return (scaled(replace(scene, objects=objects, lights=lights), "ambient"),
            f"its lights were multiplied by {1.0 / level:.2g} in place of an automatic exposure, so that unlit surfaces keep their colours")


def frame_turn(camera: Camera, scene: Scene) -> Camera:
    """Return a framing camera with an angle of view that holds the scene while the camera orbits it."""
    center, radius = bounding_sphere(scene)
    distance = max(float(np.linalg.norm(camera.camera_to_world[:3, 3] - center)), 2.0 * radius)
    angle = 2.0 * math.atan(math.tan(math.asin(radius / distance)) / FILL)
    return replace(camera, fov_y=max(angle, camera.fov_y), least_fov_x=max(angle, camera.least_fov_x))


def shines(material: Material) -> bool:
    """Return True for glass, and for surfaces so smooth that they show what they reflect."""
    return material.is_clear or (MATERIALS[material.kind].reflects and (
        material.roughness < MATTE or material.metallic_roughness_texture is not None))


def put_on_floor(scene: Scene) -> Scene:
    """Return the scene with a camera that frames its shapes, and with a grey floor below them. Raises InputError if it has no shapes."""
    center, radius = bounding_sphere(scene)
    low, side = scene.bounds()[0], 100.0 * max(radius, SMALLEST)
    corner = (center[0] - side, low[1] - 1e-4 * radius, center[2] + side)  # a little below flat lower sides
    mesh, grey = quad(corner, (2.0 * side, 0.0, 0.0), (0.0, 0.0, -2.0 * side)), Material(name="floor", albedo=(0.5,) * 3)
    floor = Object(mesh, (grey,), name="floor")
    return replace(scene, cameras=scene.cameras or (frame_camera(scene),), objects=(*scene.objects, floor))


def studio(rotation: float = 0.0) -> EnvironmentBackground:
    """Return soft boxes in a grey room, for metals and glass to reflect.

    The studio is for a camera that looks along -z, turned by `rotation` (radians) about +y, counter-clockwise seen from above."""
    width, height = STUDIO_SIZE
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = 2.0 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    ray = np.stack(np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), axis=-1)
    radiance = np.interp(ray[..., 1], ELEVATIONS, ROOM)
    for box in BOXES:
        back = np.array(box.toward) / np.linalg.norm(box.toward)
        side = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.9 else (0.0, 0.0, 1.0), back)
        side /= np.linalg.norm(side)
        along = np.maximum(ray @ back, 1e-9)
        inside = [np.clip((half - np.abs(ray @ axis) / along) / EDGE + 0.5, 0.0, 1.0)
                  for axis, half in ((side, box.width), (np.cross(back, side), box.height))]
        radiance = np.maximum(radiance, box.radiance * inside[0] * inside[1])
    return EnvironmentBackground(np.repeat(radiance[..., None], 3, axis=-1), rotation=rotation, name="studio")


def stage(scene: Scene, staging: Staging | None = None) -> tuple[Scene, list[str]]:
    """Return the scene with a camera and lights, and a sentence on each addition.

    A scene without a camera gets one that frames it. A scene that is not lit (`is_lit`) gets a key light from above the first camera's
    right shoulder. It also gets a studio if it has surfaces that reflect one (`shines`), else a pale sky. Raises InputError for a scene
    without cameras and shapes."""
    staging = staging or Staging()
    added = []
    if not scene.cameras:
        scene = replace(scene, cameras=(frame_camera(scene),))
        added.append("it has no camera: a camera that frames the scene was added")
    if not is_lit(scene):
        right, up, back = scene.cameras[0].camera_to_world[:3, :3].T
        shining = any(map(shines, scene.materials))
        around = "studio" if staging.studio and shining else "sky"
        key = DirectionalLight(tuple(-(back + 0.6 * up + 0.4 * right)), (_KEY_IRRADIANCE[around],) * 3, name="key light")
        weak = emission_named(scene)
        lacks = f"no lights but {weak}, which is too weak to light it" if weak else "no lights"
        skies = {"sky": "a pale sky", "studio": "a studio, for its smooth surfaces to reflect (studio=False or --no-studio: a pale sky),"}
        background = studio(math.atan2(back[0], back[2])) if around == "studio" else _SKY
        scene = replace(scene, lights=(key,), background=background)
        added.append(f"it has {lacks}: a key light from above the camera's shoulder and {skies[around]} were added")
    return scene, added
