"""Make the pictures of README.md and docs/gallery.md: `PYTHONPATH=. python docs/images/make.py`."""

import contextlib
import io
import re
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import wrt
from tests.gltf_files import GltfFile
from wrt.scene.shapes import icosphere, lathe

HERE = Path(__file__).resolve().parent
SIZE = (400, 300)
ROOM = """
include = [{ file = "glass.glb" }]
ambient = 0.05
[settings]
max_depth = 24
tonemap = "agx"
[cameras.main]
position = [0.3, 2.4, 6.4]
target = [0.1, 0.95, 0]
fov_y = 27
[background]
type = "gradient"
bottom = [0.75, 0.72, 0.68]
top = [0.25, 0.42, 0.75]
[materials.floor]
albedo_texture = { checkerboard = { color_a = 0.75, color_b = [0.16, 0.20, 0.27], scale = 24 } }
[[quads]]
corner = [-12, 0, 12]
edge_u = [24, 0, 0]
edge_v = [0, 0, -24]
material = "floor"
[[lights]]
type = "rectangle"
corner = [-3.5, 5, 1]
edge_u = [1.5, 0, 0]
edge_v = [0, 0, 1.5]
radiance = 14
"""


def arc(radius: float, height: float, bulge: float, rise: float, step: int) -> list[tuple[float, float]]:
    """Return profile points (radius, height) of a wall that bulges at half its height, bottom up if step is 1, top down if -1."""
    return [(radius + bulge * np.sin(np.pi * s), height + rise * s) for s in np.linspace(0.0, 1.0, 24)[::step]]


def glass(folder: Path) -> Path:
    """Write a glTF file (a vase of tinted glass, a metal ball and a clay ball) and a scene with it; return the scene's path."""
    gltf = GltfFile()
    vase = lathe([(0.0, 0.0), (0.42, 0.0), (0.42, 0.0), *arc(0.42, 0.0, 0.38, 1.75, 1), *arc(0.34, 0.16, 0.38, 1.59, -1),
                  (0.34, 0.16), (0.0, 0.16)], 96)
    ball = icosphere(5, 0.45)
    tint = {"transmissionFactor": 1.0}
    volume = {"thicknessFactor": 0.1, "attenuationColor": [0.25, 0.75, 0.62], "attenuationDistance": 0.35}
    kinds = [({"metallicFactor": 0.0, "roughnessFactor": 0.0},
              {"KHR_materials_transmission": tint, "KHR_materials_volume": volume, "KHR_materials_ior": {"ior": 1.5}}),
             ({"metallicFactor": 1.0, "roughnessFactor": 0.12, "baseColorFactor": [0.95, 0.72, 0.32, 1.0]}, {}),
             ({"metallicFactor": 0.0, "roughnessFactor": 0.8, "baseColorFactor": [0.55, 0.10, 0.06, 1.0]}, {})]
    gltf.json["extensionsUsed"] = sorted(kinds[0][1])
    places = [(vase, [0.0, 0.0, 0.0]), (ball, [-1.15, 0.45, 0.3]), (ball, [0.95, 0.45, -1.1])]
    for (mesh, place), (surface, extensions) in zip(places, kinds, strict=True):
        material = gltf.add("materials", {"pbrMetallicRoughness": surface, "extensions": extensions})
        primitive = gltf.primitive(mesh.vertices, mesh.faces.ravel(), material=material)
        primitive["attributes"]["NORMAL"] = gltf.accessor(mesh.normals)
        gltf.node(mesh=gltf.mesh(primitive), translation=place)
    gltf.write(folder, "glass.glb")
    room = folder / "room.toml"
    room.write_text(ROOM, encoding="utf-8")
    return room


def rays() -> None:
    """Draw the rays of a pixel that shows a prism: refraction, inner reflections, and the shadow rays of a point behind it."""
    tree = wrt.inspect(HERE.parents[1] / "scenes" / "glass_slab.toml", (440, 215), 0, min_throughput=0.01, spp=1)
    file = io.BytesIO()
    tree.figure().savefig(file)
    picture = Image.open(file).convert("RGB")
    picture = picture.resize((1000, round(picture.height * 1000 / picture.width)), Image.Resampling.LANCZOS)
    picture.save(HERE / "rays.jpg", quality=88, optimize=True)


def gallery() -> dict[str, str]:
    """Return the code of each picture of docs/gallery.md, by the name of its file."""
    page = (HERE.parent / "gallery.md").read_text(encoding="utf-8")
    codes = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    return {re.search(r'save\("(.*)"\)\n\Z', code)[1]: code for code in codes}


def run(code: str, folder: Path) -> None:
    """Run the code of a picture, which saves the picture in `folder`."""
    with contextlib.chdir(folder):
        exec(code.replace('"scenes/', f'"{HERE.parents[1]}/scenes/'), {})


def main() -> None:
    for code in gallery().values():
        run(code, HERE / "gallery")
    stadium = HERE.parents[1] / "scenes" / "stadium.toml"
    wrt.render(stadium, spp=64, size=SIZE).save(HERE / "mesh.png")
    with tempfile.TemporaryDirectory() as folder:
        wrt.render(glass(Path(folder)), spp=256, size=SIZE).save(HERE / "glass.png")
    rays()


if __name__ == "__main__":
    main()
