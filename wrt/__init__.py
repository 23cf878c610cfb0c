"""wrt: a Whitted ray tracer on NVIDIA Warp, a software model of RT cores, and tools to measure both.

Ray queries without a picture: load_mesh, Mesh, DeviceGeometry, build, ACCELERATORS, load_accel, accel_from_tree, camera_rays; all_hits,
count_hits, first_hits, contains, winding_number, visible; closest_points, signed_distance.
Ray queries from your own Warp kernels: kernel, ray_query. Gradients: Hits.gradients, and the modules torch, jax.
Pictures: load_scene, render, Film, Options, Progress, side_by_side.
Scenes in Python: Scene, Settings, Object, Sphere, Material, Texture, Checkerboard, Motion; Camera, OrthographicCamera,
FisheyeCamera, PanoramaCamera; PointLight, DirectionalLight, SpotLight; ConstantBackground, GradientBackground,
EnvironmentBackground.
Costs of a picture: profile. All rays of a pixel: inspect. Steps of rays through a structure: walk, trace.
Errors and warnings: InputError, SceneWarning.
Further modules: sensors, compat (trimesh, open3d, pyvista), testing.
"""

import ast
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wrt.core import VERSION as __version__

# Type checkers and editors read these imports. At run time __getattr__ imports each name on first use.
if TYPE_CHECKING:
    from wrt import compat as compat
    from wrt import jax as jax
    from wrt import sensors as sensors
    from wrt import testing as testing
    from wrt import torch as torch
    from wrt.accel.device_geometry import DeviceGeometry as DeviceGeometry
    from wrt.accel.points.closest_points import closest_points as closest_points
    from wrt.accel.points.closest_points import signed_distance as signed_distance
    from wrt.accel.points.contains import contains as contains
    from wrt.accel.points.winding import winding_number as winding_number
    from wrt.accel.queries.all_hits import all_hits as all_hits
    from wrt.accel.queries.all_hits import count_hits as count_hits
    from wrt.accel.queries.all_hits import first_hits as first_hits
    from wrt.accel.queries.ray_query import ray_query as ray_query
    from wrt.accel.queries.visible import visible as visible
    from wrt.accel.scenes.build import accel_from_tree as accel_from_tree
    from wrt.accel.scenes.build import build as build
    from wrt.accel.scenes.build import load_accel as load_accel
    from wrt.accel.structures import ACCELERATORS as ACCELERATORS
    from wrt.core.errors import InputError as InputError
    from wrt.core.errors import SceneWarning as SceneWarning
    from wrt.io.load import load_scene as load_scene
    from wrt.io.mesh_file import load_mesh as load_mesh
    from wrt.kernels.structs import kernel as kernel
    from wrt.lab.rtcore.profiler import profile as profile
    from wrt.lab.rtcore.trace import trace as trace
    from wrt.lab.walk.walk import walk as walk
    from wrt.picture.film import Film as Film
    from wrt.renderer.inspector.inspect import inspect as inspect
    from wrt.renderer.options import Options as Options
    from wrt.renderer.options import Progress as Progress
    from wrt.renderer.render import render as render
    from wrt.renderer.upload import camera_rays as camera_rays
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
    from wrt.viewer.notebook import side_by_side as side_by_side


def _public() -> dict[str, str]:
    """Return {public name: its module}, from the imports under TYPE_CHECKING in this file."""
    imports = [node for node in ast.walk(ast.parse(Path(__file__).read_bytes())) if isinstance(node, ast.ImportFrom)]
    return {each.name: node.module or "" for node in imports for each in node.names if each.asname == each.name}


_HOME = _public()
_MODULES = [name for name, module in _HOME.items() if module == __name__]
__all__ = ["__version__", *(name for name in _HOME if name not in _MODULES)]


def _find_kernels() -> None:
    """Load wrt.kernels from kernels/ if the symbolic link wrt/kernels is missing, as in a source distribution or on Windows."""
    folder = Path(__file__).resolve().parent.parent / "kernels"
    if (Path(__file__).parent / "kernels").is_dir() or not folder.is_dir():
        return
    spec = importlib.util.spec_from_file_location("wrt.kernels", folder / "__init__.py", submodule_search_locations=[str(folder)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} is not a Python package")
    module = importlib.util.module_from_spec(spec)
    sys.modules["wrt.kernels"] = module
    spec.loader.exec_module(module)
    globals()["kernels"] = module


_find_kernels()


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `python -m wrt --help` does not wait for Warp."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _HOME:
        value = globals()[name] = getattr(importlib.import_module(_HOME[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
