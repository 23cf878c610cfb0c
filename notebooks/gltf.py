# %% [markdown]
# # Bring your own glTF
# Blender exports a scene by *File, Export, glTF 2.0*, and wrt renders the exported file. This notebook writes a glTF file itself, so that
# it needs no download. It shows what wrt does with each part: meshes, materials, camera, lights. To render your own file, change the
# file's name in the cell that loads it.
#
# In Blender's export dialog: format *glTF Binary (.glb)*; under *Include* tick *Cameras* and *Punctual Lights*; under *Transform* leave
# *+Y Up*; apply modifiers. Materials must be *Principled BSDF*. The export contains its colour, metallic, roughness, transmission, IOR,
# emission and normal map, but no other shader nodes.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller. The outputs below were made without it.

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
workplace = tempfile.TemporaryDirectory()  # for the files that this notebook makes; deleted when the kernel ends
folder = Path(workplace.name)

# %% [markdown]
# ## A glTF file by hand
# A `.glb` file contains JSON and one block of bytes. The JSON has lists. The list `nodes` is a tree of transforms, whose entries refer to
# `meshes`, `cameras` and lights. Meshes refer to `accessors` (arrays in the bytes) and `materials`, and materials refer to `textures`.
# Each reference is an index into a list.

# %%
class Glb:
    """The lists of a glTF file, and its bytes. Each method that adds an item returns the item's index."""

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
# glTF has one material model, *metallic-roughness*. The base colour is the albedo of a matte surface or the reflectance of a metal.
# `metallic` blends between the two, and `roughness` blurs reflections. Extensions add transmission (glass), volume (coloured glass), IOR
# and emissive strength. If a file has a volume, shadow rays go straight through glass and take its colour (`glass_shadows="tinted"`). So
# objects behind or inside the glass are lit. With `glass_shadows="opaque"` they are in shadow.

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
# ## Objects, a camera, lights
# glTF is right-handed with +y up; the exporter rotates Blender's +z to +y. A camera looks along its own -z. The extension
# `KHR_lights_punctual` has point, spot and directional lights. They have no size, so their shadows are sharp. Emissive surfaces have a
# size; wrt uses them as area lights with soft shadows.

# %%
def turned(axis, degrees):
    """Return a rotation as a quaternion x, y, z, w."""
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

WATTS = 60.0  # of a point light in Blender; the exporter's "Standard" lighting writes candela: 683 lumen per watt, over 4 pi sr
candela = 683 * WATTS / (4 * np.pi)
glb.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "color": [1, 0.9, 0.8], "intensity": candela}]}}
glb.json["extensionsUsed"] = ["KHR_lights_punctual", "KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_ior",
                              "KHR_materials_emissive_strength"]
glb.node(name="Light", translation=[-2.2, 2.6, 2.2], extensions={"KHR_lights_punctual": {"light": 0}})
glb.write(folder / "table.glb")
print(f"{(folder / 'table.glb').stat().st_size / 1e6:.2f} MB, point light of {WATTS:.0f} W: {candela:.0f} cd")

# %% [markdown]
# ## Load and look
# Put the name of your own file here. A glTF file has no sky, so rays that leave the scene see black. The second cell adds a background.

# %%
scene = wrt.load_scene(folder / "table.glb")
scene

# %%
sky = wrt.GradientBackground(bottom=(0.30, 0.28, 0.26), top=(0.10, 0.14, 0.22))
film = wrt.render(replace(scene, background=sky), size=SIZE, spp=SPP // 4)
print(f"mean radiance {film.pixels.mean():.1f}")
wrt.side_by_side({"": film})

# %% [markdown]
# The picture is much too bright, except where only the lamp lights the shadow. The point light has photometric units (candela), but
# emission and colours are near 1. wrt does not convert units. Export with *Lighting Mode: Unitless*, which omits the factor 683:

# %%
glb.json["extensions"]["KHR_lights_punctual"]["lights"][0]["intensity"] /= 683
glb.write(folder / "table.glb")
scene = replace(wrt.load_scene(folder / "table.glb"), background=sky)
film = wrt.render(scene, size=SIZE, spp=2 * SPP)
print(f"mean radiance {film.pixels.mean():.2f}")
wrt.side_by_side({"": film})

# %% [markdown]
# ## From radiance to a picture
# The film holds linear radiance. Exposure and tone mapping are applied afterwards, without a new render. The tone curve `none` clips
# values above 1; the other curves compress them. Blender's default is AgX, too.

# %%
part = np.s_[SIZE[1] // 5:, SIZE[0] // 2:SIZE[0] * 17 // 20]
shown = {tonemap: replace(film, tonemap=tonemap, exposure=0.5) for tonemap in ("none", "reinhard", "aces", "agx")}
wrt.side_by_side({tonemap: each.to_srgb8()[part] for tonemap, each in shown.items()}, columns=4)

# %% [markdown]
# `film.save("table.exr")` keeps the radiance itself, for any other program.
#
# ## A scene around the file
# A TOML file can contain what glTF cannot express, or what you do not want to change in Blender. It includes the `.glb`, and adds
# cameras, lights, background and settings. Its table `override` replaces a material of the same name. So you can export the model again
# without losing these changes.

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
# On the command line, `python -m wrt render table.toml -o table.png --camera close` renders it, and `python -m wrt info table.toml` lists
# its contents.
#
# ## Warnings for unsupported parts
# A picture that silently lacks something is worse than an error. One warning names everything in a file that wrt does not render:

# %%
glb.json["materials"][2]["extensions"] = {"KHR_materials_iridescence": {"iridescenceFactor": 1.0}}
glb.json["animations"] = [{"name": "spin", "channels": [], "samplers": []}]
glb.write(folder / "table.glb")
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    wrt.load_scene(folder / "table.glb")
for warning in caught:
    print(warning.category.__name__, "-", str(warning.message).split("table.glb: ")[1])
assert len(caught) == 1

# %% [markdown]
# A broken file raises one error, with the place in its JSON:

# %%
glb.json["nodes"][1]["mesh"] = 99
glb.write(folder / "table.glb")
try:
    wrt.load_scene(folder / "table.glb")
except wrt.InputError as error:
    print(str(error).split("table.glb: ")[1])

# %% [markdown]
# ## Exercises
# **1.** Load a file of your own. Which warnings does it give? Which of them can you see in the picture?
# <details><summary>Solution</summary>
#
# `docs/materials.md` lists all warnings, with what the picture shows instead of the part that is left out.
# </details>
#
# **2.** glTF has no depth of field. Add an aperture to `cameras.close` in the TOML file (in place of `fov_y`: `focal_length`,
# `sensor_height`, `f_number` and `focus_distance`, as in `scenes/lens.toml`), and focus on the spout.
# <details><summary>Solution</summary>
#
# For the same angle of view, the sensor's height is $2 s' \tan(\mathrm{fov}_y/2)$, where $s'$ is $f s/(s - f)$. With `focal_length = 0.9`
# and `focus_distance = 3.5` that is `sensor_height = 0.60`. `f_number = 2` makes a visible blur. The depth layer of a picture (`--aov
# depth`) has the distance of the spout.
# </details>
#
# **3.** Make the glass ball hollow: put a second, smaller sphere into it, with the corners of its faces in reverse order.
# <details><summary>Solution</summary>
#
# `inner = icosphere(5, 0.36)`, then `replace(inner, faces=inner.faces[:, ::-1], normals=-inner.normals)`, with the material `glass` and
# the same translation. The reversed faces say that the air is inside: a ray that meets them from the glass leaves the glass.
# </details>
#
# **4.** Use a checkerboard as the wood's roughness (`metallicRoughnessTexture`: green is roughness, blue is metallic).
# <details><summary>Solution</summary>
#
# `squares = 255 * ((x // 32 + y // 32) % 2)`. The texture is `np.stack([0 * x, squares, 0 * x], axis=-1).astype(np.uint8)`. The roughness
# is the product of texture and `roughnessFactor`, so set the factor to 1: black squares reflect like a mirror.
# </details>
