"""glTF 2.0 files (.gltf, .glb) as wrt scenes: the node graph, meshes, instances, cameras and lights.

Positions, cameras and lights keep the file's units. Photometric light intensities (candela, lux) are read as radiometric ones, as in
most renderers. A camera's aspect ratio and clipping planes are ignored. Objects stand as they do without animation. Without a
default scene the first scene is read, and without scenes every root node.
Source: Khronos, glTF 2.0 specification, section 3; KHR_lights_punctual, EXT_mesh_gpu_instancing, KHR_mesh_quantization.
"""

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from wrt.core.checks import LARGEST, short
from wrt.core.errors import InputError, at, warn
from wrt.core.types import PathLike
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.materials import Materials
from wrt.io.gltf.meshes import Meshes, walk
from wrt.io.gltf.schema import LIGHT, LIGHTS, read
from wrt.scene.cameras import Camera, CameraKind, OrthographicCamera
from wrt.scene.defaults import Staging, add_fill, expose, is_lit, stage
from wrt.scene.lights import DirectionalLight, Light, PointLight, SpotLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import GREY, Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.values import require_count, rounded


def load_gltf(path: PathLike, staging: Staging | None = None, *, staged: bool = True, shapes_only: bool = False) -> Scene:
    """Read a glTF 2.0 file. The scene shares the meshes, materials and textures that the file shares.

    staged: add a camera or lights to a file without them, as `staging` says, and refuse a file without triangles. It is False for a
    file that a scene file includes. shapes_only: read neither materials nor pictures, lights, cameras and animations; every material is
    grey, and nothing is added. One SceneWarning names everything left out or added. Settings are the defaults, except that
    glass_shadows is "tinted" if there is solid glass (KHR_materials_volume). Raises InputError with the file and the place in its JSON."""
    with at(path=path), np.errstate(over="ignore", invalid="ignore"):  # the scene refuses infinite values
        document = Document(path, shapes_only)
        scene = _Reader(document, shapes_only).scene()
        notes = (("not supported and left out", document.left_out), ("wrong in the file and left out or changed", document.mistakes))
        left_out = [f"{title}: {features.sentence()}" for title, features in notes if features.sentence()]
        staged = staged and not shapes_only
        if not scene.objects and (staged or not (scene.lights or scene.cameras)):
            raise InputError("; ".join(["the scene has no triangles", *left_out]))
        own_lights = staged and is_lit(scene)
        scene, added = stage(scene, staging) if staged else (scene, [])
        if own_lights:
            scene, told = add_fill(scene, staging.fill if staging else None)
            scene, exposed = expose(scene)  # the units of a file's lights are any
            added += filter(None, (told, exposed))
    if left_out or added:
        warn(f"{os.fspath(path)}: {'; '.join(left_out + added)}")
    return scene


_LIGHTS: dict[str, Callable[..., Light]] = {
    "point": lambda place, direction, color, cone, name: PointLight(place, color, name),
    "directional": lambda place, direction, color, cone, name: DirectionalLight(direction, color, name),
    "spot": lambda place, direction, color, cone, name: SpotLight(place, direction, color, cone[0], cone[1], name),
}


@dataclass
class _Reader:
    document: Document
    shapes_only: bool = False
    objects: list[Object] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    cameras: list[CameraKind] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._meshes = Meshes(self.document)
        self._materials = Materials(self.document)
        # By the index of the mesh in the file, the weights of its morph targets, and its skin. True: the vertices are in world space.
        self._parts: dict[tuple[int, tuple[float, ...], int | None], list[tuple[Mesh, Material, bool]]] = {}

    def scene(self) -> Scene:
        document, left_out = self.document, self.document.left_out
        for index, node, world in walk(document):
            name, place = node.name or f"node {index}", f"nodes[{index}]"
            left_out.add_extensions(node.extensions, "node", name)
            if node.mesh is not None:
                self._add_mesh(index, node, world, name, place)
            if node.camera is not None and not self.shapes_only:
                self._add_camera(node, world, place)
            if not self.shapes_only:
                self._add_light(node, world, place)
        if document.raw("animations") and not self.shapes_only:
            left_out.add("motion", "file", document.path.name)
        left_out.add_extensions(document.gltf.extensions, "file", document.path.name)
        scene = Scene(tuple(self.objects), (), tuple(self.lights), tuple(self.cameras), name=document.path.stem)
        # As in other viewers, light then reaches objects inside of glass.
        solid_glass = any(material.transmission > 0.0 and not material.thin for material in scene.materials)
        return replace(scene, settings=Settings(glass_shadows="tinted" if solid_glass else "opaque"))

    def _add_mesh(self, index: int, node: GltfObject, world: np.ndarray, name: str, place: str) -> None:
        source = self.document.item("meshes", node.mesh, f"{place}.mesh")
        weights: list[float] = []
        if any(primitive.targets for primitive in source.primitives):
            weights = node.weights or read({"weights": [float]}, self.document.raw("meshes")[node.mesh], f"meshes[{node.mesh}]").weights
        key = (node.mesh, tuple(weights), node.skin)
        if key not in self._parts:
            self.document.left_out.add_extensions(source.extensions, "mesh", source.name or f"mesh {node.mesh}")
            self._parts[key] = list(self._parts_of(source, *key))
        # The vertices of a skinned mesh follow the joints; the transform of its own node has no effect.
        transforms = {posed: self._placements(node, np.eye(4) if posed else world, name, place) for *_, posed in self._parts[key]}
        for mesh, material, posed in self._parts[key]:
            with at(place):
                require_count(len(self.objects) + len(transforms[posed]), "objects")
                self.objects += [Object(mesh, (material,), transform, name=name) for transform in transforms[posed]]

    def _parts_of(self, source: GltfObject, index: int, weights: tuple[float, ...],
                  skin: int | None) -> Iterator[tuple[Mesh, Material, bool]]:
        """Yield the mesh and the material of each primitive with triangles, and True if its vertices are in world space."""
        left_out, mesh_name = self.document.left_out, source.name or f"mesh {index}"
        for i, primitive in enumerate(source.primitives):
            where = f"meshes[{index}].primitives[{i}]"
            left_out.add_extensions(primitive.extensions, "mesh", mesh_name)
            posed = skin is not None and {"JOINTS_0", "WEIGHTS_0"} <= set(primitive.attributes)
            if posed < (skin is not None):
                left_out.add("skins without JOINTS_0 and WEIGHTS_0", "mesh", mesh_name)
            mesh = self._meshes.mesh(primitive, mesh_name, where, weights, skin if posed else None)
            if mesh is not None:
                material = GREY if self.shapes_only else self._materials.material(primitive.material, f"{where}.material")
                if "TANGENT" in primitive.attributes and material.normal_texture is not None:
                    left_out.add("TANGENT, in place of which tangents are made from TEXCOORD_0", "mesh", mesh_name)
                yield mesh, material, posed

    def _placements(self, node: GltfObject, world: np.ndarray, name: str, place: str) -> np.ndarray:
        """Return the object-to-world matrices (N, 4, 4) of a node's mesh, or of its instances. Singular matrices are left out."""
        instances = self._meshes.instances(node, place)
        with np.errstate(over="ignore", invalid="ignore"):
            transforms = world[None] if instances is None else world @ instances
            flat = np.linalg.det(transforms[:, :3, :3]) == 0.0
        if flat.any():
            self.document.left_out.add("meshes scaled to no volume", "node", name)
        return transforms[~flat]

    def _add_camera(self, node: GltfObject, world: np.ndarray, place: str) -> None:
        source = self.document.item("cameras", node.camera, f"{place}.camera")
        name = node.name or source.name or f"camera {node.camera}"
        self.document.left_out.add_extensions(source.extensions, "camera", name)
        lens = getattr(source, source.type) if source.type in ("perspective", "orthographic") else None
        if lens is None:
            raise InputError("must be 'perspective' or 'orthographic', with the object of that name", place=f"cameras[{node.camera}].type")
        if not np.cross(world[:3, 1], world[:3, 2]).any():
            self.document.left_out.add("cameras scaled to no volume", "camera", name)
            return
        with at(f"{place}.camera"):
            self.cameras.append(Camera(world, lens.yfov, name=name) if source.type == "perspective" else
                                OrthographicCamera(world, 2.0 * lens.ymag, name=name))

    def _add_light(self, node: GltfObject, world: np.ndarray, place: str) -> None:
        link = self.document.extension(node, "KHR_lights_punctual", place)
        if link is None:
            return
        here = f"{place}.extensions.KHR_lights_punctual.light"
        raw = self.document.gltf.extensions.get("KHR_lights_punctual")
        lights = [] if raw is None else read(LIGHTS, raw, "extensions.KHR_lights_punctual").lights
        if not 0 <= link.light < len(lights):
            raise InputError(f"is {link.light}, but there are {len(lights)} lights", place=here)
        left_out, clamp = self.document.left_out, self.document.mistakes.clamp
        where = f"extensions.KHR_lights_punctual.lights[{link.light}]"
        source = read(LIGHT, lights[link.light], where)
        name = node.name or source.name or f"light {link.light}"
        if source.type not in _LIGHTS:
            raise InputError(f"must be one of {', '.join(_LIGHTS)}, got {short(source.type)}", place=f"{where}.type")
        if source.range is not None:
            left_out.add("range", "light", name)
        if not (world[:3, :3] if source.type == "point" else world[:3, 2]).any():
            left_out.add("lights scaled to no volume", "light", name)
            return
        color = clamp([c * source.intensity for c in source.color], 0.0, LARGEST, "color", "light", name)
        outer = clamp(rounded(source.spot.outerConeAngle, 1e-4, math.pi / 2), 1e-4, math.pi / 2, "outerConeAngle", "light", name)
        inner = clamp(rounded(source.spot.innerConeAngle, 0.0, outer), 0.0, outer, "innerConeAngle", "light", name)
        with at(where):
            self.lights.append(_LIGHTS[source.type](tuple(world[:3, 3]), tuple(-world[:3, 2]), tuple(color), (inner, outer), name))
