"""scenes/textures/make.py writes the images in scenes/textures."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np

from tests.data import ROOT
from wrt.picture.decode import decode_rgba8
from wrt.picture.image import read_image

TEXTURES = ROOT / "scenes" / "textures"


def test_images_are_what_the_script_makes(tmp_path: Path) -> None:
    script = runpy.run_path(str(TEXTURES / "make.py"))
    script["main"].__globals__["FOLDER"] = tmp_path
    script["main"]()
    names = {path.name for path in TEXTURES.iterdir() if path.suffix in (".png", ".hdr")}
    assert names == {path.name for path in tmp_path.iterdir()} and len(names) == 7
    for name in names:
        read = read_image if name.endswith(".hdr") else lambda path: decode_rgba8(path.read_bytes()) / np.float32(255.0)
        # Values are rounded to codes: another machine's sine may round to a neighbour.
        np.testing.assert_allclose(read(tmp_path / name), read(TEXTURES / name), atol=1.01 / 255.0, rtol=1.0 / 128.0, err_msg=name)
