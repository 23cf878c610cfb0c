"""wrt: a Whitted ray tracer on NVIDIA Warp, a model of the RT-core split, and a laboratory for both."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

# In a checkout the device code stands beside this package, in kernels/, and is imported as wrt.kernels all the same.
if not (Path(__file__).parent / "kernels").is_dir():
    __path__.append(str(Path(__file__).resolve().parent.parent))

# Public names and where they live. They are imported on first use: `python -m wrt --help` must not wait for Warp.
_PUBLIC = {
    "ACCELERATORS": "wrt.accel",
    "build": "wrt.queries",
    "load_accel": "wrt.queries",
    "Mesh": "wrt.mesh",
    "load_mesh": "wrt.mesh",
    "InputError": "wrt.errors",
    "SceneWarning": "wrt.errors",
    "load_scene": "wrt.scene_file",
    "render": "wrt.driver",
    "LiveView": "wrt.notebook",
    "side_by_side": "wrt.notebook",
    "Options": "wrt.options",
    "Progress": "wrt.options",
    "Film": "wrt.film",
    "profile": "wrt.profiler",
    "camera_rays": "wrt.pixel_rays",
    "Camera": "wrt.scene",
    "Checkerboard": "wrt.scene",
    "ConstantBackground": "wrt.scene",
    "DirectionalLight": "wrt.scene",
    "EnvironmentBackground": "wrt.scene",
    "GradientBackground": "wrt.scene",
    "Material": "wrt.scene",
    "Motion": "wrt.motion",
    "Object": "wrt.scene",
    "PointLight": "wrt.scene",
    "Scene": "wrt.scene",
    "Settings": "wrt.scene",
    "Sphere": "wrt.scene",
    "SpotLight": "wrt.scene",
    "Texture": "wrt.scene",
}
__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        if _PUBLIC[name] != "wrt.errors":
            importlib.import_module("wrt.address_space").require_modules()
        value = getattr(importlib.import_module(_PUBLIC[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'wrt' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
