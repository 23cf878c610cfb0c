"""Translate two pbrt-v3 scenes of the data set to wrt's scene files (TOML), as a user would write them.

The scene files name the meshes by their absolute paths. Run as a program to write one:

    python -m tests.pbrt_scene kitchen out/kitchen.toml && python -m wrt render out/kitchen.toml
"""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import numpy as np

from tests.data import DATA

# The files set "remaproughness false", so uroughness is GGX's alpha; wrt's roughness is the square root of alpha.
BY_TYPE = {
    "matte": lambda p: {"kind": "diffuse", "albedo": p.get("Kd", [0.5] * 3)},
    "substrate": lambda p: {"kind": "metallic_roughness", "albedo": p.get("Kd", [0.5] * 3), "roughness": _roughness(p)},
    "glass": lambda p: {"kind": "glass", "ior": p.get("index", [1.5])[0], "albedo": p.get("Kt", [1.0] * 3)},
    "mirror": lambda p: {"kind": "mirror", "albedo": [0.9] * 3},
    "metal": lambda p: {"kind": "conductor", "eta": p["eta"], "k": p["k"], "roughness": _roughness(p)},
    "uber": lambda p: {"kind": "diffuse", "albedo": p["Kd"], "alpha": p["opacity"][0], "alpha_mode": "blend"},
}


def _roughness(parameters: dict[str, list[float]]) -> float:
    return round(math.sqrt(parameters.get("uroughness", [0.0])[0]), 4)


def _parameters(text: str) -> dict[str, list[float]]:
    """Parse parameters such as `"rgb Kd" [ 1 2 3 ]` to lists by name; strings (textures, types) are left out."""
    found = re.findall(r'"(?:rgb|float|point|integer) (\w+)" \[([^\]]*)\]', text)
    return {name: [float(number) for number in values.split()] for name, values in found}


def materials(text: str) -> dict[str, dict[str, object]]:
    out: dict[str, dict[str, object]] = {}
    for name, kind, rest in re.findall(r'MakeNamedMaterial "(\w+)" "string type" \[ "(\w+)" \](.*)', text):
        out[name] = BY_TYPE[kind](_parameters(rest))
    return out


def camera(text: str) -> tuple[str, tuple[int, int]]:
    """Return the camera's TOML table, and the picture's width and height. pbrt looks along +z; its matrix maps world to camera
    space, and is stored by columns."""
    numbers = re.search(r"^Transform \[([^\]]*)\]", text, re.MULTILINE)
    assert numbers
    world_to_camera = np.array([float(x) for x in numbers[1].split()]).reshape(4, 4).T
    pose = np.linalg.inv(world_to_camera)
    width, height = (int(re.search(rf'"integer {axis}resolution" \[ (\d+) \]', text)[1]) for axis in "xy")  # type: ignore[index]
    half = math.tan(math.radians(float(re.search(r'"float fov" \[ ([\d.]+) \]', text)[1]) / 2.0))  # type: ignore[index]
    fov_y = 2.0 * math.degrees(math.atan(half * max(1.0, height / width)))  # pbrt's fov is for the shorter side
    position, forward, up = pose[:3, 3], pose[:3, 2], pose[:3, 1]
    table = (f"[cameras.main]\nposition = {position.tolist()}\ntarget = {(position + forward).tolist()}\n"
             f"up = {up.tolist()}\nfov_y = {fov_y:.4f}\n")
    return table, (width, height)


def _table(name: str, values: dict[str, object]) -> str:
    def toml(value: object) -> str:
        return f'"{value}"' if isinstance(value, str) else str(value)

    return f"[materials.{name}]\n" + "".join(f"{key} = {toml(value)}\n" for key, value in values.items())


def kitchen() -> str:
    folder = DATA / "scenes/bitterli_kitchen"
    text = (folder / "scene.pbrt").read_text()
    table, size = camera(text)
    tables = materials(text)
    parts = []
    for line in (folder / "kitchen_parts.tsv").read_text().splitlines()[1:]:
        _, first, count, material, _, light = (line + "\t").split("\t")[:6]
        name = material.replace(":", "_")
        if light.strip():
            name = f"light_{first}"
            tables[name] = {"kind": "diffuse", "albedo": [0.0] * 3, "emission": [float(x) for x in light.split()]}
        elif name not in tables:
            tables[name] = {"kind": "diffuse", "albedo": [0.5] * 3}
        parts.append(f'{{first = {first}, count = {count}, material = "{name}"}}')
    mesh = f'[[meshes]]\nfile = "{folder / "kitchen_1443k.ply"}"\nsmooth = false\nparts = [\n  ' + ",\n  ".join(parts) + "\n]\n"
    settings = f'ambient = [0.25, 0.25, 0.25]\n[settings]\nsize = {list(size)}\nglass_shadows = "tinted"\ntonemap = "aces"\n'
    return "\n".join(["# The country kitchen.", settings, table, *(_table(n, v) for n, v in tables.items()), mesh])


def coffee() -> str:
    folder = DATA / "scenes/pbrt_coffee"
    text = (folder / "scene.pbrt").read_text()
    table, size = camera(text)
    tables = materials(text)
    shapes = []
    current = ""
    for line in text.splitlines():
        if named := re.search(r'NamedMaterial "(\w+)"', line):
            current = named[1]
        elif mesh := re.search(r'"plymesh" "string filename" \[ "([^"]+)" \]', line):
            shapes.append(f'[[meshes]]\nfile = "{folder / mesh[1]}"\nmaterial = "{current}"\n')
        elif "AreaLightSource" in line:
            radiance = _parameters(line)["L"]
        elif "trianglemesh" in line:
            p = np.array(_parameters(line)["P"]).reshape(-1, 3)
            shapes.append(f'[[lights]]\ntype = "rectangle"\ncorner = {p[0].tolist()}\nedge_u = {(p[1] - p[0]).tolist()}\n'
                          f"edge_v = {(p[3] - p[0]).tolist()}\nradiance = {radiance}\n")
    settings = f'ambient = [0.1, 0.1, 0.1]\n[settings]\nsize = {list(size)}\nglass_shadows = "tinted"\n'
    return "\n".join(["# The coffee maker.", settings, table, *(_table(n, v) for n, v in tables.items()), *shapes])


SCENES = {"kitchen": kitchen, "coffee": coffee}

if __name__ == "__main__":
    Path(sys.argv[2]).write_text(SCENES[sys.argv[1]]())
