"""SHA-256 digests of scenes and cameras: equal digests mean equal pictures. Names of files and parts do not enter a digest."""

from hashlib import sha256

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.pack import pack

# Fields that do not enter the digest: they change no pixel, or are a scene's cameras and settings. object: fields of every class.
LEFT_OUT: dict[type, tuple[str, ...]] = {
    object: ("name",), Scene: ("cameras", "settings"), Mesh: ("groups", "face_group", "dropped"), Object: ("motion",)}


def digest(thing: Scene | CameraKind) -> str:
    """Return the SHA-256, in hexadecimal, of all fields of a scene or a camera except those in LEFT_OUT."""
    text, arrays = pack(thing, LEFT_OUT)
    out = sha256(text.encode())
    for array in arrays:
        out.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
    return out.hexdigest()
