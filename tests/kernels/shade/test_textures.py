"""Texture look-ups against a reference in float64."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, ints, launch, vec2s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.core.device import upload
from wrt.kernels import structs
from wrt.kernels.shade.textures import make_sample_texture
from wrt.kernels.structs import Surfaces, kernel
from wrt.renderer.upload import TextureTable, srgb_table
from wrt.scene.materials import Checkerboard, Texture


@cache
def texture_kernel(pictures, checkerboards):
    sample_texture = make_sample_texture(pictures, checkerboards)

    @kernel
    def look_up(surfaces: Surfaces, index: wp.array(dtype=wp.int32), uv: wp.array(dtype=wp.vec2), out: wp.array(dtype=wp.vec4)):
        i = wp.tid()
        out[i] = sample_texture(surfaces, index[i], uv[i])

    return look_up


def surfaces_with(textures):
    table = TextureTable()
    assert [table.index(texture) for texture in textures] == list(range(len(textures)))
    surfaces = Surfaces()
    surfaces.textures = upload(table.records(), structs.Texture, DEVICE)
    surfaces.texels = upload(np.concatenate([*table.texels, np.zeros(1, np.uint32)]), wp.uint32, DEVICE)
    surfaces.srgb_to_linear = upload(srgb_table(), wp.float32, DEVICE)
    return surfaces


def look_up(textures, index, uv):
    surfaces = surfaces_with(textures)
    uv = np.asarray(uv, np.float32).reshape(-1, 2)
    out = zeros(len(uv), wp.vec4)
    launch(texture_kernel(True, True), len(uv), surfaces, ints(np.broadcast_to(index, (len(uv),))), vec2s(uv), out)
    return out.numpy().astype(np.float64)


def picture(rng, height=5, width=7):
    return rng.integers(0, 256, (height, width, 4), dtype=np.uint8)


def linear(image, srgb):
    x = image / 255.0
    if srgb:
        c = x[..., :3]
        x[..., :3] = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return x


def place(i, size, wrap):
    if wrap == "clamp":
        return min(max(i, 0), size - 1)
    if wrap == "mirror":
        j = i % (2 * size)
        return j if j < size else 2 * size - 1 - j
    return i % size


def bilinear(texture, u, v):
    """Look up a texture by the definition: texel centers are at (i + 0.5) / size, and weights are linear in the distance."""
    image = linear(texture.image.astype(np.float64), texture.srgb)
    u, v = texture.uv_transform @ [u, v, 1.0]
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    total = np.zeros(4)
    for column in (int(np.floor(x)), int(np.floor(x)) + 1):
        for row in (int(np.floor(y)), int(np.floor(y)) + 1):
            weight = (1.0 - abs(x - column)) * (1.0 - abs(y - row))
            total += weight * image[place(row, height, texture.wrap[1]), place(column, width, texture.wrap[0])]
    return total


@pytest.mark.parametrize("srgb", [True, False])
@pytest.mark.parametrize("wrap", [("repeat", "repeat"), ("clamp", "repeat"), ("mirror", "clamp"), ("repeat", "mirror")])
def test_bilinear_against_the_definition(wrap, srgb):
    rng = np.random.default_rng(1)
    texture = Texture(picture(rng), srgb=srgb, wrap=wrap)
    uv = rng.uniform(-3.0, 3.0, (800, 2)).astype(np.float32)
    found = look_up([texture], 0, uv)
    expected = np.array([bilinear(texture, *row) for row in uv.astype(np.float64)])
    assert np.abs(found - expected).max() < 2e-5


def test_texel_centers_and_halfway_points():
    image = picture(np.random.default_rng(2), 4, 8)
    texture = Texture(image, srgb=False)
    column, row = np.meshgrid(np.arange(8), np.arange(4))
    uv = np.stack([(column + 0.5) / 8.0, (row + 0.5) / 4.0], axis=-1).reshape(-1, 2)
    expected = (image.reshape(-1, 4) / np.float64(255)).astype(np.float32)
    assert np.array_equal(look_up([texture], 0, uv).astype(np.float32), expected)
    between = look_up([texture], 0, [[1.0 / 8.0, 0.5 / 4.0]])[0]
    assert np.allclose(between, 0.5 * (image[0, 0] / 255.0 + image[0, 1] / 255.0), atol=1e-6)
    seam = look_up([texture], 0, [[0.0, 0.5 / 4.0]])[0]  # With WRAP_REPEAT, between the last and the first column.
    assert np.allclose(seam, 0.5 * (image[0, 0] / 255.0 + image[0, 7] / 255.0), atol=1e-6)


def test_decoding_comes_before_filtering_and_spares_alpha():
    image = np.array([[[0, 0, 0, 0], [255, 255, 255, 255]]], np.uint8)
    middle = look_up([Texture(image, srgb=True, wrap=("clamp", "clamp"))], 0, [[0.5, 0.5]])[0]
    assert np.allclose(middle, 0.5)  # The mean of decoded black and white, not the decoded middle grey.
    grey = np.full((1, 1, 4), 128, np.uint8)
    assert look_up([Texture(grey, srgb=True)], 0, [[0.2, 0.9]])[0] == pytest.approx(
        [0.215861, 0.215861, 0.215861, 128 / 255.0], abs=1e-6)


def test_uv_transform_and_several_textures():
    rng = np.random.default_rng(3)
    first = Texture(picture(rng), srgb=False)
    turned = Texture(picture(rng, 6, 3), srgb=True, wrap=("mirror", "repeat"),
                     uv_transform=np.array([[0.0, 2.0, 0.25], [-1.5, 0.5, -0.125]]))
    same_image = Texture(first.image, srgb=True)
    board = Checkerboard((0.9, 0.1, 0.2), (0.0, 0.3, 0.4), 4.0)
    textures = [first, board, turned, same_image]
    uv = rng.uniform(-2.0, 2.0, (200, 2)).astype(np.float32)
    for index in (0, 2, 3):
        expected = np.array([bilinear(textures[index], *row) for row in uv.astype(np.float64)])
        assert np.abs(look_up(textures, index, uv) - expected).max() < 2e-5
    table = TextureTable()
    for texture in textures:
        table.index(texture)
    assert table.size == first.image[..., 0].size + turned.image[..., 0].size  # A picture that is used twice is stored once.


def test_checkerboard():
    board = Checkerboard((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 2.0)
    uv = np.random.default_rng(5).uniform(-4.0, 4.0, (2000, 2)).astype(np.float32)
    first = (np.floor(2.0 * uv[:, 0]) + np.floor(2.0 * uv[:, 1])) % 2 == 0
    expected = np.where(first[:, None], [1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0])
    assert np.array_equal(look_up([board], 0, uv), expected)
    corner = look_up([board], 0, [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [-1e-6, 0.0]])
    assert corner[:, 0].tolist() == [1.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_coordinates_far_out_stay_within_the_picture(wrap):
    # The index must stay inside the picture for any coordinate: texels of other pictures are adjacent.
    inside = np.full((64, 4096, 4), 200, np.uint8)
    guard = np.zeros((1, 4096, 4), np.uint8)
    textures = [Texture(guard, srgb=False), Texture(inside, srgb=False, wrap=(wrap, wrap)), Texture(guard.copy(), srgb=False)]
    far = np.array([1e3, 1e5, 1e6, 1e7, 1e12, 3e38, 5.3e5, 123456.78])
    uv = np.concatenate([np.stack([far, -far], axis=1), np.stack([-far, far], axis=1), np.stack([far, far], axis=1)])
    assert np.allclose(look_up(textures, 1, uv), 200 / 255.0, atol=1e-5)


def test_coordinates_beyond_all_integers_keep_their_side():
    # 1e6 times 4096 exceeds int32. The conversion would give the largest or the smallest int32, depending on the device.
    wide = np.zeros((2, 4096, 4), np.uint8)
    wide[:, -1] = 255
    uv = [[1e6, 0.5], [-1e6, 0.5], [3e38, 0.5], [-3e38, 0.5]]
    assert look_up([Texture(wide, srgb=False, wrap=("clamp", "clamp"))], 0, uv)[:, 0].tolist() == [1.0, 0.0, 1.0, 0.0]
    board = Checkerboard((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0)
    assert look_up([board], 0, [[3e38, 0.5], [3e38, 1.5], [-5e9, 1.5]])[:, 0].tolist() == [1.0, 0.0, 0.0]


def test_the_table_of_plain_numbers_is_a_division():
    """textures.h divides by 255 in place of a look-up in the table."""
    np.testing.assert_array_equal(srgb_table()[256:], np.arange(256, dtype=np.float32) / np.float32(255.0))
