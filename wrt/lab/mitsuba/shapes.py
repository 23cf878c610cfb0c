"""Translate objects, spheres, materials and textures to Mitsuba; refuse those without an exact counterpart.

Objects become a mesh in world space for each of their materials, spheres stay exact."""

from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple, NoReturn, TypeAlias

import numpy as np

from wrt.core.errors import InputError
from wrt.picture.tonemap import decode_srgb
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.model import Object, Sphere
from wrt.scene.values import Color

Plugin: TypeAlias = dict[str, Any]  # for mitsuba.load_dict
MitsubaObject: TypeAlias = Any  # its class exists only after a variant of Mitsuba is set
BSDFS: dict[str, Plugin] = {"diffuse": {"type": "diffuse"}, "mirror": {"type": "conductor", "material": "none"},
                                    "conductor": {"type": "conductor"}, "glass": {"ext_ior": 1.0}}
# Kind of material -> the property of Mitsuba's BSDF that is the albedo.
COLORED = {"diffuse": "reflectance", "mirror": "specular_reflectance", "glass": "specular_transmittance"}


def refuse(what: str, where: str = "") -> NoReturn:
    """Raise InputError for a feature that Mitsuba cannot render exactly: pictures of different light cannot be compared."""
    raise InputError(f"not translatable exactly: {what}", place=f"Mitsuba: {where}" if where else "Mitsuba")


def bsdf(mi: ModuleType, material: Material) -> Plugin:
    """Return the material as a dictionary for `mitsuba.load_dict`."""
    where = f"material {material.name!r}"
    if material.kind not in BSDFS:
        refuse(f"{material.kind} (Mitsuba's principled BSDF is different)", where)
    if material.normal_texture is not None:
        refuse("normal texture (Mitsuba uses different tangents)", where)
    if max(material.specular) > 0.0:
        refuse("Blinn-Phong highlight", where)
    result = _bsdf(mi, material)
    if material.kind != "glass":  # all other materials reflect light on the back as on the front
        result = {"type": "twosided", "bsdf": result}
    elif not material.thin and material.alpha_mode == "blend":
        refuse("blended solid glass", where)
    opacity = _opacity(mi, material)
    return result if opacity is None else {"type": "mask", "opacity": opacity, "bsdf": result}


def emission(mi: ModuleType, material: Material) -> Plugin:
    """Return the material's emission as an area emitter. If it does not light other surfaces, the emitter has the sampling weight 0."""
    if material.alpha_mode != "opaque":
        refuse("emission of a partly transparent surface", f"material {material.name!r}")
    radiance = _color(mi, material.emission, material.emission_texture)
    return {"type": "area", "radiance": radiance, "sampling_weight": 1.0 if material.lights_others else 0.0}


def _bsdf(mi: ModuleType, material: Material) -> Plugin:
    """Return the material's BSDF for the front side, without opacity."""
    result = dict(BSDFS[material.kind])
    if material.kind == "conductor":
        result |= {"eta": rgb(material.eta), "k": rgb(material.k)}
    else:
        result[COLORED[material.kind]] = _color(mi, material.albedo, material.albedo_texture)
    if material.kind == "glass":
        result |= {"type": "thindielectric" if material.thin else "dielectric", "int_ior": material.ior}
        if material.thin and material.is_rough:
            refuse("a thin pane with roughness", f"material {material.name!r}")
    if material.is_rough:
        result |= {"type": f"rough{result['type']}", "distribution": "ggx", "alpha": material.roughness**2}
    return result


def rgb(color: Color) -> Plugin:
    return {"type": "rgb", "value": list(color)}


def _color(mi: ModuleType, factor: Color, texture: Texture | Checkerboard | None) -> Plugin:
    """Return factor times the texture, as linear RGB."""
    if texture is None:
        return rgb(factor)
    if isinstance(texture, Checkerboard):
        return _checkerboard(mi, factor, texture)
    return _bitmap(mi, texture, linear_rgb(texture) * np.asarray(factor, np.float32))


def _checkerboard(mi: ModuleType, factor: Color, texture: Checkerboard) -> Plugin:
    # Mitsuba's checkerboard has two squares in a unit of u or v, and color0 in the square at the origin.
    first, second = (rgb(np.multiply(color, factor).tolist()) for color in (texture.color_a, texture.color_b))
    to_uv = mi.ScalarTransform3f().scale([0.5 * texture.scale, 0.5 * texture.scale])
    return {"type": "checkerboard", "color0": first, "color1": second, "to_uv": to_uv}


def linear_rgb(texture: Texture) -> np.ndarray:
    """Return (H, W, 3) float32 linear RGB of the texels (IEC 61966-2-1 if the texture is sRGB-encoded)."""
    steps = np.arange(256, dtype=np.float64) / 255.0
    return (decode_srgb(steps) if texture.srgb else steps).astype(np.float32)[texture.image[..., :3]]


def _bitmap(mi: ModuleType, texture: Texture, values: np.ndarray) -> Plugin:
    """Return a bitmap of texels (H, W, C) float32 with the texture's filter and transform; row 0 is at v = 0 in wrt and Mitsuba."""
    if texture.wrap[0] != texture.wrap[1]:
        refuse("wrap that differs between the axes", f"texture {texture.name!r}")
    to_uv = np.vstack([texture.uv_transform, (0.0, 0.0, 1.0)])
    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(values, np.float32)), "raw": True,
            "filter_type": "bilinear", "wrap_mode": texture.wrap[0], "to_uv": mi.ScalarTransform3f(to_uv)}


def _opacity(mi: ModuleType, material: Material) -> MitsubaObject:
    """Return the opacity as a number or a bitmap, or None for an opaque material."""
    if material.alpha_mode == "opaque":
        return None
    texture = material.albedo_texture if isinstance(material.albedo_texture, Texture) else None
    if texture is None:
        return material.alpha if material.alpha_mode == "blend" else float(material.alpha >= material.alpha_cutoff)
    if material.alpha_mode != "blend":
        refuse("alpha mask with a texture (Mitsuba would cut at whole texels)", f"material {material.name!r}")
    return _bitmap(mi, texture, texture.image[..., 3:4].astype(np.float32) / 255.0 * np.float32(material.alpha))


class Part(NamedTuple):
    """The part of a scene in one Mitsuba shape. object_id: objects first, then spheres; face_index: (F,) faces, None for a sphere."""

    object_id: int
    face_index: np.ndarray | None
    material: Material


class Triangles(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None

    def of(self, vertices: np.ndarray, faces: np.ndarray) -> "Triangles":
        """Return triangles over some of the vertices. vertices: indices of the vertices to keep; faces: indices into `vertices`."""
        normals, uvs = (None if array is None else array[vertices] for array in (self.normals, self.uvs))
        return Triangles(self.vertices[vertices], faces.reshape(-1, 3), normals, uvs)


def object_parts(mi: ModuleType, thing: Object, object_id: int) -> Iterator[tuple[str, MitsubaObject, Part]]:
    """Yield (shape id, `mitsuba.Mesh`, Part) for each material that the object's faces use."""
    world = _to_world(thing)
    of_face = np.zeros(len(world.faces), np.int32) if thing.face_material is None else thing.face_material
    for index in np.unique(of_face).tolist():
        material = thing.materials[index]
        chosen = np.flatnonzero(of_face == index)
        used, faces = np.unique(world.faces[chosen], return_inverse=True)
        triangles = world if len(chosen) == len(world.faces) else world.of(used, faces)
        if material.textures and triangles.uvs is None:
            triangles = triangles._replace(uvs=np.zeros((len(triangles.vertices), 2), np.float32))
        name = f"object{object_id}_{index}"
        part = Part(object_id, chosen, material)
        yield name, make_mesh(mi, name, triangles, _properties(mi, material)), part


def sphere_shape(mi: ModuleType, sphere: Sphere) -> Plugin:
    """Return a sphere, rotated for its texture coordinates: Mitsuba's u runs around z, wrt's around y. +z becomes +y, +x becomes -x."""
    pose = np.eye(4)
    pose[:3, :3] = sphere.radius * np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    pose[:3, 3] = sphere.center
    return {"type": "sphere", "to_world": mi.ScalarTransform4f(pose), **_properties(mi, sphere.material)}


def _properties(mi: ModuleType, material: Material) -> Plugin:
    """Return the plugins of a shape: its BSDF, its emitter and the medium inside."""
    nested: Plugin = {"bsdf": bsdf(mi, material)}
    if material.is_emissive:
        if material.two_sided:
            refuse("two_sided emission", f"material {material.name!r}")
        nested["emitter"] = emission(mi, material)
    if max(material.absorption) > 0.0 and not material.thin:
        strongest = max(material.absorption)  # colours above 1 are refused, hence the scale
        ratio = [value / strongest for value in material.absorption]
        nested["interior"] = {"type": "homogeneous", "albedo": 0.0, "scale": strongest, "sigma_t": {"type": "rgb", "value": ratio}}
    return nested


def _to_world(thing: Object) -> Triangles:
    """Return triangles in world space, computed in float64 and rounded once to float32, as in wrt."""
    mesh, linear = thing.mesh, thing.transform[:3, :3]
    vertices = mesh.vertices.astype(np.float64) @ linear.T + thing.placement[:3, 3]
    # A mirroring transform reverses the winding; exchanging two corners restores it.
    faces = mesh.faces if np.linalg.det(linear) >= 0.0 else mesh.faces[:, [0, 2, 1]]
    world = Triangles(vertices.astype(np.float32), faces, None, mesh.uvs)
    if mesh.normals is None:
        return world
    normals = mesh.normals.astype(np.float64) @ np.linalg.inv(linear)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = length[:, 0] == 0.0
    normals = (normals / np.where(length > 0.0, length, 1.0)).astype(np.float32)
    if not flat[faces].any():
        return world._replace(normals=normals)
    # A zero normal means a flat corner, which gets the normal of its face. So faces can no longer share vertices.
    corners = world._replace(normals=normals).of(faces.reshape(-1), np.arange(faces.size))
    assert corners.normals is not None
    own = np.repeat(_face_normals(corners), 3, axis=0)
    return corners._replace(normals=np.where(np.any(corners.normals, axis=1, keepdims=True), corners.normals, own))


def _face_normals(triangles: Triangles) -> np.ndarray:
    """Return (F, 3) float32 unit normals of the faces; zero for a triangle without area."""
    a, b, c = (triangles.vertices[triangles.faces[:, corner]].astype(np.float64) for corner in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals / np.where(length > 0.0, length, 1.0)).astype(np.float32)


def make_mesh(mi: ModuleType, name: str, triangles: Triangles, nested: Plugin) -> MitsubaObject:
    properties = mi.Properties()
    for key, value in nested.items():
        properties[key] = mi.load_dict(value)
    mesh = mi.Mesh(name, len(triangles.vertices), len(triangles.faces), props=properties,
                   has_vertex_normals=triangles.normals is not None, has_vertex_texcoords=triangles.uvs is not None)
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = triangles.vertices.ravel()
    arrays["faces"] = triangles.faces.astype(np.uint32).ravel()
    if triangles.normals is not None:
        arrays["vertex_normals"] = triangles.normals.ravel()
    if triangles.uvs is not None:
        arrays["vertex_texcoords"] = triangles.uvs.ravel()
    arrays.update()
    return mesh
