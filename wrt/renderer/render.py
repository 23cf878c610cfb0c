"""`wrt.render`: render a scene to a film in one call, on one device or with several workers."""

from __future__ import annotations

import os
from typing import Any, Unpack

from wrt.core.checks import unknown
from wrt.core.errors import warn
from wrt.io.load import as_scene
from wrt.picture.film import Film
from wrt.renderer.options import OPTIONS, Options, RenderOptions
from wrt.renderer.renderer import Renderer
from wrt.scene.defaults import is_lit
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SETTINGS

MAX_SPP = 1 << 16  # samples per pixel with a target error, unless the caller gives spp


def render(scene: Scene | Mesh | str | os.PathLike[str], **options: Unpack[RenderOptions]) -> Film:
    """Render a scene to a linear film.

    The same arguments give the same pixels, bit for bit, for any `threads`, `tile_size`, `pass_size`, `devices` and `executor`.
    Ctrl-C ends the render early: the film has the samples so far, and `stats["interrupted"]` is True.

    Parameters
    ----------
    scene : Scene, Mesh or path
        What to render; a path names a scene or mesh file. `load_scene` says how a Mesh or a path becomes a scene.
    size : (int, int), int or str, optional
        Width and height in pixels; a width, which keeps the scene's aspect ratio; or text such as "640x360".
    spp, max_depth : int, optional
        Replace the scene's setting of the same name; see Settings. None keeps it.
    min_throughput, clamp, exposure : float, optional
        Replace settings, like `spp`.
    filter, fresnel, glass_shadows, sampler, tonemap : str, optional
        Replace settings, like `spp`.
    auto_exposure : bool, optional
        Replace settings, like `spp`.
    seed : int
        Seed of the samples.
    device : str
        Name of a Warp device such as "cpu" or "cuda:0".
    threads : int, optional
        Number of CPU threads; one for each core by default.
    accel, triangle, box : str
        Names of the acceleration structure (in ACCELERATORS), of its triangle test, and of its box test.
    accel_options : dict
        The structure's options; see `build`.
    instancing : str
        Which of the meshes that several objects share are stored once: "auto" (large meshes), "always" or "never".
    camera : str, int or camera, optional
        Name or index of one of the scene's cameras, or a camera of any kind. None: the first.
    crop : (int, int, int, int), optional
        x0, y0, x1, y1 in pixels from the top left: the rectangle to render.
    aov : str or sequence of str
        Layers to return beside the pixels: "depth", "normal", "albedo", "prim_id", "material_id". Film defines them.
    time_limit : float, optional
        Seconds of tracing after which the render stops. Each pixel gets at least one sample.
    target_error : float, optional
        Stop once the estimated error is at most this: the root mean square, over pixels and channels, of the standard error in linear
        radiance. It covers noise, but not what max_depth and min_throughput cut. Each pixel's samples form four independent sequences;
        the error is estimated when each has 1, 2, 4, 8 ... samples. The keyword `spp` is then the upper limit (default 65,536; the
        scene's is ignored), rounded down to a multiple of four.
    tile_size, pass_size : int, optional
        Side of a tile in pixels, and samples per pixel in one pass. None: wrt chooses.
    progress : function, optional
        Function that is called with a Progress about ten times per second.
    checkpoint : path, optional
        File for the samples so far, written at the end, too.
    checkpoint_every : float
        Seconds of tracing between two writes of the checkpoint.
    resume : bool
        Continue from the checkpoint; must be True if the file exists. The picture has the bits of an uninterrupted render.
    devices : sequence of str, optional
        Several devices of one kind on this machine, which share the tiles. They replace `device`.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Its workers trace the tiles, each on its `device`.

    Returns
    -------
    Film
        Linear pixels, their variance, AOVs and statistics.

    Raises
    ------
    InputError
        If the scene cannot be rendered, or an option is unknown or wrong.

    Warns
    -----
    SceneWarning
        If wrt leaves out a part of the scene, or the picture is all black (with `aov`: only if the scene has lights).

    Examples
    --------
    >>> film = wrt.render("scenes/whitted.toml", spp=16, size=(320, 180), aov=["depth"])
    >>> film.save("whitted.png")
    """
    keywords: dict[str, Any] = {**options}
    changes = {name: keywords.pop(name) for name in SETTINGS if name in keywords}
    if keywords.get("target_error") is not None and changes.get("spp") is None:
        changes["spp"] = MAX_SPP
    for name in [each for each in keywords if each not in OPTIONS]:
        raise unknown(name, "argument of render", (*SETTINGS, *OPTIONS), argument=name)
    resolved = Options(**keywords)
    scene = as_scene(scene).with_settings(**changes)
    if resolved.executor is None and resolved.devices is None:
        film = Renderer(scene, resolved, once=True).run()
    else:
        from wrt.renderer.distributed.renderer import DistributedRenderer

        film = DistributedRenderer(scene, resolved).run()
    if film.samples.all() and not film.pixels.any():
        if scene.lights:
            warn("the picture is all black: no light reaches the visible surfaces (a surface may enclose them, with all lights outside)")
        elif not (resolved.aov or is_lit(scene) or any(material.is_emissive for material in scene.materials)):
            warn("the picture is all black: the scene has no lights, no background, no ambient light and no emission")
    return film
