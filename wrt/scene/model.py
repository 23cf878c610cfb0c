"""What a scene is: frozen descriptions in NumPy, validated when they are made.

Nothing here knows of Warp, of files or of acceleration structures. World space is right-handed; lengths have the
scene's own unit; colours are linear Rec. 709 (`(3,)` floats); angles are radians. A camera looks along its -z axis with
+y up, as in glTF.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from itertools import product
from typing import Any

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_choice, as_integer, as_one, as_size, as_tuple, at_thing, unknown
from wrt.core.errors import InputError
from wrt.core.html import html_facts, html_table
from wrt.scene.mesh import Mesh
from wrt.scene.motion import Motion

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
SMALLEST = 1e-30  # of a length that must not be 0
MAX_OBJECTS = 1 << 20  # and spheres, and lights: a few bytes of a file must not make any number of them
MANY_VERTICES = 1 << 26  # of all objects together: beyond, where a scene ends is no longer asked of each
MAX_REACH = 1e18  # of a shape from the origin, in scene units: the square of a distance must be a float32


def as_vector(value: Any, what: str, *, low: float = -math.inf, high: float = math.inf) -> Color:
    """Three finite floats in [low, high]; a single number is taken three times. Raises InputError that names `what`."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be three numbers, got {value!r}") from error
    if array.ndim == 0:
        array = np.repeat(array, 3)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"{what} must be three finite numbers, got {value!r}")
    low, high = max(low, -LARGEST), min(high, LARGEST)
    if (array < low).any() or (array > high).any():
        raise InputError(f"{what} must lie in [{low:g}, {high:g}], got {array.tolist()}")
    return (float(array[0]), float(array[1]), float(array[2]))


def as_number(value: Any, what: str, *, low: float = -math.inf, high: float = math.inf) -> float:
    """One finite float in [low, high]. Raises InputError that names `what`."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be a number, got {value!r}") from error
    low, high = max(low, -LARGEST), min(high, LARGEST)
    if not math.isfinite(number) or not low <= number <= high:
        raise InputError(f"{what} must be finite and in [{low:g}, {high:g}], got {value!r}")
    return number


def as_transform(value: Any, what: str) -> np.ndarray:
    """A (4, 4) float64 affine matrix that acts on column vectors.

    Raises InputError where it is not finite, not (4, 4) or not affine. A singular one is taken: it flattens what it moves,
    and glTF files hide nodes by a scale of 0. Who cannot do with one asks himself (`Camera`, TOML scenes).
    """
    matrix = as_array(value, np.float64, what)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{what} must be a finite 4x4 matrix, got shape {matrix.shape}")
    if max(map(abs, (matrix[3] - (0.0, 0.0, 0.0, 1.0)).tolist())) > 1e-6:
        raise InputError(f"{what} must be affine (last row 0 0 0 1), got {matrix[3].tolist()}")
    return matrix


def require_count(count: int, what: str) -> None:
    """Raise InputError where a scene would hold too many of something."""
    if count > MAX_OBJECTS:
        raise InputError(f"{count} {what}; a scene holds at most {MAX_OBJECTS}")


# --- textures ---------------------------------------------------------------------------------------------------------

WRAPS = ("repeat", "clamp", "mirror")


@dataclass(frozen=True, eq=False)
class Texture:
    """An 8-bit image, sampled bilinearly.

    image: (H, W, 4) uint8, row 0 on top; srgb: RGB is sRGB-encoded (alpha never is); wrap: per axis (u, v);
    uv_transform: (2, 3), maps a mesh's (u, v, 1) to the texture's. (u, v) = (0, 0) is the image's top left corner, as in
    glTF; readers of formats with v upwards (OBJ, PLY) flip v when they load the mesh.
    """

    image: np.ndarray = field(repr=False)
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    uv_transform: np.ndarray = field(default_factory=lambda: np.eye(2, 3), repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        image = np.ascontiguousarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 4 or image.size == 0:
            raise InputError(at_thing("texture", self.name) + f"image must be (H, W, 4) uint8, got {image.shape} {image.dtype}")
        for wrap in self.wrap:
            as_choice(wrap, WRAPS, at_thing("texture", self.name) + "wrap")
        transform = as_array(self.uv_transform, np.float64, at_thing("texture", self.name) + "uv_transform")
        if transform.shape != (2, 3) or not (np.abs(transform) <= LARGEST).all():
            raise InputError(at_thing("texture", self.name) + f"uv_transform must be a 2x3 matrix of numbers up to {LARGEST:g}")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "uv_transform", transform)


@dataclass(frozen=True)
class Checkerboard:
    """Two colours in turn; `scale` squares to one unit of u and of v."""

    color_a: Color = (0.8, 0.8, 0.8)
    color_b: Color = (0.2, 0.2, 0.2)
    scale: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "color_a", as_vector(self.color_a, "checkerboard color_a", low=0.0))
        object.__setattr__(self, "color_b", as_vector(self.color_b, "checkerboard color_b", low=0.0))
        object.__setattr__(self, "scale", as_number(self.scale, "checkerboard scale", low=1e-6))


# --- materials --------------------------------------------------------------------------------------------------------

MATERIAL_KINDS = ("diffuse", "mirror", "conductor", "glass", "metallic_roughness")
ALPHA_MODES = ("opaque", "mask", "blend")

# Complex index of refraction at 630, 532 and 465 nm, rounded to three digits (optical tables of the pure metals).
CONDUCTORS: dict[str, tuple[Color, Color]] = {
    "gold": ((0.183, 0.422, 1.373), (3.424, 2.346, 1.771)),
    "silver": ((0.155, 0.117, 0.138), (4.828, 3.122, 2.147)),
    "copper": ((0.200, 0.924, 1.102), (3.912, 2.452, 2.142)),
    "aluminium": ((1.657, 0.880, 0.521), (9.224, 6.270, 4.837)),
}


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface answers light. Compared by identity: two objects share a material when they hold the same one.

    kind
        diffuse: Lambert with `albedo`, plus a normalised Blinn-Phong highlight of colour `specular` and `exponent`.
        mirror: reflects `albedo` of what comes in, at every angle.
        conductor: exact Fresnel reflection of `eta` + i `k` per channel (CONDUCTORS has presets); `roughness`.
        glass: dielectric of index `ior`; splits into reflection and refraction; `albedo` tints what is transmitted;
            `absorption` per unit length inside (Beer-Lambert); `thin`: an infinitely thin pane (no bending, both faces'
            reflections summed); `roughness`.
        metallic_roughness: glTF 2.0's model, from `albedo` (base colour), `metallic`, `roughness`, `ior`, `transmission`.
    textures: `albedo_texture` multiplies albedo (its alpha multiplies `alpha`); `metallic_roughness_texture`: g is
        roughness, b is metallic; `transmission_texture`: r; `emission_texture` multiplies emission; `normal_texture` is a
        tangent-space normal map scaled by `normal_scale`.
    roughness: glTF's perceptual one in [0, 1]; the GGX alpha is its square. 0 is a perfect mirror.
    emission: radiance, linear. The front side (counter-clockwise) emits, both where `two_sided`.
    emits_light: emissive surfaces of this material light others (False: they are only seen, as glTF's unlit ones are). With
        an emission_texture, or alpha, they are only seen in any case: `lights_others`.
    alpha_mode: opaque; mask (a hit with alpha < `alpha_cutoff` is no hit); blend (the ray goes on with 1 - alpha).
    """

    kind: str = "diffuse"
    name: str = ""
    albedo: Color = (0.8, 0.8, 0.8)
    specular: Color = BLACK
    exponent: float = 50.0
    eta: Color = CONDUCTORS["silver"][0]
    k: Color = CONDUCTORS["silver"][1]
    ior: float = 1.5
    absorption: Color = BLACK
    thin: bool = False
    metallic: float = 0.0
    roughness: float = 0.0
    transmission: float = 0.0
    emission: Color = BLACK
    two_sided: bool = False
    emits_light: bool = True
    alpha: float = 1.0
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5
    normal_scale: float = 1.0
    albedo_texture: Texture | Checkerboard | None = None
    metallic_roughness_texture: Texture | None = None
    transmission_texture: Texture | None = None
    emission_texture: Texture | Checkerboard | None = None
    normal_texture: Texture | None = None

    def __post_init__(self) -> None:
        at = at_thing("material", self.name)
        as_choice(self.kind, MATERIAL_KINDS, at + "kind")
        as_choice(self.alpha_mode, ALPHA_MODES, at + "alpha_mode")
        bounds: dict[str, tuple[float, float]] = {
            "albedo": (0.0, 1.0), "specular": (0.0, 1.0), "eta": (0.0, 1e3), "k": (0.0, 1e3),
            "absorption": (0.0, math.inf), "emission": (0.0, math.inf),
        }
        for name, (low, high) in bounds.items():
            object.__setattr__(self, name, as_vector(getattr(self, name), at + name, low=low, high=high))
        scalars: dict[str, tuple[float, float]] = {
            "exponent": (0.0, 1e6), "ior": (1.0, 10.0), "metallic": (0.0, 1.0), "roughness": (0.0, 1.0),
            "transmission": (0.0, 1.0), "alpha": (0.0, 1.0), "alpha_cutoff": (0.0, 1.0), "normal_scale": (-1e3, 1e3),
        }
        for name, (low, high) in scalars.items():
            object.__setattr__(self, name, as_number(getattr(self, name), at + name, low=low, high=high))
        for name in ("albedo", "emission", "metallic_roughness", "transmission", "normal"):
            slot = f"{name}_texture"
            if getattr(self, slot) is not None:
                kinds = (Texture, Checkerboard) if name in ("albedo", "emission") else (Texture,)
                as_one(getattr(self, slot), kinds, at + slot)

    @property
    def is_emissive(self) -> bool:
        """Whether it emits anything, textures aside."""
        return max(self.emission) > 0.0

    @property
    def lights_others(self) -> bool:
        """Whether its emission is sampled as a light: not where a texture or its alpha says where it emits, since lights are
        chosen by power, not by picture."""
        plain = self.emission_texture is None and self.alpha_mode == "opaque"
        return self.is_emissive and self.emits_light and plain

    @property
    def textures(self) -> tuple[Texture | Checkerboard, ...]:
        """Those that it has, in no order to rely on."""
        slots = (self.albedo_texture, self.metallic_roughness_texture, self.transmission_texture,
                 self.emission_texture, self.normal_texture)
        return tuple(texture for texture in slots if texture is not None)


# --- shapes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Object:
    """A mesh placed in the world.

    materials: one or more; face_material: (F,) int32 index into `materials` for each face, or None for all the first.
    transform: (4, 4), object to world. A negative determinant mirrors the mesh; its faces keep their outside outside.
    motion: what `wrt animate` does with it; a picture by itself shows the object without.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    transform: np.ndarray = field(default_factory=lambda: np.eye(4), repr=False)
    face_material: np.ndarray | None = field(default=None, repr=False)
    name: str = ""
    motion: Motion | None = None

    def __post_init__(self) -> None:
        at = at_thing("object", self.name)
        as_one(self.mesh, Mesh, at + "mesh")
        object.__setattr__(self, "materials", as_tuple(self.materials, Material, at + "materials"))
        if not self.materials:
            raise InputError(at + "needs a material")
        object.__setattr__(self, "transform", as_transform(self.transform, at + "transform"))
        with np.errstate(over="ignore"):
            reach = (np.abs(self.transform[:3, :3]).sum(axis=1) * self.mesh.reach + np.abs(self.transform[:3, 3])).max()
        if not reach <= MAX_REACH:
            raise InputError(at + f"reaches {reach:.3g} units from the origin; at most {MAX_REACH:g} can be rendered")
        if self.face_material is not None:
            index = as_array(self.face_material, np.int32, at + "face_material")
            if index.shape != (len(self.mesh.faces),):
                raise InputError(at + f"face_material must be ({len(self.mesh.faces)},), got {index.shape}")
            if index.size and (index.min() < 0 or index.max() >= len(self.materials)):
                raise InputError(at + f"face_material must index {len(self.materials)} materials")
            object.__setattr__(self, "face_material", index)
        if self.motion is not None:
            as_one(self.motion, Motion, at + "motion").check(self.mesh)


@dataclass(frozen=True, eq=False)
class Sphere:
    """An exact sphere. u runs around +y from -x (0 to 1), v from the top (0) to the bottom (1)."""

    center: Color
    radius: float
    material: Material
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("sphere", self.name)
        as_one(self.material, Material, at + "material")
        object.__setattr__(self, "center", as_vector(self.center, at + "center", low=-MAX_REACH, high=MAX_REACH))
        object.__setattr__(self, "radius", as_number(self.radius, at + "radius", low=SMALLEST, high=MAX_REACH))


# --- lights -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PointLight:
    """intensity: radiant intensity (per steradian); irradiance falls with the square of the distance."""

    position: Color
    intensity: Color
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", as_vector(self.position, at_thing("light", self.name) + "position"))
        object.__setattr__(self, "intensity", as_vector(self.intensity, at_thing("light", self.name) + "intensity", low=0.0))


@dataclass(frozen=True)
class DirectionalLight:
    """direction: the way the light travels (any length but 0); irradiance: on a surface that faces it."""

    direction: Color
    irradiance: Color
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("light", self.name)
        object.__setattr__(self, "direction", _unit(as_vector(self.direction, at + "direction"), at + "direction"))
        object.__setattr__(self, "irradiance", as_vector(self.irradiance, at + "irradiance", low=0.0))


@dataclass(frozen=True)
class SpotLight:
    """A point light in a cone: full within `inner` of its axis, none beyond `outer` (half angles in radians), and between
    them the square of a linear ramp in the cosine, as KHR_lights_punctual recommends."""

    position: Color
    direction: Color
    intensity: Color
    inner: float = 0.0
    outer: float = math.pi / 4
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("light", self.name)
        object.__setattr__(self, "position", as_vector(self.position, at + "position"))
        object.__setattr__(self, "direction", _unit(as_vector(self.direction, at + "direction"), at + "direction"))
        object.__setattr__(self, "intensity", as_vector(self.intensity, at + "intensity", low=0.0))
        object.__setattr__(self, "outer", as_number(self.outer, at + "outer", low=1e-4, high=math.pi / 2))
        object.__setattr__(self, "inner", as_number(self.inner, at + "inner", low=0.0, high=self.outer))


Light = PointLight | DirectionalLight | SpotLight


def _unit(vector: Color, what: str) -> Color:
    length = math.hypot(*vector)
    if length == 0.0:
        raise InputError(f"{what} must not be zero")
    return (vector[0] / length, vector[1] / length, vector[2] / length)


# --- background -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConstantBackground:
    """The same radiance from every direction."""

    color: Color = BLACK

    def __post_init__(self) -> None:
        object.__setattr__(self, "color", as_vector(self.color, "background color", low=0.0))


@dataclass(frozen=True)
class GradientBackground:
    """From `bottom` (straight down, -y) to `top` (+y), linear in the direction's y."""

    bottom: Color = WHITE
    top: Color = (0.5, 0.7, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bottom", as_vector(self.bottom, "background bottom", low=0.0))
        object.__setattr__(self, "top", as_vector(self.top, "background top", low=0.0))


@dataclass(frozen=True, eq=False)
class EnvironmentBackground:
    """An equirectangular picture of the surroundings.

    image: (H, W, 3) float32 linear radiance, row 0 is straight up (+y); the column at the middle is seen along -z, and
    columns run to the right of that view (towards +x). rotation: radians about +y, counter-clockwise seen from above.
    """

    image: np.ndarray = field(repr=False)
    scale: float = 1.0
    rotation: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("environment", self.name)
        image = as_array(self.image, np.float32, at + "image")
        if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise InputError(at + f"image must be (H, W, 3), got {image.shape}")
        if not np.isfinite(image).all() or (image < 0.0).any():
            raise InputError(at + "image must be finite and not negative")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "scale", as_number(self.scale, at + "scale", low=0.0))
        object.__setattr__(self, "rotation", as_number(self.rotation, at + "rotation"))


Background = ConstantBackground | GradientBackground | EnvironmentBackground


# --- camera -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole, or a thin lens where `aperture_radius` > 0.

    camera_to_world: (4, 4), rotation and translation; it looks along its own -z, +y is up. fov_y: full vertical angle of
    view (radians). focus_distance: along the axis, from the lens to the plane that is sharp. blades: 0 for a round
    aperture, else the number of its straight sides (3 or more), turned by `blade_rotation` radians.
    `lens` gives fov_y, aperture_radius and focus_distance for a focal length, an f-number and a sensor height.
    """

    camera_to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    fov_y: float = math.radians(45.0)
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    blades: int = 0
    blade_rotation: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("camera", self.name)
        matrix = as_transform(self.camera_to_world, at + "camera_to_world").copy()
        # Only the pose counts: scale and shear would bend the picture, and glTF says that a camera ignores them.
        z = matrix[:3, 2]
        x = np.cross(matrix[:3, 1], z)
        if not np.linalg.norm(x) > 0.0:
            raise InputError(at + "camera_to_world is singular")
        z = z / np.linalg.norm(z)
        x = x / np.linalg.norm(x)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, np.cross(z, x), z
        object.__setattr__(self, "camera_to_world", matrix)
        object.__setattr__(self, "fov_y", as_number(self.fov_y, at + "fov_y", low=1e-5, high=math.pi - 1e-3))
        object.__setattr__(self, "aperture_radius", as_number(self.aperture_radius, at + "aperture_radius", low=0.0))
        object.__setattr__(self, "focus_distance", as_number(self.focus_distance, at + "focus_distance", low=SMALLEST))
        object.__setattr__(self, "blade_rotation", as_number(self.blade_rotation, at + "blade_rotation"))
        as_integer(self.blades, at + "blades", 0, 64)
        if self.blades in (1, 2):
            raise InputError(at + f"blades must be 0 (round) or 3 to 64, got {self.blades}")

    @staticmethod
    def look_at(position: Any, target: Any, up: Any = (0.0, 1.0, 0.0), **rest: Any) -> Camera:
        """A camera at `position` that looks at `target`; `rest` are the other fields."""
        origin, aim, upward = (np.array(as_vector(v, n)) for v, n in ((position, "position"), (target, "target"), (up, "up")))
        z = origin - aim
        if not np.linalg.norm(z) > 0.0:
            raise InputError("camera: position and target are the same point")
        z /= np.linalg.norm(z)
        x = np.cross(upward, z)
        if np.linalg.norm(x) < 1e-9 * max(float(np.linalg.norm(upward)), 1e-300):
            raise InputError("camera: up is parallel to the direction of view")
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = x, np.cross(z, x), z, origin
        return Camera(camera_to_world=matrix, **rest)

    @staticmethod
    def lens(focal_length: float, focus_distance: float, sensor_height: float, *, f_number: float | None = None,
             aperture_radius: float | None = None) -> dict[str, float]:
        """fov_y, aperture_radius and focus_distance of a real thin lens, all lengths in scene units.

        The sensor stands where the lens makes `focus_distance` sharp, s' = f s / (s - f), so that focusing near narrows
        the view a little, as in a real camera. f_number N gives the radius f / (2 N).
        """
        f = as_number(focal_length, "focal_length", low=SMALLEST)
        s = as_number(focus_distance, "focus_distance", low=SMALLEST)
        h = as_number(sensor_height, "sensor_height", low=SMALLEST)
        if s <= f:
            raise InputError(f"focus_distance ({s:g}) must be longer than focal_length ({f:g})")
        if (f_number is None) == (aperture_radius is None):
            raise InputError("give either f_number or aperture_radius")
        radius = aperture_radius if f_number is None else f / (2.0 * as_number(f_number, "f_number", low=1e-3))
        image_distance = f * s / (s - f)
        return {"fov_y": 2.0 * math.atan(0.5 * h / image_distance), "focus_distance": s,
                "aperture_radius": as_number(radius, "aperture_radius", low=0.0)}


# --- scene ------------------------------------------------------------------------------------------------------------

FILTERS = ("box", "gaussian", "blackman-harris")
SAMPLERS = ("sobol", "independent")
TONEMAPS = ("none", "reinhard", "aces", "agx")
MAX_DEPTH = 64  # bounces
FRESNELS = ("exact", "schlick")
GLASS_SHADOWS = ("opaque", "tinted")


@dataclass(frozen=True)
class Settings:
    """How a scene wants to be rendered; every field can be overridden at the call of `render`.

    max_depth: bounces after the first hit (0: only direct light). min_throughput: a ray that would carry less than this
    share (largest channel) is cut. fresnel: "exact", or "schlick" (cheaper, approximate). glass_shadows: solid glass
    "opaque" to shadow rays (right but for caustics, which a Whitted tracer does not see), or "tinted": shadow rays go
    straight through it, as they do in scenes from glTF files that have solid glass. sampler: "sobol" (Owen-scrambled, evenly
    spread), or "independent" random numbers, whose noise falls more slowly. exposure in stops.
    """

    size: tuple[int, int] = (640, 360)
    spp: int = 64
    max_depth: int = 8
    min_throughput: float = 1e-3
    filter: str = "blackman-harris"
    fresnel: str = "exact"
    glass_shadows: str = "opaque"
    sampler: str = "sobol"
    exposure: float = 0.0
    tonemap: str = "none"

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", as_size(self.size))
        object.__setattr__(self, "spp", as_integer(self.spp, "spp", 1, 1 << 24))
        object.__setattr__(self, "max_depth", as_integer(self.max_depth, "max_depth", 0, MAX_DEPTH))
        as_number(self.min_throughput, "min_throughput", low=0.0, high=1.0)
        as_number(self.exposure, "exposure", low=-100.0, high=100.0)
        as_choice(self.filter, FILTERS, "filter")
        as_choice(self.fresnel, FRESNELS, "fresnel")
        as_choice(self.glass_shadows, GLASS_SHADOWS, "glass_shadows")
        as_choice(self.sampler, SAMPLERS, "sampler")
        as_choice(self.tonemap, TONEMAPS, "tonemap")


SETTINGS = tuple(each.name for each in fields(Settings))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is rendered: shapes, lights, background, cameras (the first is the default) and settings.

    ambient: radiance that every diffuse surface receives from all around, unshadowed (Whitted's ambient term).
    """

    objects: tuple[Object, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    lights: tuple[Light, ...] = ()
    cameras: tuple[Camera, ...] = ()
    background: Background = ConstantBackground()
    ambient: Color = BLACK
    settings: Settings = Settings()
    name: str = ""

    def __post_init__(self) -> None:
        kinds: dict[str, Any] = {"objects": Object, "spheres": Sphere, "cameras": Camera,
                                 "lights": (PointLight, DirectionalLight, SpotLight)}
        for name, kind in kinds.items():
            object.__setattr__(self, name, as_tuple(getattr(self, name), kind, name))
        for name in ("objects", "spheres", "lights"):
            require_count(len(getattr(self, name)), name)
        as_one(self.background, (ConstantBackground, GradientBackground, EnvironmentBackground), "background")
        as_one(self.settings, Settings, "settings")
        object.__setattr__(self, "ambient", as_vector(self.ambient, "ambient", low=0.0))

    def __repr__(self) -> str:
        counts = {"triangle": sum(len(thing.mesh.faces) for thing in self.objects), "object": len(self.objects),
                  "sphere": len(self.spheres), "material": len(self.materials), "light": len(self.lights),
                  "camera": len(self.cameras)}
        parts = [f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items() if count]
        with contextlib.suppress(InputError):  # without shapes there are no bounds
            low, high = ("({})".format(", ".join(f"{value:.4g}" for value in corner)) for corner in self.bounds())
            parts.append(f"from {low} to {high}")
        return f"Scene({', '.join([repr(self.name)] * bool(self.name) + parts)})"

    def _repr_html_(self) -> str:
        things = [(thing.name, "mesh", len(thing.mesh.faces), ", ".join(m.name or m.kind for m in thing.materials))
                  for thing in self.objects]
        things += [(sphere.name, "sphere", 1, sphere.material.name or sphere.material.kind) for sphere in self.spheres]
        lights = [(light.name, type(light).__name__) for light in self.lights]
        lights += [(m.name, "emissive material") for m in self.materials if m.lights_others]
        lights.append(("", type(self.background).__name__))
        cameras = [(each.name, f"{math.degrees(each.fov_y):.4g} degrees high", each.aperture_radius) for each in self.cameras]
        settings = {each.name: getattr(self.settings, each.name) for each in fields(Settings)}
        settings["size"] = f"{self.settings.size[0]}x{self.settings.size[1]}"
        return html_table(repr(self), ("shape", "kind", "primitives", "materials"), things) + html_table(
            "", ("light", "kind"), lights) + html_table("", ("camera", "angle of view", "aperture radius"), cameras) + html_facts(
            "Settings", settings)

    @property
    def materials(self) -> tuple[Material, ...]:
        """Every material in use, each once, in the order of first use: `material_id` counts in this order."""
        used: dict[int, Material] = {}
        for thing in self.objects:
            for material in thing.materials:
                used.setdefault(id(material), material)
        for sphere in self.spheres:
            used.setdefault(id(sphere.material), sphere.material)
        return tuple(used.values())

    def camera(self, name: str | int | None = None) -> Camera:
        """The camera of that name or number (None: the first). Raises InputError that lists the names there are."""
        if not self.cameras:
            raise InputError("the scene has no camera")
        if name is None:
            return self.cameras[0]
        for camera in self.cameras:
            if camera.name == name:
                return camera
        for index, camera in enumerate(self.cameras):
            if str(index) == str(name):
                return camera
        known = ", ".join(f"{camera.name!r} (number {i})" for i, camera in enumerate(self.cameras))
        raise InputError(f"no camera {name!r}; the scene's cameras are {known}")

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner (3,) float64 of all shapes in world space; raises InputError where there are none. The box of
        more than MANY_VERTICES (`outlines`) can be larger than need be."""
        corners: list[np.ndarray] = []
        for points, transform in self.outlines():
            points = points @ transform[:3, :3].T + transform[:3, 3]
            corners += [points.min(axis=0), points.max(axis=0)]
        for sphere in self.spheres:
            center = np.array(sphere.center)
            corners += [center - sphere.radius, center + sphere.radius]
        if not corners:
            raise InputError("the scene has no shapes")
        return np.min(corners, axis=0), np.max(corners, axis=0)

    def outlines(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Of each object with faces, points (N, 3) float64 that hold it and its transform: the vertices of its mesh. Where all
        objects together have more than MANY_VERTICES, a mesh that several show is held by the corners of its box: else many
        small nodes of a file that show one large mesh would take hours."""
        shown = [thing for thing in self.objects if len(thing.mesh.faces)]
        times = Counter(id(thing.mesh) for thing in shown)
        many = sum(len(thing.mesh.vertices) for thing in shown) > MANY_VERTICES
        boxes: dict[int, np.ndarray] = {}
        for thing in shown:
            vertices, key = thing.mesh.vertices, id(thing.mesh)
            if many and times[key] > 1:
                if key not in boxes:
                    boxes[key] = np.array(list(product(*zip(vertices.min(axis=0), vertices.max(axis=0), strict=True))), np.float64)
                yield boxes[key], thing.transform
            else:
                yield vertices.astype(np.float64), thing.transform

    def with_settings(self, **changes: Any) -> Scene:
        """A copy with some settings changed (None leaves one as it is). Raises InputError for a setting that is none."""
        for name in changes:
            if name not in SETTINGS:
                raise InputError(unknown(name, "setting", SETTINGS))
        return replace(self, settings=replace(self.settings, **{k: v for k, v in changes.items() if v is not None}))
