"""The commands that make pictures: `render`, with its checkpoint, and `animate`, which makes frames or an animated picture."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from wrt.cli.common import (
    DURATION,
    STAGING,
    Assignments,
    Names,
    OneOf,
    Parsed,
    depth_hint,
    load,
    naming,
    say,
    say_json,
    settings_of,
    shared,
    warnings_reported,
)
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted, exit_code, held_interrupts
from wrt.io.meshes import SUFFIXES

if TYPE_CHECKING:
    from wrt.picture.film import Film
    from wrt.scene.model import Scene
    from wrt.scene.settings import SettingChanges


@click.command(help=f"Render SCENE to a picture. SCENE is .toml, .gltf, .glb, or a mesh: {SUFFIXES}.")
@shared("scene")
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Picture to write: .png, .exr, .hdr, .jpg or .webp  [default: the scene's file name with .png]")
@shared("spp", "size", "seed", "device")
@click.option("--cluster", metavar="ADDRESS",
              help="Share the work among the workers of a Dask scheduler, tcp://host:8786 (docs/cluster.md)")
@shared("threads", "crop", "camera", "max_depth", "min_throughput", "clamp", "filter", "fresnel", "sampler", "assignments", "accel")
@STAGING
@click.option("--instancing", type=OneOf("wrt.accel.scenes.instancing:INSTANCING"), default="auto", show_default=True,
              help="Store a mesh that several objects share once: auto (large meshes), always or never")
@click.option("--aov", type=Names(), default=(), help="Layers to write as well: depth, normal, albedo, prim_id, material_id")
@click.option("--bits", type=int, help="Bits per channel. PNG: 8 or 16, EXR: 16 or 32  [default: 8 for PNG, 32 for EXR]")
@shared("tonemap", "exposure")
@click.option("--time-limit", type=DURATION, help="Stop tracing after this time (30s, 5m, 1h) and write the picture so far")
@click.option("--target-error", type=float,
              help="Stop when the estimated noise is at most this: the root mean square, over pixels and channels, of the"
                   " standard error in linear radiance. --spp is then an upper limit  [default: 65536]")
@click.option("--checkpoint", "every", type=DURATION, help="Save the samples so far at this interval (30s, 5m, 1h), for --resume")
@click.option("--checkpoint-file", "file", type=click.Path(path_type=Path), help="Checkpoint  [default: the picture's name + .checkpoint]")
@click.option("--resume", is_flag=True, help="Continue from the checkpoint; if there is none, start from the beginning")
@shared("quiet", "as_json")
def render(scene: Path, output: Path | None, *, assignments: Assignments, staging: dict[str, Parsed], quiet: bool, as_json: bool,
           **options: Parsed) -> None:
    begin = time.perf_counter()
    from wrt.picture.film import aov_path, depth_range
    from wrt.picture.image import check_writable

    output, bits = output or Path(f"{scene.stem or 'picture'}.png"), options.pop("bits")
    check_writable(output, bits)
    if scene.exists():
        from wrt.accel.queries.raw_launches import preload_headers
        from wrt.core.compiling import WATCH

        click.get_current_context().with_resource(WATCH.reported_by_caller())  # `trace` reports it
        preload_headers()  # in the background, while the next modules are imported
    settings = check_options(output, assignments, options)
    layers = options["aov"] if output.suffix.lower() != ".exr" else None  # an EXR file holds the layers as channels
    for name in layers or ():
        check_writable(aov_path(output, name))
    clock, begin = {"import": time.perf_counter() - begin}, time.perf_counter()
    loaded = load(scene, quiet, staging).with_settings(**settings)
    clock["load"] = time.perf_counter() - begin
    with warnings_reported(quiet):
        film = trace(loaded, scene, settings.get("spp"), options, quiet)
        begin = time.perf_counter()
        with held_interrupts() as signals:
            paths = film.save(output, bits=bits, aov=layers)
    checkpoint: Path | None = options.get("checkpoint")
    if checkpoint is not None and not (film.stats["interrupted"] or film.stats["timed_out"]):
        if not checkpoint.is_dir():  # the picture is complete
            checkpoint.unlink(missing_ok=True)
        film.stats["checkpoint"] = None
    if signals:
        film.stats |= {"interrupted": True, "signal": film.stats["signal"] or signals[0]}
    film.stats["seconds"] = clock | film.stats["seconds"] | {"write": time.perf_counter() - begin}
    if as_json:
        say_json({"output": [str(path) for path in paths], **film.metadata, **film.stats})
    else:
        for path in paths:
            say(path, err=False)
    if not quiet and "depth" in (layers or ()) and (ends := depth_range(film.aov["depth"])):
        say(f"depth picture: white is {ends['white']:.4g}, the darkest grey {ends['darkest']:.4g}, linear between, in scene units")
    if not quiet:
        for line in _summary(film, loaded.settings.auto_exposure):
            say(line)
    if film.stats["interrupted"]:
        raise SystemExit(exit_code(film.stats["signal"]))


def check_options(output: Path, assignments: Assignments, options: dict[str, Parsed]) -> "SettingChanges":
    """Return changes of the scene's settings, and convert `options` in place to the options of `wrt.render`.

    Raises InputError for an invalid setting or option, before the scene is read."""
    from wrt.renderer.options import Options
    from wrt.scene.model import Scene

    settings = settings_of(assignments, options)
    options |= checkpoint_options(output, options.pop("every"), options.pop("file"), options.pop("resume"))
    Scene().with_settings(**settings)
    cluster = options.pop("cluster")
    if cluster is not None:
        from wrt.renderer.workers import connected

        options["executor"] = click.get_current_context().with_resource(connected(cluster))
    Options(**options)
    return settings


def trace(loaded: "Scene", path: Path, spp: int | None, options: dict[str, Parsed], quiet: bool) -> "Film":
    """Render a scene, with progress on stderr. path: the scene's file. Raises Interrupted if interrupted before the first sample."""
    from wrt.renderer.progress import progress_reporter
    from wrt.renderer.render import render as render_scene
    from wrt.renderer.schedule import plain_text

    with progress_reporter(quiet) as progress, naming(path):
        film = render_scene(loaded, spp=spp, progress=progress, **options)
    if not film.stats["samples"]:
        raise Interrupted(film.stats["signal"] or signal.SIGINT)
    film.metadata["scene"] = plain_text(path.name)
    return film


def _summary(film: "Film", auto_exposure: bool) -> Iterator[str]:
    """Yield lines with samples, rays, what is missing in the picture, and the seconds of each stage ("compile" overlaps "upload")."""
    s = film.stats
    if auto_exposure:
        yield f"exposure {film.exposure:+.2g}, chosen automatically (--exposure 0: none)"
    resumed, target = s.get("resumed"), s.get("target_error")
    yield ", ".join(filter(None, (
        f"{film.metadata['spp']} spp{' (interrupted)' if s['interrupted'] else ' (time limit)' if s['timed_out'] else ''}",
        f"{resumed['samples']} spp from the checkpoint" if resumed else "",
        f"estimated error {s['estimated_error']:.3g}" if target is not None else "",
        f"above the target of {target:g}" if target is not None and not s["target_reached"] else "",
        f"{(film.samples == 0).mean():.0%} of the pixels are still black" if film.samples.min() == 0 else "",
        f"{s['rays'] / 1e6:.2f} M rays", f"{s['rays_per_second'] / 1e6:.2f} Mray/s",
        f"{s['not_finite']} samples were not finite and count as black" if s["not_finite"] else "",
        f"clamp {film.metadata['clamp']:g} took {s['clamped_share']:.2g} of the light" if "clamp" in film.metadata else "")))
    yield f"seconds: {', '.join(f'{name} {value:.2f}' for name, value in s['seconds'].items())}"
    if s.get("checkpoint"):
        yield f"{s['checkpoint']}: --resume continues from this checkpoint"
    if hint := depth_hint(s, film.metadata["max_depth"]):
        yield hint


EVERY = 60.0  # seconds between two checkpoints
SUFFIX = ".checkpoint"  # appended to the picture's name


def checkpoint_options(output: Path, every: float | None, file: Path | None, resume: bool) -> dict[str, object]:
    """Return the options of `wrt.render` for --checkpoint, --checkpoint-file and --resume; empty if all three are absent."""
    if every is None and file is None and not resume:
        return {}
    file = file or output.with_name(output.name + SUFFIX)
    if os.path.realpath(file) == os.path.realpath(output):
        raise InputError("is the picture; a checkpoint needs a file of its own", path=file)
    return {"checkpoint": file, "checkpoint_every": EVERY if every is None else every, "resume": resume}


@click.command()
@shared("scene")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="A folder for PNG frames, or one file: .gif, .png or .apng (an animated PNG)")
@click.option("--frames", type=int, default=36, show_default=True, help="Number of frames")
@click.option("--degrees", type=float, help="Orbit of the camera in degrees  [default: 360, or 0 if an object moves]")
@click.option("--fps", type=float, default=24.0, show_default=True, help="Frames per second of a .gif, .png or .apng file")
@click.option("--rebuild-at", type=float, default=1.5, show_default=True,
              help="Rebuild the acceleration structure, instead of refitting it, once its SAH cost has grown by this factor")
@shared("spp", "size", "assignments", "seed", "device", "threads", "camera", "accel", "quiet", "as_json")
def animate(scene: Path, output: Path, fps: float, assignments: Assignments, quiet: bool, as_json: bool,
            **options: Parsed) -> None:
    """Render an animation of SCENE. It is a turntable, or the motion of its objects (`motion` and `morph` in TOML)."""
    from wrt.renderer import animate as animation
    from wrt.renderer.options import Options

    if not 0.1 <= fps <= 100.0:
        raise InputError(f"must be 0.1 to 100, got {fps:g}", argument="fps")
    plan = animation.Animation(*(options.pop(name) for name in ("frames", "degrees", "rebuild_at")))
    settings = settings_of(assignments, options)
    rendering = Options(**options)
    target = animation.check_output(output)
    loaded = load(scene, quiet).with_settings(**settings)
    pictures, rows, signal, darkest = [], [], None, {"visibly_cut": 0.0}
    begin = time.perf_counter()
    with warnings_reported(quiet), naming(scene):
        for film in animation.animate(loaded, plan, rendering):
            if film.stats["interrupted"]:
                signal = film.stats["signal"]
                break
            row = film.stats["frame"] | {"trace": film.stats["seconds"]["trace"]}
            rows.append(row)
            darkest = max(darkest, film.stats, key=lambda stats: stats["visibly_cut"])
            if target.is_dir():
                film.save(animation.frame_path(target, row["number"], plan.frames))
            else:
                pictures.append(film.to_srgb8())
            if not quiet:
                say(f"frame {row['number'] + 1} of {plan.frames}: structure {row['structure']} in {row['seconds']:.3f} s,"
                    f" traced in {row['trace']:.2f} s")
    if pictures:
        animation.save_movie(target, pictures, fps)
    if as_json:
        say_json({"output": str(target), "frames": rows, "seconds": time.perf_counter() - begin})
    elif rows:
        say(target, err=False)
    hint = depth_hint(darkest, loaded.settings.max_depth, "--set max_depth=")
    if hint and not quiet:
        say(hint)
    if len(rows) < plan.frames:
        say(f"interrupted after {len(rows)} of {plan.frames} frames")
        raise SystemExit(exit_code(signal))
