"""The Features (kernels/shade/features.py) with which the render kernels of a scene are compiled."""

import math

from wrt.accel.scenes.instancing import instanced_meshes
from wrt.core.types import JsonObject
from wrt.kernels.parameters import TEXTURES
from wrt.kernels.shade.features import Features
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CameraKind
from wrt.scene.lights import EMISSIVE, LIGHTS
from wrt.scene.materials import MATERIALS, Checkerboard, Texture
from wrt.scene.model import Scene

STACK_STEP = 16  # Stack sizes are multiples of this, so that scenes share kernels.
TOOLS = {"counting", "recording"}  # features for measurements and the inspector, which no scene asks for
PARAMETER_TEXTURES = tuple(name for name, texture in TEXTURES.items() if texture.feature == "parameter_textures")


def switches(features: Features) -> dict[str, bool]:
    """Return each on/off feature by name. Each kind of light, material and background counts as a feature, too."""
    on_off = {name: value for name, value in vars(features).items() if isinstance(value, bool) and name not in TOOLS}
    return on_off | {f"{name}_lights": name in features.lights for name in (*LIGHTS, *EMISSIVE)} | {
        name: name in features.materials for name in MATERIALS} | {
        name: name == features.background for name in BACKGROUNDS if name != Features.background}


def features_of(scene: Scene, camera: CameraKind, meshes: frozenset[int] = frozenset()) -> Features:
    """Return the features for a scene and a camera. meshes: id()s of the instanced meshes (wrt.accel.scenes.instancing)."""
    settings, materials = scene.settings, scene.materials
    textures = [texture for material in materials for texture in material.textures]
    kinds = {material.kind for material in materials}
    diffuse = any(MATERIALS[m.kind].scatters and max(m.albedo) > 0.0 for m in materials)
    rough = any(m.is_rough for m in materials)
    highlight = rough or any(max(m.specular) > 0.0 for m in materials)
    lit = diffuse or highlight
    occlusion = diffuse and max(scene.ambient) > 0.0 and scene.ambient_occlusion > 0.0
    lights = {light.kind for light in scene.lights}
    lights |= {"mesh"} if any(m.lights_others for thing in scene.objects for m in thing.materials) else set()
    lights |= {"sphere"} if any(s.material.lights_others for s in scene.spheres) else set()
    clear = [m for m in materials if m.is_clear]
    blend = any(m.alpha_mode == "blend" for m in materials)
    tinted = settings.glass_shadows == "tinted" and any(not m.thin for m in clear)
    reflection = any(MATERIALS[kind].reflects for kind in kinds)
    refraction = bool(clear)
    clearcoat = any(m.is_coated for m in materials)
    children = int(reflection) + int(refraction) + int(blend) + int(clearcoat)
    # A ray is popped before its children are pushed, so that each level adds children - 1 rays to the stack. The ray straight through a
    # blended surface does not increase the depth: it waits on the stack below its siblings until they are done.
    pending = (children - 1) * (settings.max_depth + 1) + 1
    return Features(
        camera=camera.device,
        **camera.switches(),
        filter=settings.filter != "box",
        independent=settings.sampler == "independent",
        instances=bool(meshes),
        spheres=bool(scene.spheres),
        smooth=any(thing.mesh.normals is not None for thing in scene.objects),
        textures=any(isinstance(texture, Texture) for texture in textures),
        checkerboards=any(isinstance(texture, Checkerboard) for texture in textures),
        normal_maps=any(m.normal_texture is not None for m in materials),
        parameter_textures=any(m.reads(name) and getattr(m, name) is not None for m in materials for name in PARAMETER_TEXTURES),
        cutout=any(m.alpha_mode == "mask" for m in materials),
        blend=blend,
        materials=tuple(name for name in MATERIALS if name in kinds),
        thin_glass=any(m.thin for m in clear),
        absorption=any(max(m.absorption) > 0.0 for m in clear),
        transmission=any(m.uses("transmission") for m in clear),
        rough=rough,
        highlight=highlight,
        specular=any(m.scales_reflectance for m in materials),
        clearcoat=clearcoat,
        schlick=settings.fresnel == "schlick" and any(m.uses("ior") for m in materials),
        emission=any(m.is_emissive for m in materials),
        lights=tuple(name for name in (*LIGHTS, *EMISSIVE) if lit and name in lights),
        background=scene.background.kind,
        sky_light=lit and not scene.background.is_black,
        ambient=max(scene.ambient) > 0.0 and not occlusion,
        ambient_occlusion=occlusion,
        tinted_shadows=tinted,
        transparent_shadows=lit and (blend or tinted or any(m.thin for m in clear)),
        reflection=reflection,
        refraction=refraction,
        stack_size=1 if children < 2 else STACK_STEP * math.ceil(pending / STACK_STEP),
    )


def describe(scene: Scene, camera: str | int | None = None) -> JsonObject:
    """Return counts, names, bounds (None without shapes) and features of a scene, as `python -m wrt info` prints them."""
    meshes = {id(o.mesh): o.mesh for o in scene.objects}.values()
    has_shapes = scene.spheres or any(len(thing.mesh.faces) for thing in scene.objects)
    low, high = (corner.tolist() for corner in scene.bounds()) if has_shapes else (None, None)
    return {
        "name": scene.name,
        "triangles": sum(len(thing.mesh.faces) for thing in scene.objects),
        "unique_triangles": sum(len(mesh.faces) for mesh in meshes),
        "zero_area_triangles_left_out": sum(mesh.dropped for mesh in meshes),
        "objects": len(scene.objects),
        "spheres": len(scene.spheres),
        "materials": [f"{m.name or i} ({m.kind})" for i, m in enumerate(scene.materials)],
        "lights": [f"{light.name or i} ({type(light).__name__})" for i, light in enumerate(scene.lights)],
        "emissive_objects": sum(any(m.lights_others for m in o.materials) for o in scene.objects),
        "background": type(scene.background).__name__,
        "cameras": [c.name or str(i) for i, c in enumerate(scene.cameras)],
        "size": "{}x{}".format(*scene.settings.size),
        "spp": scene.settings.spp,
        "bounds_low": low,
        "bounds_high": high,
        "features": switches(features_of(scene, scene.camera(camera), instanced_meshes(scene))),
    }
