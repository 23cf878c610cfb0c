"""Digests of scenes and cameras: equal for equal pictures, whatever the names of files and parts."""

from __future__ import annotations

from hashlib import sha256

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.pack import pack

# Fields that change no pixel.
NO_PIXEL: dict[type, tuple[str, ...]] = {
    object: ("name",), Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def scene_digest(scene: Scene) -> str:
    """Return the SHA-256 of all that can change a pixel, except cameras and settings."""
    return _digest(scene)


def camera_digest(camera: CameraKind) -> str:
    return _digest(camera)


def _digest(thing: Scene | CameraKind) -> str:
    text, arrays = pack(thing, NO_PIXEL)
    out = sha256(text.encode())
    for array in arrays:
        out.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
    return out.hexdigest()
