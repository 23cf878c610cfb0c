"""The command line: it parses, calls and prints; it knows nothing of rendering.

stdout is data, stderr is talk. Exit codes: 0; 1 where `compare` or `devices --check` finds more difference than allowed; 2 for a
user's mistake, with one message; 128 and the signal's number when interrupted: 130 by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP.
Whatever takes long to import is imported by the command that needs it.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import io
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import click

import wrt
from wrt.cli.animate import animate
from wrt.cli.build import build
from wrt.cli.common import (
    CLUSTER,
    DURATION,
    Commands,
    Names,
    OneOf,
    depth_hint,
    load,
    naming,
    say,
    say_json,
    settings_of,
    shared,
    spread_options,
    warnings_reported,
)
from wrt.cli.compile import compile_kernels
from wrt.cli.devices import devices
from wrt.cli.measure import bench, profile, stability
from wrt.cli.reporting import measured
from wrt.cli.save import checkpoint_options, remove_checkpoint, save_film
from wrt.cli.view import view
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted, exit_code, raise_on_termination
from wrt.io.meshes import SUFFIXES
from wrt.lab.plans import WhatIf

GARBAGE_AT = 500_000  # new objects before Python looks for garbage: a start makes 300,000, and all of them stay
# In errors of Warp and Python that are no MemoryError: the system gave no thread, no array, no room for a library.
OUT_OF_MEMORY = ("can't start new thread", "Failed to allocate", "failed to map segment")


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(wrt.__version__, message="wrt %(version)s")
def cli() -> None:
    """A Whitted ray tracer on NVIDIA Warp."""


for command in (stability, bench, build, compile_kernels, devices, profile, animate, view):
    cli.add_command(command)
measured(cli, WhatIf)


@cli.command(help=f"Render SCENE (.toml, .gltf, .glb, or a mesh: {SUFFIXES}) to a picture.")
@shared("scene")
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Picture to write: .png, .exr or .hdr  [default: the scene's name with .png]")
@shared("spp", "size", "seed")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`); several share: cuda:0,cuda:1")
@CLUSTER
@shared("threads", "crop", "camera", "max_depth")
@click.option("--min-throughput", type=float, help="Cut rays that carry less than this share  [default: 0.001]")
@click.option("--filter", "filter_name", type=OneOf("wrt.scene.settings:FILTERS"), help="Pixel filter")
@click.option("--fresnel", type=OneOf("wrt.scene.settings:FRESNELS"), help="exact, or schlick (cheaper, approximate)")
@click.option("--sampler", type=OneOf("wrt.scene.settings:SAMPLERS"), help="sobol (evenly spread), or independent (random)")
@shared("given", "accel")
@click.option("--instancing", type=OneOf("wrt.accel.scenes.instancing:INSTANCING"), default="auto", show_default=True,
              help="Keep shared meshes once: auto (large ones), always or never")
@click.option("--aov", type=Names(), default=(), help="Also depth, normal, albedo, prim_id, material_id")
@click.option("--bits", type=int, help="PNG: 8 or 16; EXR: 16 or 32")
@click.option("--tonemap", type=OneOf("wrt.scene.settings:TONEMAPS"), help="Curve from linear to display  [default: the scene's]")
@click.option("--exposure", type=float, help="Stops  [default: the scene's, 0]")
@click.option("--time-limit", type=DURATION, help="Stop after 30s, 5m, 1h of tracing, with what there is")
@click.option("--target-error", type=float,
              help="Stop when the picture's estimated error is no larger: the root mean square, over pixels and channels, of"
                   " the standard error in linear radiance (noise alone); --spp is then the most to take  [default: 65536]")
@click.option("--checkpoint", "every", type=DURATION, help="Save the work so far this often, for --resume")
@click.option("--checkpoint-file", type=click.Path(path_type=Path), help="Where to  [default: the picture's name + .checkpoint]")
@click.option("--resume", is_flag=True, help="Go on from the checkpoint; without one, from the beginning")
@shared("quiet", "as_json")
def render(scene: Path, output: Path | None, given: tuple[tuple[str, Any], ...], quiet: bool, as_json: bool,
           **options: Any) -> None:
    begin = time.perf_counter()
    from wrt.picture.image import check_writable

    output = output or Path(f"{scene.stem or 'picture'}.png")
    bits, aov = options.pop("bits"), options["aov"]
    check_writable(output, bits)
    from wrt.core.device import preload_headers

    if scene.exists():
        preload_headers()  # while the rest is imported
    from wrt.picture.film import aov_path
    from wrt.renderer.options import Options
    from wrt.renderer.progress import progress_reporter
    from wrt.renderer.render import render as render_scene
    from wrt.renderer.result import plain_text
    from wrt.scene.model import Scene

    # Whatever can be wrong with an option is told before a scene is read and one of our kernels compiled.
    flags = {"filter": options.pop("filter_name")}
    flags |= {name: options.pop(name) for name in (
        "spp", "size", "max_depth", "min_throughput", "fresnel", "sampler", "tonemap", "exposure")}
    settings = settings_of(given, flags)
    options |= checkpoint_options(output, options.pop("every"), options.pop("checkpoint_file"), options.pop("resume"))
    Scene().with_settings(**settings)
    options |= spread_options(options.pop("cluster"), options.pop("device"))
    Options(**options)
    layers = aov if output.suffix.lower() != ".exr" else None  # in an EXR file they are channels, all of them
    for name in layers or ():
        check_writable(aov_path(output, name))
    clock, begin = {"import": time.perf_counter() - begin}, time.perf_counter()
    loaded = load(scene, quiet).with_settings(**settings)
    clock["load"] = time.perf_counter() - begin
    checkpoint = options.get("checkpoint")
    if checkpoint is not None and options["resume"] and not (os.path.lexists(checkpoint) or quiet):
        say(f"{checkpoint}: no checkpoint yet, rendering from the beginning")

    with warnings_reported(quiet):
        with progress_reporter(quiet) as progress, naming(scene):
            film = render_scene(loaded, spp=settings.get("spp"), progress=progress, **options)
        if not film.stats["samples"]:
            raise Interrupted(film.stats["signal"] or signal.SIGINT)  # there is nothing to keep
        begin = time.perf_counter()
        film.metadata["scene"] = plain_text(scene.name)
        paths, late, misplaced = save_film(film, output, bits, layers)
    if checkpoint is not None and not (misplaced or film.stats["interrupted"] or film.stats["timed_out"]):
        remove_checkpoint(checkpoint)  # it has done its work
        film.stats["checkpoint"] = None
    if late:
        film.stats |= {"interrupted": True, "signal": film.stats["signal"] or late[0]}
    film.stats["seconds"] = clock | film.stats["seconds"] | {"write": time.perf_counter() - begin}
    if as_json:
        say_json({"output": [str(path) for path in paths], **film.metadata, **film.stats})
    else:
        for path in paths:
            say(path, err=False)
    if not quiet:
        say(_summary(film))
    if misplaced:
        raise InputError(f"{misplaced}; the picture was written to {paths[0]} instead")
    if film.stats["interrupted"]:
        raise SystemExit(exit_code(film.stats["signal"]))


def _summary(film: Any) -> str:
    s = film.stats
    cut = f"cut: {s['cut_by_depth']} rays by depth, {s['cut_by_throughput']} by throughput"
    end = "interrupted" if s["interrupted"] else "time limit" if s["timed_out"] else ""
    note = f" ({end})" if end else ""
    if s.get("resumed"):
        note += f", {s['resumed']['samples']} of them from the checkpoint"
    if film.samples.min() == 0:
        note = f" ({end}: {(film.samples == 0).mean():.0%} of the pixels are still black)"
    lost = f"; {s['not_finite']} samples were not finite and count as black" if s["not_finite"] else ""
    if s.get("target_error") is not None:
        note += f", estimated error {s['estimated_error']:.3g}"
        note += "" if s["target_reached"] else f" (above the target of {s['target_error']:g})"
    hint = depth_hint(s["visibly_cut"], film.metadata["max_depth"])
    hint = f"\n{hint}" if hint else ""
    kept = f"\n{s['checkpoint']}: go on from it with --resume" if s.get("checkpoint") else ""
    return (f"{film.metadata['spp']} spp{note}, {s['rays'] / 1e6:.2f} M rays, {s['rays_per_second'] / 1e6:.2f} Mray/s; "
            f"{cut}, lost throughput {s['lost_throughput_per_sample']:.2g} a sample{lost}\n{_seconds(s)}{kept}{hint}")


def _seconds(stats: dict[str, Any]) -> str:
    """Of each stage: upload and build run beside compile."""
    seconds = stats["seconds"]
    notes = dict.fromkeys(seconds, "")
    if stats.get("resumed"):
        notes["trace"] = f" ({stats['resumed']['seconds']:.2f} of them before it was resumed)"
    return "seconds: " + ", ".join(f"{name} {value:.2f}{notes[name]}" for name, value in seconds.items())


@cli.command()
@shared("scene", "camera", "given", "as_json")
def info(scene: Path, camera: str | None, given: tuple[tuple[str, Any], ...], as_json: bool) -> None:
    """Tell what SCENE holds, and which features its kernel is compiled with."""
    from wrt.renderer.features import describe

    settings = settings_of(given)
    loaded = load(scene, quiet=False).with_settings(**settings)
    with naming(scene):
        facts = describe(loaded, camera)
    if as_json:
        say_json(facts)
        return
    features = facts.pop("features")
    for name, value in facts.items():
        between = "; " if isinstance(value, list) and value and isinstance(value[0], str) else ", "  # names may have commas
        shown = "none" if value in (None, []) else between.join(map(str, value)) if isinstance(value, list) else value
        say(f"{name}: {shown}", err=False)
    for state in (True, False):
        names = [name for name, on in features.items() if on is state]
        say(f"features {'on' if state else 'off'}: {', '.join(names) or 'none'}", err=False)


@cli.command()
@click.option("--markdown", is_flag=True, help="As a page to read, docs/scene_format.md")
def schema(markdown: bool) -> None:
    """Print the JSON Schema of scene files."""
    if markdown:
        from wrt.io.toml.reference_page import scene_format

        click.echo(scene_format(), nl=False)
        return
    from wrt.io.load import schema as scene_schema

    click.echo(json.dumps(scene_schema(), indent=2))


@cli.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
def validate(scenes: tuple[Path, ...]) -> None:
    """Check SCENES without rendering; exit code 2 where one cannot be used."""
    bad = 0
    for scene in scenes:
        try:
            load(scene, quiet=False)
            say(f"{scene}: ok", err=False)
        except InputError as error:
            bad += 1
            say(f"error: {error}")
    if bad:
        raise SystemExit(2)


@cli.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write a picture of the difference (.png)")
@click.option("--max-mse", type=float, help="Fail above this mean squared error")
@click.option("--max-relmse", type=float, help="Fail above this relative mean squared error")
@click.option("--min-psnr", type=float, help="Fail below this many dB")
@click.option("--max-flip", type=float, help="Fail above this mean FLIP error")
@click.option("--tonemap", type=OneOf("wrt.scene.settings:TONEMAPS"), default="none", show_default=True,
              help="For PSNR and FLIP, which see what a display shows")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, likewise")
@shared("as_json")
def compare(a: Path, b: Path, output: Path | None, tonemap: str, exposure: float, as_json: bool, **limits: Any) -> None:
    """Measure the error of picture A against the reference B."""
    from wrt.picture import metrics
    from wrt.picture.image import check_writable, read_image, write_codes
    from wrt.scene.settings import Settings

    Settings(tonemap=tonemap, exposure=exposure)  # told before the pictures are read
    if output is not None:
        if output.suffix.lower() != ".png":
            raise InputError("a picture of the difference is a .png", output)
        check_writable(output)
    first, second = read_image(a), read_image(b)
    result = metrics.compare(first, second, exposure=exposure, tonemap=tonemap)
    if output is not None:
        write_codes(output, metrics.difference_image(first, second))
    if as_json:
        say_json(result)
    else:
        for name, value in result.items():
            say(f"{name}: {value:.6g}", err=False)
    broken = metrics.failures(result, {name.split("_")[1]: limit for name, limit in limits.items()})
    for sentence in broken:
        say(sentence)
    if broken:
        raise SystemExit(1)


def main() -> None:
    """Entry point: one clear message for a user's mistake, and no traceback for Ctrl-C."""
    gc.set_threshold(GARBAGE_AT)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that stdout cannot encode is no reason to fail
    raise_on_termination()
    try:
        code = cli(standalone_mode=False)
    except InputError as error:
        say(f"error: {error}")
        code = 2
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except OSError as error:  # from outside of wrt: a path too long for the system, stdout on a full disk
        say(f"error: {error}")
        code = 2
    except (click.Abort, KeyboardInterrupt) as error:  # click makes the first of the second
        cause = error.__cause__ if isinstance(error, click.Abort) else error
        code = exit_code(cause.number if isinstance(cause, Interrupted) else None)
        say("interrupted")
    except (MemoryError, RuntimeError, ImportError) as error:  # click.Abort is a RuntimeError, too
        told = f"{error}: {error.__cause__}" if error.__cause__ else str(error)
        if not (isinstance(error, MemoryError) or any(words in told for words in OUT_OF_MEMORY)):
            raise
        say(f"error: not enough memory{': ' if told else ''}{told}")
        code = 2
    except SystemExit as error:
        code = error.code
    if sys.getprofile() or sys.gettrace():
        sys.exit(code)  # who measures Python writes what he has when it ends
    _leave(code if isinstance(code, int) else 1 if code else 0)


def _leave(code: int) -> NoReturn:
    """Exit without waiting for a thread that compiles, and without freeing one by one what the system frees at once. Nothing is
    lost by it: files are whole or were never there."""
    if not code:
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # closed, or on a full disk
            stream.flush()
    os._exit(code)
