"""Pictures with instances equal pictures with copied meshes, and no new ray hits the surface that it leaves."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import wrt
from tests.command_line import wrt as command
from tests.data import data_path
from tests.gltf_files import GltfFile
from tests.kernel_tools import DEVICE
from tests.placed import place
from tests.refused import refused
from wrt.accel.base import OneMesh
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.build import build
from wrt.accel.scenes.flatten import flatten, flatten_joined
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import upload
from wrt.kernels.query import RayArrays
from wrt.kernels.shade.surface import make_surface_at
from wrt.kernels.study.respawn import Respawn, make_respawn_kernel
from wrt.kernels.traverse.common import Units
from wrt.lab.bench.visibility import compared, rasterizer
from wrt.picture.film import Film
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material, Texture
from wrt.scene.mesh import Mesh, smooth
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import icosphere, quad

AOVS = ("depth", "normal", "albedo", "prim_id", "material_id")
SIZE = (160, 120)


def turned(seed: int, scale: object, *move: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix() @ np.diag(np.broadcast_to(np.asarray(scale), 3))
    matrix[:3, 3] = move
    return matrix


def picture(seed: int, alpha: bool) -> Texture:
    rng = np.random.default_rng(seed)
    image = rng.integers(60, 255, (8, 8, 4), dtype=np.uint8)
    image[..., 3] = np.where(rng.random((8, 8)) < 0.5, 0, 255) if alpha else 255
    image[..., 2] = np.maximum(image[..., 2], 180)  # normals of the normal map point upwards
    return Texture(image, srgb=alpha)


def everything() -> Scene:
    """Return a scene with cut-outs, normal maps, absorbing glass, smooth meshes, area lights, spheres, and materials by face.
    All objects but the floor share meshes. Their transforms stretch, rotate and mirror."""
    ball, pane = smooth(icosphere(2)), quad()
    uvs = np.stack([np.arctan2(ball.vertices[:, 2], ball.vertices[:, 0]) / (2.0 * math.pi), ball.vertices[:, 1]], axis=1)
    ball = Mesh(ball.vertices, ball.faces, ball.normals, uvs.astype(np.float32))
    flat = Mesh(ball.vertices, ball.faces)
    lamp = Material(name="lamp", albedo=(0.0, 0.0, 0.0), emission=(12.0, 11.0, 9.0))
    grey, red = Material(name="grey"), Material(name="red", albedo=(0.7, 0.1, 0.1))
    leaf = Material(name="leaf", alpha_mode="mask", albedo_texture=picture(1, True))
    bumpy = Material(name="bumpy", normal_texture=picture(2, False))
    glass = Material(name="glass", kind="glass", absorption=(0.8, 0.2, 0.1))
    by_face = (np.arange(len(flat.faces)) % 2).astype(np.int32)
    floor = np.diag([20.0, 20.0, 1.0, 1.0])
    floor[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix() @ floor[:3, :3]
    objects = (
        Object(quad(), (grey,), floor),
        Object(ball, (bumpy,), turned(1, (1.0, 0.6, 1.2), -2.6, 1.0, 0.0)),
        Object(ball, (bumpy,), turned(2, (-0.8, 0.8, 0.8), 0.0, 0.8, -1.0)),
        Object(ball, (glass,), turned(3, (0.9, 0.7, 0.8), 0.3, 0.9, 1.6)), Object(ball, (leaf,), turned(4, 0.9, 2.4, 1.0, 0.4)),
        Object(flat, (red, grey), turned(5, (0.5, 0.5, -0.9), -1.2, 0.8, 1.9), by_face),
        Object(flat, (red,), turned(6, (0.3, 0.6, 0.3), 1.4, 0.6, 2.0)),
        Object(pane, (lamp,), turned(7, 1.5, -3.0, 5.0, 1.0)), Object(pane, (lamp,), turned(9, (2.0, 1.0, 1.0), 3.0, 5.0, 2.0)),
        Object(pane, (leaf,), turned(8, 1.3, -0.6, 1.4, 0.3)),
    )
    return Scene(objects, (Sphere((1.2, 0.4, 0.9), 0.4, red),), (), (Camera.look_at((0.0, 2.4, 7.0), (0.0, 0.9, 0.0)),),
                 ConstantBackground((0.2, 0.25, 0.3)), settings=Settings(size=SIZE, spp=64, max_depth=5))


@cache
def both() -> tuple[Film, Film]:
    return tuple(wrt.render(everything(), instancing=mode, aov=AOVS) for mode in ("never", "always"))  # type: ignore[return-value]


def test_the_same_is_seen_through_instances() -> None:
    copied, shared = both()
    same = copied.aov["prim_id"] == shared.aov["prim_id"]
    assert (~same).mean() < 2e-4  # rounding changes pixels at silhouettes
    assert len(np.unique(copied.aov["prim_id"])) > 500 and len(np.unique(copied.aov["material_id"])) == 6
    np.testing.assert_array_equal(shared.aov["material_id"][same], copied.aov["material_id"][same])
    hit = same & np.isfinite(copied.aov["depth"])
    np.testing.assert_allclose(shared.aov["depth"][hit], copied.aov["depth"][hit], rtol=2e-5)
    np.testing.assert_allclose(shared.aov["albedo"][hit], copied.aov["albedo"][hit], atol=2e-3)
    off = np.abs(shared.aov["normal"] - copied.aov["normal"])[hit].max(axis=-1)
    assert off.max() < 2e-3


def test_the_same_light_is_seen_through_instances() -> None:
    """The noise of each picture is known. Both use the same samples, so that they differ by a small part of the noise."""
    copied, shared = both()
    error = np.sqrt(copied.variance.mean())
    assert np.sqrt(((copied.pixels - shared.pixels) ** 2).mean()) < 0.05 * error
    np.testing.assert_allclose(shared.pixels.mean(axis=(0, 1)), copied.pixels.mean(axis=(0, 1)), rtol=2e-3)
    assert shared.stats["not_finite"] == 0
    assert abs(shared.stats["rays"] / copied.stats["rays"] - 1.0) < 2e-3


def test_stats_tell_what_is_kept() -> None:
    copied, shared = both()
    assert copied.stats["triangles"] == shared.stats["triangles"] == copied.stats["stored_triangles"]
    # The copied floor, and each of the two balls and the pane once.
    assert shared.stats["stored_triangles"] == 2 + 320 + 320 + 2
    assert shared.stats["accel"]["bytes"] < 0.5 * copied.stats["accel"]["bytes"]


def test_the_rasterizer_sees_the_same() -> None:
    """A z-buffer of the copied triangles shows the same surfaces as rays through the instances."""
    side = 160
    scene = Scene(tuple(thing for thing in everything().objects if thing.materials[0].alpha_mode == "opaque"),
                  cameras=everything().cameras, settings=Settings(size=(side, side), spp=1))
    film = wrt.render(scene, instancing="always", aov=("depth", "prim_id"))
    raster = rasterizer(flatten_joined(scene).geometry, scene.cameras[0], side)()
    found = compared(raster, (film.aov["depth"].ravel(), film.aov["prim_id"].ravel()))
    assert found["covered"] > 10_000 and found["differ"] < 10


@cache
def respawn_kernel() -> object:
    structure = Structure(ACCELERATORS["bvh"], Units(instances=True))
    surface_at = make_surface_at(False, False, False, False, instances=True)
    return make_respawn_kernel(structure.struct, structure.traversal(any_hit=False), surface_at)


@pytest.mark.parametrize(("scale", "far", "aside"), [(1e-3, 20.0, 30.0), (1.0, 0.0, 300.0), (1e4, 300.0, 3.0)])
def test_no_new_ray_meets_the_surface_it_leaves(scale: float, far: float, aside: float) -> None:
    """Rays leave a closed convex mesh, and no triangle is excluded from the test. The mesh is stretched and rotated. Its distance
    in radii is `far` from the origin of the world, and `aside` from the origin of its own space."""
    ball, n, rng = icosphere(3), 40_000, np.random.default_rng(1)
    moved = Mesh(ball.vertices + np.float32(aside), ball.faces)
    center, objects = scale * far * np.array([1.1, 1.1, 1.0]), []
    for away in (0.0, 1e3 * scale):
        matrix = turned(1, scale * np.array([1.0, 0.5, 1.3]), *center)
        matrix[:3, 3] -= matrix[:3, :3] @ np.full(3, aside) - np.array([0.0, 0.0, away])
        objects.append(Object(moved, (Material(),), matrix))
    device = DEVICE
    described = Scene(tuple(objects))
    scene = upload_scene(described, device, instanced_meshes(described, "always"))
    accel = build(scene.world.geometry, "bvh")
    origin = rng.normal(size=(n, 3))
    origin *= 4.0 * scale / np.linalg.norm(origin, axis=1, keepdims=True)
    target = 0.4 * scale * rng.normal(size=(n, 3))
    rays, out = RayArrays(), Respawn()
    for name, rows in (("origin", center + origin), ("direction", target - origin)):
        setattr(rays, name, upload(rows, wp.vec3, device))
    rays.t_min, rays.t_max = (upload(np.full(n, t, np.float32), wp.float32, device) for t in (0.0, np.inf))
    # Outwards: back towards the origin of the ray, or along the surface.
    out.direction = upload(origin / scale + 2.0 * rng.normal(size=(n, 3)), wp.vec3, device)
    out.first_prim_id, out.next_prim_id = (wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2))
    wp.launch(respawn_kernel(), dim=n, inputs=[accel.data, scene.surfaces, rays, out, 0], device=device)
    first, following = out.first_prim_id.numpy(), out.next_prim_id.numpy()
    hit = first >= 0
    corners = scene.world.corners(first[hit])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = (normal * out.direction.numpy()[hit]).sum(axis=1) > 0.0
    assert outward.sum() > 10_000
    assert (following[hit][outward] == -1).all()


def test_nodes_and_instances_of_a_gltf_file_share_their_mesh(tmp_path) -> None:
    file = GltfFile()
    ball = icosphere(2)
    mesh = file.mesh(file.primitive(ball.vertices, ball.faces.reshape(-1)))
    file.node(mesh=mesh, translation=[0, 3, 0])
    file.node(mesh=mesh, scale=[1, -1, 1])
    moves = file.accessor([[float(3 * i), 0.0, 4.0] for i in range(5)])
    file.node(mesh=mesh, extensions={"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}})
    file.json["scenes"] = [{"nodes": [0, 1, 2]}]
    file.json["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    with pytest.warns(wrt.SceneWarning):
        scene = wrt.load_scene(file.write(tmp_path))
    film = wrt.render(scene, size=(64, 48), spp=1, instancing="always")
    assert film.stats["triangles"] == 7 * 320 and film.stats["stored_triangles"] == 320


def test_instances_are_no_structure_over_one_mesh(tmp_path) -> None:
    accel = build(place(*((Geometry.of(icosphere(1)), np.eye(4)),) * 2), "bvh")
    assert isinstance(accel, Instances) and not isinstance(accel, OneMesh)
    assert "160 primitives in 2 instances" in repr(accel)
    for option in ("triangle", "box"):
        with refused(option, "'none'"):
            build(accel.geometry, **{option: "none"})
    (tmp_path / "x.toml").write_text('[materials]\nm = {}\n[[meshes]]\nshape = {kind = "icosphere", subdivisions = 7}\n'
                                     'material = "m"\ninstances = [{}, {translate = [3, 0, 0]}]\n')
    result = command("build", str(tmp_path / "x.toml"), "-o", str(tmp_path / "x.accel"))
    assert result.code == 2 and "x.toml: a scene with instances has no structure in a file" in result.err
    with refused("nonsense", "no option"):
        build(accel.geometry, "bvh", nonsense=1)


@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_what_is_joined_keeps_its_numbers(builder: str) -> None:
    """A floor and a sphere come after the instances in the scene, and before them in the structure."""
    ball, grey = icosphere(2), Material()
    floor = Object(quad((-5.0, -5.0, 0.0), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0)), (grey,))
    objects = Object(ball, (grey,), turned(1, 1.0, 2.0, 0.0, 2.0)), Object(ball, (grey,), turned(2, 1.0, -2.0, 0.0, 2.0)), floor
    scene = Scene(objects, (Sphere((0.0, 2.0, 2.0), 1.0, grey),))
    origins = np.random.default_rng(1).uniform((-4.0, -4.0, 5.0), (4.0, 4.0, 5.0), (500, 3))
    rays = origins, np.broadcast_to([0.1, 0.2, -1.0], origins.shape)
    expected = build(flatten(scene, frozenset()).geometry, "brute_force").closest_hit(*rays)
    assert (expected.prim_id == 642).any() and ((640 <= expected.prim_id) & (expected.prim_id < 642)).any()
    hits = build(flatten(scene, instanced_meshes(scene, "always")).geometry, "bvh2", builder=builder).closest_hit(*rays)
    assert np.array_equal(hits.prim_id, expected.prim_id)


@pytest.mark.slow
def test_a_million_triangles_of_shared_spheres_take_a_hundredth_of_the_memory() -> None:
    with pytest.warns(wrt.SceneWarning):  # the scene has no camera and no lights
        scene = wrt.load_scene(data_path("scenes/gltf/MetalRoughSpheresNoTextures.glb"))
    copied, shared = (wrt.render(scene, size=(160, 120), spp=4, instancing=mode) for mode in ("never", "auto"))
    assert shared.stats["accel"]["bytes"] < 0.02 * copied.stats["accel"]["bytes"]
    assert np.sqrt(((copied.pixels - shared.pixels) ** 2).mean()) < 0.1 * np.sqrt(copied.variance.mean())
