"""The command `render`, which makes a picture."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wrt.cli.common import (
    CLUSTER,
    DURATION,
    Given,
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
    spread_options,
    warnings_reported,
)
from wrt.cli.save import checkpoint_options, remove_checkpoint, save_film
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted, exit_code
from wrt.io.meshes import SUFFIXES

if TYPE_CHECKING:
    from wrt.picture.film import Film
    from wrt.scene.model import Scene
    from wrt.scene.settings import SettingChanges


@click.command(help=f"Render SCENE (.toml, .gltf, .glb, or a mesh: {SUFFIXES}) to a picture.")
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
def render(scene: Path, output: Path | None, given: Given, quiet: bool, as_json: bool,
           **options: Parsed) -> None:
    begin = time.perf_counter()
    output, bits = output or Path(f"{scene.stem or 'picture'}.png"), options.pop("bits")
    check_picture(output, bits)
    if scene.exists():
        from wrt.accel.queries.raw_launches import preload_headers

        preload_headers()  # while the rest is imported
    settings = check_options(output, given, options)
    layers = options["aov"] if output.suffix.lower() != ".exr" else None  # in an EXR file layers are channels
    check_layers(output, layers)
    clock, begin = {"import": time.perf_counter() - begin}, time.perf_counter()
    loaded = load(scene, quiet).with_settings(**settings)
    clock["load"] = time.perf_counter() - begin
    checkpoint = options.get("checkpoint")
    if checkpoint is not None and options["resume"] and not (os.path.lexists(checkpoint) or quiet):
        say(f"{checkpoint}: no checkpoint yet, rendering from the beginning")

    with warnings_reported(quiet):
        film = trace(loaded, scene, settings.get("spp"), options, quiet)
        begin = time.perf_counter()
        paths, late, misplaced = save_film(film, output, bits, layers)
    if checkpoint is not None and not (misplaced or film.stats["interrupted"] or film.stats["timed_out"]):
        remove_checkpoint(checkpoint)  # the picture is done
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


def check_picture(output: Path, bits: int | None) -> None:
    """Raise InputError if no picture can be written there."""
    from wrt.picture.image import check_writable

    check_writable(output, bits)


def check_layers(output: Path, layers: Sequence[str] | None) -> None:
    """Raise InputError if a layer's picture cannot be written beside the output."""
    from wrt.picture.film import aov_path

    for name in layers or ():
        check_picture(aov_path(output, name), None)


def check_options(output: Path, given: Given, options: dict[str, Parsed]) -> SettingChanges:
    """Return the scene's settings, and leave the options of `wrt.render` in `options`.

    Raises InputError for invalid ones, before a scene is read and a kernel compiled."""
    from wrt.renderer.options import Options
    from wrt.scene.model import Scene

    flags = {"filter": options.pop("filter_name")}
    flags |= {name: options.pop(name) for name in (
        "spp", "size", "max_depth", "min_throughput", "fresnel", "sampler", "tonemap", "exposure")}
    settings = settings_of(given, flags)
    options |= checkpoint_options(output, options.pop("every"), options.pop("checkpoint_file"), options.pop("resume"))
    Scene().with_settings(**settings)
    options |= spread_options(options.pop("cluster"), options.pop("device"))
    Options(**options)
    return settings


def trace(loaded: Scene, path: Path, spp: int | None, options: dict[str, Parsed], quiet: bool) -> Film:
    """Render a scene, with progress on stderr. Raises Interrupted if there is no sample to keep."""
    from wrt.renderer.progress import progress_reporter
    from wrt.renderer.render import render as render_scene
    from wrt.renderer.result import plain_text

    with progress_reporter(quiet) as progress, naming(path):
        film = render_scene(loaded, spp=spp, progress=progress, **options)
    if not film.stats["samples"]:
        raise Interrupted(film.stats["signal"] or signal.SIGINT)
    film.metadata["scene"] = plain_text(path.name)
    return film


def _summary(film: Film) -> str:
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


def _seconds(stats: Mapping[str, Any]) -> str:
    """Return the seconds of each stage. Upload and build run beside compile."""
    seconds = stats["seconds"]
    notes = dict.fromkeys(seconds, "")
    if stats.get("resumed"):
        notes["trace"] = f" ({stats['resumed']['seconds']:.2f} of them before it was resumed)"
    return "seconds: " + ", ".join(f"{name} {value:.2f}{notes[name]}" for name, value in seconds.items())
