# %% [markdown]
# # Bring your own glTF
# A scene made in Blender becomes a picture here by way of glTF 2.0: *File, Export, glTF 2.0*. This notebook makes such a file by
# itself, so that it runs without any download, and shows what wrt does with each part: meshes, materials, camera, lights. Then
# put your own file's name into the cell that loads it.
#
# In Blender's export dialog: format *glTF Binary (.glb)*; under *Include* tick *Cameras* and *Punctual Lights*; under *Transform*
# leave *+Y Up*; apply modifiers. Materials must be *Principled BSDF*: colour, metallic, roughness, transmission, IOR, emission
# and a normal map go with it, node trees do not.
#
# With `WRT_QUICK` in the environment, pictures are smaller; the outputs below are of the full setting.

# %%
import io
import json
import os
import struct
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import wrt
from wrt.scene.shapes import box, icosphere, quad, teapot, torus

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP = ((160, 90), 4) if QUICK else ((480, 270), 48)
workplace = tempfile.TemporaryDirectory()  # for the files that this notebook makes; gone when the kernel ends
folder = Path(workplace.name)

# %% [markdown]
# ## A glTF file by hand
# A `.glb` is JSON and one block of bytes. The JSON has lists: `nodes` (places in the world, in a tree) that point to `meshes`,
# `cameras`, lights; meshes point to `accessors` (arrays in the bytes) and `materials`; materials point to `textures`. Everything
# points by its number in a list.

# %%
class Glb:
    """Collects the lists of a glTF file, and the bytes; every method returns the number of what it added."""

    def __init__(self):
        self.json = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], "extensionsUsed": []}
        self.bytes = bytearray()

    def add(self, kind, **item):
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def view(self, data):
        self.bytes += bytes(-len(self.bytes) % 4)
        self.bytes += data
        return self.add("bufferViews", buffer=0, byteOffset=len(self.bytes) - len(data), byteLength=len(data))

    def accessor(self, array, kind, component):
        limits = {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()} if kind == "VEC3" else {}
        view = self.view(np.ascontiguousarray(array).tobytes())
        return self.add("accessors", bufferView=view, componentType=component, count=len(array), type=kind, **limits)

    def mesh(self, mesh, material):
        attributes = {"POSITION": self.accessor(mesh.vertices, "VEC3", 5126)}
        if mesh.normals is not None:
            attributes["NORMAL"] = self.accessor(mesh.normals, "VEC3", 5126)
        if mesh.uvs is not None:
            attributes["TEXCOORD_0"] = self.accessor(mesh.uvs, "VEC2", 5126)
        indices = self.accessor(mesh.faces.reshape(-1).astype(np.uint32), "SCALAR", 5125)
        return self.add("meshes", primitives=[{"attributes": attributes, "indices": indices, "material": material}])

    def texture(self, picture):
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "PNG")
        image = self.add("images", bufferView=self.view(file.getvalue()), mimeType="image/png")
        return self.add("textures", source=image)

    def node(self, **item):
        self.json["scenes"][0]["nodes"].append(self.add("nodes", **item))

    def write(self, path):
        self.json["buffers"] = [{"byteLength": len(self.bytes)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self.bytes) + bytes(-len(self.bytes) % 4)
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data)) + struct.pack("<I4s", len(text), b"JSON")
                         + text + struct.pack("<I4s", len(data), b"BIN\0") + data)

# %% [markdown]
# ## Materials
# All of glTF's materials are one: *metallic-roughness*. The base colour is what a matte surface scatters, or what a metal
# reflects; `metallic` chooses between the two; `roughness` blurs reflections. Extensions add to it: transmission (glass), volume
# (coloured glass), IOR, emissive strength. In a file with a volume, shadow rays go through glass and take its colour
# (`glass_shadows="tinted"`): what stands behind it, or in it, is lit. `glass_shadows="opaque"` is for a heavy shadow.

# %%
glb = Glb()


def material(name, color, metallic, roughness, **more):
    surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness}
    surface |= more.pop("surface", {})
    return glb.add("materials", name=name, pbrMetallicRoughness=surface, **more)


def transmission(**volume):
    extensions = {"KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_ior": {"ior": 1.5}}
    return extensions | ({"KHR_materials_volume": volume} if volume else {})


y, x = np.mgrid[:256, :256]
planks = (np.stack([178 + 0 * x, 128 + 0 * x, 86 + 0 * x], axis=-1) * (0.80 + 0.05 * (y // 32 % 4)[..., None])
          + 9 * np.sin(0.35 * x + 3 * np.sin(0.05 * x + (y // 32) * 2.1))[..., None])
planks[y % 32 == 0] *= 0.55
wood = material("planks", (1, 1, 1), 0.0, 0.55,
                surface={"baseColorTexture": {"index": glb.texture(np.clip(planks, 0, 255).astype(np.uint8))}})
gold = material("gold", (1.0, 0.77, 0.34), 1.0, 0.25)
clay = material("clay", (0.55, 0.16, 0.12), 0.0, 0.35)
glass = material("glass", (1, 1, 1), 0.0, 0.0,
                 extensions=transmission(thicknessFactor=1.0, attenuationColor=[0.35, 0.85, 0.65], attenuationDistance=0.6))
lamp = material("lamp", (0, 0, 0), 0.0, 1.0, emissiveFactor=[1.0, 0.85, 0.6],
                extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 9.0}})
len(glb.json["materials"])

# %% [markdown]
# ## Things, a camera, lights
# glTF is right-handed with +y up; the exporter turns Blender's +z up into that. A camera looks along its own -z.
# `KHR_lights_punctual` has point, spot and directional lights, without size: their shadows are sharp. Emissive surfaces have a
# size, and wrt takes them as lights: soft shadows.

# %%
def turned(axis, degrees):
    """A quaternion x, y, z, w."""
    half = np.radians(degrees) / 2
    return [*(np.sin(half) * np.array(axis, float)).tolist(), float(np.cos(half))]


glb.node(name="floor", mesh=glb.mesh(quad((-4, 0, 3), (8, 0, 0), (0, 0, -6)), wood))
glb.node(name="pot", mesh=glb.mesh(teapot(48), clay), translation=[-0.95, 0, 0], rotation=turned((0, 1, 0), -25))
glb.node(name="ring", mesh=glb.mesh(torus(0.42, 0.13, 96, 48), gold), translation=[0.75, 0.42, -0.55],
         rotation=turned((1, 0.25, 0) / np.linalg.norm((1, 0.25, 0)), 78))
glb.node(name="ball", mesh=glb.mesh(icosphere(5, 0.4), glass), translation=[0.55, 0.4, 0.65])
glb.node(name="lamp", mesh=glb.mesh(box((-0.5, 0, -0.5), (0.5, 0.04, 0.5)), lamp), translation=[0.2, 2.4, 0.4])

pose = wrt.Camera.look_at((0.6, 1.35, 3.7), (0.0, 0.42, 0.0)).camera_to_world
glb.node(name="Camera", matrix=pose.T.reshape(-1).tolist(),
         camera=glb.add("cameras", type="perspective", perspective={"yfov": float(np.radians(31)), "znear": 0.1}))

WATTS = 60.0  # of a point light in Blender; the exporter's "Standard" lighting writes candela: 683 lumen to a watt, over 4 pi
candela = 683 * WATTS / (4 * np.pi)
glb.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "color": [1, 0.9, 0.8], "intensity": candela}]}}
glb.json["extensionsUsed"] = ["KHR_lights_punctual", "KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_ior",
                              "KHR_materials_emissive_strength"]
glb.node(name="Light", translation=[-2.2, 2.6, 2.2], extensions={"KHR_lights_punctual": {"light": 0}})
glb.write(folder / "table.glb")
print(f"{(folder / 'table.glb').stat().st_size / 1e6:.2f} MB, point light of {WATTS:.0f} W: {candela:.0f} cd")

# %% [markdown]
# ## Load and look
# Here is the place for your own file's name. glTF knows no sky: what rays see that leave the scene is black, until it is said
# otherwise.

# %%
scene = wrt.load_scene(folder / "table.glb")
scene

# %%
sky = wrt.GradientBackground(bottom=(0.30, 0.28, 0.26), top=(0.10, 0.14, 0.22))
film = wrt.render(replace(scene, background=sky), size=SIZE, spp=SPP // 4)
print(f"mean radiance {film.pixels.mean():.1f}")
wrt.side_by_side({"": film})

# %% [markdown]
# Much too bright, but for the lamp's soft light in the shadow: the point light is in photometric units (candela), emission and
# colours are near 1, and wrt takes all of them as they stand. Export with *Lighting Mode: Unitless*, which leaves the 683 out:

# %%
glb.json["extensions"]["KHR_lights_punctual"]["lights"][0]["intensity"] /= 683
glb.write(folder / "table.glb")
scene = replace(wrt.load_scene(folder / "table.glb"), background=sky)
film = wrt.render(scene, size=SIZE, spp=2 * SPP)
print(f"mean radiance {film.pixels.mean():.2f}")
wrt.side_by_side({"": film})

# %% [markdown]
# ## From radiance to a picture
# The film holds linear radiance; how it is shown is decided afterwards, and costs nothing. `none` clips what is brighter than 1;
# the curves bend it down. Blender's default is AgX, too.

# %%
part = np.s_[SIZE[1] // 5:, SIZE[0] // 2:SIZE[0] * 17 // 20]
shown = {tonemap: replace(film, tonemap=tonemap, exposure=0.5) for tonemap in ("none", "reinhard", "aces", "agx")}
wrt.side_by_side({tonemap: each.to_srgb8()[part] for tonemap, each in shown.items()}, columns=4)

# %% [markdown]
# `film.save("table.exr")` keeps the radiance itself, for any other program.
#
# ## A scene around the file
# What glTF cannot say, or what you do not want to change in Blender, stands in a TOML file around it: it includes the `.glb`, and
# adds cameras, lights, background and settings; `override` replaces a material of the same name. So the model can be exported
# again and again.

# %%
(folder / "table.toml").write_text("""
title = "the table, seen from the other side"
include = ["table.glb"]

[settings]
max_depth = 10
tonemap = "aces"
exposure = 0.6

[cameras.close]
position = [-2.7, 1.1, 3.0]
target = [-0.1, 0.42, 0.0]
fov_y = 28

[background]
type = "gradient"
bottom = [0.30, 0.28, 0.26]
top = [0.10, 0.14, 0.22]

[override.clay]
kind = "metallic_roughness"
albedo = [0.10, 0.22, 0.45]
roughness = 0.15
""")
around = wrt.load_scene(folder / "table.toml")
print([camera.name for camera in around.cameras])
wrt.side_by_side({"": wrt.render(around, size=SIZE, spp=2 * SPP)})

# %% [markdown]
# On the command line: `python -m wrt render table.toml -o table.png --camera close`, and `python -m wrt info table.toml` for what
# is in it.
#
# ## What is left out is told
# A picture that silently lacks something is worse than an error. Everything in a file that wrt does not draw is named in one
# warning:

# %%
glb.json["materials"][2]["extensions"] = {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0}}
glb.json["animations"] = [{"name": "spin", "channels": [], "samplers": []}]
glb.write(folder / "table.glb")
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    wrt.load_scene(folder / "table.glb")
for warning in told:
    print(warning.category.__name__, "-", str(warning.message).split("table.glb: ")[1])
assert len(told) == 1

# %% [markdown]
# And a file that is broken is one clear error, with the place in its JSON:

# %%
glb.json["nodes"][1]["mesh"] = 99
glb.write(folder / "table.glb")
try:
    wrt.load_scene(folder / "table.glb")
except wrt.InputError as error:
    print(str(error).split("table.glb: ")[1])

# %% [markdown]
# ## Exercises
# 1. Load a file of your own. Which warnings does it give? Which of them can you see in the picture?
# 2. glTF has no depth of field. Add an aperture to `cameras.close` in the TOML file (in place of `fov_y`: `focal_length`,
#    `sensor_height`, `f_number` and `focus_distance`, as in `scenes/lens.toml`), and focus on the spout.
# 3. Make the glass ball hollow: a second, smaller sphere in it with its faces turned round.
# 4. Let a checkerboard be the wood's roughness (`metallicRoughnessTexture`: green is roughness, blue is metallic).
