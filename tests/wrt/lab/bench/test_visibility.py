"""Z-buffer against rays on whole pictures, the check that compares them, and the bench's arithmetic and report."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import data_path
from tests.device import NAME
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.core.errors import InputError
from wrt.lab.bench import visibility
from wrt.lab.bench.rasterizer import Rasterizer, RayCaster
from wrt.lab.bench.report import Row, run, text
from wrt.lab.bench.visibility import Plan, fit, fits, framing, row_of, series, subdivided, surfaces, terrain
from wrt.lab.bench.visibility_check import agreement, compare
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import box, icosphere, merged, prism, quad, teapot, torus

SIZE = (160, 120)
WIDE = math.radians(80.0)
PROCEDURAL = {
    "teapot": (lambda: teapot(48), None),
    "torus": (torus, None),
    "terrain": (lambda: terrain(60), Camera.look_at((0.1, 0.35, 0.9), (0.0, 0.0, -0.3), fov_y=WIDE)),
    "inside a ball": (lambda: icosphere(4), Camera.look_at((0.2, 0.1, -0.3), (1.0, 0.3, 0.5), fov_y=WIDE)),
    "on a ball's axis": (lambda: icosphere(4), Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))),
    "inside a box": (box, Camera.look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), fov_y=WIDE)),
    "boxes in boxes": (lambda: merged([box((-s,) * 3, (s,) * 3) for s in (0.5, 1.0, 2.0)], "boxes"), None),
}
DATA = {
    "meshes/small/cow.obj": None,
    "meshes/small/teapot.obj": None,
    "meshes/small/legocar.obj": None,
    "meshes/medium/stanford_bunny.ply": None,
    "meshes/medium/sponza_dabrovic.obj": ((-11.0, 6.0, 0.6), (10.0, 4.0, 0.0)),
    "meshes/large/conference_331k.ply": "inside",
}


def geometry_of(mesh: Mesh) -> Geometry:
    return Geometry(mesh.vertices.copy(), mesh.faces.copy(), np.zeros((0, 4), np.float32))


def checked(mesh: Mesh, camera: Camera, size: tuple[int, int] = SIZE) -> Row:
    """The z-buffer against the renderer's own AOVs."""
    scene = Scene(objects=(Object(replace(mesh, normals=None), (Material(),)),), cameras=(camera,))
    aov = wrt.render(scene, size=size, spp=1, max_depth=0, aov=("depth", "prim_id")).aov
    geometry = geometry_of(mesh)
    return compare(Rasterizer(geometry), aov["depth"], aov["prim_id"], geometry, camera, size)


def assert_agree(result: Row) -> None:
    assert result.covered > 0.01 * result.pixels
    assert result.unexplained == 0
    assert result.depth_share <= 1.0
    assert result.ties + result.silhouettes == result.differ


@pytest.mark.parametrize("name", PROCEDURAL)
def test_rays_and_z_buffer_see_the_same_on_procedural_scenes(name: str) -> None:
    make, camera = PROCEDURAL[name]
    mesh = make()
    result = checked(mesh, camera or framing(mesh))
    assert_agree(result)
    if name not in ("on a ball's axis", "inside a box"):  # these have edges through many centres
        assert result.differ <= 3


@pytest.mark.parametrize("name", DATA)
def test_rays_and_z_buffer_see_the_same_on_real_meshes(name: str) -> None:
    mesh, pose = wrt.load_mesh(data_path(name)), DATA[name]
    if pose == "inside":
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        pose = (low + [0.3, 0.4, 0.45] * (high - low), low + [0.8, 0.45, 0.55] * (high - low))
    result = checked(mesh, framing(mesh) if pose is None else Camera.look_at(*pose, fov_y=WIDE))
    assert_agree(result)
    assert result.differ <= 1e-3 * result.pixels


def test_the_ray_caster_gives_the_aovs_bit_for_bit() -> None:
    mesh, size = teapot(24), (70, 50)  # the last tiles are partial
    camera = framing(mesh)
    scene = Scene(objects=(Object(replace(mesh, normals=None), (Material(),)),), cameras=(camera,))
    aov = wrt.render(scene, size=size, spp=1, max_depth=0, aov=("depth", "prim_id")).aov
    for threads in (1, 3):
        caster = RayCaster(geometry_of(mesh), threads=threads)
        caster.draw(camera, size)
        np.testing.assert_array_equal(caster.depth(), aov["depth"])
        np.testing.assert_array_equal(caster.prim_id(), aov["prim_id"])


# --- the check itself: it must explain what is explained, and nothing else ----------------------------------------------

STRAIGHT = Camera(fov_y=math.pi / 2)


def sheet(side: float) -> Mesh:
    return quad((-side, -side, -1.0), (2.0 * side, 0.0, 0.0), (0.0, 2.0 * side, 0.0))


def test_edges_through_centres_are_ties_and_outlines_are_silhouettes() -> None:
    """A square whose outline and diagonal go through centres: rays take both ends of it, the fill rule takes one."""
    result = checked(sheet(4.0 / 8.0 + 1.0 / 16.0), STRAIGHT, (16, 16))
    assert_agree(result)
    # Rows and columns 3 to 12; the fill rule leaves the last of both out. Rays give the diagonal to triangle 0 throughout.
    assert result.covered == 81
    assert result.silhouettes == 19
    assert result.ties in (0, 9)


@cache
def ball() -> tuple[Geometry, Camera, np.ndarray, np.ndarray]:
    mesh = icosphere(4)
    geometry, camera = geometry_of(mesh), framing(mesh)
    caster = RayCaster(geometry)
    caster.draw(camera, (64, 64))
    return geometry, camera, caster.depth(), caster.prim_id()


def judged(depth: np.ndarray, prim_id: np.ndarray) -> Row:
    geometry, camera, *_ = ball()
    return compare(Rasterizer(geometry), depth, prim_id, geometry, camera, (64, 64))


def test_a_right_answer_has_nothing_to_explain() -> None:
    _, _, depth, prim_id = ball()
    result = judged(depth, prim_id)
    assert_agree(result)
    assert result.differ <= 2


@pytest.mark.parametrize("kind", ["lost", "through to the back", "invented", "wrong triangle"])
def test_a_wrong_answer_is_unexplained(kind: str) -> None:
    _, _, depth, prim_id = (array.copy() if isinstance(array, np.ndarray) else array for array in ball())
    before = judged(depth, prim_id)
    places = [(32, 32), (25, 40), (38, 30)]
    for row, column in places if kind != "invented" else [(0, 0), (1, 5), (2, 63)]:
        if kind == "lost":
            depth[row, column], prim_id[row, column] = np.inf, -1
        elif kind == "through to the back":  # what a ray that slips through the front would see
            depth[row, column], prim_id[row, column] = depth[row, column] + 1.5, 7
        elif kind == "invented":
            depth[row, column], prim_id[row, column] = 3.0, 11
        else:
            depth[row, column], prim_id[row, column] = depth[row, column] * 0.9, (prim_id[row, column] + 500) % 5120
    result = judged(depth, prim_id)
    assert result.unexplained == before.unexplained + 3
    assert result.depth_share <= 1.0


def test_a_depth_beyond_its_bound_is_told() -> None:
    _, _, depth, prim_id = ball()
    for factor, out_of_bound in ((1.0 + 1e-7, False), (1.0 + 1e-4, True)):
        off = depth.copy()
        off[32, 32] = depth[32, 32] * np.float32(factor)
        assert (judged(off, prim_id).depth_share > 1.0) is out_of_bound


def test_coincident_triangles_are_ties() -> None:
    mesh = sheet(0.9)
    twice = Geometry(mesh.vertices.copy(), np.concatenate([mesh.faces, mesh.faces]), np.zeros((0, 4), np.float32))
    caster = RayCaster(twice)
    caster.draw(STRAIGHT, (31, 31))
    assert set(np.unique(caster.prim_id())) == {-1, 0, 1}  # the lowest of equals
    other = np.where(caster.prim_id() >= 0, caster.prim_id() + 2, -1)
    result = compare(Rasterizer(twice), caster.depth(), other.astype(np.int32), twice, STRAIGHT, (31, 31))
    assert result.ties == result.differ == result.covered > 0
    assert result.unexplained == 0


def test_what_cannot_be_drawn_is_refused() -> None:
    spheres = Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.ones((2, 4), np.float32))
    with refused("geometry", "2 spheres"):
        Rasterizer(spheres)
    with refused("accel", "no structure 'kd'"):
        RayCaster(spheres, "kd")


def test_nothing_is_a_picture_without_hits() -> None:
    nothing = Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 4), np.float32))
    result = agreement(Rasterizer(nothing), RayCaster(nothing), nothing, STRAIGHT, (8, 4))
    assert (result.pixels, result.covered, result.differ, result.depth_error) == (32, 0, 0, 0.0)


# --- the bench's shapes and arithmetic ------------------------------------------------------------------------------------


def test_subdividing_keeps_the_surface_closed_and_its_area() -> None:
    mesh = merged([prism(5), icosphere(1)], "both")
    finer = subdivided(mesh)
    assert len(finer.faces) == 4 * len(mesh.faces)

    def area(m: Mesh) -> float:
        corner = m.vertices[m.faces].astype(np.float64)
        return float(np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2)

    assert area(finer) == pytest.approx(area(mesh), rel=1e-6)
    for m in (mesh, finer):
        directed = m.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        assert len(np.unique(directed, axis=0)) == len(directed)
        there = {tuple(edge) for edge in directed.tolist()}
        assert all((b, a) in there for a, b in there)


def test_surfaces_grow_to_the_limit_and_cover_the_same(tmp_path: Path) -> None:
    path = tmp_path / "box.obj"
    path.write_text(BOX_OBJ)
    first = {surface.name: surface for surface in surfaces(Plan(max_triangles=20_000))}
    assert [len(mesh.faces) for mesh in first["sphere"].meshes] == [1280, 5120]
    assert [len(mesh.faces) for mesh in first["terrain"].meshes] == [968, 3872, 15488]
    given, = surfaces(Plan(meshes=[path], max_triangles=1000))
    assert [len(mesh.faces) for mesh in given.meshes] == [12, 48, 192, 768]
    for surface in (*first.values(), given):
        covered = []
        for mesh in surface.meshes:
            rasterizer = Rasterizer(geometry_of(mesh))
            rasterizer.draw(surface.camera, (128, 128))
            covered.append((rasterizer.prim_id() >= 0).mean())
        assert min(covered) > 0.15
        assert max(covered) < 1.03 * min(covered)


def row(sweep: str, triangles: int, pixels: int, raster: float, cast: float, build: float = 1.0, surface: str = "s") -> Row:
    same = Row(pixels=pixels, covered=pixels // 2, differ=3, ties=2, silhouettes=1, unexplained=0, depth_error=1e-6,
               depth_share=0.3)
    return row_of((raster,) * 3, (cast,) * 3, (build,) * 2, same, sweep=sweep, surface=surface, triangles=triangles, pixels=pixels)


def test_fit_finds_the_exponent_of_a_power_and_its_uncertainty() -> None:
    n = np.array([1e3, 4e3, 1.6e4, 6.4e4, 2.56e5])
    found = fit(n, 3e-9 * n**0.7)
    assert found == {"exponent": pytest.approx(0.7), "error": pytest.approx(0.0, abs=1e-9), "last": pytest.approx(0.7)}
    # Against the textbook's variance of the slope, over many noisy sweeps.
    rng = np.random.default_rng(1)
    noisy = [fit(n, n**0.7 * np.exp(0.1 * rng.normal(size=5))) for _ in range(2000)]
    spread = np.std([f["exponent"] for f in noisy])
    assert np.mean([f["exponent"] for f in noisy]) == pytest.approx(0.7, abs=0.005)
    assert np.sqrt(np.mean([f["error"]**2 for f in noisy])) == pytest.approx(spread, rel=0.05)
    assert math.isnan(fit([1.0, 2.0], [1.0, 4.0])["error"])
    with pytest.raises(ValueError, match="two points"):
        fit([1.0], [1.0])


def test_fits_come_from_the_rows() -> None:
    rows = [row("triangles", n, 4096, 1e-8 * n, 1e-4 * math.log2(n)) for n in (64000, 1000, 4000, 16000)]
    rows += [row("pixels", 1000, n, 1e-5, 1e-8 * n) for n in (4096, 16384)]
    rows += [row("triangles", 1000, 4096, 1.0, 2.0, surface="alone")]
    assert [r.triangles for r in series(rows)["triangles", "s"]] == [1000, 4000, 16000, 64000]
    found = {(f["sweep"], f["cost"]): f for f in fits(rows)}
    assert set(found) == {(s, c) for s in ("triangles", "pixels") for c in ("raster", "cast")} | {("triangles", "build")}
    assert found["triangles", "raster"]["exponent"] == pytest.approx(1.0)
    assert found["pixels", "cast"]["exponent"] == pytest.approx(1.0)
    assert found["pixels", "raster"]["exponent"] == pytest.approx(0.0, abs=1e-12)
    assert 0.0 < found["triangles", "cast"]["exponent"] < 0.2
    assert rows[0].cast_and_build_over_raster == pytest.approx((1e-4 * math.log2(64000) + 1.0) / 64e-5)


def test_a_run_measures_both_sweeps_and_finds_no_difference_unexplained(tmp_path: Path) -> None:
    path = tmp_path / "ball.obj"
    mesh = icosphere(2)
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices.tolist())
                    + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces.tolist()))
    told: list[Row] = []
    plan = Plan(meshes=[path], size=48, max_size=130, max_triangles=1280, runs=2)
    rows = run(plan, told.extend)
    assert rows == told
    assert [(r.sweep, r.triangles, r.pixels) for r in rows] == [
        ("triangles", 320, 48**2), ("triangles", 1280, 48**2), ("pixels", 1280, 64**2), ("pixels", 1280, 128**2)]
    for r in rows:
        assert len(r.raster) == len(r.cast) == len(r.build) == 2
        assert min(r.raster + r.cast + r.build) > 0.0
        assert_agree(r.agreement)
    json.dumps([r.as_dict() for r in rows])


@pytest.mark.parametrize(("option", "value"), [("size", 0), ("max_size", 63), ("runs", 0), ("max_triangles", 0), ("threads", 0),
                                               ("accel", "kd"), ("device", "gpu")])
def test_a_plan_that_cannot_be_run_is_refused(option: str, value: object) -> None:
    with pytest.raises(InputError, match=str(value) if value != 63 else "max_size must be 64 to 16384, got 63"):
        Plan(**{option: value})


def test_the_tables_hold_what_was_measured() -> None:
    rows = [row("triangles", 1000, 4096, 0.002, 0.006), row("triangles", 4000, 4096, 0.003, 0.006)]
    page = text(rows, Plan(), "")
    lines = [line for line in page.splitlines() if line.startswith("| s ")]
    first = [cell.strip() for cell in lines[0].strip("|").split("|")]
    named = dict(zip(visibility.COLUMNS, first, strict=True))
    assert named["triangles"] == "1000" and named["covered"] == "50.0%" and named["raster ms"] == "2 [2, 2]"
    assert named["cast / raster"] == "3 [3, 3]" and named["(cast + build) / raster"] == "503" and named["build ms"] == "1e+03"
    assert (named["differ"], named["ties"], named["silhouettes"], named["unexplained"]) == ("3", "2", "1", "0")
    assert len({len(line) for line in page.splitlines() if line.startswith("| s ") and line.count("|") == 16}) == 1


# --- the command ----------------------------------------------------------------------------------------------------------

QUICK = ("bench", "visibility", "box.obj", "--size", 32, "--max-size", 64, "--max-triangles", 48, "--runs", 1)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    return tmp_path


def test_the_command_prints_tables_and_writes_a_report(folder: Path) -> None:
    result = command(*QUICK, "-o", "report.md")
    assert result.code == 0, result.err
    assert "## As triangles grow" in result.out and "| cast   | box.obj |" in result.out
    told = (folder / "report.md").read_text()
    assert "python -m wrt bench visibility box.obj --size 32 --max-size 64" in told


def test_the_command_prints_json(folder: Path) -> None:
    result = command(*QUICK, "--json", "-q")
    assert result.code == 0 and result.err == ""
    facts = json.loads(result.out)
    assert [r["triangles"] for r in facts["rows"]] == [12, 48, 48]
    assert all(r["agreement"]["unexplained"] == 0 for r in facts["rows"])
    assert {f["cost"] for f in facts["exponents"]} == {"raster", "cast", "build"}
    assert {f["surface"] for f in facts["exponents"]} == {"box.obj"} and ("threads" if NAME == "cpu" else NAME) in facts["machine"]


@pytest.mark.parametrize(("arguments", "message"), [
    (("nothing.obj",), "nothing.obj"),
    (("box.obj", "-o", "box.obj"), "box.obj"),
    (("box.obj", "-o", "no/folder.md"), "no/folder"),
    (("--accel", "kd"), "no structure 'kd'"),
    (("--device", "gpu"), "no device 'gpu'"),
])
def test_mistakes_get_one_message(folder: Path, arguments: tuple[str, ...], message: str) -> None:
    result = command("bench", "visibility", *arguments)
    assert result.code == 2
    assert len(result.errors) == 1 and message in result.errors[0]
