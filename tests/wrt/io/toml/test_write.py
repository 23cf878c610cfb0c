"""`Scene.save`: the scene that is read again renders to the same bits; nothing half-written is left."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.both_loops import differences, film_of
from tests.data import ROOT
from tests.random_scenes import placement, plan_of_scene
from tests.test_random_scenes import GROUPS
from wrt.core.device import start
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.defaults import is_lit
from wrt.scene.materials import Texture
from wrt.scene.model import Scene
from wrt.scene.motion import Motion
from wrt.scene.shapes import box, icosphere, quad

SCENES = sorted((ROOT / "scenes").glob("*.toml"))
NO_TRIANGLES = wrt.Mesh(np.empty((0, 3)), np.empty((0, 3), int))
SMALL = {"size": (12, 8), "spp": 1}


def saved(scene: Scene, folder: Path) -> Scene:
    scene.save(folder / "scene.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wrt.SceneWarning)
        return wrt.load_scene(folder / "scene.toml")


def arrays_of(mesh: wrt.Mesh) -> list[bytes]:
    return [b"" if array is None else array.tobytes() for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.uvs)]


def assert_same(scene: Scene, again: Scene) -> None:
    """Compare what kernels receive: geometry, placements, materials of faces, cameras and textures."""
    assert again.settings == scene.settings and again.ambient == scene.ambient
    for one, two in zip(scene.objects, again.objects, strict=True):
        assert arrays_of(one.mesh) == arrays_of(two.mesh) and np.array_equal(one.transform, two.transform)
        names = [np.array([m.kind + str(m.albedo) + str(m.emission) for m in thing.materials])[
            0 if thing.face_material is None else thing.face_material] for thing in (one, two)]
        assert np.array_equal(np.broadcast_to(names[0], len(one.mesh.faces)), np.broadcast_to(names[1], len(one.mesh.faces)))
    for i, one in enumerate(scene.objects):
        for j, two in enumerate(scene.objects[:i]):
            assert (one.mesh is two.mesh) == (again.objects[i].mesh is again.objects[j].mesh)
    for one, two in zip(scene.cameras, again.cameras, strict=True):
        assert one.camera_to_world.tobytes() == two.camera_to_world.tobytes()
        fields = one.record((16, 9)), two.record((16, 9))
        assert np.array_equal(*(np.float32([*each.values()]) for each in fields))


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_shipped_scenes_are_the_same(path: Path, tmp_path: Path) -> None:
    scene = wrt.load_scene(path)
    assert_same(scene, again := saved(scene, tmp_path))
    assert np.array_equal(*(np.float32([m.eta + m.albedo for m in each.materials]) for each in (scene, again)))


@pytest.mark.parametrize("name", ["textures", "environment", "instances", "lens", "spot"])
def test_shipped_scenes_render_to_the_same_bits(name: str, tmp_path: Path) -> None:
    scene = wrt.load_scene(ROOT / "scenes" / f"{name}.toml")
    again = saved(scene, tmp_path)
    for camera in range(len(scene.cameras)):
        one, two = (wrt.render(each, camera=camera, **SMALL) for each in (scene, again))
        assert one.pixels.tobytes() == two.pixels.tobytes()


@pytest.mark.parametrize("group", GROUPS[:2])
def test_random_scenes_render_to_the_same_bits(group: int, tmp_path: Path) -> None:
    """Another test compiles the kernels of these groups, too."""
    rendered = 0
    for seed in range(4):
        plan = plan_of_scene(group, seed)
        again = saved(plan.scene, tmp_path)
        assert_same(plan.scene, again)
        if is_lit(plan.scene):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", wrt.SceneWarning)  # for example of emissive materials that light nothing
                films = [film_of(prepare(plan_of(each, plan.options), start("cpu")), (0, 0, *each.settings.size), (0, 2))
                         for each in (plan.scene, again)]
            assert differences(*films) == []
            rendered += 1
    assert rendered


@pytest.mark.parametrize("group", range(0, 200, 20))
def test_more_random_scenes_are_the_same(group: int, tmp_path: Path) -> None:
    scene = plan_of_scene(group, 1).scene
    assert_same(scene, saved(scene, tmp_path))


def test_what_is_not_in_shipped_scenes(tmp_path: Path) -> None:
    """Shared meshes with other materials in each object, motion, a sheared texture, names that repeat or are empty."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (3, 5, 4), np.uint8)  # also colours under alpha 0
    texture = Texture(image, uv_transform=rng.normal(size=(2, 3)), wrap=("clamp", "mirror"))
    red, blue, drawn = (wrt.Material(name="a \"b\"\n", albedo=color) for color in ((1, 0, 0), (0, 0, 1), (0.2, 0.3, 0.4)))
    drawn = replace(drawn, albedo_texture=texture, name="")
    ball = icosphere(1)
    rough = replace(ball, normals=ball.normals * np.float32(1.001))  # load_mesh would normalise them
    degenerate = wrt.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2], [0, 2, 3]])
    face_material = rng.integers(0, 3, len(ball.faces))
    things = (wrt.Object(ball, (red, blue, drawn), face_material=face_material), wrt.Object(ball, (drawn,)),
              wrt.Object(ball, (blue, red), placement(rng), 1 * (face_material > 1)),
              wrt.Object(rough, (red,), motion=Motion(rng.uniform(1, 2, (3, 3, 3)), replace(ball, vertices=2 * ball.vertices))),
              wrt.Object(degenerate, (red,)), wrt.Object(replace(ball), (red,)))
    angles = rng.uniform(0.1, 1.5, 40)
    cameras = tuple(Camera.look_at(rng.normal(size=3), rng.normal(size=3), fov_y=angle) for angle in angles)
    spots = tuple(wrt.SpotLight(rng.normal(size=3), rng.normal(size=3), (1, 1, 1), outer=angle) for angle in angles)
    scene = wrt.Scene(things, lights=spots, cameras=cameras, name="\x7f\u20ac\U0001f600")
    again = saved(scene, tmp_path)
    assert_same(scene, again)
    assert again.name == scene.name
    for one, two in zip(scene.lights, again.lights, strict=True):
        assert one.direction == two.direction and np.float32(one.outer) == np.float32(two.outer)
    motion = again.objects[3].motion
    assert motion is not None and motion.target is not None and np.array_equal(motion.keys, things[3].motion.keys)
    assert arrays_of(motion.target) == arrays_of(things[3].motion.target)
    found = again.objects[1].materials[0].albedo_texture
    assert np.array_equal(found.image, image) and np.array_equal(found.uv_transform, texture.uv_transform) and found.wrap == texture.wrap
    before = sorted(path.name for path in (tmp_path / "scene_files").iterdir())
    again.save(tmp_path / "scene.toml")  # the files are the same, and have the same names
    assert sorted(path.name for path in (tmp_path / "scene_files").iterdir()) == before


@dataclass(frozen=True, eq=False)
class OwnCamera(CameraKind):
    kind = "own"
    own: float = 0.0


@pytest.mark.parametrize(("change", "message"), [
    ({"cameras": (OwnCamera(name="mine"),)}, "camera 'mine'.*OwnCamera"),
    ({"objects": (wrt.Object(icosphere(0), (wrt.Material(),), np.diag([1, 0, 1, 1]), name="flat"),)}, "object 'flat'.*invertible"),
    ({"objects": (wrt.Object(NO_TRIANGLES, (wrt.Material(),), name="none"),)}, "object 'none'.*without"),
    ({"name": "a\ud800"}, "UTF-8")])
def test_what_scene_files_do_not_hold_is_named_and_nothing_is_written(change: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(wrt.InputError, match=message):
        replace(wrt.Scene.of([icosphere(0)]), **change).save(tmp_path / "scene.toml")
    assert not list(tmp_path.iterdir())


def test_a_failure_keeps_the_scene_that_was_saved_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = wrt.Scene.of([icosphere(0), icosphere(1)])
    scene.save(tmp_path / "a.toml")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    save, calls = wrt.Mesh.save, []

    def fail(mesh: wrt.Mesh, path: Path) -> None:
        calls.append(path)
        if len(calls) == 2:
            raise wrt.InputError("the disk is full", path=path)
        save(mesh, path)

    monkeypatch.setattr(wrt.Mesh, "save", fail)
    with pytest.raises(wrt.InputError, match="full"):
        wrt.Scene.of([box((0, 0, 0), (1, 1, 1)), quad((0, 0, 0), (1, 0, 0), (0, 1, 0))]).save(tmp_path / "a.toml")
    assert {path: path.read_bytes() for path in before} == before
    with pytest.raises(wrt.InputError, match="toml"):
        scene.save(tmp_path / "a.obj")
    with pytest.raises(wrt.InputError, match="folder does not exist"):
        scene.save(tmp_path / "none" / "a.toml")
