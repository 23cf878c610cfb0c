"""From a scene to a film in one call, on this device or by others."""

from __future__ import annotations

import os
from typing import Any

from wrt.core.checks import unknown
from wrt.core.errors import InputError, warn
from wrt.io.load import as_scene
from wrt.picture.film import Film
from wrt.renderer.options import OPTIONS, Options
from wrt.renderer.renderer import Renderer
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SETTINGS

MAX_SPP = 1 << 16  # where a target error asks for more than anybody said


def render(scene: Scene | Mesh | str | os.PathLike[str], *, spp: int | None = None,
           size: tuple[int, int] | str | None = None, settings: dict[str, Any] | None = None, **options: Any) -> Film:
    """Render a scene; returns a Film (linear pixels, variance, AOVs, stats), whose docstring defines each AOV.

    scene: a Scene; the path of a scene or mesh file, or a Mesh, is loaded as `load_scene` does. size: width and height, or
    "640x360". spp, size and all other fields of Settings (max_depth, filter, tonemap ...), here or in `settings`, override
    the scene's own; the other `options` are the fields of Options: seed, device, accel, threads, camera, crop, aov,
    time_limit, target_error, progress ...
    With target_error the scene's own spp is no limit, but MAX_SPP is, unless spp is given.
    The same arguments give the same pixels, bit for bit, for any threads, tile_size and pass_size. Interrupted by Ctrl-C, it
    returns what it has, with stats["interrupted"] set. checkpoint, checkpoint_every, resume: a render that survives the end of
    its process (Options). A scene with lights whose picture is all black gets a SceneWarning. Raises InputError for anything that
    cannot be rendered.
    """
    if options.get("target_error") is not None and spp is None:
        spp = MAX_SPP
    changes = {**(settings or {}), **{name: options.pop(name) for name in SETTINGS if name in options}}
    changes |= {name: value for name, value in (("spp", spp), ("size", size)) if value is not None}
    for name in options:
        if name not in OPTIONS:
            raise InputError(unknown(name, "argument of render", (*SETTINGS, *OPTIONS)))
    how = Options(**options)
    scene = as_scene(scene).with_settings(**changes)
    if how.executor is None and how.devices is None:
        film = Renderer(scene, how, once=True).run()
    else:
        from wrt.renderer.distributed.renderer import DistributedRenderer

        film = DistributedRenderer(scene, how).run()
    if scene.lights and film.samples.all() and not film.pixels.any():
        warn("the picture is all black: no light reaches what the camera sees (it may be enclosed, with all lights outside)")
    return film
