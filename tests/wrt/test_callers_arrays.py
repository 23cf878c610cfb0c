"""The caller's arrays are read during a call and never later: a test writes into every array that was passed to every public call.

The public calls are drawn from the public names, so that a new one fails `test_every_public_call_is_tested` until it has a row here.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
import wrt.compat.open3d
import wrt.sensors
from wrt.accel.base import OneMesh
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.queries.accelerator import Accelerator
from wrt.scene.shapes import icosphere

BALL = icosphere(2)
TRIANGLES = {"vertices": BALL.vertices, "faces": BALL.faces.astype(np.int32)}
ATTRIBUTES = {"normals": BALL.vertices / np.linalg.norm(BALL.vertices, axis=1, keepdims=True), "uvs": BALL.vertices[:, :2] * 0.5 + 0.5}
RAYS = {"origins": np.float32([[0.1, 0.2, 5.0], [0.0, 0.1, 5.0], [4.0, 0.0, 0.0]]),
        "directions": np.float32([[0.0, 0.0, -1.0], [0.0, 0.0, -2.0], [0.0, 1.0, 0.0]])}
POINTS = {"points": np.float32([[0.1, 0.2, 0.3], [2.0, 0.0, 0.0]])}
PLACE = np.array([[0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.25], [0.0, 0.0, 1.0, -1.0], [0.0, 0.0, 0.0, 1.0]])
K = np.array([[8.0, 0.0, 3.5], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]])
IMAGE = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)
CORNERS = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
SQUARE = wrt.Mesh(CORNERS, [[0, 1, 2], [0, 2, 3]], uvs=CORNERS[:, :2] * 0.5 + 0.5)

Answers = Callable[[Any], Any]


@dataclass
class Call:
    """A public call. arrays: its arguments; make: the call; answers: numbers that its result gives later."""

    arrays: dict[str, np.ndarray]
    make: Callable[..., Any]
    answers: Answers


def methods_of(kind: type) -> list[str]:
    return [name for name, each in vars(kind).items() if inspect.isroutine(each) and not name.startswith("_")]


def flat(value: object) -> Iterator[bytes]:
    """Yield the bytes of all arrays and numbers in an answer."""
    if isinstance(value, wp.array):
        value = value.numpy()
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple | list):
        for each in value:
            yield from flat(each)
    elif isinstance(value, np.ndarray):
        yield value.tobytes()
    else:
        yield repr(value).encode()


def of_structure(accel: Any, **world: int) -> list[object]:
    """Ask a structure for everything that it reads from its geometry."""
    rays, points = RAYS.values(), POINTS["points"]
    hits = accel.closest_hit(*rays, **world)
    questions: list[Callable[[], object]] = [
        lambda: accel.any_hit(*rays, **world), lambda: wrt.all_hits(accel, *rays, **world).t, lambda: wrt.visible(accel, *rays, **world),
        lambda: wrt.contains(accel, points, **world), lambda: wrt.winding_number(accel, points, **world),
        lambda: wrt.closest_points(accel, points, **world).point]
    questions += [partial(getattr, hits, name) for name in (
        "t", "prim_id", "point", "point_error", "normal", "shading_normal", "uv", "object", "material", "instance")]
    out = []
    for question in questions:
        try:
            out.append(question())
        except wrt.InputError as error:  # the structure cannot answer it
            out.append(str(error))
    return out


def of_mesh(mesh: wrt.Mesh) -> list[object]:
    return [mesh.vertices, mesh.faces, mesh.normals, mesh.uvs, mesh.face_group, *of_structure(wrt.build(mesh)),
            *of_structure(wrt.build(wrt.Scene((wrt.Object(mesh),)), movable=True))]


def fields_of(made: Any) -> list[object]:
    return [getattr(made, each.name) for each in fields(made)]


def of_sensor(sensor: Any) -> list[object]:
    hits = wrt.build(BALL).closest_hit(sensor.origins, sensor.directions)
    return [sensor.origins, sensor.directions, sensor.axis, sensor.depth(hits), sensor.range(hits)]


def of_query(found: Any) -> Any:
    return [value for value in vars(found).values() if isinstance(value, np.ndarray)] if hasattr(found, "__dict__") else found


def read_now(found: Any) -> Any:
    """Return what a query has computed. `hits.point` and the like read the rays again, as the docstring of HitPoints says."""
    return [found.t, found.u, found.v, found.prim_id]


def refitted(vertices: np.ndarray, kind: Callable[[np.ndarray], Any] = np.asarray, accel: str = "bvh8", **options: Any) -> Any:
    structure = wrt.build(BALL, accel)
    structure.refit(kind(vertices), **options)
    return structure


def moved(**arrays: np.ndarray) -> Any:
    structure = wrt.build([wrt.Scene((wrt.Object(BALL), wrt.Object(SQUARE)))] * 2)
    structure.move(**arrays)  # type: ignore[call-overload]
    return structure


def vec3s(rows: np.ndarray) -> wp.array:
    return wp.array(rows, dtype=wp.vec3, device="cpu", copy=False)


def device_geometry(vertices: np.ndarray, faces: np.ndarray) -> wrt.DeviceGeometry:
    return wrt.DeviceGeometry(vec3s(vertices), wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu", copy=False))


def warp_mesh(vertices: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    return wp.Mesh(vec3s(vertices), wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu", copy=False))


def geometry(vertices: np.ndarray, faces: np.ndarray) -> Geometry:
    return Geometry(vertices, faces, np.zeros((0, 4), np.float32))


def instances(vertices: np.ndarray, faces: np.ndarray, **arrays: np.ndarray) -> Any:
    from wrt.accel.geometry import InstancedGeometry

    return wrt.build(InstancedGeometry((geometry(vertices, faces),), **arrays, n_triangles=2 * len(faces)))


def tree_of() -> dict[str, np.ndarray]:
    return {name: np.array(each) for name, each in vars(wrt.build(BALL, "bvh2").tree()).items()}


def loaded(vertices: np.ndarray, faces: np.ndarray, path: Any = None) -> Any:
    return wrt.load_accel(path, geometry(vertices, faces))


def ray_class(module: str, method: str, **rays: np.ndarray) -> Any:
    """Ask an adapter's class over a ball. Its results are arrays of its own."""
    if module == "trimesh":
        trimesh = pytest.importorskip("trimesh")
        from wrt.compat.trimesh import RayMeshIntersector

        return getattr(RayMeshIntersector(trimesh.Trimesh(BALL.vertices, BALL.faces, process=False)), method)(*rays.values())
    scene = wrt.compat.open3d.RaycastingScene()
    scene.add_triangles(BALL.vertices, BALL.faces)
    return getattr(scene, method)(*rays.values())


def of_tensors(found: Any) -> list[np.ndarray]:
    return [np.asarray(each) for each in found]


def added(vertices: np.ndarray, faces: np.ndarray) -> wrt.compat.open3d.RaycastingScene:
    scene = wrt.compat.open3d.RaycastingScene()
    scene.add_triangles(vertices, faces)
    return scene


def from_trimesh(vertices: np.ndarray, faces: np.ndarray) -> wrt.Mesh:
    mesh = pytest.importorskip("trimesh").Trimesh(process=False)
    mesh._data.data.update(vertices=vertices, faces=faces)  # without a copy
    return wrt.Mesh.from_trimesh(mesh)


def tensors(library: str, **arrays: np.ndarray) -> Any:
    module = pytest.importorskip(library)
    make = module.from_numpy if library == "torch" else module.numpy.asarray
    return list(getattr(wrt, library).closest_hit(wrt.build(BALL), *map(make, arrays.values())))


def world() -> dict[str, np.ndarray]:
    return {"object": np.array([0, 1]), "matrix": np.stack([PLACE, np.eye(4)]), "world": np.array([1, 1])}


TWO = {"to_world": np.stack([np.eye(4)[:3], PLACE[:3]]), "part": np.array([0, 0]), "first_prim": np.array([0, len(BALL.faces)])}
RAY6 = np.concatenate(list(RAYS.values()), axis=1)
RANGES = {"ranges": np.float32([1.0, 2.0, np.inf])}
LOOK = {"position": np.array([0.0, 1.0, 5.0]), "target": np.zeros(3), "up": np.array([0.0, 1.0, 0.0])}
PATTERN = {"face_material": np.int32([0, 1])}
KEYS = np.stack([np.float64([[0, 0, 0], [0, 0, 0], [1, 1, 1]]), np.float64([[2, 0, 0], [0, 90, 0], [1, 2, 1]])])
TENT = {"position": np.array([0.0, 1.0, 4.0]), "direction": np.array([0.0, -0.5, -1.0]), "color": np.array([2.0, 1.0, 0.5])}
BALL_HITS = partial(wrt.build(BALL).closest_hit, *RAYS.values())

CALLS: dict[str, Call] = {
    "Mesh": Call(TRIANGLES | ATTRIBUTES | {"face_group": np.zeros(len(BALL.faces), np.int32)}, partial(wrt.Mesh, groups=("a",)), of_mesh),
    "Mesh in float64": Call({name: each.astype(float) for name, each in (TRIANGLES | ATTRIBUTES).items() if name != "faces"},
                            partial(wrt.Mesh, faces=BALL.faces), of_mesh),
    "DeviceGeometry": Call(TRIANGLES, device_geometry, lambda made: of_structure(wrt.build(made, "bvh2"))),
    "build": Call(TRIANGLES, lambda vertices, faces: wrt.build((vertices, faces)), of_structure),
    "build over a Mesh": Call(TRIANGLES | ATTRIBUTES, lambda **arrays: wrt.build(wrt.Mesh(**arrays)), of_structure),
    "build over a Geometry": Call(TRIANGLES, lambda **arrays: wrt.build(geometry(**arrays)), of_structure),
    "build over spheres": Call({"spheres": np.float32([[0, 0, 0, 1]])}, lambda spheres: wrt.build(Geometry(*TRIANGLES.values(), spheres)),
                               lambda accel: read_now(accel.closest_hit(*RAYS.values()))),
    "build over instances": Call(TRIANGLES | TWO, instances, of_structure),
    "build over a DeviceGeometry": Call(TRIANGLES, lambda **arrays: wrt.build(device_geometry(**arrays), "bvh2"), of_structure),
    "build over a wp.Mesh": Call(TRIANGLES, lambda **arrays: wrt.build(warp_mesh(**arrays)), of_structure),
    "build of worlds": Call(TRIANGLES, lambda vertices, faces: wrt.build([(vertices, faces)] * 2), partial(of_structure, world=1)),
    "accel_from_tree": Call(tree_of(), lambda **tree: wrt.accel_from_tree(BALL, tree), of_structure),
    "accel_from_tree's mesh": Call(TRIANGLES, lambda **arrays: wrt.accel_from_tree(geometry(**arrays), tree_of()), of_structure),
    "load_accel": Call(TRIANGLES, loaded, of_structure),
    "OneMesh.refit": Call({"vertices": BALL.vertices * 1.5}, refitted, of_structure),
    "OneMesh.refit to a Warp array": Call({"vertices": BALL.vertices * 1.5}, partial(refitted, kind=vec3s, accel="bvh2"), of_structure),
    "OneMesh.refit in place": Call({"vertices": BALL.vertices * 1.5}, partial(refitted, kind=vec3s, accel="bvh2", in_place=True),
                                   of_structure),
    "Instances.move": Call(world(), moved, partial(of_structure, world=1)),
    "Accelerator.closest_hit": Call(RAYS | {"t_max": np.float32([9, 9, 9])}, lambda **rays: wrt.build(BALL).closest_hit(**rays), read_now),
    "Accelerator.any_hit": Call(RAYS, lambda **rays: wrt.build(BALL).any_hit(**rays), np.asarray),
    "Hits.gradients": Call({name: np.ones(3) for name in "tuv"}, lambda **cotangents: BALL_HITS().gradients(**cotangents), tuple),
    "all_hits": Call(RAYS, lambda **rays: wrt.all_hits(wrt.build(BALL), **rays), of_query),
    "count_hits": Call(RAYS, lambda **rays: wrt.count_hits(wrt.build(BALL), **rays), np.asarray),
    "first_hits": Call(RAYS, lambda **rays: wrt.first_hits(wrt.build(BALL), **rays, k=2), read_now),
    "visible": Call(RAYS, lambda origins, directions: wrt.visible(wrt.build(BALL), origins, directions), np.asarray),
    "closest_points": Call(POINTS, lambda points: wrt.closest_points(wrt.build(BALL), points), of_query),
    "signed_distance": Call(POINTS, lambda points: wrt.signed_distance(wrt.build(BALL), points), np.asarray),
    "contains": Call(POINTS, lambda points: wrt.contains(wrt.build(BALL), points), np.asarray),
    "winding_number": Call(POINTS, lambda points: wrt.winding_number(wrt.build(BALL), points), np.asarray),
    "trace": Call(RAYS, lambda **rays: wrt.trace(wrt.build(BALL), **rays), lambda trace: repr(trace)),
    "walk": Call({name: rays[0] for name, rays in RAYS.items()}, lambda origins, directions: wrt.walk(wrt.build(BALL), origins, directions),
                 lambda walk: [str(walk), repr(walk.as_dict())]),
    "Object": Call(PATTERN | {"transform": PLACE}, partial(wrt.Object, SQUARE, (wrt.Material(), wrt.Material())), fields_of),
    "Sphere": Call({"center": np.zeros(3)}, lambda center: wrt.Sphere(center, 1.0), fields_of),
    "Scene": Call({"ambient": np.full(3, 0.5)}, lambda ambient: wrt.Scene(ambient=ambient), fields_of),
    "Scene.of": Call(TRIANGLES, lambda vertices, faces: wrt.Scene.of([(vertices, faces)]), lambda scene: of_structure(wrt.build(scene))),
    "Texture": Call({"image": IMAGE, "uv_transform": np.float64([[2, 0, 0.5], [0, 2, 0]])}, wrt.Texture, fields_of),
    "Checkerboard": Call({"color_a": np.ones(3), "color_b": np.zeros(3)}, wrt.Checkerboard, fields_of),
    "Material": Call({"albedo": np.array([0.25, 0.5, 0.75]), "emission": np.ones(3)}, wrt.Material, fields_of),
    "EnvironmentBackground": Call({"image": IMAGE[..., :3].astype(np.float32)}, wrt.EnvironmentBackground, fields_of),
    "ConstantBackground": Call({"color": np.ones(3)}, wrt.ConstantBackground, fields_of),
    "GradientBackground": Call({"top": np.ones(3), "bottom": np.zeros(3)}, wrt.GradientBackground, fields_of),
    "PointLight": Call({"position": TENT["position"], "intensity": TENT["color"]}, wrt.PointLight, fields_of),
    "DirectionalLight": Call({"direction": TENT["direction"], "irradiance": TENT["color"]}, wrt.DirectionalLight, fields_of),
    "SpotLight": Call({"position": TENT["position"], "direction": TENT["direction"], "intensity": TENT["color"]}, wrt.SpotLight, fields_of),
    "Motion": Call({"keys": KEYS}, wrt.Motion, fields_of),
    "Camera.look_at": Call(LOOK, wrt.Camera.look_at, fields_of),
    "Camera.posed": Call({"matrix": PLACE}, wrt.Camera.posed, fields_of),
    **{name: Call({"camera_to_world": PLACE}, getattr(wrt, name), fields_of)
       for name in ("Camera", "OrthographicCamera", "FisheyeCamera", "PanoramaCamera")},
    "Settings": Call({"size": np.array([6, 4])}, wrt.Settings, fields_of),
    "Options": Call({"crop": np.array([0, 0, 4, 3])}, wrt.Options, fields_of),
    "render": Call({"camera_to_world": PLACE, "crop": np.array([0, 0, 4, 3])},
                   lambda camera_to_world, crop: wrt.render(wrt.Scene((wrt.Object(SQUARE),), cameras=(wrt.Camera(camera_to_world),)),
                                                            size=(6, 6), spp=1, crop=crop),
                   lambda film: film.pixels),
    "side_by_side": Call({"picture": IMAGE[..., :3]}, lambda picture: wrt.side_by_side({"": picture}), np.asarray),
    "sensors.pinhole": Call({"intrinsics": K, "pose": PLACE, "distortion": np.array([0.01, 0, 0, 0])},
                            partial(wrt.sensors.pinhole, size=(8, 6)), of_sensor),
    "sensors.fisheye": Call({"intrinsics": K, "pose": PLACE}, partial(wrt.sensors.fisheye, size=(8, 6)), of_sensor),
    "sensors.lidar": Call({"pose": PLACE}, partial(wrt.sensors.lidar, "vlp-16", columns=8), of_sensor),
    "sensors.rotating_lidar": Call({"elevations": np.linspace(-0.5, 0.5, 4), "pose": np.stack([PLACE] * 8)},
                                   partial(wrt.sensors.rotating_lidar, steps=8, rolling=True), of_sensor),
    "sensors.raster_lidar": Call({"fov": np.array([1.0, 0.5]), "pose": PLACE}, partial(wrt.sensors.raster_lidar, size=(8, 6)), of_sensor),
    "sensors.project": Call({"points": np.array([[0.1, 0.2, 1.0]]), "intrinsics": K}, wrt.sensors.project, np.asarray),
    "sensors.unproject": Call({"pixels": np.array([[1.0, 2.0]]), "intrinsics": K}, wrt.sensors.unproject, np.asarray),
    "Mesh.from_trimesh": Call(TRIANGLES, from_trimesh, of_mesh),
    "torch.closest_hit": Call({"vertices": BALL.vertices * 1.5} | RAYS, partial(tensors, "torch"), of_tensors),
    "jax.closest_hit": Call({"vertices": BALL.vertices * 1.5} | RAYS, partial(tensors, "jax"), of_tensors),
    "compat.open3d.add_triangles": Call(TRIANGLES, added, lambda scene: scene.cast_rays(RAY6)),
    **{f"compat.open3d.{name}": Call({"rays": RAY6} if "ray" in name or "intersections" in name or "occlusions" in name else
                                     {"query_points": POINTS["points"]}, partial(ray_class, "open3d", name), lambda found: found)
       for name in methods_of(wrt.compat.open3d.RaycastingScene) if name not in ("add_triangles", "create_rays_pinhole")},
    "compat.open3d.create_rays_pinhole": Call({"intrinsic_matrix": K, "extrinsic_matrix": PLACE}, partial(
        wrt.compat.open3d.RaycastingScene.create_rays_pinhole, width_px=4, height_px=3), np.asarray),
    **{f"compat.trimesh.{name}": Call(RAYS if "intersects" in name else POINTS, partial(ray_class, "trimesh", name), lambda found: found)
       for name in ("intersects_id", "intersects_location", "intersects_first", "intersects_any", "contains_points")},
    "sensors.with_range_noise": Call(RANGES, partial(wrt.sensors.with_range_noise, seed=0), np.asarray),
}

NO_ARRAYS = {"ACCELERATORS", "InputError", "SceneWarning", "__version__", "kernel", "load_mesh", "load_scene", "ray_query", "Progress",
             "inspect", "profile", "camera_rays", "sensors.LIDARS", "Accelerator.save", "OneMesh.save",
             "OneMesh.tree", "OneMesh.options", "Mesh.save", "Mesh.note_clean", "Mesh.to_trimesh",
             "Scene.save", "Scene.bounds", "Scene.camera", "Scene.outlines", "Scene.with_settings", "Camera.lens", "Camera.opened",
             "Camera.record", "Camera.switches", "Mesh.reach", "Mesh.warn_if_far", "OneMesh.restore", "Instances.restore"}
"""Public names without an argument that holds arrays, or whose argument is an object of another row: a scene, a camera, a structure."""
KEEP = {"Film", "sensors.Images", "sensors.Sensor", "sensors.LidarModel"}
"""Records of results, whose docstrings say that they keep the arrays that they are given."""


def public_calls() -> Iterator[str]:
    """Yield the public names of wrt and wrt.sensors, and the public methods of structures, of data and of an adapter."""
    yield from wrt.__all__
    yield from (f"sensors.{name}" for name in wrt.sensors.__all__)
    yield from (f"{kind.__name__}.{name}" for kind in (Accelerator, OneMesh, Instances, wrt.Mesh, wrt.Scene, wrt.Camera)
                for name in methods_of(kind))
    yield from (f"compat.open3d.{name}" for name in methods_of(wrt.compat.open3d.RaycastingScene))


def test_every_public_call_is_tested() -> None:
    assert set(public_calls()) - NO_ARRAYS - KEEP <= CALLS.keys()
    for name in KEEP:
        place: ModuleType = wrt.sensors if "." in name else wrt
        assert "keeps the arrays" in inspect.getdoc(getattr(place, name.split(".")[-1]))


def written(array: np.ndarray) -> None:
    """Overwrite an array with other valid values."""
    array[...] = np.roll(array.reshape(-1), 1).reshape(array.shape) if array.dtype.kind in "iub" else array[::-1] * 0.5 + 0.125


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.filterwarnings("ignore::wrt.SceneWarning")
def test_answers_stay_when_the_caller_writes_to_the_arrays_of_a_call(name: str, tmp_path: Any) -> None:
    call = CALLS[name]
    make = call.make
    if name == "load_accel":
        wrt.build(geometry(**TRIANGLES)).save(tmp_path / "ball.accel")
        make = partial(make, path=tmp_path / "ball.accel")
    before = {key: np.array(array) for key, array in call.arrays.items()}
    expected = list(flat(call.answers(make(**before))))
    arrays = {key: np.array(array) for key, array in call.arrays.items()}
    result = make(**arrays)
    for key, array in arrays.items():
        assert array.flags.writeable and array.tobytes() == np.array(call.arrays[key]).tobytes(), f"{key} was written to"
        written(array)
    assert any(array.tobytes() != before[key].tobytes() for key, array in arrays.items())
    assert list(flat(call.answers(result))) == expected
