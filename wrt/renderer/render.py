"""Render a scene to a film in one call, on this device or by workers."""

from __future__ import annotations

import os
from typing import Any, Unpack

from wrt.core.checks import unknown
from wrt.core.errors import warn
from wrt.io.load import as_scene
from wrt.picture.film import Film
from wrt.renderer.options import OPTIONS, Options, RenderOptions
from wrt.renderer.renderer import Renderer
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
    scene
        A Scene. A Mesh, or the path of a scene or mesh file, is loaded as `load_scene` does.
    size, spp, max_depth, min_throughput, filter, fresnel, glass_shadows, sampler, exposure, tonemap
        Replace the scene's own setting of that name; see Settings. None keeps it. `size` may also be text such as "640x360".
    seed
        Seed of the samples.
    device, threads
        A device of Warp, "cpu" or "cuda:0"; the number of CPU threads (None: one for each core).
    accel, accel_options, triangle, box
        Name of the acceleration structure in ACCELERATORS, its options as `build` takes them, and its triangle and box test.
    instancing
        Which meshes that several objects share are stored once: "auto", "always" or "never".
    camera
        Name or index of one of the scene's cameras, or a camera of any kind. None: the first.
    crop
        x0, y0, x1, y1 in pixels: the part of the picture to render.
    aov
        Layers to return beside the pixels: "depth", "normal", "albedo", "prim_id", "material_id". Film defines them.
    time_limit
        Seconds of tracing. The first sample of each pixel is always taken.
    target_error
        Stop once the estimated error is no larger: the root mean square, over pixels and channels, of the standard error in
        linear radiance. It is noise alone, without what max_depth and min_throughput cut. Each pixel's samples form four
        independent sequences. The estimate is made when each has 1, 2, 4, 8 ... samples. The keyword `spp` is then the upper
        limit, rounded down to a multiple of four; without it the limit is 65,536, whatever the scene says.
    tile_size, pass_size
        Side of a tile in pixels, and samples of a pixel in one pass. None: chosen by wrt.
    progress
        Called with a Progress about ten times a second.
    checkpoint, checkpoint_every, resume
        File that holds the work so far, written every `checkpoint_every` seconds of tracing and at the end; it stays. An existing
        file is refused, unless `resume` is True: the picture then has the bits of an uninterrupted render.
    devices
        Several devices of this machine, of one kind, that share the tiles, in place of `device`.
    executor
        A concurrent.futures.Executor or a dask.distributed.Client, whose workers trace the tiles on their `device`.

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
        If part of the scene is left out, or the picture is all black although the scene has lights.

    Examples
    --------
    >>> film = wrt.render("scenes/whitted.toml", spp=16, size=(320, 180), aov=["depth"])
    >>> film.save("whitted.png")
    """
    given: dict[str, Any] = {**options}
    changes = {name: given.pop(name) for name in SETTINGS if name in given}
    if given.get("target_error") is not None and changes.get("spp") is None:
        changes["spp"] = MAX_SPP
    for name in given:
        if name not in OPTIONS:
            raise unknown(name, "argument of render", (*SETTINGS, *OPTIONS), argument=name)
    how = Options(**given)
    scene = as_scene(scene).with_settings(**changes)
    if how.executor is None and how.devices is None:
        film = Renderer(scene, how, once=True).run()
    else:
        from wrt.renderer.distributed.renderer import DistributedRenderer

        film = DistributedRenderer(scene, how).run()
    if scene.lights and film.samples.all() and not film.pixels.any():
        warn("the picture is all black: no light reaches what the camera sees (it may be enclosed, with all lights outside)")
    return film
