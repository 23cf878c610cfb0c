"""What a scene is, as one number: the same for the same picture, whatever the file is called that it came from."""

from __future__ import annotations

from hashlib import sha256
from typing import Any

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.pack import pack

# What of them changes no pixel.
NO_PIXEL: dict[type, tuple[str, ...]] = {
    object: ("name",), Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def scene_digest(scene: Scene) -> str:
    """SHA-256 of everything in a scene that can change a pixel, but for cameras and settings."""
    return _digest(scene)


def camera_digest(camera: CameraKind) -> str:
    return _digest(camera)


def _digest(thing: Any) -> str:
    text, arrays = pack(thing, NO_PIXEL)
    out = sha256(text.encode())
    for array in arrays:
        out.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
    return out.hexdigest()
