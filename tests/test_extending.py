"""The instructions of docs/extending.md work: their edits are applied to a copy of the project and run, as are docs/extensions."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from tests.data import ROOT

EXTENSIONS = ROOT / "docs" / "extensions"
BLOCK = re.compile(r"^```diff\n# (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

TRY_IT = """
import numpy as np, stored_normal, wrt
from wrt.scene.shapes import icosphere

ball = icosphere(4)
rng = np.random.default_rng(0)
target = rng.normal(size=(4000, 3)).astype(np.float32)
target *= (1.2 * rng.random((4000, 1)) / np.linalg.norm(target, axis=1, keepdims=True)).astype(np.float32)
origin = np.broadcast_to(np.float32([3.0, 1.0, 2.0]), target.shape)
rays = origin, target - origin
hits = {name: wrt.build(ball, **options).closest_hit(*rays, counters=True) for name, options in {
    "brute": {"accel": "brute_force"}, "runs": {"accel": "runs", "length": 16}, "volumes": {"triangle": "signed_volumes"}}.items()}
brute, runs, volumes = (hits[name] for name in ("brute", "runs", "volumes"))
assert 1000 < (brute.prim_id >= 0).sum() < 4000
for field in ("t", "u", "v", "prim_id"):
    assert np.array_equal(getattr(brute, field), getattr(runs, field)), field
assert (runs.counters.nodes == len(ball.faces) // 16).all()
assert runs.counters.primitives.mean() < 0.7 * len(ball.faces)
sorted_boxes, bvh8 = (wrt.build(ball, accel=accel) for accel in ("runs", "bvh8"))
lists, expected = (wrt.all_hits(accel, *rays) for accel in (sorted_boxes, bvh8))
assert np.array_equal(lists.first, expected.first) and np.array_equal(lists.t, expected.t)
assert np.array_equal(lists.prim_id, expected.prim_id)
assert np.array_equal(wrt.contains(sorted_boxes, target), inside := wrt.contains(bvh8, target)) and 1000 < inside.sum() < 4000
both = brute.prim_id == volumes.prim_id
assert both.mean() > 0.995
found = both & (brute.prim_id >= 0)
assert np.quantile(np.abs(volumes.t[found] - brute.t[found]), 0.9) < 1e-4

# A triangle test with its own record, in wide and compressed BVHs and brute force.
alone = wrt.build(ball, accel="brute_force", triangle="stored_normal").closest_hit(*rays)
assert (alone.prim_id == brute.prim_id).mean() > 0.995
for accel in ("bvh", "bvh8c"):
    own = wrt.build(ball, accel=accel, triangle="stored_normal").closest_hit(*rays)
    assert np.array_equal(own.prim_id, alone.prim_id) and np.array_equal(own.t, alone.t), accel

wrt.build(ball, accel="runs").save("ball.accel")
again = wrt.load_accel("ball.accel", ball).closest_hit(*rays)
assert np.array_equal(again.prim_id, brute.prim_id)

# A retroreflector returns rays to the camera: a pixel that looks up shows half the radiance from behind and below the camera.
import retroreflector

sign = wrt.render("sign.toml", threads=2).pixels[:, 16, 0]
slope = np.tan(np.radians(20.0)) * (1.0 - (2.0 * np.arange(32) + 1.0) / 32.0)
assert np.allclose(sign, 0.5 * 0.5 * (1.0 - slope / np.sqrt(1.0 + slope**2)), atol=1e-3)

# A user's light and background: a beam of radius 0.5 on a floor of albedo 0.5. Beside the floor is the ground; the sky lights both.
import beam, horizon, pickle

stage = wrt.load_scene("stage.toml")
assert isinstance(stage.lights[0], beam.BeamLight) and stage.lights[0].radius == 0.5
moved = stage.lights[0].moved(np.diag([2.0, 2.0, 2.0, 1.0]))
assert moved.position == (0.0, 6.0, 0.0) and moved.direction == (0.0, -1.0, 0.0)
picture = wrt.render(stage, threads=2).pixels[:, :, 1]
assert np.array_equal(wrt.render(pickle.loads(pickle.dumps(stage)), threads=2).pixels[:, :, 1], picture)
x = 5.0 * np.tan(np.radians(20.0)) * ((2.0 * np.arange(32) + 1.0) / 32.0 - 1.0)
distance, side = np.hypot(x[:, None], x), np.maximum(np.abs(x[:, None]), np.abs(x))
for where, expected in ((distance < 0.4, 0.5 + 0.125), ((distance > 0.6) & (side < 1.1), 0.125), (side > 1.3, 1.0)):
    assert where.sum() > 20 and np.allclose(picture[where], expected, atol=1e-5)
try:
    wrt.Scene(lights=beam.BeamLight((0, 1, 0), (0, 0, 0), 1))
    raise AssertionError("a light without direction is accepted")
except wrt.InputError as error:
    assert error.argument == "direction" and error.place == "light"
print("all of it works")
"""

STAGE = """
[settings]
size = [32, 32]
spp = 4
filter = "box"
[cameras.main]
position = [0, 5, 0]
target = [0, 0, 0]
up = [0, 0, -1]
fov_y = 40
[background]
type = "horizon"
ground = 1
sky = 0.25
[materials.floor]
albedo = 0.5
[[quads]]
corner = [-1.2, 0, 1.2]
edge_u = [2.4, 0, 0]
edge_v = [0, 0, -2.4]
material = "floor"
[[lights]]
type = "beam"
position = [0, 3, 0]
direction = [0, -2, 0]
irradiance = 3.14159265
radius = 0.5
"""

SIGN = """
[settings]
size = [32, 32]
spp = 64
filter = "box"
[cameras.main]
position = [0, 0, 5]
target = [0, 0, 0]
fov_y = 40
[background]
type = "gradient"
bottom = 0
top = 1
[materials.sign]
kind = "retroreflector"
albedo = 0.5
[[boxes]]
low = [-9, -9, -1]
high = [9, 9, 0]
material = "sign"
"""


# The right half of a mirror is half worn. Both loops of the renderer shade it alike, with other textures and without.
WORN_SIGNS = """
from dataclasses import replace
import numpy as np, wrt
from wrt.core.device import load_kernel, start
from wrt.renderer.film import DeviceFilm, Work
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of, render_kernel
from wrt.renderer.prepare import prepare
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import quad

PART = (0, 0, 32, 32)
worn = Texture(np.uint8([[[0, 255, 255, 255], [255, 0, 0, 0]]]), srgb=False, wrap=("clamp", "clamp"))
sign = Material("mirror", albedo=(0.5, 0.5, 0.5), wear=0.5, wear_texture=worn)
sheet = replace(quad((-2, -2, 0), (4, 0, 0), (0, 4, 0)), uvs=np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]))
board = Object(quad((12, -1, 9), (2, 0, 0), (0, 2, 0)), (Material(albedo_texture=Checkerboard()),))
behind = np.diag([1.0, 1.0, 1.0, 1.0])
behind[2, 3] = -5.0

def film_of(ready):
    film = DeviceFilm(ready.plan.scene.settings, ready.plan.crop, ready.device, 0, 1)
    ready.launch(film)(Work(PART, 0, 4))
    return dict(film.arrays())["mean of group 0"].numpy().reshape(32, 32, 3)

for boards in (False, True):
    instances = boards  # each pair compiles kernels; neither feature reads the other
    signs = [Object(sheet, (sign,)), Object(sheet, (sign,), behind)][: 1 + instances]
    scene = Scene(objects=(*signs, *[board][: int(boards)]), background=ConstantBackground((1.0, 1.0, 1.0)),
                  cameras=(Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov_y=0.7),)).with_settings(size=(32, 32), filter="box")
    plan = plan_of(scene, Options(device="cpu", threads=1, instancing="always"))
    assert plan.features.parameter_textures and plan.features.instances == instances and plan.features.checkerboards == boards
    ready = prepare(plan, start("cpu"))
    kernel = render_kernel(plan.features, plan.structure)
    load_kernel(kernel, ready.device)
    by_waves, alone = film_of(ready), film_of(replace(ready, waves=None, kernels=[kernel]))
    assert ready.waves is not None and by_waves.tobytes() == alone.tobytes()
    assert (by_waves[:, :7] == 0.5).all() and (by_waves[:, 25:] == 0.25).all()
print("all of it works")
"""


A_CAMERA = """
import numpy as np, wrt
import cylinder

scene = wrt.load_scene("cylinder.toml")
(camera,) = scene.cameras
assert isinstance(camera, cylinder.CylinderCamera) and np.isclose(camera.fov_x, np.radians(200.0))
film = wrt.render(scene, aov=("depth",), threads=2)
angle = np.radians(200.0) * ((np.arange(40) + 0.5) / 40.0 - 0.5)
height = np.radians(200.0) * 0.5 * (0.5 - (np.arange(20) + 0.5) / 20.0)
x, z = np.sin(angle), -np.cos(angle)
expected = np.stack(np.broadcast_arrays(x[None], height[:, None], z[None]), axis=-1) / np.sqrt(1.0 + height**2)[:, None, None]
directions = wrt.camera_rays(camera, (40, 20))[1].reshape(20, 40, 3)
assert np.allclose(directions, expected, atol=1e-6)
assert np.allclose(film.aov["depth"], 3.0, rtol=1e-6)  # from the middle of a sphere
assert np.allclose(film.pixels[..., 0], 0.25, atol=1e-5)

import pickle

from docs.site.scene_format import scene_format
from wrt.scene.model import digest

(back,) = pickle.loads(pickle.dumps(scene)).cameras
assert digest(back) == digest(camera)
assert "### Cylinder camera" in scene_format()
print("all of it works")
"""

CYLINDER = """
[settings]
size = [40, 20]
spp = 4
[cameras.main]
type = "cylinder"
matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
fov_x = 200
[materials.glow]
albedo = 0
emission = 0.25
two_sided = true
[[spheres]]
center = [0, 0, 0]
radius = 3
material = "glow"
"""


def apply(copy: Path) -> None:
    """Apply the diffs of docs/extending.md. The old lines of a diff must occur exactly once in the file."""
    text = (ROOT / "docs" / "extending.md").read_text()
    blocks = BLOCK.findall(text)
    assert 2 * len(blocks) == text.count("```"), "a block names no file"
    for name, body in blocks:
        lines = body.splitlines()
        old = "\n".join(line[1:] for line in lines if line[:1] in (" ", "-")) + "\n"
        new = "\n".join(line[1:] for line in lines if line[:1] in (" ", "+")) + "\n"
        before = (copy / name).read_text()
        assert before.count("\n" + old) == 1, f"{name}: {old}"
        (copy / name).write_text(before.replace("\n" + old, "\n" + new))


def python(folder: Path, *arguments: str, path: Path | str = "") -> str:
    environment = {**os.environ, "PYTHONPATH": str(path or folder)}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_text_can_be_followed(tmp_path: Path) -> None:
    for folder in ("wrt", "kernels"):
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(EXTENSIONS / "structure", tmp_path, dirs_exist_ok=True)
    apply(tmp_path)
    for file in (ROOT / "tests" / "stored_normal.py", *(EXTENSIONS / f"{name}.py" for name in ("beam", "horizon", "retroreflector"))):
        shutil.copy(file, tmp_path)
    (tmp_path / "sign.toml").write_text(SIGN)
    (tmp_path / "stage.toml").write_text(STAGE)
    assert python(tmp_path, "-c", TRY_IT).endswith("all of it works\n")
    assert python(tmp_path, "-c", WORN_SIGNS).endswith("all of it works\n")
    (tmp_path / "sign.toml").write_text(SIGN.replace("retroreflector", "mirror"))
    python(tmp_path, "-m", "wrt", "render", "sign.toml", "-q", "--accel", "runs", "-o", "sign.png")
    assert (tmp_path / "sign.png").exists()


PYRAMID = "OFF\n5 5 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n.5 .5 1\n4 0 3 2 1\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3 3 0 4\n"
READ_IT = """
import wrt
from wrt.io.mesh_file import MESH_FORMATS, load_mesh, register_mesh_format

register_mesh_format(".pyramid", lambda path: MESH_FORMATS[".shape"](path))
for name in ("a.shape", "a.pyramid"):
    mesh = load_mesh(name)
    assert len(mesh.vertices) == 5 and len(mesh.faces) == 6
    assert len(wrt.load_scene(name).objects) == 1
try:
    load_mesh("broken.shape")
    raise AssertionError("it was read")
except wrt.InputError as error:
    assert str(error.path) == "broken.shape" and "corner" in error.what
try:
    load_mesh("a.obj2")
    raise AssertionError("it was read")
except wrt.InputError as error:
    assert ".npz, .obj, .off, .ply, .shape, .stl, .pyramid" in str(error)
print("all of it works")
"""


def test_a_mesh_format_is_one_file(tmp_path: Path) -> None:
    name = "wrt/io/meshes/shape.py"
    for folder in ("wrt", "kernels"):
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(EXTENSIONS / "shape.py", tmp_path / name)
    for file, text in (("a.shape", PYRAMID), ("a.pyramid", PYRAMID), ("broken.shape", PYRAMID.replace("3 3 0 4", "3 3 0 7"))):
        (tmp_path / file).write_text(text)
    assert python(tmp_path, "-W", "ignore", "-c", READ_IT).endswith("all of it works\n")
    assert "or a mesh: .npz, .obj, .off, .ply, .shape, .stl" in " ".join(python(tmp_path, "-m", "wrt", "render", "--help").split())


def test_a_camera_of_ones_own_needs_no_copy_of_the_project(tmp_path: Path) -> None:
    shutil.copy(EXTENSIONS / "cylinder.py", tmp_path)
    (tmp_path / "cylinder.toml").write_text(CYLINDER)
    assert python(tmp_path, "-c", A_CAMERA, path=ROOT).endswith("all of it works\n")


def test_a_package_adds_commands_measurements_and_structures(tmp_path: Path) -> None:
    """The package is installed as pip does it: the module, and a .dist-info folder with the entry points."""
    package = EXTENSIONS / "my_lab"
    shutil.copy(package / "my_lab.py", tmp_path)
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    installed = tmp_path / "my_lab-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    (installed / "entry_points.txt").write_text("".join(
        f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in rows.items())
        for group, rows in project["entry-points"].items()))
    (tmp_path / "pyramid.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")

    def command(*words: str) -> str:
        return python(tmp_path, "-m", "wrt", *words, path=f"{tmp_path}{os.pathsep}{ROOT}")

    assert "Print how many triangles SCENE has." in command("--help")
    assert command("triangles", "pyramid.obj") == "4\n"
    table = command("bench", "memory", "pyramid.obj")
    assert "| pyramid.obj |         bvh4 |" in table and "| pyramid.obj | small_leaves |" in table
    assert "small_leaves" not in command("bench", "memory", "pyramid.obj", "--quick").split("##")[0]
    assert command("build", "pyramid.obj", "--accel", "small_leaves", "-o", "pyramid.accel") == "pyramid.accel\n"
    loads = "import wrt; print(wrt.load_accel('pyramid.accel', 'pyramid.obj').name)"
    assert python(tmp_path, "-c", loads, path=f"{tmp_path}{os.pathsep}{ROOT}") == "small_leaves\n"
