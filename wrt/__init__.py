"""wrt: a Whitted ray tracer on NVIDIA Warp, a model of the RT-core split, and a laboratory for both.

Rays by themselves: load_mesh, Mesh, DeviceGeometry, build, ACCELERATORS, load_accel, camera_rays; all_hits, count_hits,
first_hits, contains, winding_number, visible; closest_points, signed_distance.
Rays from kernels of your own: kernel, ray_query. Gradients: Hits.gradients, wrt.torch, wrt.jax.
Pictures: load_scene, render, Film, Options, Progress, LiveView, side_by_side.
Scenes in Python: Scene, Settings, Object, Sphere, Material, Texture, Checkerboard, Motion; Camera, OrthographicCamera,
FisheyeCamera, PanoramaCamera; PointLight, DirectionalLight, SpotLight; ConstantBackground, GradientBackground,
EnvironmentBackground.
What a picture costs: profile. What is fastest on a device: tune. What goes wrong: InputError, SceneWarning.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wrt.core.version import VERSION as __version__

if TYPE_CHECKING:
    from wrt.accel.all_hits import all_hits as all_hits
    from wrt.accel.all_hits import count_hits as count_hits
    from wrt.accel.all_hits import first_hits as first_hits
    from wrt.accel.build import build as build
    from wrt.accel.build import load_accel as load_accel
    from wrt.accel.closest_points import closest_points as closest_points
    from wrt.accel.closest_points import signed_distance as signed_distance
    from wrt.accel.contains import contains as contains
    from wrt.accel.device_geometry import DeviceGeometry as DeviceGeometry
    from wrt.accel.ray_query import ray_query as ray_query
    from wrt.accel.structures import ACCELERATORS as ACCELERATORS
    from wrt.accel.visible import visible as visible
    from wrt.accel.winding import winding_number as winding_number
    from wrt.core.errors import InputError as InputError
    from wrt.core.errors import SceneWarning as SceneWarning
    from wrt.io.load import load_scene as load_scene
    from wrt.io.mesh_file import load_mesh as load_mesh
    from wrt.kernels.structs import kernel as kernel
    from wrt.lab.rtcore.profiler import profile as profile
    from wrt.lab.tune import tune as tune
    from wrt.picture.film import Film as Film
    from wrt.renderer.options import Options as Options
    from wrt.renderer.options import Progress as Progress
    from wrt.renderer.pixel_rays import camera_rays as camera_rays
    from wrt.renderer.render import render as render
    from wrt.scene.backgrounds import ConstantBackground as ConstantBackground
    from wrt.scene.backgrounds import EnvironmentBackground as EnvironmentBackground
    from wrt.scene.backgrounds import GradientBackground as GradientBackground
    from wrt.scene.cameras import Camera as Camera
    from wrt.scene.cameras import FisheyeCamera as FisheyeCamera
    from wrt.scene.cameras import OrthographicCamera as OrthographicCamera
    from wrt.scene.cameras import PanoramaCamera as PanoramaCamera
    from wrt.scene.lights import DirectionalLight as DirectionalLight
    from wrt.scene.lights import PointLight as PointLight
    from wrt.scene.lights import SpotLight as SpotLight
    from wrt.scene.materials import Checkerboard as Checkerboard
    from wrt.scene.materials import Material as Material
    from wrt.scene.materials import Texture as Texture
    from wrt.scene.mesh import Mesh as Mesh
    from wrt.scene.model import Object as Object
    from wrt.scene.model import Scene as Scene
    from wrt.scene.model import Sphere as Sphere
    from wrt.scene.motion import Motion as Motion
    from wrt.scene.settings import Settings as Settings
    from wrt.viewer.notebook import LiveView as LiveView
    from wrt.viewer.notebook import side_by_side as side_by_side


# The same names at run time, each imported when it is first used: `python -m wrt --help` must not wait for Warp.
_PUBLIC = {
    "wrt.accel.all_hits": ("all_hits", "count_hits", "first_hits"),
    "wrt.accel.build": ("build", "load_accel"),
    "wrt.accel.closest_points": ("closest_points", "signed_distance"),
    "wrt.accel.contains": ("contains",),
    "wrt.accel.device_geometry": ("DeviceGeometry",),
    "wrt.accel.ray_query": ("ray_query",),
    "wrt.accel.structures": ("ACCELERATORS",),
    "wrt.accel.visible": ("visible",),
    "wrt.accel.winding": ("winding_number",),
    "wrt.core.errors": ("InputError", "SceneWarning"),
    "wrt.io.load": ("load_scene",),
    "wrt.io.mesh_file": ("load_mesh",),
    "wrt.kernels.structs": ("kernel",),
    "wrt.lab.rtcore.profiler": ("profile",),
    "wrt.lab.tune": ("tune",),
    "wrt.picture.film": ("Film",),
    "wrt.renderer.options": ("Options", "Progress"),
    "wrt.renderer.pixel_rays": ("camera_rays",),
    "wrt.renderer.render": ("render",),
    "wrt.scene.backgrounds": ("ConstantBackground", "EnvironmentBackground", "GradientBackground"),
    "wrt.scene.cameras": ("Camera", "FisheyeCamera", "OrthographicCamera", "PanoramaCamera"),
    "wrt.scene.lights": ("DirectionalLight", "PointLight", "SpotLight"),
    "wrt.scene.materials": ("Checkerboard", "Material", "Texture"),
    "wrt.scene.mesh": ("Mesh",),
    "wrt.scene.model": ("Object", "Scene", "Sphere"),
    "wrt.scene.motion": ("Motion",),
    "wrt.scene.settings": ("Settings",),
    "wrt.viewer.notebook": ("LiveView", "side_by_side"),
}
_FOR_LIBRARIES = ("torch", "jax")  # modules of that name
_HOME = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = ["__version__", *_HOME]


def _find_kernels() -> None:
    """In a checkout, wrt/kernels is a symbolic link to kernels/. Where links are not kept (the source distribution, Windows),
    wrt.kernels is made of that folder itself."""
    folder = Path(__file__).resolve().parent.parent / "kernels"
    if (Path(__file__).parent / "kernels").is_dir() or not folder.is_dir():
        return
    spec = importlib.util.spec_from_file_location("wrt.kernels", folder / "__init__.py", submodule_search_locations=[str(folder)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} is no package")
    module = importlib.util.module_from_spec(spec)
    sys.modules["wrt.kernels"] = module
    spec.loader.exec_module(module)
    globals()["kernels"] = module


_find_kernels()


def _imported(module: str) -> Any:
    """What an import makes stays: to look through it for garbage again and again took a tenth of the start."""
    collects = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        if collects:
            gc.enable()


def __getattr__(name: str) -> Any:
    if name in _FOR_LIBRARIES:
        return importlib.import_module(f"wrt.{name}")
    if name in _HOME:
        value = getattr(_imported(_HOME[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'wrt' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
