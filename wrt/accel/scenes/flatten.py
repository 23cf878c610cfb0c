"""Scenes as arrays: joined triangles in world space, instanced meshes in their own space, and several worlds in one structure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from wrt.accel.flat_scene import FlatScene, Placed
from wrt.accel.geometry import MESH_OF_A_SPHERE, Geometry, InstancedGeometry, NumberedGeometry
from wrt.accel.scenes.instancing import is_instance, is_invertible
from wrt.core.errors import InputError
from wrt.scene.clean import flip_collinear
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.model import Object, Scene, moved_by, scene_origin

MOST = 2**31 - 2  # faces, and vertices
GREY = Material()


def flatten(scene: Scene, meshes: frozenset[int] = frozenset()) -> FlatScene:
    """Convert a scene to arrays. meshes: id() of each mesh that is stored once (wrt.accel.scenes.instancing)."""
    return flatten_instanced(scene, meshes) if meshes else flatten_joined(scene)


def flatten_joined(scene: Scene) -> FlatScene:
    """Transform all objects to world space and join their arrays. Positions are computed in float64 and rounded once.

    Rounding may put the corners of a face on a line; `wrt.scene.clean.flip_collinear` repairs such faces.
    """
    index = {id(material): i for i, material in enumerate(scene.materials)}
    joined = _joined(scene.objects, index)
    _check_size(len(joined.vertices), len(joined.faces))
    geometry = Geometry(joined.vertices, joined.faces, _spheres(scene))
    return FlatScene(geometry, joined.vertices, joined.faces, joined.normals if _is_smooth(scene) else None, joined.uvs,
                 np.concatenate([joined.material, _sphere_materials(scene, index)]), objects=_first_prims(scene))


def flatten_instanced(scene: Scene, meshes: frozenset[int]) -> FlatScene:
    """Convert a scene to arrays with instances of `meshes`, given by id(). Other objects are joined in world space: parts[0]."""
    index = {id(material): i for i, material in enumerate(scene.materials)}
    instanced = [is_instance(thing, meshes) for thing in scene.objects]
    flat = _joined(tuple(thing for thing, apart in zip(scene.objects, instanced, strict=True) if not apart), index)
    parts = {0: flat}  # then by id of the mesh
    materials: dict[tuple[int, ...], tuple[int, np.ndarray]] = {(): (0, flat.material)}
    n_material = len(flat.material)
    rows: list[tuple[int, int, int, int, np.ndarray]] = []  # first_prim, part, first material, step, to_world
    prim_ids: list[np.ndarray] = []  # of part 0
    first_prim = n_flat = 0
    for thing, apart in zip(scene.objects, instanced, strict=True):
        count = len(thing.mesh.faces)
        if not apart:
            if not rows or rows[-1][1] != 0:  # otherwise the object extends the last run
                rows.append((first_prim, 0, n_flat, 1, np.eye(4)))
            prim_ids.append(np.arange(first_prim, first_prim + count, dtype=np.int64))
            n_flat += count
        else:
            part = parts.get(id(thing.mesh)) or parts.setdefault(id(thing.mesh), _own_space(thing.mesh))
            table = np.array([index[id(m)] for m in thing.materials], np.int32)
            key = (id(thing.face_material), *table.tolist()) if thing.face_material is not None else (0, int(table[0]))
            if key not in materials:
                each = table[:1] if thing.face_material is None else table[thing.face_material][part.source]
                materials[key] = (n_material, each)
                n_material += len(each)
            rows.append((first_prim, id(thing.mesh), materials[key][0], int(thing.face_material is not None), thing.placement))
        first_prim += count
    _check_size(sum(len(part.vertices) for part in parts.values()), first_prim)
    return _placed_scene(scene, index, parts, rows, materials, prim_ids, first_prim)


def _placed_scene(scene: Scene, index: dict[int, int], parts: "dict[int, _Joined]", rows: list[tuple[int, int, int, int, np.ndarray]],
                  materials: dict[tuple[int, ...], tuple[int, np.ndarray]], prim_ids: list[np.ndarray], n_triangles: int) -> FlatScene:
    """Assemble the result of `flatten_instanced` from its local variables."""
    spheres = _spheres(scene)
    prim_ids.append(np.arange(n_triangles, n_triangles + len(spheres), dtype=np.int64))
    prim_material = np.concatenate([*(each for _, each in materials.values()), _sphere_materials(scene, index)]).astype(np.int32)
    place = {key: i for i, key in enumerate(parts)}
    first_vertex = np.cumsum([0, *(len(part.vertices) for part in parts.values())])
    first_face = np.cumsum([0, *(len(part.faces) for part in parts.values())])
    joined = list(parts.values())
    flat = joined[0]
    geometries = (NumberedGeometry(flat.vertices, flat.faces, spheres, prim_ids=np.concatenate(prim_ids).astype(np.int32)),
                  *(Geometry(part.vertices, part.faces, spheres[:0], part.origin) for part in joined[1:]))
    instances = [(place[key], matrix[:3], first) for first, key, _, _, matrix in rows if key]
    if len(geometries[0]):
        instances.insert(0, (0, np.eye(4)[:3], 0))
    geometry = InstancedGeometry(geometries, np.array([i[0] for i in instances], np.int32), np.array([i[1] for i in instances]),
                                 np.array([i[2] for i in instances], np.int64), n_triangles)
    # Faces and face materials of joined objects have the same indices, in the order of part 0.
    runs = [(first, material if key == 0 else int(first_face[place[key]]), material, step, matrix[:3])
            for first, key, material, step, matrix in rows]
    runs.append((n_triangles, 0, len(prim_material) - len(spheres), 1, np.eye(4)[:3]))
    columns = [np.array([run[i] for run in runs], np.int64) for i in range(4)]
    return FlatScene(geometry, np.concatenate([part.vertices for part in joined]),
                 np.concatenate([part.faces + np.int32(first) for part, first in zip(joined, first_vertex, strict=False)]),
                 np.concatenate([part.normals for part in joined]) if _is_smooth(scene) else None,
                 np.concatenate([part.uvs for part in joined]), prim_material,
                 Placed(columns[0], columns[1], columns[2], columns[3], np.array([run[4] for run in runs], np.float64)),
                 _first_prims(scene), names=tuple(thing.name for thing in scene.objects))


def with_shared(worlds: Sequence[Mesh | Scene], shared: Mesh | Scene | None) -> Sequence[Mesh | Scene]:
    """Add the objects of `shared` to each world, behind its own. Raises InputError for spheres."""
    if shared is None:
        return worlds
    scenes = [each if isinstance(each, Scene) else Scene((_alone(each),)) for each in (*worlds, shared)]
    if scenes[-1].spheres:
        raise InputError("has spheres, but only meshes are in worlds", argument="shared", hint=MESH_OF_A_SPHERE)
    return [replace(each, objects=each.objects + scenes[-1].objects) for each in scenes[:-1]]


def worlds_over(worlds: Sequence[Mesh | Scene], unnamed: bool = False) -> FlatScene:
    """Join several worlds in one geometry; each mesh is stored once. Raises InputError for spheres and flattened objects.
    unnamed: the caller has one scene and knows no world, so that messages name none."""
    for index, scene in enumerate(worlds):
        place = "" if unnamed else f"world {index}"
        for thing in scene.objects if isinstance(scene, Scene) else ():
            if not is_invertible(thing):
                raise InputError("is flattened or sheared too much to be an instance",
                                 place=f"{place and place + ': '}object {thing.name!r}")
        if isinstance(scene, Scene) and scene.spheres:
            raise InputError("has spheres, but only meshes move (movable=True) or are in worlds", place=place or "the scene",
                             hint=MESH_OF_A_SPHERE)
    objects = [scene.objects if isinstance(scene, Scene) else (_alone(scene),) for scene in worlds]
    together = tuple(thing for each in objects for thing in each)
    if not together:
        raise InputError("must have at least one object in all its worlds together", argument="mesh")
    joined = Scene(together)
    origin = scene_origin(joined)
    joined = moved_by(joined, origin)
    together = joined.objects
    flat = flatten(joined, frozenset(id(thing.mesh) for thing in together))
    geometry = flat.geometry
    assert isinstance(geometry, InstancedGeometry)
    places = {id(material): i for i, material in enumerate(joined.materials)}
    own = [(world, places[id(material)], i) for world, scene in enumerate(worlds)
           for i, material in enumerate(scene.materials if isinstance(scene, Scene) else (GREY,))]
    return replace(flat, geometry=replace(geometry, origin=origin, worlds=np.cumsum([0, *map(len, objects)])), objects=None,
                   own_materials=np.array(sorted(own), np.int64).reshape(-1, 3))


def _alone(mesh: Mesh) -> Object:
    return Object(mesh, (GREY,), name=mesh.name)


def _is_smooth(scene: Scene) -> bool:
    return any(thing.mesh.normals is not None for thing in scene.objects)


def _first_prims(scene: Scene) -> np.ndarray:
    counts = [*(len(thing.mesh.faces) for thing in scene.objects), *(1 for _ in scene.spheres)]
    return np.cumsum([0, *counts])[:-1]


def _spheres(scene: Scene) -> np.ndarray:
    return np.array([(*s.center, s.radius) for s in scene.spheres], np.float32).reshape(-1, 4)


def _sphere_materials(scene: Scene, index: dict[int, int]) -> np.ndarray:
    return np.array([index[id(s.material)] for s in scene.spheres], np.int32)


def _check_size(vertices: int, faces: int) -> None:
    if vertices > MOST or faces > MOST:
        raise InputError("the scene has more than 2^31 - 2 vertices or faces")


@dataclass(frozen=True, eq=False)
class _Joined:
    """Arrays of joined objects, or of one mesh. source: (F,), index of the original face in which each face lies (flip_collinear),
    or all faces if none was flipped."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    source: np.ndarray | slice
    material: np.ndarray
    origin: np.ndarray | None = None  # of the mesh


def _joined(objects: tuple[Object, ...], index: dict[int, int]) -> _Joined:
    """Join objects in world space. index: index of each material in the scene, by its id()."""
    parts, material, first = [], [np.zeros(0, np.int32)], 0
    for thing in objects:
        v, f, n, t = _transformed(thing)
        parts.append((v, f + np.int32(first) if first else f, n, t))
        table = np.array([index[id(m)] for m in thing.materials], np.int32)
        material.append(np.full(len(f), table[0]) if thing.face_material is None else table[thing.face_material])
        first += len(v)
        _check_size(first, 0)
    empty = [np.zeros((0, width), dtype) for width, dtype in ((3, np.float32), (3, np.int32), (3, np.float32), (2, np.float32))]
    vertices, faces, normals, uvs = map(np.concatenate, zip(*parts, strict=True)) if parts else empty
    is_clean = len(objects) == 1 and _is_unmoved(objects[0]) and objects[0].mesh.is_clean
    # Far from the origin, rounding puts corners on a line. One call for all objects is faster than a call for each.
    faces, source = (faces, slice(None)) if is_clean else flip_collinear(vertices, faces, all(_is_bare(thing.mesh) for thing in objects))
    return _Joined(vertices, faces, normals, uvs, source, np.concatenate(material)[source])


def _own_space(mesh: Mesh) -> _Joined:
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()  # because the caller may write to its arrays
    faces, source = (faces, slice(None)) if mesh.is_clean else flip_collinear(vertices, faces, _is_bare(mesh))
    return _Joined(vertices, faces, *_attributes(mesh), source, np.zeros(0, np.int32), mesh.origin)


def _is_bare(mesh: Mesh) -> bool:
    """Return whether vertices are nothing but places, so that two at the same place are one."""
    return mesh.normals is None and mesh.uvs is None


def _attributes(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and uvs of the vertices; zeros if the mesh has none."""
    return (np.zeros_like(mesh.vertices) if mesh.normals is None else mesh.normals,
            np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs)


def _is_unmoved(thing: Object) -> bool:
    return np.array_equal(thing.placement, np.eye(4))


def _transformed(thing: Object) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    mesh, matrix = thing.mesh, thing.placement
    faces = mesh.faces
    normals, uvs = _attributes(mesh)
    if _is_unmoved(thing):
        return mesh.vertices, faces, normals, uvs
    linear = matrix[:3, :3]
    vertices = (mesh.vertices.astype(np.float64) @ linear.T + matrix[:3, 3]).astype(np.float32)
    # The cofactor matrix transforms normals. It is the inverse transpose times the determinant, and exists for flat objects too.
    # For a mirrored object, the determinant's sign would turn normals inwards: it is removed, and the faces are reversed instead.
    mirrored = np.linalg.det(linear) < 0.0
    if mirrored:
        faces = faces[:, [0, 2, 1]]
    if mesh.normals is not None:
        cofactors = np.stack([np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])])
        normals = unit_rows(normals.astype(np.float64) @ cofactors.T * (-1.0 if mirrored else 1.0))
    return vertices, faces, normals, uvs
