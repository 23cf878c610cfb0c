"""SHA-256 digests of scenes and cameras: equal digests mean equal pictures. Names of files and parts do not enter a digest."""

from dataclasses import fields, is_dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

# Fields that do not enter the digest: they change no pixel, or are a scene's cameras and settings. object: fields of every class.
LEFT_OUT: dict[type, tuple[str, ...]] = {
    object: ("name",), Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def digest(thing: Scene | CameraKind) -> str:
    """Return the SHA-256, in hexadecimal, of all fields of a scene or a camera except those in LEFT_OUT."""
    out = sha256()
    known: dict[int, int] = {}  # what several things share enters once, by its id

    def add(value: Any) -> None:
        if isinstance(value, tuple):
            out.update(f"({len(value)} ".encode())
            for each in value:
                add(each)
        elif not (is_dataclass(value) or isinstance(value, np.ndarray)):
            out.update(f"{value.item() if isinstance(value, np.generic) else value!r} ".encode())
        elif id(value) in known:
            out.update(f"{known[id(value)]} ".encode())
        else:
            known[id(value)] = len(known)
            if isinstance(value, np.ndarray):
                out.update(f"{value.shape}{value.dtype.str}".encode() + np.ascontiguousarray(value).tobytes())
            else:
                out.update(type(value).__name__.encode())
                for each in fields(value):
                    if each.name not in (*LEFT_OUT[object], *LEFT_OUT.get(type(value), ())):
                        add(getattr(value, each.name))

    add(thing)
    return out.hexdigest()
