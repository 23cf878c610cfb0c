"""Upload of a scene to a device: geometry, tables of materials, textures and lights, and cameras, whose rays are there for queries."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.queries.hit_points import instance_records
from wrt.accel.queries.rays import to_origin
from wrt.accel.scenes.flatten import flatten
from wrt.core.checks import as_one, as_size, listed
from wrt.core.device import launch, made_once, records, start, upload
from wrt.core.errors import InputError, warn
from wrt.core.types import Device, WarpStruct
from wrt.kernels import structs
from wrt.kernels.shade import backgrounds, lights, materials, textures
from wrt.kernels.shade.cameras import make_camera_rays_kernel
from wrt.kernels.warp_private import fields_of
from wrt.picture.tonemap import decode_srgb
from wrt.scene.backgrounds import Background
from wrt.scene.cameras import CameraKind
from wrt.scene.materials import ALPHA_MODES, Checkerboard, Material, Texture, kinds_that_use
from wrt.scene.model import Scene, moved_camera
from wrt.scene.values import LUMINANCE, type_of

# If a scene has more emissive objects, they are sampled as one light, by power, since a shadow ray to each would cost too much.
MAX_MESH_LIGHTS = 16
WRAPS = {"repeat": textures.WRAP_REPEAT, "clamp": textures.WRAP_CLAMP, "mirror": textures.WRAP_MIRROR}


class TextureTable:
    """Table of the textures, and the texels of all images one after another. Several textures can share one stored image."""

    def __init__(self) -> None:
        self.rows: list[Texture | Checkerboard] = []
        self.texels: list[np.ndarray] = []
        self.first: dict[int, int] = {}
        self.size = 0

    def index(self, texture: Texture | Checkerboard | None) -> int:
        """Return the index of a texture in the table, after adding it if it is new; -1 for None."""
        if texture is None:
            return -1
        for i, row in enumerate(self.rows):
            if row is texture:
                return i
        if isinstance(texture, Texture) and id(texture.image) not in self.first:
            self.first[id(texture.image)] = self.size
            self.texels.append(texture.image.reshape(-1, 4).view(np.uint32).ravel())
            self.size += self.texels[-1].size
            if self.size > 2**31 - 1:
                raise InputError(f"more than 2^31 texels in all (at {texture.name!r})", place="textures")
        self.rows.append(texture)
        return len(self.rows) - 1

    def records(self) -> np.ndarray:
        out = records(structs.Texture, max(len(self.rows), 1))
        for i, texture in enumerate(self.rows):
            row = out[i]
            if isinstance(texture, Checkerboard):
                row["row_u"], row["row_v"] = (texture.scale, 0.0, 0.0), (0.0, texture.scale, 0.0)
                row["color_a"], row["color_b"] = texture.color_a, texture.color_b
                continue
            row["first"] = self.first[id(texture.image)]
            row["height"], row["width"] = texture.image.shape[:2]
            row["srgb"] = texture.srgb
            row["wrap_u"], row["wrap_v"] = WRAPS[texture.wrap[0]], WRAPS[texture.wrap[1]]
            row["row_u"], row["row_v"] = texture.uv_transform
        return out


@cache
def srgb_table() -> np.ndarray:
    """Return linear values, (512,) float32: entry i decodes the sRGB code i (IEC 61966-2-1), entry 256 + i is i / 255."""
    code = np.arange(256) / 255.0
    return np.concatenate([decode_srgb(code), code]).astype(np.float32)


def index_of(kind: str, table: Collection[str], group: str) -> int:
    """Return the index of `kind` in a table of device functions. Raises InputError if the table lacks it. group: noun for the error."""
    if kind not in table:
        raise InputError(f"{group} {kind!r} has no device function in the tables of wrt.kernels.shade")
    return list(table).index(kind)


def material_records(scene_materials: tuple[Material, ...], table: TextureTable) -> np.ndarray:
    """Return the array of Material structs. Fields that the kind does not use are 0; textures -1; `transmission` 1 for clear kinds."""
    out = records(structs.Material, max(len(scene_materials), 1))
    some_use = kinds_that_use()
    for row, material in zip(out, scene_materials, strict=False):
        for name in out.dtype.names or ():
            unused = name in some_use and not material.uses(name)
            if name.endswith("_texture"):
                row[name] = -1 if unused else table.index(getattr(material, name))
            elif name == "kind":
                row[name] = index_of(material.kind, materials.MATERIALS, "material kind")
            elif name == "alpha_mode":
                row[name] = ALPHA_MODES.index(material.alpha_mode)
            elif unused:
                row[name] = 1.0 if name == "transmission" and material.is_clear else 0.0
            else:
                row[name] = getattr(material, name)
    return out


def light_records(scene: Scene, world: FlatScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return arrays of device structs Light and Emitter (emissive triangle), and the cdf of each mesh light's emitters (float32).

    Each object with emissive faces is one light. More than MAX_MESH_LIGHTS such objects form one light together."""
    rows: list[dict[str, Any]] = []
    for light in scene.lights:
        rows.append({"kind": index_of(light.kind, lights.LIGHTS, "light kind"), **light.record()})
    for sphere in scene.spheres:
        if sphere.material.lights_others:
            rows.append({"kind": index_of("sphere", lights.LIGHTS, "light kind"), "position": sphere.center, "radius": sphere.radius,
                         "color": sphere.material.emission, "two_sided": sphere.material.two_sided})
    parts = [records(structs.Emitter, 1)[:0]]
    cdfs = [np.zeros(0, np.float32)]
    first = 0
    for _, part, cdf in mesh_lights(scene, world):
        rows.append({"kind": index_of("mesh", lights.LIGHTS, "light kind"), "first": first, "count": len(part)})
        parts.append(part)
        cdfs.append(cdf)
        first += len(part)
    out = records(structs.Light, max(len(rows), 1))
    for i, values in enumerate(rows):
        for name, value in values.items():
            out[i][name] = value
    return out[: len(rows)], np.concatenate(parts), np.concatenate(cdfs)


def mesh_lights(scene: Scene, world: FlatScene) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield, for each light made of emissive faces, the prim_ids of these faces, the array of struct Emitter, and its cdf."""
    groups = _emissive_groups(scene, world)
    if len(groups) > MAX_MESH_LIGHTS:
        groups = [np.concatenate(groups)]
    for prim_id in groups:
        part, cdf = _emitters(scene, world, prim_id)
        if len(part):
            yield prim_id, part, cdf


def _emissive_groups(scene: Scene, world: FlatScene) -> list[np.ndarray]:
    """Return, for each object with emissive faces, the prim_ids of these faces."""
    lit = np.array([m.lights_others for m in scene.materials], bool)
    groups = []
    first = 0
    for thing in scene.objects:
        n = len(thing.mesh.faces)
        if any(m.lights_others for m in thing.materials):
            prim_id = np.arange(first, first + n)
            prim_id = prim_id[lit[world.materials(prim_id)]]
            if len(prim_id):
                groups.append(prim_id)
        first += n
    return groups


def _emitters(scene: Scene, world: FlatScene, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the emitters of the light with the faces `prim_id`, and their cdf by power; both are empty if the total power is 0."""
    corner = world.corners(prim_id)
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    power = np.array([LUMINANCE @ np.array(m.emission) for m in scene.materials])[world.materials(prim_id)] * area
    total = power.sum()
    if not total > 0.0:
        return records(structs.Emitter, 1)[:0], np.zeros(0, np.float32)
    # The density is computed from the rounded cdf, because the kernels sample the emitters with it.
    cdf = (np.cumsum(power) / total).astype(np.float32)
    cdf[np.nonzero(power)[0][-1] :] = 1.0
    share = np.diff(cdf.astype(np.float64), prepend=0.0)
    out = records(structs.Emitter, len(prim_id))
    face, out["instance"] = world.places(prim_id)
    out["v0"], out["v1"], out["v2"] = corners = np.moveaxis(world.vertices[world.faces[face]], 1, 0)
    out["normal"] = unit_normals(*corners)
    out["material"] = world.materials(prim_id)
    # An emitter below 2^-128 square units has the density inf and lights nothing.
    with np.errstate(over="ignore"):
        out["pdf_area"] = np.divide(share, area, out=np.zeros_like(area), where=area > 0.0)
    return out, cdf


def unit_normals(v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> np.ndarray:
    """Return unit normals of triangles, with the bits of wrt.kernels.shade.surface.triangle_normal. All arrays: (N, 3) float32."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        a, b = (edge / np.abs(edge).max(axis=1, keepdims=True) for edge in (v1 - v0, v2 - v0))
        n = a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
        x, y, z = n.T
        length = np.sqrt(x * x + y * y + z * z)[:, None]
        return np.where(length > 0.0, n / length, np.float32(0.0))


def background_struct(background: Background, device: Device) -> WarpStruct:
    b: WarpStruct = structs.Background()
    index_of(background.kind, backgrounds.BACKGROUNDS, "background kind")
    for name, value in background.record().items():
        kind = fields_of(b)[name]
        if isinstance(value, np.ndarray):
            setattr(b, name, upload(value, kind.dtype, device))
        else:
            setattr(b, name, wp.vec3(*value) if kind is wp.vec3 else value)
    return b


@dataclass(frozen=True, eq=False)
class DeviceScene:
    """A scene on a device: structs `surfaces` and `lighting` for the kernels, and `world`, the flattened scene on the host."""

    world: FlatScene
    surfaces: WarpStruct
    lighting: WarpStruct


def warn_left_out(scene: Scene) -> None:
    """Issue a SceneWarning for each part of the scene that a picture leaves out. Raises InputError if the scene cannot be rendered."""
    for sphere in scene.spheres:
        if sphere.material.alpha_mode == "mask" and sphere.material.albedo_texture is not None:
            raise InputError(f"a cut-out texture needs a mesh; material {sphere.material.name!r}", place=f"sphere {sphere.name!r}")
    without_uvs = [thing.name or str(i) for i, thing in enumerate(scene.objects)
            if thing.mesh.uvs is None and any(m.textures for m in thing.materials)]
    if without_uvs:
        warn(f"no texture coordinates, so that a texture shows its first texel everywhere: objects {listed(without_uvs)}")
    unlit = [m.name or str(i) for i, m in enumerate(scene.materials) if m.is_emissive and m.emits_light and not m.lights_others]
    if unlit:
        warn("emission that is seen but lights nothing, because it varies with a texture or alpha: materials"
             f" {listed(unlit)} (emits_light = false turns this warning off)")


def upload_scene(scene: Scene, device: Device, meshes: frozenset[int] = frozenset()) -> DeviceScene:
    """Upload a scene. meshes: id()s of the instanced meshes (wrt.accel.scenes.instancing). Raises and warns as `warn_left_out` does."""
    warn_left_out(scene)
    world = flatten(scene, meshes)
    table = TextureTable()
    rows = material_records(scene.materials, table)
    s = structs.Surfaces()
    s.n_triangles = world.geometry.n_triangles
    s.vertices = upload(world.vertices, wp.vec3, device)
    s.faces = upload(world.faces, wp.vec3i, device)
    s.normals = upload(np.zeros((1, 3)) if world.normals is None else world.normals, wp.vec3, device)
    s.uvs = upload(world.uvs, wp.vec2, device)
    s.spheres = upload(world.geometry.spheres, wp.vec4, device)
    if world.placed is not None:
        s.instances = upload(instance_records(world.placed), structs.Instance, device)
    s.prim_material = upload(world.prim_material, wp.int32, device)
    s.materials = upload(rows, structs.Material, device)
    s.textures = upload(table.records(), structs.Texture, device)
    s.texels = upload(np.concatenate([np.zeros(1, np.uint32), *table.texels])[1:] if table.texels else np.zeros(1), wp.uint32, device)
    s.srgb_to_linear = upload(srgb_table(), wp.float32, device)

    lighting = structs.Lighting()
    rows, emitters, cdf = light_records(scene, world)
    lighting.count = len(rows)
    lighting.lights = upload(rows, structs.Light, device)
    lighting.emitters = upload(emitters, structs.Emitter, device)
    lighting.emitter_cdf = upload(cdf, wp.float32, device)
    lighting.background = background_struct(scene.background, device)
    lighting.ambient = wp.vec3(*scene.ambient)
    lighting.ambient_radius = scene.ambient_occlusion
    return DeviceScene(world, s, lighting)


def camera_struct(camera: CameraKind, size: tuple[int, int]) -> WarpStruct:
    """Return the device's struct Camera. size: width and height of the picture, whose ratio is the camera's aspect ratio."""
    c = import_module(camera.device).Camera()
    pose = camera.camera_to_world
    c.origin = wp.vec3(*pose[:3, 3])
    c.right, c.up, c.forward = wp.vec3(*pose[:3, 0]), wp.vec3(*pose[:3, 1]), wp.vec3(*(-pose[:3, 2]))
    for name, value in camera.record(size).items():
        setattr(c, name, value)
    return c


# --- camera rays, for queries -----------------------------------------------------------------------------------------


camera_rays_kernel = made_once(make_camera_rays_kernel)


def camera_rays(camera: CameraKind, size: tuple[int, int] | str) -> tuple[np.ndarray, np.ndarray]:
    """Make one ray for each pixel, through the centres of the lens and of the pixel. The AOVs of a Film come from the same rays.

    Parameters
    ----------
    camera
        A camera of any kind.
    size
        Width and height of the picture, or text such as "640x360".

    Returns
    -------
    origins, directions
        (width * height, 3) float32 each, in world space, row by row from the top left. Origins farther than 1,024 from 0 are float64, if
        float32 would round them. Directions have unit length, so that a hit's t is the AOV "depth". Beyond the image circle of a
        fisheye, directions are 0.
    """
    width, height = as_size(size)
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5)) / np.float32(width)
    y = (np.arange(height, dtype=np.float32) + np.float32(0.5)) / np.float32(height)
    film = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
    return film_rays(camera, (width, height), film.reshape(-1, 2))


def film_rays(camera: CameraKind, size: tuple[int, int], film: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make rays through the points `film` (N, 2) of a picture; its top left corner is (0, 0), its bottom right corner (1, 1)."""
    device = start("cpu")
    kernel = camera_rays_kernel(import_module(as_one(camera, CameraKind, "camera").device))
    place = camera.camera_to_world[:3, 3]
    far = place if type_of(place) is np.float64 else None
    camera = moved_camera(camera, far)
    origins, directions = (wp.empty(len(film), dtype=wp.vec3, device=device) for _ in range(2))
    launch(kernel, len(film), camera_struct(camera, size), upload(film, wp.vec2, device), origins, directions)
    return to_origin(origins.numpy(), far), directions.numpy()
