"""A scene file (TOML) for the Cornell box of the data set: materials for the groups of its OBJ file, and a camera.

The scene file names the OBJ file by its absolute path. Run as a program to write it:

    python -m tests.cornell_box out/cornell_box.toml && python -m wrt render out/cornell_box.toml
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.data import DATA

# Albedos and emission are the usual RGB values of this scene.
SCENE = """\
# The Cornell box, lit by its lamp alone.
title = "cornell box"

[settings]
size = [512, 512]
spp = 64
max_depth = 0
filter = "box"

[cameras.main]
position = [0.0, 1.0, 6.8]
target = [0.0, 1.0, 0.0]
fov_y = 19.5

[materials.white]
albedo = [0.725, 0.71, 0.68]

[materials.red]
albedo = [0.63, 0.065, 0.05]

[materials.green]
albedo = [0.14, 0.45, 0.091]

[materials.lamp]
albedo = 0
emission = [17, 12, 4]

[[meshes]]
name = "box"
file = "{file}"
material = "white"
materials = {{ leftWall = "red", rightWall = "green", light = "lamp" }}
"""


def cornell_box() -> str:
    return SCENE.format(file=DATA.resolve() / "scenes/cornell_box_obj/cornell_box.obj")


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(cornell_box())
