"""The z-buffer: coverage against exact arithmetic, the fill rule, triangles through the camera, and independence of order."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, launch, zeros  # Before warp: it silences Warp's banner.
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.kernels.structs import kernel
from wrt.kernels.study import rasterize as kernels
from wrt.lab.bench.rasterizer import NOTHING, Rasterizer, directions_from_pixels, view_struct
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import Camera, FisheyeCamera
from wrt.scene.shapes import box, icosphere

import warp as wp  # isort: skip

# tan(fov / 2) = 1: if width and height are powers of two, all of the camera's numbers are exact.
STRAIGHT = Camera(fov_y=math.pi / 2)
TURNED = Camera.look_at((0.3, -0.2, 0.7), (1.1, 0.4, -2.0), up=(0.1, 1.0, 0.2), fov_y=1.1)


def geometry(triangles) -> Geometry:
    """Return triangles (N, 3 corners, 3) as a Geometry without shared vertices."""
    vertices = np.asarray(triangles, np.float32).reshape(-1, 3)
    return Geometry(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), np.zeros((0, 4), np.float32))


def origin_of(camera: Camera) -> np.ndarray:
    """Return the float32 position that the device gets, as (3,) float64."""
    return np.array(list(camera_struct(camera, (1, 1)).origin), np.float64)


def draw(what: Geometry, camera: Camera, size, threads=1) -> tuple[np.ndarray, np.ndarray]:
    rasterizer = Rasterizer(what, threads=threads)
    rasterizer.draw(camera, size)
    return rasterizer.depth(), rasterizer.prim_id()


def counts(what: Geometry, camera: Camera, size) -> np.ndarray:
    """Return how many triangles cover each pixel, by drawing each triangle alone."""
    total = np.zeros((size[1], size[0]), int)
    for face in what.faces:
        total += draw(Geometry(what.vertices, face[None].copy(), what.spheres), camera, size)[1] == 0
    return total


def at_pixels(camera: Camera, size, places, distance) -> np.ndarray:
    """Return the world points (N, 3), float32, at the picture points `places` (N, 2) in pixels and a distance along the axis."""
    d = np.column_stack([places, np.ones(len(places))]) @ directions_from_pixels(camera, size).T
    return (origin_of(camera) + d * np.reshape(distance, (-1, 1))).astype(np.float32)


def exact_answer(triangle, camera: Camera, size, column: int, row: int):
    """Return 1 if a pixel's centre is inside, -1 outside, 0 on or too near an edge; and the depth along d."""
    matrix = directions_from_pixels(camera, size)
    point = (Fraction(2 * column + 1, 2), Fraction(2 * row + 1, 2), Fraction(1))
    d = [sum(Fraction(float(m)) * x for m, x in zip(line, point, strict=True)) for line in matrix]
    origin = [Fraction(x) for x in origin_of(camera).tolist()]
    corners = [[Fraction(float(x)) - o for x, o in zip(corner, origin, strict=True)] for corner in triangle]

    def det(a, b, c):
        return (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]))

    areas = [det(d, corners[(i + 1) % 3], corners[(i + 2) % 3]) for i in range(3)]
    largest = max(abs(area) for area in areas)
    if any(abs(area) <= largest * Fraction(1, 10**11) for area in areas):
        return 0, None
    if min(areas) < 0 < max(areas):
        return -1, None
    depth = det(*corners) / sum(areas)
    return (1 if depth > 0 else -1), float(depth) * math.sqrt(float(sum(x * x for x in d)))


def random_triangles(kind: str, rng: np.random.Generator, n: int) -> np.ndarray:
    if kind == "ahead":
        return rng.uniform(-2.0, 2.0, (n, 3, 3)) + [0.0, 0.0, -3.0]
    if kind == "around":  # Many triangles cross the plane of the camera.
        return rng.uniform(-3.0, 3.0, (n, 3, 3))
    if kind == "huge":
        return rng.uniform(-1.0, 1.0, (n, 3, 3)) * 10.0 ** rng.uniform(0.0, 30.0, (n, 1, 1))
    if kind == "slivers":
        ends = rng.uniform([[-4.0, -2.0, -4.0], [1.0, -2.0, -4.0]], [[-1.0, 2.0, -2.0], [4.0, 2.0, -2.0]], (n, 2, 3))
        return np.concatenate([ends, ends.mean(axis=1, keepdims=True) + 0.3 * rng.normal(size=(n, 1, 3))], axis=1)
    raise ValueError(kind)


@pytest.mark.parametrize("camera", [STRAIGHT, TURNED], ids=["straight", "turned"])
@pytest.mark.parametrize("kind", ["ahead", "around", "huge", "slivers"])
def test_coverage_and_depth_are_those_of_exact_arithmetic(kind: str, camera: Camera) -> None:
    n, size, decided, covered = 14, (11, 7), 0, 0
    for triangle in random_triangles(kind, np.random.default_rng(5), n).astype(np.float32):
        depth, prim_id = draw(geometry(triangle), camera, size)
        for row in range(size[1]):
            for column in range(size[0]):
                inside, truth = exact_answer(triangle, camera, size, column, row)
                if inside:
                    decided += 1
                    covered += inside > 0
                    assert prim_id[row, column] == (0 if inside > 0 else -1)
                if inside > 0:
                    assert abs(depth[row, column] - truth) <= 0.51 * np.spacing(np.float32(truth))
    assert decided > 0.95 * n * size[0] * size[1] and covered > 3


def test_the_fill_rule_counts_a_right_triangle_as_top_left() -> None:
    """The diagonal passes through n centres. A triangle above or left of it owns them: n (n + 1) / 2 pixels, else n (n - 1) / 2."""
    n = 8
    corner = np.array([[0.0, 0.0], [n, 0.0], [0.0, n], [n, n]])
    for triangle, area in (((0, 1, 2), n * (n - 1) // 2), ((3, 1, 2), n * (n + 1) // 2)):
        points = at_pixels(STRAIGHT, (16, 16), corner[list(triangle)] + 4.0, 1.0)
        prim_id = draw(geometry([points]), STRAIGHT, (16, 16))[1]
        assert (prim_id == 0).sum() == area
    # The diagonal from top left to bottom right is the left edge of the triangle on its right.
    for triangle, area in (((0, 1, 3), n * (n + 1) // 2), ((0, 3, 2), n * (n - 1) // 2)):
        points = at_pixels(STRAIGHT, (16, 16), corner[list(triangle)] + 4.0, 1.0)
        assert (draw(geometry([points]), STRAIGHT, (16, 16))[1] == 0).sum() == area


def test_a_quad_from_centre_to_centre_has_its_top_and_left_sides() -> None:
    points = at_pixels(STRAIGHT, (16, 16), np.array([[2.5, 3.5], [9.5, 3.5], [9.5, 12.5], [2.5, 12.5]]), 1.0)
    quad = Geometry(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros((0, 4), np.float32))
    prim_id = draw(quad, STRAIGHT, (16, 16))[1]
    expected = np.zeros((16, 16), bool)
    expected[3:12, 2:9] = True
    np.testing.assert_array_equal(prim_id >= 0, expected)


@pytest.mark.parametrize("flip", [False, True], ids=["front", "back"])
@pytest.mark.parametrize("camera", [STRAIGHT, TURNED], ids=["exact", "rounded"])
def test_each_centre_on_shared_edges_and_corners_is_covered_once(camera: Camera, flip: bool) -> None:
    """The corners of a sheet are at pixel centres, at many distances. In the turned camera, rounding moves them off the centres."""
    n, size = 7, (16, 16)
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    places = np.column_stack([x.ravel(), y.ravel()]) * 2.0 + 0.5
    points = at_pixels(camera, size, places, 2.0 ** rng.integers(-2, 3, len(places)))
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    a, b, c, d = corner, corner + 1, corner + n + 2, corner + n + 1
    other = rng.random(len(a)) < 0.5  # Chooses the diagonal of each square.
    faces = np.concatenate([np.where(other[:, None], np.column_stack(p), np.column_stack(q))
                            for p, q in (((a, b, c), (a, b, d)), ((a, c, d), (b, c, d)))])
    sheet = Geometry(points, (faces[:, ::-1] if flip else faces).astype(np.int32).copy(), np.zeros((0, 4), np.float32))
    total = counts(sheet, camera, size)
    assert (total[1:14, 1:14] == 1).all()  # Inside the outline.
    assert total.max() == 1
    if camera is STRAIGHT:  # The corners are exact: only top and left sides of the outline are covered.
        expected = np.zeros(total.shape, int)
        expected[0:14, 0:14] = 1
        np.testing.assert_array_equal(total, expected)


@pytest.mark.parametrize("camera", [STRAIGHT, TURNED], ids=["exact", "rounded"])
def test_one_triangle_of_a_fan_owns_its_middle(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    for n in range(3, 24):
        angle = np.sort(rng.random(n)) * 2.0 * np.pi
        if np.ptp(np.append(angle, angle[0] + 2.0 * np.pi)) > 0.0 and np.diff(np.append(angle, angle[0] + 2.0 * np.pi)).max() > 3.1:
            continue  # The middle is outside the picture.
        ring = 4.5 + 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
        points = at_pixels(camera, (8, 8), np.concatenate([[[4.5, 4.5]], ring]), rng.uniform(0.5, 4.0, n + 1))
        i = np.arange(n)
        fan = Geometry(points, np.column_stack([0 * i, i + 1, (i + 1) % n + 1]).astype(np.int32), np.zeros((0, 4), np.float32))
        assert counts(fan, camera, (8, 8))[4, 4] == 1


def test_no_pixel_is_lost_inside_a_closed_mesh_with_corners_at_the_centres() -> None:
    """A ball surrounds the camera, whose picture has 256 pixels. Every visible corner is moved onto a pixel's centre."""
    size = (16, 16)
    for camera in (STRAIGHT, TURNED):
        ball = icosphere(4)
        points = ball.vertices.astype(np.float64) * 3.0
        to_pixels = np.linalg.inv(directions_from_pixels(camera, size))
        p = points @ to_pixels.T
        seen = p[:, 2] > 0.3
        places = np.floor(p[seen, :2] / p[seen, 2:]) + 0.5
        moved = points + origin_of(camera)
        moved[seen] = at_pixels(camera, size, places, p[seen, 2])
        _, prim_id = draw(Geometry(moved.astype(np.float32), ball.faces, np.zeros((0, 4), np.float32)), camera, size)
        assert (prim_id >= 0).all()


def test_a_plane_through_the_camera_ends_at_the_horizon() -> None:
    """A triangle at y = -1 extends far beyond the view on all sides of the camera. Its depth below the horizon is 1 / -d_y."""
    size = (64, 64)
    floor = geometry([[[-1e4, -1.0, 2e4], [2e4, -1.0, 0.0], [-1e4, -1.0, -2e4]]])
    depth, prim_id = draw(floor, STRAIGHT, size)
    assert (prim_id[:32] == -1).all() and (prim_id[32:] == 0).all()
    x, y = np.meshgrid((np.arange(64) + 0.5) / 32 - 1.0, 1.0 - (np.arange(64) + 0.5) / 32)
    truth = np.sqrt(x**2 + y**2 + 1.0)[32:] / -y[32:]
    assert (np.abs(depth[32:] - truth) <= 0.51 * np.spacing(truth.astype(np.float32))).all()
    assert np.isinf(depth[:32]).all()


def test_a_box_around_the_camera_fills_the_picture() -> None:
    """The camera is at the cube's centre: the largest component of the direction determines the depth."""
    camera = Camera.look_at((0.0, 0.0, 0.0), (1.0, 0.7, -0.4), fov_y=2.5)
    size = (40, 24)
    depth, prim_id = draw(Geometry.of(box((-2.0,) * 3, (2.0,) * 3)), camera, size)
    assert (prim_id >= 0).all()
    column, row = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    d = np.stack([column, row, np.ones_like(row)], axis=-1) @ directions_from_pixels(camera, size).T
    truth = 2.0 * np.linalg.norm(d, axis=-1) / np.abs(d).max(axis=-1)
    np.testing.assert_allclose(depth, truth, rtol=2.0**-23)


@pytest.mark.parametrize(("name", "triangle"), [
    ("behind", [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]]),
    ("edge-on", [[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, -3.0]]),
    ("edge-on through the camera's plane", [[0.25, 0.25, -1.0], [0.25, 1.0, -1.0], [-0.25, 0.5, 1.0]]),
    ("in the camera's plane", [[0.5, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0]]),
    ("collinear", [[-1.0, -1.0, -2.0], [0.0, 0.0, -2.0], [1.0, 1.0, -2.0]]),
    ("a point", [[0.0625, 0.0625, -1.0]] * 3),
    ("repeated", [[-1.0, 0.0625, -1.0], [1.0, 0.0625, -1.0], [1.0, 0.0625, -1.0]]),
    ("beside the picture", [[1.5, -1.0, -1.0], [3.0, -1.0, -1.0], [3.0, 1.0, -1.0]]),
])
def test_what_is_never_seen(name: str, triangle) -> None:
    for size in ((16, 16), (15, 15)):
        assert (draw(geometry([triangle]), STRAIGHT, size)[1] == -1).all()


def test_triangles_without_area_are_not_seen_though_rounding_gives_them_some() -> None:
    """The corners are on the picture's diagonal, which goes through centres. Projection moves them off the line by a last digit."""
    rng = np.random.default_rng(6)
    along = rng.uniform(-1.0, 1.0, (500, 3, 1))
    what = geometry(along * [1.0, 1.0, 0.0] - [0.0, 0.0, 1.0])
    assert (draw(what, Camera(fov_y=1.9), (15, 15))[1] == -1).all()


def test_a_triangle_through_the_camera_itself_is_at_depth_0() -> None:
    depth, prim_id = draw(geometry([[[0.25, -1.0, -1.0], [0.25, 1.0, -1.0], [-0.25, 0.0, 1.0]]]), STRAIGHT, (16, 16))
    assert (prim_id == 0).all() and (depth == 0.0).all()


@pytest.mark.parametrize("exponent", [-100, -40, 40, 100])
def test_scaling_by_a_power_of_two_scales_the_depth_alone(exponent: int) -> None:
    scale = np.float32(2.0**exponent)
    camera = Camera.look_at((0.0, 0.0, 0.0), (0.2, 0.1, -1.0), fov_y=1.4)
    ball = icosphere(3)
    ball_ahead = (ball.vertices * 0.8 + np.float32([0.2, 0.1, -1.2])).astype(np.float32)
    depth, prim_id = draw(Geometry(ball_ahead, ball.faces, np.zeros((0, 4), np.float32)), camera, (48, 40))
    scaled, scaled_id = draw(Geometry(ball_ahead * scale, ball.faces, np.zeros((0, 4), np.float32)), camera, (48, 40))
    assert (prim_id >= 0).any()
    np.testing.assert_array_equal(prim_id, scaled_id)
    np.testing.assert_array_equal(depth * scale, scaled)


def test_tiny_triangles_are_found_by_the_centre_they_are_around() -> None:
    """A triangle of 1e-3 pixels around a centre covers only that pixel. Moved by half a pixel, it covers none."""
    size = (32, 32)
    for camera in (STRAIGHT, TURNED):
        place = np.array([[13.5, 20.5]]) + 1e-3 * np.array([[-1.0, -0.7], [1.2, -0.8], [0.1, 1.0]])
        prim_id = draw(geometry([at_pixels(camera, size, place, 1.0)]), camera, size)[1]
        assert np.argwhere(prim_id == 0).tolist() == [[20, 13]]
        assert (draw(geometry([at_pixels(camera, size, place + 0.5, 1.0)]), camera, size)[1] == -1).all()


def soup(n: int) -> Geometry:
    rng = np.random.default_rng(8)
    centre = rng.uniform(-4.0, 4.0, (n, 1, 3))
    return geometry(centre + rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-2.5, -0.5, (n, 1, 1)))


def test_the_order_of_triangles_does_not_matter() -> None:
    what, size = soup(3000), (70, 50)
    depth, prim_id = draw(what, TURNED, size)
    assert 100 < len(np.unique(prim_id))
    order = np.random.default_rng(1).permutation(len(what.faces))
    other_depth, other_id = draw(Geometry(what.vertices, what.faces[order].copy(), what.spheres), TURNED, size)
    np.testing.assert_array_equal(depth, other_depth)
    np.testing.assert_array_equal(prim_id, np.where(other_id >= 0, order[other_id], -1))  # No two triangles have the same depth.


def test_at_equal_depth_the_lowest_prim_id_wins() -> None:
    triangle = [[-9.0, -9.0, -2.0], [9.0, -9.0, -2.0], [0.0, 9.0, -2.0]]
    nearer = [[-9.0, -9.0, -1.0], [0.0, -9.0, -1.0], [0.0, 9.0, -1.0]]
    prim_id = draw(geometry([triangle, triangle, nearer, triangle, nearer]), STRAIGHT, (8, 8))[1]
    assert set(np.unique(prim_id)) == {0, 2}


@pytest.mark.parametrize("threads", [2, 5, 64])
def test_threads_do_not_change_a_pixel(threads: int) -> None:
    what = soup(2000)
    for size in ((70, 50), (3, 1), (1, 9)):
        for expected, found in zip(draw(what, TURNED, size, 1), draw(what, TURNED, size, threads), strict=True):
            np.testing.assert_array_equal(expected, found)


def test_the_launch_for_cuda_gives_the_same_picture() -> None:
    """One launch has all bands, with every triangle in each band. The test runs it on the CPU, in one thread."""
    what, size = soup(500), (70, 50)
    rasterizer = Rasterizer(what)
    rasterizer.draw(TURNED, size)
    expected = rasterizer.keys.numpy().copy()
    rasterizer.keys.fill_(NOTHING)
    rasterizer._launch(view_struct(TURNED, size), (4, 500), rasterizer.all, 0, 16)
    np.testing.assert_array_equal(expected, rasterizer.keys.numpy())


@kernel
def turns(p: wp.array(dtype=wp.vec2d), q: wp.array(dtype=wp.vec2d), out: wp.array(dtype=wp.float64)):
    tid = wp.tid()
    out[tid] = kernels.turn(p[tid], q[tid])


def test_turn_has_the_exact_sign() -> None:
    """In many cases both products round to the same number: q is a multiple of p except for the last digits."""
    rng = np.random.default_rng(4)
    p = rng.normal(size=(4000, 2)) * 10.0 ** rng.uniform(-20.0, 20.0, (4000, 1))
    q = p * rng.normal(size=(4000, 1))
    q[::4] = p[::4] * 3.0 * 2.0 ** rng.integers(-30, 30, (1000, 1))  # Almost collinear.
    q[1::4] = p[1::4] * 0.5  # Exactly collinear.
    q[2::4] *= 1.0 + 2.0**-52 * rng.integers(-1, 2, (1000, 2))
    out = zeros(4000, wp.float64)
    launch(turns, 4000, *(wp.array(rows, dtype=wp.vec2d, device=DEVICE) for rows in (p, q)), out)
    back = zeros(4000, wp.float64)
    launch(turns, 4000, *(wp.array(rows, dtype=wp.vec2d, device=DEVICE) for rows in (q, p)), back)
    np.testing.assert_array_equal(out.numpy(), -back.numpy())
    exact = np.array([int(np.sign(Fraction(a) * Fraction(d) - Fraction(b) * Fraction(c)))
                      for (a, b), (c, d) in zip(p.tolist(), q.tolist(), strict=True)])
    np.testing.assert_array_equal(np.sign(out.numpy()), exact)
    rounded = np.sign(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    assert (rounded != exact).sum() > 100 and (exact == 0).sum() >= 1000  # The cases are hard.


def test_kernels_compile_for_turing_and_hopper(tmp_path: Path) -> None:
    for each in (kernels.project, kernels.bound, kernels.rasterize):
        binaries = wp.compile_aot_module(each.module, arch=[75, 90], module_dir=tmp_path)
        assert [Path(binary).stat().st_size > 5_000 for binary in binaries] == [True, True]


def test_only_a_perspective_camera_can_be_rasterized():
    mesh = icosphere(1)
    ball = Geometry(mesh.vertices, mesh.faces, np.zeros((0, 4), np.float32))
    with refused(what="fisheye", place="camera 'sky'"):
        Rasterizer(ball).draw(FisheyeCamera(name="sky"), (8, 8))
