"""glTF 2.0 files (.gltf, .glb) as wrt scenes: the node graph, meshes, instances, cameras and lights.

Positions, cameras and lights are in the file's own units; light intensities (candela, lux) are taken as radiometric
ones, one for one, as most renderers do. A camera's aspect ratio and clipping planes do not count: the picture's size
and the rays decide. Skinned and animated things stand in their rest pose. Where the file names no default scene, its
first is shown, and where it has no scenes at all, every root node.
Source: Khronos, glTF 2.0 specification, section 3; KHR_lights_punctual, EXT_mesh_gpu_instancing, KHR_mesh_quantization.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wrt.core.errors import InputError, SceneWarning
from wrt.core.memory import Meter
from wrt.io.gltf.accessors import Accessors
from wrt.io.gltf.document import Document
from wrt.io.gltf.materials import Materials
from wrt.io.gltf.schema import Instancing, PunctualLightOfNode, PunctualLights, SpotCone, at, exactly
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.clean import clean
from wrt.scene.defaults import stage
from wrt.scene.lights import DirectionalLight, Light, PointLight, SpotLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.values import MAX_REACH, as_transform, require_count

# Attributes that are read, or named by who wants them (skins, textures), or are the application's own (underscore).
# TANGENT is named where a normal map would use it: tangents are made from the texture coordinates.
_NAMED_ELSEWHERE = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_", "JOINTS_", "WEIGHTS_", "_")
# Of memory, while a mesh is made; an index can be a triangle of its own. And of an object.
BYTES_OF_VERTEX, BYTES_OF_INDEX, BYTES_OF_OBJECT = 60.0, 150.0, 1200.0
# What a node's instances may set, and what holds where they do not.
_INSTANCE_ATTRIBUTES: dict[str, tuple[str, tuple[float, ...]]] = {
    "TRANSLATION": ("VEC3", (0.0, 0.0, 0.0)),
    "ROTATION": ("VEC4", (0.0, 0.0, 0.0, 1.0)),
    "SCALE": ("VEC3", (1.0, 1.0, 1.0)),
}


def load_gltf(path: str | os.PathLike[str], *, staged: bool = True) -> Scene:
    """Read a glTF 2.0 file.

    Meshes, materials and textures that the file shares are shared objects in the scene. staged: a file without a camera
    or light gets one (see `wrt.scene.defaults`), and one without triangles is refused; False: the scene is as in the file, as
    another file includes it. Everything that is left out or added is named in one SceneWarning.
    The scene's settings are the defaults, but for glass_shadows = "tinted" where the file has solid glass (KHR_materials_volume).
    Raises InputError that names the file and the place in its JSON.
    """
    try:
        document = Document(path)
        scene = _Reader(document).scene()
        if not scene.objects and (staged or not (scene.lights or scene.cameras)):
            raise InputError(f"the scene has no triangles{_but(document)}")
        scene, added = stage(scene) if staged else (scene, [])
    except InputError as error:
        raise InputError(str(error), path) from None
    left_out = document.left_out.sentence()
    sentences = ([f"not supported and left out: {left_out}"] if left_out else []) + added
    if sentences:
        warnings.warn(f"{os.fspath(path)}: {'; '.join(sentences)}", SceneWarning, stacklevel=2)
    return scene


def _but(document: Document) -> str:
    left_out = document.left_out.sentence()
    return f"; not supported and left out: {left_out}" if left_out else ""


# --- the node graph ---------------------------------------------------------------------------------------------------


def walk(document: Document) -> Iterator[tuple[int, Any, np.ndarray]]:
    """Each node of the default scene as (index, node, world matrix (4, 4) float64), parents before children.

    Raises InputError for a node with two parents or that is its own ancestor, anywhere in the file.
    """
    _check_forest(document)
    stack = [(index, place, np.eye(4)) for index, place in reversed(_roots(document))]
    seen: set[int] = set()
    while stack:
        index, place, parent = stack.pop()
        node = document.item("nodes", index, place)
        if index in seen:
            raise InputError(f"nodes[{index}] is in the scene twice", None, place)
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is reported by whatever stands there
            world = parent @ local_matrix(node, f"nodes[{index}]")
        yield index, node, world
        children = [(child, f"nodes[{index}].children[{i}]", world) for i, child in enumerate(node.children)]
        stack += reversed(children)


def _roots(document: Document) -> list[tuple[int, str]]:
    gltf = document.gltf
    if gltf.scene is None and not gltf.scenes:
        children = {child for node in gltf.nodes for child in node.children}
        return [(index, "nodes") for index in range(len(gltf.nodes)) if index not in children]
    number = gltf.scene or 0
    scene = document.item("scenes", number, "scene")
    document.left_out.add_extensions(scene.extensions, "scene", scene.name or str(number))
    roots: dict[int, str] = {}
    for i, index in enumerate(scene.nodes):
        place = f"scenes[{number}].nodes[{i}]"
        if index in roots:
            raise InputError(f"nodes[{index}] is in the scene twice", None, place)
        document.item("nodes", index, place)
        roots[index] = place
    return list(roots.items())


def _check_forest(document: Document) -> None:
    nodes = document.gltf.nodes
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for i, child in enumerate(node.children):
            place = f"nodes[{index}].children[{i}]"
            document.item("nodes", child, place)
            if child in parent:
                raise InputError(f"nodes[{child}] has two parents, the first is nodes[{parent[child]}]", None, place)
            parent[child] = index
    # With one parent each, whatever cannot be reached from a root is on a cycle or hangs from one.
    reached = [index for index in range(len(nodes)) if index not in parent]
    for index in reached:
        reached += nodes[index].children
    if len(reached) < len(nodes):
        first = min(set(range(len(nodes))) - set(reached))
        raise InputError("the node graph has a cycle", None, f"nodes[{first}]")


def local_matrix(node: Any, place: str) -> np.ndarray:
    """A node's own transform (4, 4) float64: its matrix, or translation * rotation * scale."""
    if node.matrix is None and node.translation is None and node.scale is None and node.rotation is None:
        return np.eye(4)
    if node.matrix is not None:
        with at(f"{place}.matrix"):
            return as_transform(np.array(exactly(node.matrix, 16, "")).reshape(4, 4).T, "it")
    translation = exactly(node.translation or [0.0] * 3, 3, f"{place}.translation")
    scale = exactly(node.scale if node.scale is not None else [1.0] * 3, 3, f"{place}.scale")
    rotation = exactly(node.rotation or [0.0, 0.0, 0.0, 1.0], 4, f"{place}.rotation")
    if not any(rotation):
        raise InputError("must be a unit quaternion, got zero", None, f"{place}.rotation")
    return compose(np.array([translation]), np.array([rotation]), np.array([scale]))[0]


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(N, 4, 4) matrices translation * rotation * scale from (N, 3), (N, 4) and (N, 3).

    The rotations are quaternions x, y, z, w of any length but 0.
    """
    rotation = rotation / np.abs(rotation).max(axis=1, keepdims=True)  # the square of the length must not vanish
    x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    columns = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)],
        [2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)],
        [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    matrices = np.zeros((len(x), 4, 4))
    matrices[:, :3, :3] = np.array(columns).transpose(2, 1, 0) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1.0
    return matrices


# --- triangles --------------------------------------------------------------------------------------------------------


def _list_of_triangles(indices: np.ndarray) -> np.ndarray:
    return indices[:len(indices) // 3 * 3].reshape(-1, 3)


def _strip(indices: np.ndarray) -> np.ndarray:
    i = np.arange(max(len(indices) - 2, 0), dtype=indices.dtype)
    odd = i & 1  # every second triangle swaps two corners, so that all face the same way
    return indices[np.stack([i, i + 1 + odd, i + 2 - odd], axis=1)]


def _fan(indices: np.ndarray) -> np.ndarray:
    i = np.arange(max(len(indices) - 2, 0), dtype=indices.dtype)
    return indices[np.stack([i + 1, i + 2, np.zeros_like(i)], axis=1)]


TRIANGULATE: dict[int, Callable[[np.ndarray], np.ndarray]] = {4: _list_of_triangles, 5: _strip, 6: _fan}
_NOT_TRIANGLES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


class _Meshes:
    """Makes meshes; primitives with the same accessors and mode share one Mesh object."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._accessors = Accessors(document)
        self._meshes: dict[tuple[Any, ...], Mesh | None] = {}
        self._meter = Meter()
        self._instances = 0

    def mesh(self, primitive: Any, name: str, place: str) -> Mesh | None:
        """The mesh of a primitive, or None where it holds no triangle with an area."""
        left_out, attributes = self._document.left_out, primitive.attributes
        if primitive.mode not in TRIANGULATE and primitive.mode not in _NOT_TRIANGLES:
            raise InputError(f"must be 0 to 6, got {primitive.mode}", None, f"{place}.mode")
        if primitive.mode in _NOT_TRIANGLES or "POSITION" not in attributes:
            left_out.add(_NOT_TRIANGLES.get(primitive.mode, "primitives without POSITION"), "mesh", name)
            return None
        for attribute in sorted(attributes):
            if not attribute.startswith(_NAMED_ELSEWHERE):
                left_out.add(attribute, "mesh", name)
        if primitive.targets:
            left_out.add("morph targets", "mesh", name)
        key = (*(attributes.get(a) for a in ("POSITION", "NORMAL", "TEXCOORD_0")), primitive.indices, primitive.mode)
        if key not in self._meshes:
            self._meshes[key] = self._make(primitive, name, place)
        if self._meshes[key] is None:
            left_out.add("primitives without a triangle that has an area", "mesh", name)
        return self._meshes[key]

    def _make(self, primitive: Any, name: str, place: str) -> Mesh | None:
        positions = self._attribute(primitive, "POSITION", "VEC3", place)
        normals = self._attribute(primitive, "NORMAL", "VEC3", place)
        uvs = self._attribute(primitive, "TEXCOORD_0", "VEC2", place)
        assert positions is not None
        for attribute, array in (("NORMAL", normals), ("TEXCOORD_0", uvs)):
            if array is not None and len(array) != len(positions):
                raise InputError(f"has {len(array)} elements, POSITION has {len(positions)}", None,
                                 f"{place}.attributes.{attribute}")
        indices = self._indices(primitive, len(positions), place)
        with at(place):
            self._meter.take(BYTES_OF_VERTEX * len(positions) + BYTES_OF_INDEX * len(indices), "the mesh")
        if primitive.mode == 4 and len(indices) % 3:
            self._document.left_out.add("incomplete last triangles", "mesh", name)
        with at(place):
            cleaned = clean(positions, TRIANGULATE[primitive.mode](indices), normals, uvs)
            if not len(cleaned.faces):
                return None
            normals = None if cleaned.normals is None else _unit(cleaned.normals)
            return Mesh(cleaned.vertices, cleaned.faces, normals, cleaned.uvs, dropped=cleaned.dropped, name=name)

    def _attribute(self, primitive: Any, attribute: str, kind: str, place: str) -> np.ndarray | None:
        index = primitive.attributes.get(attribute)
        if index is None:
            return None
        return self._accessors.read(index, kind, f"{place}.attributes.{attribute}").astype(np.float32, copy=False)

    def _indices(self, primitive: Any, count: int, place: str) -> np.ndarray:
        if primitive.indices is None:
            return np.arange(count, dtype=np.int32)
        where = f"{place}.indices"
        indices = self._accessors.read(primitive.indices, "SCALAR", where)[:, 0]
        if indices.dtype.kind != "u":
            raise InputError("must be of an unsigned integer type, not normalised", None, where)
        if indices.max() >= count:
            i = int(np.argmax(indices >= count))
            raise InputError(f"index {i} is {int(indices[i])}, but there are {count} vertices", None, where)
        return indices.astype(np.int32)  # accessors end at 2^31 - 1

    def instances(self, node: Any, place: str) -> np.ndarray | None:
        """(N, 4, 4) transforms of a node's instances, relative to the node, or None where it has just itself."""
        instancing = self._document.extension(node, "EXT_mesh_gpu_instancing", Instancing, place)
        if instancing is None:
            return None
        place = f"{place}.extensions.EXT_mesh_gpu_instancing.attributes"
        wanted = _INSTANCE_ATTRIBUTES
        found = {name: self._accessors.read(index, wanted[name][0], f"{place}.{name}").astype(np.float64)
                 for name, index in instancing.attributes.items() if name in wanted}
        counts = {len(array) for array in found.values()}
        if len(counts) != 1:
            raise InputError(f"must hold accessors of one length, got {sorted(counts) or 'none'}", None, place)
        if "ROTATION" in found and not found["ROTATION"].any(axis=1).all():
            raise InputError("must hold unit quaternions, but one is zero", None, f"{place}.ROTATION")
        count = counts.pop()
        self._instances += count
        with at(place):
            require_count(self._instances, "instances")
        return compose(*(found.get(name, np.broadcast_to(default, (count, len(default))))
                         for name, (_, default) in wanted.items()))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Each row at length 1, float32; rows of zeros stay. Quantised normals are off by up to a percent."""
    length = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros(vectors.shape), where=length > 0.0).astype(np.float32)


def _require_reach(mesh: Mesh, transforms: np.ndarray) -> None:
    """Raise InputError where a transform takes the mesh so far out that single precision cannot square the distance."""
    with np.errstate(over="ignore", invalid="ignore"):
        reach = (np.abs(transforms[:, :3, :3]).sum(axis=2) * mesh.reach + np.abs(transforms[:, :3, 3])).max(initial=0.0)
    if not reach <= MAX_REACH:
        raise InputError(f"the mesh reaches {reach:.3g} units from the origin; at most {MAX_REACH:g} can be traced")


# --- lights -----------------------------------------------------------------------------------------------------------


def _point(source: Any, color: Any, world: np.ndarray, name: str) -> Light:
    return PointLight(tuple(world[:3, 3]), color, name)


def _directional(source: Any, color: Any, world: np.ndarray, name: str) -> Light:
    return DirectionalLight(tuple(-world[:3, 2]), color, name)


def _spot(source: Any, color: Any, world: np.ndarray, name: str) -> Light:
    cone = source.spot or SpotCone()
    return SpotLight(tuple(world[:3, 3]), tuple(-world[:3, 2]), color, cone.innerConeAngle, cone.outerConeAngle, name)


LIGHTS: dict[str, Callable[..., Light]] = {"point": _point, "directional": _directional, "spot": _spot}


# --- the scene --------------------------------------------------------------------------------------------------------


def _settings(scene: Scene) -> Settings:
    """A glTF file has no settings. Other viewers light what stands in its glass, and so do shadow rays that go through glass."""
    solid_glass = any(material.transmission > 0.0 and not material.thin for material in scene.materials)
    return Settings(glass_shadows="tinted" if solid_glass else "opaque")


@dataclass
class _Reader:
    document: Document
    objects: list[Object] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    cameras: list[CameraKind] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._meshes = _Meshes(self.document)
        self._materials = Materials(self.document)
        self._parts: dict[int, list[tuple[Mesh, Material]]] = {}  # of each mesh
        self._meter = Meter()
        lights = self.document.extension(self.document.gltf, "KHR_lights_punctual", PunctualLights, "")
        self._punctual = lights.lights if lights else []

    def scene(self) -> Scene:
        document, left_out = self.document, self.document.left_out
        for index, node, world in walk(document):
            name, place = node.name or f"node {index}", f"nodes[{index}]"
            left_out.add_extensions(node.extensions, "node", name)
            if node.mesh is not None:
                self._add_mesh(node, world, name, place)
            if node.camera is not None:
                self._add_camera(node, world, place)
            self._add_light(node, world, place)
        for index, animation in enumerate(document.gltf.animations):
            left_out.add("motion", "animation", animation.name or f"animation {index}")
        for extension, raw in (document.gltf.extensions or {}).items():
            if extension not in left_out:
                left_out.add_extensions({extension: raw}, "file", document.path.name)
        scene = Scene(tuple(self.objects), (), tuple(self.lights), tuple(self.cameras), name=document.path.stem)
        return replace(scene, settings=_settings(scene))

    def _add_mesh(self, node: Any, world: np.ndarray, name: str, place: str) -> None:
        source = self.document.item("meshes", node.mesh, f"{place}.mesh")
        known = node.mesh in self._parts
        if not known:
            self.document.left_out.add_extensions(source.extensions, "mesh", source.name or f"mesh {node.mesh}")
        if node.skin is not None:
            self.document.left_out.add("skins", "node", name)
        transforms = self._placements(node, world, name, place)
        if not known:
            self._parts[node.mesh] = list(self._parts_of(source, node.mesh))
        for mesh, material in self._parts[node.mesh]:
            with at(place):
                _require_reach(mesh, transforms)
                require_count(len(self.objects) + len(transforms), "objects")
                self._meter.take(BYTES_OF_OBJECT * len(transforms), "the scene")
                self.objects += [Object(mesh, (material,), transform, name=name) for transform in transforms]

    def _parts_of(self, source: Any, number: int) -> Iterator[tuple[Mesh, Material]]:
        """The mesh and the material of each primitive that has triangles; asked once for all nodes that show them."""
        left_out, mesh_name = self.document.left_out, source.name or f"mesh {number}"
        for i, primitive in enumerate(source.primitives):
            where = f"meshes[{number}].primitives[{i}]"
            # A compressed copy beside plain accessors changes nothing: were it the only one, it would be required.
            extensions = {k: v for k, v in (primitive.extensions or {}).items() if k != "KHR_draco_mesh_compression"}
            left_out.add_extensions(extensions, "mesh", mesh_name)
            mesh = self._meshes.mesh(primitive, mesh_name, where)
            if mesh is not None:
                material = self._materials.material(primitive.material, f"{where}.material")
                if "TANGENT" in primitive.attributes and material.normal_texture is not None:
                    left_out.add("TANGENT, in place of which tangents are made from TEXCOORD_0", "mesh", mesh_name)
                yield mesh, material

    def _placements(self, node: Any, world: np.ndarray, name: str, place: str) -> np.ndarray:
        """(N, 4, 4) world matrices of a node's mesh: one, or one for each instance; without those that flatten it."""
        instances = self._meshes.instances(node, place)
        with np.errstate(over="ignore", invalid="ignore"):
            transforms = world[None] if instances is None else world @ instances
            flat = np.linalg.det(transforms[:, :3, :3]) == 0.0
        if flat.any():
            self.document.left_out.add("meshes scaled to no volume", "node", name)
        return transforms[~flat]

    def _add_camera(self, node: Any, world: np.ndarray, place: str) -> None:
        source = self.document.item("cameras", node.camera, f"{place}.camera")
        name = node.name or source.name or f"camera {node.camera}"
        self.document.left_out.add_extensions(source.extensions, "camera", name)
        lens = getattr(source, source.type) if source.type in ("perspective", "orthographic") else None
        if lens is None:
            raise InputError("must be 'perspective' or 'orthographic', with the object of that name", None,
                             f"cameras[{node.camera}].type")
        with at(f"{place}.camera"):
            self.cameras.append(Camera(world, lens.yfov, name=name) if source.type == "perspective" else
                                OrthographicCamera(world, 2.0 * lens.ymag, name=name))

    def _add_light(self, node: Any, world: np.ndarray, place: str) -> None:
        link = self.document.extension(node, "KHR_lights_punctual", PunctualLightOfNode, place)
        if link is None:
            return
        here = f"{place}.extensions.KHR_lights_punctual.light"
        if not 0 <= link.light < len(self._punctual):
            raise InputError(f"is {link.light}, but there are {len(self._punctual)} lights", None, here)
        source, where = self._punctual[link.light], f"extensions.KHR_lights_punctual.lights[{link.light}]"
        name = node.name or source.name or f"light {link.light}"
        if source.type not in LIGHTS:
            raise InputError(f"must be one of {', '.join(LIGHTS)}, got {source.type!r}", None, f"{where}.type")
        if source.range is not None:
            self.document.left_out.add("range", "light", name)
        color = exactly(source.color, 3, f"{where}.color")
        with at(where):
            self.lights.append(LIGHTS[source.type](source, tuple(c * source.intensity for c in color), world, name))
