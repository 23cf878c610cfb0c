"""What a scene is, as one number: the same for the same picture, whatever the file is called that it came from."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

# What of them changes no pixel, beside names.
NO_PIXEL = {Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def scene_digest(scene: Scene) -> str:
    """SHA-256 of everything in a scene that can change a pixel, but for cameras and settings."""
    return _digest(scene, {}).hex()


def camera_digest(camera: CameraKind) -> str:
    return _digest(camera, {}).hex()


def _digest(value: Any, known: dict[int, bytes]) -> bytes:
    """known: digests by id of what was met before; objects share meshes, materials and textures."""
    if is_dataclass(value) and id(value) in known:
        return known[id(value)]
    out = sha256(type(value).__name__.encode() + b"\0")
    if is_dataclass(value):
        left_out = ("name", *NO_PIXEL.get(type(value), ()))
        for each in fields(value):
            if each.name not in left_out:
                out.update(each.name.encode() + b"\0" + _digest(getattr(value, each.name), known))
        known[id(value)] = out.digest()
    elif isinstance(value, tuple | list):
        for each in value:
            out.update(_digest(each, known))
    elif isinstance(value, np.ndarray):
        out.update(f"{value.shape}{value.dtype.str}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, bool | int | float | str | np.number | None):
        out.update(repr(value).encode())
    else:
        raise TypeError(f"no digest of {type(value).__name__}")
    return out.digest()
