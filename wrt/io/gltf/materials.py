"""Images, textures and materials of glTF files, converted to those of a wrt scene.

Three features are ignored without a warning. Occlusion textures hold baked ambient shadow, which a ray tracer computes. Thickness
textures are not needed, because rays hit the far side of a volume. Back faces are never culled, because light would leak through them.
Source: Khronos, glTF 2.0 specification, sections 3.8 (texture data) and 3.9 (materials), and each extension's own text.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from wrt.core.checks import LARGEST, short
from wrt.core.errors import InputError, at
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.schema import ITEMS, read
from wrt.picture.decode import decode_rgba8
from wrt.scene.kinds import forms
from wrt.scene.materials import Material, Texture
from wrt.scene.values import BLACK, Color

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_DARKEST = 1e-6  # channel of an attenuation colour; 0 would need infinite absorption
_FULL_REFLECTANCE = 25.0  # factor on the reflectance of the index 1.5, 0.04, that makes it 1
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"
_ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}

_LIMITS = {key: (each.metadata["limits"].get("ge", 0.0), each.metadata["limits"].get("le", LARGEST))
           for key, each in forms(Material).items() if each.metadata["form"] in ("number", "color")}

# Values with which an unsupported extension has no effect: the warning then leaves it out.
_NEUTRAL: dict[str, dict[str, Any]] = {
    "KHR_materials_sheen": {"sheenColorFactor": [0, 0, 0]},
    "KHR_materials_iridescence": {"iridescenceFactor": 0},
    "KHR_materials_anisotropy": {"anisotropyStrength": 0},
    "KHR_materials_dispersion": {"dispersion": 0},
    "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0},
}


class Textures:
    """Cache of textures: each image is decoded once, and equal settings of one image share a Texture."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[tuple[Any, ...], Texture] = {}
        self._roughness: dict[tuple[int, float], Texture] = {}

    def texture(self, info: GltfObject, srgb: bool, material: str, place: str) -> Texture | None:
        """Return the texture of a textureInfo. None: there is no textureInfo, or the texture cannot be read, which is recorded."""
        try:
            return self._texture(info, srgb, material, place) if info is not None else None
        except InputError as error:
            self._document.mistakes.add(f"a texture, because {error}", "material", material)
            return None

    def _texture(self, info: GltfObject, srgb: bool, material: str, place: str) -> Texture | None:
        """Return the texture of a textureInfo. None: there is no image, or it uses coordinates other than TEXCOORD_0."""
        document = self._document
        texture = document.item("textures", info.index, f"{place}.index")
        document.left_out.add_extensions(info.extensions, "material", material)
        transform = document.extension_or_defaults(info, "KHR_texture_transform", place)
        coordinates = transform.texCoord if transform.texCoord is not None else info.texCoord
        if coordinates != 0:
            document.left_out.add(f"textures by TEXCOORD_{coordinates}", "material", material)
            return None
        wrap = self._wrap(texture, material, f"textures[{info.index}]")
        matrix = _uv_transform(transform)
        source = self._source(texture, f"textures[{info.index}]")
        if source is None:
            others = ", ".join(map(short, texture.extensions))
            document.left_out.add(f"textures whose only image is that of {others}" if others else "textures without an image",
                                  "material", material)
            return None
        key = (source, srgb, wrap, matrix.tobytes())
        if key not in self._textures:
            image = document.item("images", source, place)
            file = image.uri if image.uri and image.uri[:5] != "data:" else ""
            name = texture.name or image.name or file or f"image {source}"
            self._textures[key] = Texture(self._image(source), srgb=srgb, wrap=wrap, uv_transform=matrix, name=name)
        return self._textures[key]

    def roughness(self, texture: Texture, glossiness: float) -> Texture:
        """Return a texture of 1 - `glossiness` alpha in green, which multiplies a roughness; rounded to 8 bits."""
        key = (id(texture), glossiness)
        if key not in self._roughness:
            image = np.full_like(texture.image, 255)
            image[..., 1] = np.rint(255.0 - glossiness * texture.image[..., 3])
            self._roughness[key] = replace(texture, image=image, srgb=False)
        return self._roughness[key]

    def _wrap(self, texture: GltfObject, material: str, place: str) -> tuple[str, str]:
        if texture.sampler is None:
            return ("repeat", "repeat")
        try:
            sampler = self._document.item("samplers", texture.sampler, f"{place}.sampler")
            for axis in ("wrapS", "wrapT"):
                if getattr(sampler, axis) not in _WRAPS:
                    raise InputError(f"must be one of {', '.join(map(str, _WRAPS))}, got {getattr(sampler, axis)}",
                                     place=f"samplers[{texture.sampler}].{axis}")
        except InputError as error:
            self._document.mistakes.add(f"a sampler, because {error}", "material", material)
            return ("repeat", "repeat")
        if sampler.magFilter == _NEAREST:
            self._document.left_out.add("nearest-neighbour sampling", "material", material)
        return (_WRAPS[sampler.wrapS], _WRAPS[sampler.wrapT])

    def _source(self, texture: GltfObject, place: str) -> int | None:
        """Return the index of the texture's PNG or JPEG image, else of the image in an extension, else None."""
        source = texture.source
        for name in ("EXT_texture_webp", "EXT_texture_avif"):
            if source is None:
                extension = self._document.extension(texture, name, place)
                source = extension.source if extension else None
        if source is not None:
            self._document.item("images", source, f"{place}.source")
        return source

    def _image(self, index: int) -> np.ndarray:
        if index not in self._images:
            place = f"images[{index}]"
            image = self._document.item("images", index, place)
            if image.uri is not None:
                data: Any = self._document.resource(image.uri, f"{place}.uri")
                place = f"{place}.uri" if image.uri[:5] == "data:" else f"{place}.uri ({image.uri})"
            elif image.bufferView is not None:
                data = self._document.view(image.bufferView, f"{place}.bufferView")[0].tobytes()
            else:
                raise InputError("has neither a uri nor a bufferView", place=place)
            with at(place):
                self._images[index] = decode_rgba8(data)
            self._images[index].flags.writeable = False  # so that textures share it
        return self._images[index]


def _uv_transform(transform: GltfObject) -> np.ndarray:
    """Return the (2, 3) matrix that scales, then rotates, then offsets (u, v, 1).

    A positive rotation is counter-clockwise in the image, with v downwards, as in the prose, the example and the sample models of
    KHR_texture_transform. The GLSL listing in that specification rotates the other way."""
    (offset_u, offset_v), (scale_u, scale_v) = transform.offset, transform.scale
    cosine, sine = math.cos(transform.rotation), math.sin(transform.rotation)
    return np.array([[cosine * scale_u, sine * scale_v, offset_u], [-sine * scale_u, cosine * scale_v, offset_v]])


class Materials:
    """Cache of materials: each index of a glTF material gives one Material object."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._textures = Textures(document)
        self._materials: dict[int | None, Material] = {}

    def material(self, index: int | None, place: str) -> Material:
        """Return the material `index`; for None the default material of the specification: white, metallic, rough."""
        if index not in self._materials:
            if index is None:
                self._materials[None] = Material(kind="metallic_roughness", name="default", albedo=(1.0, 1.0, 1.0),
                                                 metallic=1.0, roughness=1.0)
            else:
                source = self._document.item("materials", index, place)
                self._materials[index] = self._make(source, source.name or f"material {index}", f"materials[{index}]")
        return self._materials[index]

    def _make(self, source: GltfObject, name: str, place: str) -> Material:
        for extension, raw in source.extensions.items():
            neutral = _NEUTRAL.get(extension) if isinstance(raw, dict) else None
            if neutral is None or any(raw.get(key, value) != value for key, value in neutral.items()):
                self._document.left_out.add_extensions({extension: raw}, "material", name)
        glossy = self._document.extension(source, _GLOSSY, place)
        if glossy is not None:
            source.pbrMetallicRoughness = read(ITEMS["materials"], {}, "").pbrMetallicRoughness
        fields = self._clamped(self._base(source, glossy, name, place), name)
        if self._document.extension(source, "KHR_materials_unlit", place) is not None:
            fields = _unlit(fields)
        else:
            fields |= {"kind": "metallic_roughness"} | self._reflection(source, name, place)
            fields |= self._specular(source, name, place) | self._clearcoat(source, name, place)
            fields |= self._transmission(source, name, place) | self._emission(source, name, place)
            fields |= self._glossy(glossy, name, f"{place}.extensions.{_GLOSSY}") if glossy is not None else {}
        with at(place):
            return Material(**self._clamped(fields, name))

    def _clamped(self, fields: dict[str, Any], name: str) -> dict[str, Any]:
        """Return fields of a Material, with numbers and colours clamped to their limits."""
        return {key: self._document.mistakes.clamp(value, *_LIMITS[key], key, "material", name) if key in _LIMITS else value
                for key, value in fields.items()}

    def _base(self, source: GltfObject, glossy: GltfObject | None, name: str, place: str) -> dict[str, Any]:
        """Return the fields that lit and unlit materials share: name, base colour or diffuse colour, alpha and sides."""
        pbr, color = source.pbrMetallicRoughness, f"{place}.pbrMetallicRoughness.baseColor"
        factor, texture = pbr.baseColorFactor, pbr.baseColorTexture
        if glossy is not None:
            factor, texture, color = glossy.diffuseFactor, glossy.diffuseTexture, f"{place}.extensions.{_GLOSSY}.diffuse"
        if source.alphaMode not in _ALPHA_MODES:
            raise InputError(f"must be one of {', '.join(_ALPHA_MODES)}, got {short(source.alphaMode)}", place=f"{place}.alphaMode")
        alpha, cutoff = factor[3], source.alphaCutoff
        if cutoff > 1.0:  # allowed; the surface is then invisible
            alpha, cutoff = 0.0, 1.0
        return {
            "name": name, "albedo": tuple(factor[:3]), "alpha": alpha, "alpha_mode": _ALPHA_MODES[source.alphaMode],
            "alpha_cutoff": cutoff, "two_sided": source.doubleSided,
            "albedo_texture": self._textures.texture(texture, True, name, f"{color}Texture"),
        }

    def _reflection(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        pbr = source.pbrMetallicRoughness
        fields: dict[str, Any] = {"metallic": pbr.metallicFactor, "roughness": pbr.roughnessFactor}
        fields["metallic_roughness_texture"] = self._textures.texture(
            pbr.metallicRoughnessTexture, False, name, f"{place}.pbrMetallicRoughness.metallicRoughnessTexture")
        if (normal := source.normalTexture) is not None:
            fields["normal_texture"] = self._textures.texture(normal, False, name, f"{place}.normalTexture")
            fields["normal_scale"] = normal.scale
        return fields

    def _transmission(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        """Return the fields of glass: a thin pane, or solid glass if KHR_materials_volume gives a thickness above 0."""
        transmission = self._document.extension_or_defaults(source, "KHR_materials_transmission", place)
        if transmission.transmissionFactor == 0.0:
            return {}
        fields: dict[str, Any] = {"transmission": transmission.transmissionFactor, "thin": True}
        fields["transmission_texture"] = self._textures.texture(
            transmission.transmissionTexture, False, name, f"{place}.extensions.KHR_materials_transmission.transmissionTexture")
        volume = self._document.extension_or_defaults(source, "KHR_materials_volume", place)
        if volume.thicknessFactor > 0.0:
            clamp = self._document.mistakes.clamp
            volume.attenuationColor = clamp(volume.attenuationColor, 0.0, 1.0, "attenuationColor", "material", name)
            if volume.attenuationDistance <= 0.0:
                self._document.mistakes.add("attenuationDistance of 0, now infinite", "material", name)
            fields |= {"thin": False, "absorption": absorption(volume)}
        return fields

    def _specular(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        """Return the index and the factors on its reflectance. An index of 0 means the reflectance 1 times these factors."""
        ior = self._document.extension_or_defaults(source, "KHR_materials_ior", place).ior
        specular = self._document.extension_or_defaults(source, "KHR_materials_specular", place)
        place = f"{place}.extensions.KHR_materials_specular"
        return {
            "ior": ior or 1.5, "specular_factor": specular.specularFactor,
            "specular_color": tuple((1.0 if ior else _FULL_REFLECTANCE) * channel for channel in specular.specularColorFactor),
            "specular_texture": self._textures.texture(specular.specularTexture, False, name, f"{place}.specularTexture"),
            "specular_color_texture": self._textures.texture(specular.specularColorTexture, True, name, f"{place}.specularColorTexture"),
        }

    def _glossy(self, glossy: GltfObject, name: str, place: str) -> dict[str, Any]:
        """Return the fields of a surface that has the specular colour as its reflectance at normal incidence.

        Where the specification multiplies the diffuse colour by 1 - max(specular), wrt multiplies it by 1 - F, F being the largest
        channel of the reflectance at each angle: the same at normal incidence."""
        clamp = self._document.mistakes.clamp
        specular = clamp(glossy.specularFactor, 0.0, 1.0, "specularFactor", "material", name)
        glossiness = clamp(glossy.glossinessFactor, 0.0, 1.0, "glossinessFactor", "material", name)
        texture = self._textures.texture(glossy.specularGlossinessTexture, True, name, f"{place}.specularGlossinessTexture")
        return {
            "metallic": 0.0, "ior": 1.5, "specular_factor": 1.0, "specular_texture": None, "specular_color_texture": texture,
            "specular_color": tuple(_FULL_REFLECTANCE * channel for channel in specular),
            "roughness": 1.0 - glossiness if texture is None else 1.0,
            "metallic_roughness_texture": None if texture is None else self._textures.roughness(texture, glossiness),
        }

    def _clearcoat(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        coat = self._document.extension_or_defaults(source, "KHR_materials_clearcoat", place)
        if coat.clearcoatFactor == 0.0:
            return {}
        place = f"{place}.extensions.KHR_materials_clearcoat"
        if coat.clearcoatNormalTexture is not None:
            self._document.left_out.add("clearcoatNormalTexture", "material", name)
        return {
            "clearcoat": coat.clearcoatFactor, "clearcoat_roughness": coat.clearcoatRoughnessFactor,
            "clearcoat_texture": self._textures.texture(coat.clearcoatTexture, False, name, f"{place}.clearcoatTexture"),
            "clearcoat_roughness_texture": self._textures.texture(
                coat.clearcoatRoughnessTexture, False, name, f"{place}.clearcoatRoughnessTexture"),
        }

    def _emission(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        strength = self._document.extension_or_defaults(source, "KHR_materials_emissive_strength", place).emissiveStrength
        emission = tuple(value * strength for value in source.emissiveFactor)
        if not any(emission):
            return {}
        if source.emissiveTexture is None:
            return {"emission": emission}
        texture = self._textures.texture(source.emissiveTexture, True, name, f"{place}.emissiveTexture")
        if texture is None:  # left out with a warning; without a texture the whole surface would glow
            return {}
        return {"emission": emission, "emission_texture": texture}


def absorption(volume: GltfObject) -> Color:
    """Return the coefficient a (Beer-Lambert) per unit of world length: exp(-a attenuationDistance) is the attenuationColor."""
    if math.isinf(volume.attenuationDistance) or volume.attenuationDistance <= 0.0:
        return BLACK
    red, green, blue = (-math.log(max(channel, _DARKEST)) / volume.attenuationDistance for channel in volume.attenuationColor)
    return (red, green, blue)


def _unlit(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a surface that emits its base colour and lights nothing."""
    texture = fields["albedo_texture"]
    return fields | {
        "kind": "diffuse", "albedo": BLACK, "emission": fields["albedo"], "emission_texture": texture, "two_sided": True,
        "emits_light": False, "albedo_texture": texture if fields["alpha_mode"] != "opaque" else None,  # its alpha still counts
    }
