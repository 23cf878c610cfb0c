"""Images, textures and materials of glTF."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import wrt
from tests.gltf_files import GltfFile, encode, load_warned, one_material, one_triangle
from tests.refused import refused
from wrt.core.errors import InputError, SceneWarning
from wrt.io.gltf.reader import load_gltf
from wrt.picture.decode import MAX_SIDE, decode_rgba8
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Scene
from wrt.scene.settings import Settings
from wrt.scene.values import BLACK

GLOSSY = "KHR_materials_pbrSpecularGlossiness"
PIXELS = np.arange(4 * 6 * 4, dtype=np.uint8).reshape(4, 6, 4) * 2


def load(file: GltfFile, folder: Any) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        return load_gltf(file.write(folder), staged=False)


def material_of(source: dict[str, Any], folder: Any) -> Material:
    """The wrt material that a glTF material without textures becomes; any warning fails the test."""
    return load_gltf(one_material(source).write(folder), staged=False).materials[0]


def textured(source: dict[str, Any], pixels: np.ndarray = PIXELS, **sampler: Any) -> GltfFile:
    """A quad whose material may name texture 0."""
    file = one_material(source)
    image = file.image(pixels)
    file.add("textures", {"source": image, "sampler": file.add("samplers", sampler)})
    return file


def base(**info: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **info}}}


# --- materials --------------------------------------------------------------------------------------------------------


def test_defaults_are_those_of_the_specification(tmp_path):
    for material in (material_of({}, tmp_path), load_gltf(one_triangle().write(tmp_path), staged=False).materials[0]):
        assert material.kind == "metallic_roughness"
        assert material.albedo == (1, 1, 1) and material.ior == 1.5
        assert material.metallic == 1 and material.roughness == 1
        assert not material.is_emissive and material.alpha_mode == "opaque" and not material.textures
        assert material.transmission == 0 and not material.two_sided


def test_factors(tmp_path):
    material = material_of({
        "name": "m", "doubleSided": True, "alphaMode": "MASK", "alphaCutoff": 0.25, "emissiveFactor": [0.1, 0.2, 0.3],
        "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.25, 0.125, 0.75], "metallicFactor": 0.3,
                                 "roughnessFactor": 0.6},
        "extensions": {"KHR_materials_ior": {"ior": 1.33}, "KHR_materials_emissive_strength": {"emissiveStrength": 10}},
    }, tmp_path)
    assert (material.name, material.two_sided, material.alpha_mode, material.alpha_cutoff) == ("m", True, "mask", 0.25)
    assert material.albedo == (0.5, 0.25, 0.125) and material.alpha == 0.75
    assert (material.metallic, material.roughness, material.ior) == (0.3, 0.6, 1.33)
    assert material.emission == pytest.approx((1, 2, 3)) and material.emits_light


def test_a_cutoff_above_one_hides_everything(tmp_path):
    material = material_of({"alphaMode": "MASK", "alphaCutoff": 2}, tmp_path)
    assert material.alpha < material.alpha_cutoff


def test_transmission_is_thin_without_a_volume(tmp_path):
    glass = {"KHR_materials_transmission": {"transmissionFactor": 0.9}}
    material = material_of({"extensions": glass}, tmp_path)
    assert material.transmission == 0.9 and material.thin and material.absorption == BLACK
    material = material_of({"extensions": {**glass, "KHR_materials_volume": {"thicknessFactor": 0}}}, tmp_path)
    assert material.thin


def test_absorption_gives_the_attenuation_colour_at_its_distance(tmp_path):
    color, distance = np.array([0.9, 0.5, 0.1]), 0.25
    volume = {"thicknessFactor": 1, "attenuationColor": color.tolist(), "attenuationDistance": distance}
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_volume": volume}
    material = material_of({"extensions": glass}, tmp_path)
    assert not material.thin
    assert np.exp(-np.array(material.absorption) * distance) == pytest.approx(color)
    assert np.exp(-np.array(material.absorption) * 2 * distance) == pytest.approx(color**2)
    volume["attenuationColor"] = [0, 0, 1]
    material = material_of({"extensions": glass}, tmp_path)
    assert math.isfinite(material.absorption[0]) and math.exp(-material.absorption[0] * distance) < 1e-5
    assert material.absorption[2] == 0
    del volume["attenuationDistance"]
    assert material_of({"extensions": glass}, tmp_path).absorption == BLACK


def test_unlit_shows_its_base_colour_and_lights_nothing(tmp_path):
    source = {**base(), "alphaMode": "BLEND", "emissiveFactor": [1, 0, 0], "extensions": {"KHR_materials_unlit": {}}}
    source["pbrMetallicRoughness"]["baseColorFactor"] = [0.2, 0.4, 0.6, 0.5]
    material = load(textured(source), tmp_path).materials[0]
    assert material.kind == "diffuse" and material.albedo == BLACK and material.emission == (0.2, 0.4, 0.6)
    assert material.two_sided and not material.emits_light and material.alpha == 0.5
    assert material.emission_texture is not None and material.emission_texture is material.albedo_texture
    source["alphaMode"] = "OPAQUE"
    assert load(textured(source), tmp_path).materials[0].albedo_texture is None


def test_an_emission_texture_is_seen_but_lights_nothing(tmp_path):
    material = load(textured({"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}), tmp_path).materials[0]
    assert material.is_emissive and not material.lights_others and material.emission_texture.srgb
    assert not load(textured({"emissiveTexture": {"index": 0}}), tmp_path).materials[0].textures  # the factor is black


def test_each_slot_has_its_encoding(tmp_path):
    slot = {"index": 0}
    material = load(textured({
        "pbrMetallicRoughness": {"baseColorTexture": slot, "metallicRoughnessTexture": slot},
        "normalTexture": {"index": 0, "scale": 0.5}, "occlusionTexture": slot, "emissiveTexture": slot,
        "emissiveFactor": [1, 1, 1],
        "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1, "transmissionTexture": slot}},
    }), tmp_path).materials[0]
    assert material.albedo_texture.srgb and material.emission_texture.srgb
    assert not material.metallic_roughness_texture.srgb and not material.normal_texture.srgb
    assert not material.transmission_texture.srgb and material.normal_scale == 0.5
    # The same image with the same settings is the same texture, and there is one decoded copy of the image.
    assert material.albedo_texture is material.emission_texture
    assert material.normal_texture is material.transmission_texture is material.metallic_roughness_texture
    assert material.albedo_texture.image is material.normal_texture.image
    assert np.array_equal(material.normal_texture.image, PIXELS)


@pytest.mark.parametrize("source, message", [
    ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1]}},
     (None, "hold 4 numbers", "materials[0].pbrMetallicRoughness.baseColorFactor")),
    ({"pbrMetallicRoughness": {"metallicFactor": "shiny"}}, (None, "number", "materials[0].pbrMetallicRoughness.metallicFactor")),
    ({"pbrMetallicRoughness": {"baseColorTexture": {}}}, (None, "required", "materials[0].pbrMetallicRoughness.baseColorTexture.index")),
    ({"alphaMode": "GLASS"}, (None, "OPAQUE, MASK, BLEND", "materials[0].alphaMode")),
    ({"pbrMetallicRoughness": {"roughnessFactor": math.nan}}, (None, "finite", "materials[0].pbrMetallicRoughness.roughnessFactor")),
    ({"extensions": {"KHR_materials_ior": 3}}, (None, "object", "materials[0].extensions.KHR_materials_ior")),
    ({"extensions": {"KHR_materials_specular": {"specularColorFactor": [1, 1]}}},
     (None, "hold 3 numbers", "materials[0].extensions.KHR_materials_specular.specularColorFactor")),
    ({"extensions": {GLOSSY: {"diffuseFactor": [1, 1, 1]}}}, (None, "hold 4 numbers", f"materials[0].extensions.{GLOSSY}.diffuseFactor")),
])
def test_wrong_materials_are_refused(tmp_path, source, message):
    with refused(*message):
        material_of(source, tmp_path)
    assert load_gltf(one_material(source).write(tmp_path), shapes_only=True).objects  # rays need no material


GLASS = {"KHR_materials_transmission": {"transmissionFactor": 1}}


@pytest.mark.parametrize("source, field, value, named", [
    ({"pbrMetallicRoughness": {"baseColorFactor": [1.00016, 0.5, 0.5, 1]}}, "albedo", (1, 0.5, 0.5), "albedo"),
    ({"pbrMetallicRoughness": {"baseColorFactor": [1, -0.1, 1.1, 1]}, "extensions": {"KHR_materials_unlit": {}}}, "emission", (1, 0, 1),
     "albedo"),
    ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1.0000001192]}, "alphaMode": "BLEND"}, "alpha", 1, "alpha"),
    ({"pbrMetallicRoughness": {"roughnessFactor": -1}}, "roughness", 0, "roughness"),
    ({"emissiveFactor": [-1, 0, 2]}, "emission", (0, 0, 2), "emission"),
    ({"emissiveFactor": [1, 1, 0], "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 1e300}}}, "emission",
     (1e30, 1e30, 0), "emission"),
    ({"extensions": {"KHR_materials_ior": {"ior": 0.9999}}}, "ior", 1, "ior"),
    ({"extensions": {"KHR_materials_specular": {"specularColorFactor": [-0.1, 1, 2]}}}, "specular_color", (0, 1, 2), "specular_color"),
    ({"extensions": {GLOSSY: {"specularFactor": [1, 2, 1]}}}, "specular_color", (25, 25, 25), "specularFactor"),
    ({"extensions": {GLOSSY: {"glossinessFactor": 1.01}}}, "roughness", 0, "glossinessFactor"),
    ({"extensions": GLASS | {"KHR_materials_volume": {"thicknessFactor": 1, "attenuationDistance": 0}}}, "absorption", (0, 0, 0),
     "attenuationDistance"),
    ({"extensions": GLASS | {"KHR_materials_volume": {"thicknessFactor": 1, "attenuationDistance": 2, "attenuationColor": [1.1, 1, 1]}}},
     "absorption", (0, 0, 0), "attenuationColor"),
])
def test_factors_outside_of_their_limits_are_clamped_and_named(tmp_path, source, field, value, named):
    scene, messages = load_warned(one_material(source).write(tmp_path), staged=False)
    assert getattr(scene.materials[0], field) == value
    assert len(messages) == 1 and f": {named}" in messages[0] and "(material 'material 0')" in messages[0]


@pytest.mark.parametrize("extension, value, named", [
    ("KHR_materials_sheen", {"sheenColorFactor": [0, 0, 1]}, True),
    ("KHR_materials_clearcoat", {"clearcoatFactor": 0.5}, False),
    ("KHR_materials_specular", {"specularFactor": 0.5}, False),
    ("KHR_materials_dispersion", {"dispersion": 0.2}, True),
    ("NV_materials_mdl", {}, True),
    ("KHR_materials_iridescence", "no object", True),
    ("KHR_xmp_json_ld", {"packet": 0}, False),
])
def test_extensions_are_named_where_they_change_the_picture(tmp_path, extension, value, named):
    file = one_material({"name": "paint", "extensions": {extension: value}})
    path = file.write(tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_gltf(path, staged=False)
    assert [f"{extension} (material 'paint')" in str(w.message) for w in caught] == ([True] if named else [])


def test_clear_coat_and_specular(tmp_path):
    coat = {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.25}
    specular = {"specularFactor": 0.75, "specularColorFactor": [1, 0.5, 2]}
    material = material_of({"extensions": {"KHR_materials_clearcoat": coat, "KHR_materials_specular": specular}}, tmp_path)
    assert (material.clearcoat, material.clearcoat_roughness) == (0.5, 0.25)
    assert (material.specular_factor, material.specular_color) == (0.75, (1.0, 0.5, 2.0))
    assert material.is_coated and material.scales_reflectance
    nothing = {"KHR_materials_clearcoat": {"clearcoatRoughnessFactor": 1, "clearcoatNormalTexture": {"index": 0}},
               "KHR_materials_specular": {}}
    plain = material_of({"extensions": nothing}, tmp_path)
    assert not plain.is_coated and not plain.scales_reflectance and plain.is_rough


def test_textures_of_clear_coat_and_specular(tmp_path):
    slot = {"index": 0}
    source = {"extensions": {
        "KHR_materials_clearcoat": {"clearcoatFactor": 1, "clearcoatTexture": slot, "clearcoatRoughnessTexture": slot,
                                    "clearcoatNormalTexture": slot},
        "KHR_materials_specular": {"specularTexture": slot, "specularColorTexture": slot}}}
    with pytest.warns(SceneWarning, match="clearcoatNormalTexture .material 'material 0'"):
        material = load_gltf(textured(source).write(tmp_path), staged=False).materials[0]
    assert not material.clearcoat_texture.srgb and not material.clearcoat_roughness_texture.srgb and not material.specular_texture.srgb
    assert material.specular_color_texture.srgb and material.scales_reflectance


def glossy(**fields: Any) -> dict[str, Any]:
    """A material of specular-glossiness; a reader that knows the extension ignores the metallic-roughness beside it."""
    return {"pbrMetallicRoughness": {"metallicFactor": 1, "roughnessFactor": 0.9, "baseColorFactor": [1, 0, 1, 0.1]},
            "extensions": {GLOSSY: fields}}


def seen(source: dict[str, Any], folder: Any, pixels: np.ndarray | None = None) -> np.ndarray:
    """Return the radiance of the quad from ahead, in surroundings of radiance 1."""
    file = one_material(source) if pixels is None else textured(source, pixels)
    scene = replace(load(file, folder), background=ConstantBackground((1.0, 1.0, 1.0)), settings=Settings(filter="box", min_throughput=0.0),
                    cameras=(Camera.look_at((0.4, 0.3, 9), (0.4, 0.3, 0), fov_y=1e-3),))
    return wrt.render(scene, size=(1, 1), spp=1).pixels[0, 0]


def test_specular_glossiness_has_its_reflectance_at_normal_incidence(tmp_path):
    specular, diffuse = np.array([0.9, 0.5, 0.02]), np.array([0.5, 0.25, 1.0])
    material = material_of(glossy(diffuseFactor=[*diffuse, 0.75], specularFactor=specular.tolist(), glossinessFactor=0.75), tmp_path)
    assert (material.albedo, material.alpha, material.roughness, material.metallic) == (tuple(diffuse), 0.75, 0.25, 0.0)
    factors = {"diffuseFactor": [*diffuse, 1.0], "specularFactor": specular.tolist()}
    # F0 and c_diff = diffuse (1 - max(specular)) of the specification, by factors and by a texture.
    assert seen(glossy(**factors), tmp_path) == pytest.approx(specular + diffuse * (1.0 - specular.max()), abs=1e-5)
    source = glossy(**factors, specularGlossinessTexture={"index": 0})
    specular[2] = 0.0
    texels = np.broadcast_to(np.array([255, 188, 0, 255], np.uint8), (2, 2, 4))  # 188 in sRGB is 0.503
    specular[1] = 0.5 * ((188 / 255 + 0.055) / 1.055) ** 2.4
    assert seen(source, tmp_path, texels) == pytest.approx(specular + diffuse * (1.0 - specular.max()), abs=1e-5)


def test_textures_of_specular_glossiness(tmp_path):
    source = glossy(diffuseTexture={"index": 0}, specularGlossinessTexture={"index": 0}, glossinessFactor=0.5)
    material = load(textured(source, wrapS=33071), tmp_path).materials[0]
    assert material.albedo_texture is material.specular_color_texture and material.albedo_texture.srgb
    rough = material.metallic_roughness_texture
    assert not rough.srgb and rough.wrap == ("clamp", "repeat") and material.roughness == 1.0
    assert np.abs(rough.image[..., 1] / 255.0 - (1.0 - 0.5 * PIXELS[..., 3] / 255.0)).max() < 0.51 / 255.0


def test_an_index_of_0_means_the_specular_colour_itself(tmp_path):
    source = {"KHR_materials_ior": {"ior": 0}, "KHR_materials_specular": {"specularColorFactor": [0.5, 1, 0]}}
    pbr = {"metallicFactor": 0, "roughnessFactor": 0}
    assert seen({"extensions": source, "pbrMetallicRoughness": pbr}, tmp_path) == pytest.approx([0.5, 1.0, 0.0], abs=1e-5)


# --- textures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code, wrap", [(10497, "repeat"), (33071, "clamp"), (33648, "mirror")])
def test_wrap_modes(tmp_path, code, wrap):
    texture = load_gltf(textured(base(), wrapS=code).write(tmp_path), staged=False).materials[0].albedo_texture
    assert texture.wrap == (wrap, "repeat")
    texture = load_gltf(textured(base(), wrapT=code).write(tmp_path), staged=False).materials[0].albedo_texture
    assert texture.wrap == ("repeat", wrap)


def test_a_wrong_sampler_leaves_its_texture_out(tmp_path):
    file = textured(base())
    file.json["textures"][0]["sampler"] = 3
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert not scene.materials[0].textures and "a texture, because textures[0].sampler: is 3, but there are" in messages[0]


def uv_transform(folder: Any, **transform: Any) -> np.ndarray:
    source = base(extensions={"KHR_texture_transform": transform})
    return load(textured(source), folder).materials[0].albedo_texture.uv_transform


def test_texture_transform_examples_of_the_specification(tmp_path):
    """The extension's two examples: the lower left quadrant turned clockwise by 90 degrees, and T upside down."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])  # clockwise from the top left
    quadrant = uv_transform(tmp_path, offset=[0, 1], rotation=1.57079632679, scale=[0.5, 0.5])
    # Clockwise: the quadrant's lower left corner appears top left, its upper left corner top right.
    assert corners @ quadrant.T == pytest.approx(np.array([[0, 1], [0, 0.5], [0.5, 0.5], [0.5, 1]]), abs=1e-9)
    assert corners @ uv_transform(tmp_path, offset=[0, 1], scale=[1, -1]).T == pytest.approx(
        np.array([[0, 1], [1, 1], [1, 0], [0, 0]]))


def test_second_set_of_coordinates_is_left_out_and_named(tmp_path):
    for info in ({"texCoord": 1}, {"extensions": {"KHR_texture_transform": {"texCoord": 1}}}):
        path = textured({"name": "m", **base(**info)}).write(tmp_path)
        with pytest.warns(SceneWarning, match=r"textures by TEXCOORD_1 \(material 'm'\)"):
            assert load_gltf(path, staged=False).materials[0].albedo_texture is None
    info = {"texCoord": 1, "extensions": {"KHR_texture_transform": {"texCoord": 0}}}
    assert load_gltf(textured(base(**info)).write(tmp_path), staged=False).materials[0].albedo_texture is not None


def test_a_left_out_emission_texture_does_not_make_the_surface_glow(tmp_path):
    source = {"emissiveTexture": {"index": 0, "texCoord": 1}, "emissiveFactor": [1, 1, 1]}
    assert not load(textured(source), tmp_path).materials[0].is_emissive


def test_webp_by_its_extension(tmp_path):
    file = one_material(base())
    pixels = np.full((8, 8, 4), (200, 100, 50, 255), np.uint8)
    file.add("textures", {"extensions": {"EXT_texture_webp": {"source": file.image(pixels, "WEBP")}}})
    image = load_gltf(file.write(tmp_path), staged=False).materials[0].albedo_texture.image
    assert np.abs(image.astype(int) - pixels).max() <= 8  # a lossy format


@pytest.mark.parametrize("texture, error", [
    (None, "materials[0].pbrMetallicRoughness.baseColorTexture.index: is 0, but there are 0 textures"),
    ({"source": 4}, "textures[0].source: is 4, but there are 0 images"),
    ({"source": "4"}, "textures[0].source: must be an integer"),
])
def test_textures_whose_parts_are_not_there_are_named_and_left_out(tmp_path, texture, error):
    file = one_material({**base(), "emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}})
    if texture:
        file.add("textures", texture)
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert scene.materials[0].albedo_texture is None and not scene.materials[0].is_emissive
    assert error in messages[0] and "(material 'material 0')" in messages[0]


@pytest.mark.parametrize("texture, message", [
    ({"extensions": {"KHR_texture_basisu": {"source": 0}}}, "textures whose only image is that of 'KHR_texture_basisu' (material"),
    ({}, "textures without an image (material"),
])
def test_a_texture_without_an_image_is_left_out_and_named(tmp_path, texture, message):
    """By glTF 2.0, a file is valid if a texture has no source, but the behaviour is undefined."""
    file = one_material(base())
    file.add("textures", texture)
    scene, told = load_warned(file.write(tmp_path), staged=False)
    assert scene.materials[0].textures == () and len(told) == 1 and message in told[0]


# --- images -----------------------------------------------------------------------------------------------------------


def png_header(width: int, height: int) -> bytes:
    """A PNG with this size in its header, and a single row of pixels."""
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    row = zlib.compress(bytes(1 + min(width, MAX_SIDE)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", row) + chunk(b"IEND", b"")


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1"])
def test_every_mode_becomes_rgba(mode):
    picture = Image.fromarray(PIXELS).convert(mode)
    stream = io.BytesIO()
    picture.save(stream, "PNG")
    assert np.array_equal(decode_rgba8(stream.getvalue()), np.array(picture.convert("RGBA")))


@pytest.mark.parametrize("format", ["PNG", "JPEG", "WEBP"])
def test_truncated_images(format):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    data = encode(noise, format)
    for length in (0, 5, 20, len(data) // 2):
        with refused(what="read"):
            decode_rgba8(data[:length])


def test_images_that_are_none():
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"
    for data in (b"hello", eps):
        with refused(what="none"):
            decode_rgba8(data)


@pytest.mark.parametrize("size", [(MAX_SIDE + 1, 1), (1, MAX_SIDE + 1)])
def test_images_beyond_the_limit(size):
    with refused(what=f"{size[0]}x{size[1]}"):
        decode_rgba8(png_header(*size))
    assert decode_rgba8(png_header(MAX_SIDE, 1)).shape == (1, MAX_SIDE, 4)


def test_decompression_bombs():
    with refused(what="10000x16000"):
        decode_rgba8(png_header(10000, 16000))
    with refused(what="exceeds limit"):
        decode_rgba8(png_header(MAX_SIDE, MAX_SIDE))  # in Pillow's own words
    with pytest.raises(InputError):
        decode_rgba8(png_header(2**31 - 1, 2**31 - 1))


def test_an_unsound_image_is_named(tmp_path):
    file = one_material(base())
    file.add("textures", {"source": file.add("images", {"uri": "picture.png"})})
    path = file.write(tmp_path)

    def assert_named(error):
        scene, messages = load_warned(path, staged=False)
        assert scene.materials[0].albedo_texture is None and f"a texture, because {error}" in messages[0]
        load_gltf(path, shapes_only=True)  # without a warning
        wrt.build(path)

    assert_named("images[0].uri: 'picture.png': cannot be read")
    (tmp_path / "picture.png").write_bytes(encode(PIXELS)[:40])
    assert_named("images[0].uri: 'picture.png'")
    (tmp_path / "picture.png").write_bytes(encode(PIXELS))
    assert load_gltf(path, staged=False).materials[0].albedo_texture.name == "picture.png"
    file.json["images"] = [{"mimeType": "image/png"}]
    path = file.write(tmp_path)
    assert_named("images[0]: has neither a uri")
    file.json["images"] = [{"uri": "../secret.png"}]
    path = file.write(tmp_path)
    assert_named("images[0].uri: '../secret.png': is no path")


@pytest.mark.parametrize("mapped", [True, False])
def test_tangents_are_named_where_a_normal_map_would_use_them(tmp_path, mapped):
    file = one_material({"name": "bumpy"})
    texture = {"index": file.add("textures", {"source": file.image(np.zeros((1, 1, 3), np.uint8))})}
    if mapped:
        file.json["materials"][0]["normalTexture"] = texture
    primitive = file.json["meshes"][0]["primitives"][0]
    primitive["attributes"]["TANGENT"] = file.accessor([[1, 0, 0, 1]] * 4)
    file.json["meshes"][0]["primitives"].append(dict(primitive))
    _, told = load_warned(file.write(tmp_path))
    assert sum(text.count("TANGENT") for text in told) == int(mapped)


# --- unlit surfaces ---------------------------------------------------------------------------------------------------


CARD = {"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}, "extensions": {"KHR_materials_unlit": {}}}


@pytest.mark.parametrize("light", [{"type": "directional", "intensity": 0.01}, {"type": "point", "intensity": 9e6}])
@pytest.mark.parametrize("lit", [False, True])
def test_unlit_surfaces_keep_their_colours_beside_lights(tmp_path, light, lit):
    """Lit surfaces beside them are neither black nor white, though lights have any unit."""
    file = one_material(CARD)
    file.json["extensions"] = {"KHR_lights_punctual": {"lights": [light]}}
    file.node(extensions={"KHR_lights_punctual": {"light": 0}}, translation=[0.5, 0.5, 3])
    if lit:
        matte = file.add("materials", {"pbrMetallicRoughness": {"metallicFactor": 0}})
        quad = file.json["meshes"][0]["primitives"][0] | {"material": matte}
        file.node(mesh=file.mesh(quad), translation=[2, 0, 0])
    scene, messages = load_warned(file.write(tmp_path))
    assert not scene.settings.auto_exposure and ("its lights were multiplied by" in messages[0]) == lit
    film = wrt.render(scene, spp=4, size=(64, 32))
    card = np.abs(film.pixels - np.float32([0.2, 0.4, 0.6])).max(axis=2) < 1e-5
    assert card.sum() > 100 and film.exposure == 0.0
    rest = film.pixels[~card & (film.pixels.min(axis=2) > 0)]
    assert not lit or 0.1 < np.median(rest) < 1.01
