"""Readers of scene files: TOML, glTF, or a mesh alone."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from wrt.core.checks import as_path, shown
from wrt.core.errors import InputError, at, warn
from wrt.core.files import read_file, require_file
from wrt.core.registry import Registry
from wrt.core.types import JsonObject, PathLike
from wrt.io.mesh_file import MESH_FORMATS, load_mesh
from wrt.scene.defaults import UP, Staging, put_on_floor, stage
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene


def load_scene(path: PathLike, *, up: str = "y", studio: bool = True, floor: bool = False,
               fill: float | None = None) -> Scene:
    """Read a scene file: TOML (.toml), glTF 2.0 (.gltf, .glb), or a mesh in light grey.

    A scene without a camera gets one that frames it, and a scene without a light gets lights; a SceneWarning names the additions.

    Parameters
    ----------
    path
        The file. Its suffix gives the format: .toml, .gltf, .glb or one of wrt.io.mesh_file.MESH_FORMATS.
    up
        Axis of a mesh file that points up in the picture: "x", "y" or "z". Scene files have +y up.
    studio
        Light glass and smooth surfaces in a scene without lights by a studio, which they reflect. False: by a pale sky.
    floor
        Put the mesh of a mesh file on a grey floor.
    fill
        Radiance of an ambient term beside the lights of a glTF file. None: if its only lights are emissive surfaces, an estimate of
        the light between surfaces, else 0.

    Raises
    ------
    InputError
        If the file cannot be used; it names the file and the place. For TOML it lists all mistakes, each with key, value and expectation.
        If `up` or `floor` is given for a scene file, or `fill` for a file that is not glTF.
    """
    staging = Staging(up, studio, floor, fill)
    path = as_path(path, "path")
    suffix, known = path.suffix.lower(), ", ".join([*LOADERS, *MESH_FORMATS])
    require_file(path, f" (a scene is one of {known})")
    if suffix not in LOADERS and suffix not in MESH_FORMATS:
        raise InputError(f"is no scene file: its suffix must be one of {known}", path=path)
    if suffix in LOADERS and (up != "y" or floor):
        raise InputError("is for mesh files alone: a scene file says what is up and what is below", argument="up" if up != "y" else "floor",
                         path=path)
    if fill is not None and suffix not in (".gltf", ".glb"):
        raise InputError("is for glTF files alone", argument="fill", path=path, hint="a TOML scene has `ambient`")
    with np.errstate(over="ignore", invalid="ignore"):  # the scene refuses infinite values
        if suffix in LOADERS:
            return LOADERS[suffix](path, staging)
        return _bare(load_mesh(path), path.stem, path, staging)


def as_scene(value: Scene | Mesh | PathLike) -> Scene:
    """Return a Scene unchanged, or the scene of a Mesh or file, with the warnings of `load_scene`. Raises InputError for other values."""
    if isinstance(value, Scene):
        return value
    if isinstance(value, Mesh):
        return _bare(value, value.name or "mesh", value.name or "mesh", Staging())
    if isinstance(value, str | os.PathLike):
        return load_scene(value)
    raise InputError(f"must be a Scene, a Mesh, or the path of a scene or mesh file, got {shown(value)}", argument="scene")


def schema() -> JsonObject:
    """Return the JSON Schema (draft 2020-12) of TOML scene files."""
    from wrt.io.toml.schema import scene_schema

    return {**scene_schema()}


def _load_toml(path: Path, staging: Staging) -> Scene:
    from wrt.io.toml.build import build
    from wrt.io.toml.report import check

    return _staged(build(check(_parse(path), path), path), path, staging)


def _bare(mesh: Mesh, name: str, path: PathLike, staging: Staging) -> Scene:
    """Return a scene of one mesh in light grey."""
    grey = Material(name="light grey", albedo=(0.75, 0.75, 0.75))
    unread = " (.mtl files are not read)" if os.fspath(path).lower().endswith(".obj") else ""
    parts = f"its {len(mesh.groups)} parts are all light grey{unread}: a TOML scene can give each a material"
    notes = [parts] if len(mesh.groups) > 1 else []
    notes += ["a camera that frames it, and a grey floor, were added"] if staging.floor else []
    scene = Scene(objects=(Object(mesh, (grey,), UP[staging.up], name=name),), name=name)
    with at(path=path):
        return _staged(put_on_floor(scene) if staging.floor else scene, path, staging, notes)


LOADERS: Registry[Callable[..., Scene]] = Registry("scene format", {
    ".toml": _load_toml, ".gltf": "wrt.io.gltf.reader:load_gltf", ".glb": "wrt.io.gltf.reader:load_gltf"})


def _parse(path: Path) -> JsonObject:
    with at(path=path):
        data = read_file(path)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise InputError("is nested too deeply", path=path) from None
    except ValueError as error:  # no TOML, no UTF-8, or an integer of thousands of digits
        found = re.fullmatch(r"(.*?)(?: \(at (line \d+, column \d+|end of document)\))?", str(error), re.DOTALL)
        what, place = found.groups() if found else (str(error), None)
        raise InputError(what, path=path, place=place) from error


def _staged(scene: Scene, path: PathLike, staging: Staging, notes: Sequence[str] = ()) -> Scene:
    """Add a camera and lights to a scene without them, and issue one SceneWarning with `notes` and the additions."""
    with at(path=path):
        scene, added = stage(scene, staging)
    if notes or added:
        warn(f"{os.fspath(path)}: {'; '.join([*notes, *added])}")
    return scene
