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
from wrt.scene.materials import SLOTS, Material, Texture
from wrt.scene.values import BLACK

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_DARKEST = 1e-6  # channel of an attenuation colour; 0 would need infinite absorption
_FULL_REFLECTANCE = 25.0  # factor on the reflectance of the index 1.5, 0.04, that makes it 1
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"
_ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}

_LIMITS = {key: (each.metadata["limits"].get("ge", 0.0), each.metadata["limits"].get("le", LARGEST))
           for key, each in forms(Material).items() if each.metadata["form"] in ("number", "color")}
# The fields of a Material by the object of glTF that holds them, with their keys in it.
_KEYS = {
    "pbrMetallicRoughness": {"metallic": "metallicFactor", "roughness": "roughnessFactor",
                             "metallic_roughness_texture": "metallicRoughnessTexture"},
    "KHR_materials_specular": {"specular_factor": "specularFactor", "specular_color": "specularColorFactor",
                               "specular_texture": "specularTexture", "specular_color_texture": "specularColorTexture"},
    "KHR_materials_transmission": {"transmission": "transmissionFactor", "transmission_texture": "transmissionTexture"},
    "KHR_materials_clearcoat": {"clearcoat": "clearcoatFactor", "clearcoat_roughness": "clearcoatRoughnessFactor",
                                "clearcoat_texture": "clearcoatTexture", "clearcoat_roughness_texture": "clearcoatRoughnessTexture"},
}
_SWITCHES = ("transmission", "clearcoat")  # a factor of 0 means that the extension has no effect


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
        sampler = self._document.item("samplers", texture.sampler, f"{place}.sampler")
        if sampler.magFilter == _NEAREST:
            self._document.left_out.add("nearest-neighbour sampling", "material", material)
        return (_WRAPS.get(sampler.wrapS, "repeat"), _WRAPS.get(sampler.wrapT, "repeat"))

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
                place = f"{place}.uri: {short(image.uri)}"
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
        document = self._document
        document.left_out.add_extensions(source.extensions, "material", name)
        glossy = document.extension(source, _GLOSSY, place)
        if glossy is not None:  # a reader that knows this extension ignores pbrMetallicRoughness
            source.pbrMetallicRoughness = read(ITEMS["materials"], {}, "").pbrMetallicRoughness
        fields = self._clamped(self._base(source, glossy, name, place), name)
        if document.extension(source, "KHR_materials_unlit", place) is not None:
            fields = _unlit(fields)
        else:
            fields |= {"kind": "metallic_roughness"} | self._by_keys(source, name, place)
            ior = document.extension_or_defaults(source, "KHR_materials_ior", place).ior
            fields["ior"] = ior or 1.5
            if not ior:  # an index of 0 means the reflectance 1 times the specular factors
                fields["specular_color"] = [_FULL_REFLECTANCE * channel for channel in fields["specular_color"]]
            if (normal := source.normalTexture) is not None:
                fields["normal_texture"] = self._textures.texture(normal, False, name, f"{place}.normalTexture")
                fields["normal_scale"] = normal.scale
            if fields.get("transmission"):
                fields |= self._volume(source, name, place)
            fields |= self._emission(source, name, place)
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

    def _by_keys(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        """Return the fields in _KEYS."""
        fields: dict[str, Any] = {}
        for holder, keys in _KEYS.items():
            if holder.startswith("KHR"):
                values, where = self._document.extension_or_defaults(source, holder, place), f"{place}.extensions.{holder}"
            else:
                values, where = getattr(source, holder), f"{place}.{holder}"
            for field, key in keys.items():
                value = getattr(values, key)
                if field in _SWITCHES and value == 0.0:
                    break
                fields[field] = self._textures.texture(value, SLOTS[field], name, f"{where}.{key}") if field in SLOTS else value
            if "clearcoat" in fields and getattr(values, "clearcoatNormalTexture", None) is not None:
                self._document.left_out.add("clearcoatNormalTexture", "material", name)
        return fields

    def _volume(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        """Return the fields of glass: a thin pane, or solid glass if KHR_materials_volume gives a thickness above 0."""
        volume = self._document.extension_or_defaults(source, "KHR_materials_volume", place)
        if volume.thicknessFactor <= 0.0:
            return {"thin": True}
        distance, mistakes = volume.attenuationDistance, self._document.mistakes
        color = mistakes.clamp(volume.attenuationColor, 0.0, 1.0, "attenuationColor", "material", name)
        if distance <= 0.0:
            mistakes.add("attenuationDistance of 0, now infinite", "material", name)
        if not 0.0 < distance < math.inf:
            return {"thin": False}
        # By Beer-Lambert, exp(-absorption distance) is the colour.
        return {"thin": False, "absorption": [-math.log(max(channel, _DARKEST)) / distance for channel in color]}

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

    def _emission(self, source: GltfObject, name: str, place: str) -> dict[str, Any]:
        strength = self._document.extension_or_defaults(source, "KHR_materials_emissive_strength", place).emissiveStrength
        emission = tuple(value * strength for value in source.emissiveFactor)
        if not any(emission) or source.emissiveTexture is None:
            return {"emission": emission}
        texture = self._textures.texture(source.emissiveTexture, True, name, f"{place}.emissiveTexture")
        # A texture that is left out leaves no emission: without it, the whole surface would glow.
        return {"emission": emission if texture else BLACK, "emission_texture": texture}


def _unlit(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a surface that emits its base colour and lights nothing."""
    texture = fields["albedo_texture"]
    return fields | {
        "kind": "diffuse", "albedo": BLACK, "emission": fields["albedo"], "emission_texture": texture, "two_sided": True,
        "emits_light": False, "albedo_texture": texture if fields["alpha_mode"] != "opaque" else None,  # its alpha still counts
    }
