"""`wrt.render`: render a scene to a film in one call; and Renderer, a prepared scene that renders repeatedly."""

from __future__ import annotations

import os
import warnings
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.bvh.wide import SMALL
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.scenes.build import build
from wrt.accel.scenes.instancing import stored_meshes
from wrt.accel.structures import default_options
from wrt.core.device import start
from wrt.core.errors import InputError, SceneWarning, warn
from wrt.io.load import as_scene
from wrt.picture.film import Film
from wrt.renderer.options import Options, RenderOptions, split
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.prepare import kind_of, prepare
from wrt.renderer.schedule import LocalTracer, Run
from wrt.renderer.upload import upload_scene
from wrt.scene.cameras import CameraKind
from wrt.scene.defaults import is_lit
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges

if TYPE_CHECKING:
    from wrt.renderer.checkpoint import Checkpoint

MAX_SPP = 1 << 16  # samples per pixel with a target error, unless the caller gives spp
REFINED_FROM = 8  # smallest number of camera samples per triangle for which refining the tree saves time


def render(scene: Scene | Mesh | str | os.PathLike[str], **options: Unpack[RenderOptions]) -> Film:
    """Render a scene to a linear film.

    The same arguments give the same pixels, bit for bit, for any `threads`, `tile_size`, `pass_size` and `executor`.
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
    executor : dask.distributed.Client, optional
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
    changes, others = split(options, "render")
    resolved = Options(**others)
    if resolved.target_error is not None and changes.get("spp") is None:
        changes["spp"] = MAX_SPP
    scene = as_scene(scene).with_settings(**changes)
    if resolved.executor is None:
        film = Renderer(scene, resolved, once=True).run()
    else:
        from wrt.renderer.workers import render_with_workers

        film = render_with_workers(scene, resolved)
    if film.samples.all() and not film.pixels.any():
        if scene.lights:
            warn("the picture is all black: no light reaches the visible surfaces (a surface may enclose them, with all lights outside)")
        elif not (resolved.aov or is_lit(scene) or any(material.is_emissive for material in scene.materials)):
            warn("the picture is all black: the scene has no lights, no background, no ambient light and no emission")
    return film


class Renderer:
    """A prepared scene, which `run` renders any number of times. Raises InputError if the scene cannot be rendered.

    once: True if the caller needs one picture only. If this picture has few samples, wrt then chooses a faster builder (`builder_for`)."""

    def __init__(self, scene: Scene, options: Options, *, once: bool = False) -> None:
        if options.executor is not None:
            raise InputError("a Renderer runs on one device", hint="use wrt.render for an `executor`")
        device = start(options.device)
        plan = plan_of(scene, options)
        plan.require_memory(device)
        self.checkpoint: Checkpoint | None = None
        if options.checkpoint is not None:
            from wrt.renderer.checkpoint import checkpoint_of

            self.checkpoint = checkpoint_of(plan, options.checkpoint, kind_of(device))
        if once and (builder := builder_for(plan)):  # the checkpoint does not contain it: a resumed render may use another tree
            plan = replace(plan, options=replace(options, accel_options=builder | options.accel_options))
        self.prepared = prepare(plan, device)

    @property
    def accel(self) -> Accelerator:
        return self.prepared.accel

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Unpack[SettingChanges]) -> None:
        """Set the camera and settings of the next `run`. Kernels and structure stay. The parameters are those of Prepared.aimed."""
        if self.checkpoint is not None:
            raise InputError("a renderer with a checkpoint cannot change its camera or settings")
        self.prepared = self.prepared.aimed(camera, angles_of, **settings)

    def move_objects(self, scene: Scene, rebuild_at: float) -> dict[str, object]:
        """Replace the scene by a scene with the same objects in other places: upload the surfaces, and refit the structure.

        The structure is rebuilt if it cannot be refitted, or if its SAH cost would grow by more than the factor `rebuild_at`. Returns
        "structure" ("refitted" or "rebuilt"), "seconds", and "growth", the factor by which the SAH cost grew (NaN: unknown)."""
        old = self.prepared
        plan = old.plan.moved(scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)  # the constructor has reported the warnings
            arrays = upload_scene(plan.scene, old.device, plan.meshes)
        geometry: Any = arrays.world.geometry
        self.prepared = replace(old, plan=plan, arrays=arrays)
        if isinstance(old.accel, OneMesh) and old.accel.can_refit and same_faces(old.accel.geometry, geometry):
            refit = asdict(old.accel.refit(geometry.vertices, rebuild_at))
            return {"structure": "rebuilt" if refit["rebuilt"] else "refitted", "seconds": refit["seconds"], "growth": refit["growth"]}
        options = plan.options
        chosen: dict[str, Any] = {"triangle": options.triangle, "box": options.box, **options.accel_options}
        accel = build(geometry, plan.accel, options.device, old.threads, **chosen)
        self.prepared = replace(self.prepared, accel=accel)
        return {"structure": "rebuilt", "seconds": accel.stats.build_seconds, "growth": float("nan")}

    def run(self, *, seed: int | None = None, spp: int | None = None) -> Film:
        """Render one picture. seed, spp: replace the options' seed and the scene's spp; None keeps them."""
        if self.checkpoint is not None and (seed is not None or spp is not None):
            raise InputError("a renderer with a checkpoint cannot change its seed or spp")
        return Run(LocalTracer(self.prepared), self.checkpoint, seed, spp).film()


def builder_for(plan: Plan) -> dict[str, str]:
    """Return {"builder": "binned"} if, for a single picture, the default builder takes longer than it saves; else {}."""
    triangles = sum(len(mesh.faces) for mesh in stored_meshes(plan.scene, plan.meshes))
    few = triangles > SMALL and plan.area * plan.scene.settings.spp < REFINED_FROM * triangles
    return {"builder": "binned"} if few and default_options(plan.accel).get("builder") == "refined" else {}


def same_faces(before: Geometry, now: Geometry | InstancedGeometry) -> bool:
    """Return True if only vertex positions differ. A face whose corners become collinear is left out, so that the faces differ."""
    return (isinstance(now, Geometry) and np.array_equal(before.faces, now.faces) and before.vertices.shape == now.vertices.shape)
