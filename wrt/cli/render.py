"""The commands that make pictures: `render`, with its checkpoint, and `animate`, which makes frames or an animated picture."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from wrt.cli.common import (
    CLUSTER,
    DURATION,
    STAGING,
    Assignments,
    Names,
    OneOf,
    Parsed,
    depth_hint,
    device_options,
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
from wrt.core.settings import DEFAULT_DEVICE
from wrt.io.meshes import SUFFIXES

if TYPE_CHECKING:
    from wrt.picture.film import Film
    from wrt.scene.model import Scene
    from wrt.scene.settings import SettingChanges

STDOUT = Path("-")
WATCH_EVERY = 0.2  # seconds between two looks at a watched file


@click.command(help=f"Render SCENE to a picture. SCENE is .toml, .gltf, .glb, or a mesh: {SUFFIXES}.")
@shared("scene")
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Picture to write: .png, .exr, .hdr, .jpg or .webp; - is a PNG on stdout  [default: the scene's file name with .png]")
@shared("spp", "size", "seed")
@click.option("--device", default=DEFAULT_DEVICE, show_default=True,
              help="cpu, cuda:0 ... (`devices` lists them). Several of one kind share the work: cuda:0,cuda:1")
@CLUSTER
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
@click.option("--checkpoint-file", type=click.Path(path_type=Path), help="Checkpoint  [default: the picture's name + .checkpoint]")
@click.option("--resume", is_flag=True, help="Continue from the checkpoint; if there is none, start from the beginning")
@click.option("--watch", is_flag=True, help="Render again whenever the file SCENE changes, until Ctrl-C")
@shared("quiet", "as_json")
def render(scene: Path, output: Path | None, watch: bool, quiet: bool, **options: Parsed) -> None:
    if not watch:
        render_once(scene, output, quiet=quiet, **options)
        return
    if output == STDOUT or options["resume"]:
        raise InputError("makes a picture after each change, which needs a file and a new start", argument="--watch",
                         hint="give -o a file name, and no --resume")
    watched(scene, lambda: render_once(scene, output, quiet=quiet, **options), quiet)


def watched(scene: Path, make: Callable[[], None], quiet: bool) -> None:
    """Call `make` now and after each change of the file `scene`, until Ctrl-C. An InputError is reported: the file may be half edited."""
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            seen = stamp(scene)
            try:
                make()
            except InputError as error:
                say(f"error: {error}")
            if not quiet:
                say(f"{scene}: waiting for a change (Ctrl-C ends)")
            while stamp(scene) in (seen, None):
                time.sleep(WATCH_EVERY)


def stamp(path: Path) -> tuple[int, int, int] | None:
    """Return values that change when a file is written or replaced; None while it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def render_once(scene: Path, output: Path | None, *, assignments: Assignments, staging: dict[str, Parsed], quiet: bool,
                as_json: bool, **options: Parsed) -> None:
    """Render SCENE and write its picture. The arguments are those of the command."""
    begin = time.perf_counter()
    from wrt.picture.film import aov_path, depth_range
    from wrt.picture.image import check_writable, output_format

    output, bits = output or Path(f"{scene.stem or 'picture'}.png"), options.pop("bits")
    if output == STDOUT:
        require_alone(as_json, options)
        output_format("-.png", bits)
    else:
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
    checkpoint = options.get("checkpoint")
    if checkpoint is not None and options["resume"] and not (os.path.lexists(checkpoint) or quiet):
        say(f"{checkpoint}: no checkpoint yet, rendering from the beginning")
    if checkpoint is None and not quiet and os.path.lexists(unused := output.with_name(output.name + SUFFIX)):
        say(f"{unused}: a checkpoint of an earlier render is here; --resume continues from it, this render begins anew")

    with warnings_reported(quiet):
        film = trace(loaded, scene, settings.get("spp"), options, quiet)
        begin = time.perf_counter()
        with held_interrupts() as signals:
            paths = [] if output == STDOUT else film.save(output, bits=bits, aov=layers)
            if output == STDOUT:
                write_to_stdout(film, bits)
    if checkpoint is not None and not (film.stats["interrupted"] or film.stats["timed_out"]):
        remove_checkpoint(checkpoint)  # the picture is complete
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
        say(_summary(film, loaded.settings.auto_exposure))
    if film.stats["interrupted"]:
        raise SystemExit(exit_code(film.stats["signal"]))


def require_alone(as_json: bool, options: dict[str, Parsed]) -> None:
    """Raise InputError for an option that writes beside a picture on stdout, and if stdout is closed."""
    if sys.stdout is None:
        raise InputError("is stdout, which is closed", argument="-o -", hint="give -o a file name")
    for name, given in (("json", as_json), ("aov", options["aov"]), ("checkpoint", options["every"]), ("resume", options["resume"])):
        if given and not (name in ("checkpoint", "resume") and options["checkpoint_file"]):
            raise InputError("has no place if the picture goes to stdout", argument=f"--{name}", hint="give -o a file name")


def check_options(output: Path, assignments: Assignments, options: dict[str, Parsed]) -> "SettingChanges":
    """Return changes of the scene's settings, and convert `options` in place to the options of `wrt.render`.

    Raises InputError for an invalid setting or option, before the scene is read."""
    from wrt.renderer.options import Options
    from wrt.scene.model import Scene

    settings = settings_of(assignments, options)
    options |= checkpoint_options(output, options.pop("every"), options.pop("checkpoint_file"), options.pop("resume"))
    Scene().with_settings(**settings)
    options |= device_options(options.pop("cluster"), options.pop("device"))
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


LEAST_LOSS = 0.001  # Mean radiance lost by cut rays that the summary mentions, in surroundings of radiance 1; 8 bits have steps of 0.004.


def _summary(film: "Film", auto_exposure: bool) -> str:
    """Return a text with samples, rays, what cut rays cost, and the seconds of each stage ("compile" overlaps "upload" and "build")."""
    s = film.stats
    end = "interrupted" if s["interrupted"] else "time limit" if s["timed_out"] else ""
    note = f" ({end})" if end else ""
    if s.get("resumed"):
        note += f", {s['resumed']['samples']} spp from the checkpoint"
    if film.samples.min() == 0:
        note = f" ({end}: {(film.samples == 0).mean():.0%} of the pixels are still black)"
    black = f"; {s['not_finite']} samples were not finite and count as black" if s["not_finite"] else ""
    if "clamp" in film.metadata:
        black += f"; clamp {film.metadata['clamp']:g} took {s['clamped_share']:.2g} of the light"
    if s.get("target_error") is not None:
        note += f", estimated error {s['estimated_error']:.3g}"
        note += "" if s["target_reached"] else f" (above the target of {s['target_error']:g})"
    hint = depth_hint(s, film.metadata["max_depth"])
    lost = s["lost_throughput_per_sample"]
    cut = (f"; rays cut by max_depth and min_throughput would add {lost:.2g} to the picture's mean in surroundings of radiance 1"
           if lost >= LEAST_LOSS and not hint else "")
    hint = f"\n{hint}" if hint else ""
    saved = f"\n{s['checkpoint']}: --resume continues from this checkpoint" if s.get("checkpoint") else ""
    resumed = f" ({s['resumed']['seconds']:.2f} before the resume)" if s.get("resumed") else ""
    seconds = ", ".join(f"{name} {value:.2f}{resumed if name == 'trace' else ''}" for name, value in s["seconds"].items())
    exposed = f"exposure {film.exposure:+.2g}, chosen automatically (--exposure 0: none)\n" if auto_exposure else ""
    return (f"{exposed}{film.metadata['spp']} spp{note}, {s['rays'] / 1e6:.2f} M rays, {s['rays_per_second'] / 1e6:.2f} Mray/s"
            f"{cut}{black}\nseconds: {seconds}{saved}{hint}")


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


def write_to_stdout(film: "Film", bits: int | None) -> None:
    """Write the picture to stdout as a PNG file."""
    from wrt.picture.image import encode_png
    from wrt.picture.tonemap import to_codes

    codes = to_codes(film.pixels, film.exposure, film.tonemap, bits or 8)
    click.echo(encode_png(codes, film.metadata), nl=False)


def remove_checkpoint(path: Path) -> None:
    """Remove the checkpoint of a finished picture. Raises InputError if that fails."""
    if path.is_dir():  # not written by wrt; the render has warned that the checkpoint is not saved
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot be removed: {error.strerror}",
                         path=path, hint="remove this checkpoint by hand; the picture is finished") from error


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
