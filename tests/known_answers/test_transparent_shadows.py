"""Shadow rays through transparent surfaces, in pictures with a known answer."""

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, launch, zeros  # isort: skip (starts Warp)
import warp as wp

import wrt
from tests.fresnel import fresnel
from wrt.core.device import upload
from wrt.kernels.shade.shadows import MAX_TRANSPARENT, is_opaque
from wrt.kernels.structs import Material as MaterialRecord
from wrt.kernels.structs import kernel
from wrt.renderer.render import render
from wrt.renderer.upload import TextureTable, material_records
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad
from wrt.scene.values import Color

pytestmark = pytest.mark.filterwarnings("ignore:the picture is all black")  # Some pictures must be black.

ONE: Color = (1.0, 1.0, 1.0)
WHITE = Material(albedo=ONE)
FLOOR = Object(quad((-10, 0, 10), (20, 0, 0), (0, 0, -20)), (WHITE,))
SUN = DirectionalLight((0.6, -0.8, 0.0), (np.pi,) * 3)
SIGMA = {"absorption": (0.5, 0.1, 0.9)}
# Distant objects with the features of all tests, so that the tests share a kernel.
EXTRA = tuple(Object(quad((1e4, i, 0), (1, 0, 0), (0, 1, 0)), (material,)) for i, material in enumerate(
    (Material("glass", alpha_mode="blend", **SIGMA), Material("glass", thin=True), Material(alpha_mode="mask"))))


def lit(*objects, light=SUN, shadows="opaque"):
    """Return the radiance of a white floor below the objects, and the render's statistics."""
    scene = Scene(objects=(FLOOR, *objects, *EXTRA), lights=(light,),
                  cameras=(Camera.look_at((0.0, 0.5, 0.8), (0.0, 0.0, 0.0), fov_y=0.01),),
                  settings=Settings(size=(2, 2), spp=1, filter="box", glass_shadows=shadows, max_depth=0))
    film = render(scene)
    return film.pixels.mean(axis=(0, 1), dtype=np.float64), film.stats


def pane(material, y=1.0):
    return Object(quad((-10, y, 10), (20, 0, 0), (0, 0, -20)), (material,))


def block(material, low=1.0, high=1.5):
    return Object(box((-10.0, low, -10.0), (10.0, high, 10.0)), (material,))


@pytest.mark.parametrize("count", [1, 12, 256, 257])
def test_panes_of_alpha_0_shade_nothing_up_to_a_number_that_is_counted(count):
    clear = Material(alpha=0.0, alpha_mode="blend")
    lamp = PointLight((0.0, 3.0, 0.0), (9.0 * np.pi,) * 3)
    value, stats = lit(*(pane(clear, y) for y in np.linspace(1.0, 2.0, count)), light=lamp)
    there = count <= MAX_TRANSPARENT
    assert np.allclose(value, float(there), rtol=1e-3)
    assert stats["cut_by_depth"] == (0 if there else stats["samples"])
    assert stats["lost_throughput_per_sample"] == pytest.approx(float(not there))  # A white floor reflects all of the lost light.


@pytest.mark.parametrize("count", [0, 3, 255, 256])
def test_an_opaque_pane_behind_clear_ones_is_counted_as_one_more(count):
    """The ray that hits the opaque pane counts. Behind MAX_TRANSPARENT panes the shadow ray is cut."""
    clear = Material(alpha=0.0, alpha_mode="blend")
    lamp = PointLight((0.0, 3.0, 0.0), ONE)
    value, stats = lit(*(pane(clear, y) for y in np.linspace(1.0, 2.0, count)), pane(WHITE, 2.5), light=lamp)
    assert not value.any() and stats["rays"] == stats["samples"] * (1 + count + 1)
    assert stats["cut_by_depth"] == (stats["samples"] if count == MAX_TRANSPARENT else 0)


@pytest.mark.parametrize("shadows", ["opaque", "tinted"])
@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_the_shadow_of_blended_solid_glass_is_that_with_and_without_it(shadows, alpha):
    without, opaque = lit(shadows=shadows)[0], lit(block(Material("glass", albedo=ONE, **SIGMA)), shadows=shadows)[0]
    assert (opaque < 0.9 * without).all() and (opaque.any() == (shadows == "tinted"))
    value, _ = lit(block(Material("glass", albedo=ONE, alpha=alpha, alpha_mode="blend", **SIGMA)), shadows=shadows)
    assert np.allclose(value, (1.0 - alpha) * without + alpha * opaque, rtol=1e-5)


def test_a_light_within_blended_glass_shines_out_through_one_face_or_none():
    lamp = PointLight((0.0, 1.25, 0.0), (1.5625 * np.pi,) * 3)
    glass = {"albedo": (1.0, 0.5, 1.0), "absorption": (0.0, 0.0, 2.0)}
    without = lit(light=lamp, shadows="tinted")[0]
    opaque = lit(block(Material("glass", **glass)), light=lamp, shadows="tinted")[0]
    assert np.allclose(opaque, 0.96 * np.array([1.0, 0.5, np.exp(-0.5)]), rtol=2e-3)
    value, _ = lit(block(Material("glass", alpha=0.4, alpha_mode="blend", **glass)), light=lamp, shadows="tinted")
    assert np.allclose(value, 0.6 * without + 0.4 * opaque, rtol=1e-5)


def test_absorption_goes_on_behind_a_pane_within_the_glass():
    # A clear pane divides the shadow ray's path through the block. The absorption must be that of the whole path.
    glass = Material("glass", albedo=ONE, ior=1.0, **SIGMA)
    whole, _ = lit(block(glass), shadows="tinted")
    cut, _ = lit(block(glass), pane(Material(alpha=0.0, alpha_mode="blend"), 1.2), shadows="tinted")
    assert np.allclose(whole, np.exp(-np.array(SIGMA["absorption"]) * 0.5 / 0.8) * 0.8, rtol=1e-4)
    assert np.allclose(cut, whole, rtol=1e-4)


@pytest.mark.parametrize("mode", ["opaque", "mask"])
def test_alpha_lets_no_light_through_what_is_not_blended(mode):
    assert not lit(pane(Material(alpha=0.7, alpha_mode=mode)))[0].any()


def test_layers_of_blended_surfaces_multiply():
    layers = [pane(Material(alpha=alpha, alpha_mode="blend"), 1.0 + alpha) for alpha in (0.25, 0.5)]
    assert np.allclose(lit(*layers)[0], 0.8 * 0.75 * 0.5, rtol=1e-5)


@kernel
def opaque_kernel(materials: wp.array(dtype=MaterialRecord), out: wp.array(dtype=wp.bool)):
    out[wp.tid()] = is_opaque(materials[wp.tid()])


KINDS = [("diffuse", {}), ("mirror", {}), ("conductor", {}), ("glass", {}), ("glass", {"thin": True}), ("metallic_roughness", {}),
         ("metallic_roughness", {"transmission": 0.01})]


@pytest.mark.parametrize("alpha_mode", ["opaque", "mask", "blend"])
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_opaque_is_what_leaves_the_floor_below_it_dark(kind, alpha_mode):
    """The shadow ray meets the pane from either side."""
    materials = [Material(name, alpha_mode=alpha_mode, alpha=0.5, alpha_cutoff=0.1, **fields) for name, fields in KINDS]
    out = zeros(len(KINDS), wp.bool)
    launch(opaque_kernel, len(KINDS), upload(material_records(tuple(materials), TextureTable()), MaterialRecord, DEVICE), out)
    opaque = out.numpy()
    assert opaque.any() == (alpha_mode != "blend") and not opaque.all()
    far = [Object(quad((1e4, 10 + i, 0), (1, 0, 0), (0, 1, 0)), (Material(name, **fields),))  # Features of all kinds, as EXTRA has.
           for i, (name, fields) in enumerate(KINDS)]
    below = Object(quad((-10, 1, 10), (0, 0, -20), (20, 0, 0)), (materials[kind],))
    for sheet in (pane(materials[kind]), below):
        assert lit(sheet, *far, shadows="tinted")[0].any() != opaque[kind]


# --- glass ------------------------------------------------------------------------------------------------------------


def transmittance(glass, angle, shadows):
    """Return the transmittance of a pane or block for green, in parallel light at this angle to its normal."""
    light = DirectionalLight((np.sin(angle), -np.cos(angle), 0.0), (np.pi,) * 3)
    body = pane(glass) if glass.thin else block(glass)
    return lit(body, light=light, shadows=shadows)[0][1] / lit(light=light, shadows=shadows)[0][1]


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 80.0])
def test_solid_glass_tints_by_both_faces_and_the_way_between(degrees):
    # 60 and 80 degrees are beyond the critical angle. The unbent ray must not be totally reflected at the exit.
    angle = np.radians(degrees)
    glass = Material("glass", albedo=(1.0, 0.8, 1.0), absorption=(0.0, 0.7, 0.0))
    expected = (0.8 * (1.0 - fresnel(np.cos(angle), 1.5))) ** 2 * np.exp(-0.7 * 0.5 / np.cos(angle))
    assert transmittance(glass, angle, "tinted") == pytest.approx(expected, rel=1e-4)


def test_solid_glass_is_opaque_to_shadow_rays_by_default():
    assert transmittance(Material("glass"), 0.5, "opaque") == 0.0


@pytest.mark.parametrize("degrees", [0.0, 70.0])
def test_a_thin_pane_always_lets_light_through(degrees):
    angle = np.radians(degrees)
    r = fresnel(np.cos(angle), 1.5)
    expected = 0.8 * (1.0 - 2.0 * r / (1.0 + r))
    glass = Material("glass", albedo=(1.0, 0.8, 1.0), thin=True)
    assert np.isclose(transmittance(glass, angle, "opaque"), expected, rtol=1e-4)


def test_absorption_counts_from_where_the_camera_stands_in_the_glass():
    ball = Sphere((0, 0, 0), 2.0, Material("glass", albedo=(1, 1, 1), ior=1.0, absorption=(1.0, 1.0, 1.0)))
    inner = Sphere((0, 0, 0), 1.0, Material("glass", albedo=(1, 1, 1), ior=1.0))
    white = {"background": ConstantBackground((1, 1, 1)), "settings": Settings(filter="box")}
    within = Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=0.01)
    outside = Camera.look_at((0, 0, 9), (0, 0, 0), fov_y=0.01)
    seen = render(Scene(spheres=(ball,), cameras=(within,), **white), spp=1, size=(2, 2)).pixels.mean()
    assert seen == pytest.approx(np.exp(-2.0), rel=1e-4)
    # With a clear ball of radius 1 inside, the ray is in the absorbing glass for a length of 1 on each side.
    seen = render(Scene(spheres=(ball, inner), cameras=(outside,), **white), spp=1, size=(2, 2)).pixels.mean()
    assert seen == pytest.approx(np.exp(-2.0), rel=1e-3)


SIZE = 40.0


def floor_under(pane: wrt.Object, degrees: float) -> float:
    """Return the mean radiance of a white floor that a directional light reaches only through the pane."""
    floor = wrt.Object(quad((-SIZE, 0.0, SIZE), (2 * SIZE, 0.0, 0.0), (0.0, 0.0, -2 * SIZE)), wrt.Material(albedo=(1.0, 1.0, 1.0)))
    way = np.array([np.sin(np.radians(degrees)), -np.cos(np.radians(degrees)), 0.0])
    scene = wrt.Scene((floor, pane), lights=(wrt.DirectionalLight(tuple(way), (1.0, 1.0, 1.0)),),
                      cameras=(wrt.Camera.look_at((0.0, 0.5, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), fov_y=0.5),),
                      settings=wrt.Settings(size=(4, 4), spp=4, glass_shadows="tinted"))
    film = wrt.render(scene)
    assert film.pixels.std() < 1e-5
    return float(film.pixels.mean())


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("degrees", [5.0, 40.0, 75.0])
def test_a_coat_takes_its_share_at_the_angle_of_the_ray(solid: bool, degrees: float) -> None:
    """Where light leaves solid glass it meets no coat, so that a slab takes as much as a pane."""
    clear = {"kind": "metallic_roughness", "transmission": 1.0, "albedo": (1.0, 1.0, 1.0), "thin": not solid}
    mesh = (box((-SIZE, 1.0, -SIZE), (SIZE, 2.0, SIZE)) if solid else
            quad((-SIZE, 1.0, SIZE), (2 * SIZE, 0.0, 0.0), (0.0, 0.0, -2 * SIZE)))
    bare, coated = (floor_under(wrt.Object(mesh, wrt.Material(clearcoat=coat, **clear)), degrees)  # type: ignore[arg-type]
                    for coat in (0.0, 0.8))
    assert bare > 0.01 and coated / bare == pytest.approx(1.0 - 0.8 * float(fresnel(np.cos(np.radians(degrees)), 1.5)), rel=1e-4)
