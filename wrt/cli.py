"""The command line: it parses, calls and prints; it knows nothing of rendering.

stdout is data, stderr is talk. Exit codes: 0; 1 where `compare` finds more difference than allowed; 2 for a user's mistake,
with one message; 130 when interrupted. Whatever takes long to import is imported by the command that needs it.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import click

from wrt.errors import InputError, SceneWarning

INTERRUPTED = 130
DIGITS = "[0-9]{1,9}"  # more are no pixel, and Python refuses to read thousands


class Size(click.ParamType):
    """640x360"""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(f"({DIGITS})[xX]({DIGITS})", str(value))
        if not match:
            self.fail(f"{value!r} is not a size; write 640x360", param, ctx)
        return int(match[1]), int(match[2])


class Crop(click.ParamType):
    """X0,Y0,X1,Y1"""

    name = "X0,Y0,X1,Y1"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        numbers = [number.strip() for number in str(value).split(",")]
        if len(numbers) != 4 or not all(re.fullmatch(DIGITS, number) for number in numbers):
            self.fail(f"{value!r} is not a rectangle; write X0,Y0,X1,Y1 in pixels from the top left", param, ctx)
        return tuple(int(number) for number in numbers)


class Duration(click.ParamType):
    """30, 30s, 5m or 1h"""

    name = "TIME"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]*)?)\s*([smh]?)", str(value))
        if not match:
            self.fail(f"{value!r} is not a time; write 30s, 5m or 1h", param, ctx)
        return float(match[1]) * {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}[match[2]]


class Names(click.ParamType):
    """Comma-separated names."""

    name = "NAME,..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        if isinstance(value, tuple):  # the default
            return value
        return tuple(name.strip() for name in str(value).split(",") if name.strip())


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="wrt", message="wrt %(version)s")
def cli() -> None:
    """A Whitted ray tracer on NVIDIA Warp."""


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Picture to write: .png, .exr or .hdr  [default: the scene's name with .png]")
@click.option("--spp", type=int, help="Samples a pixel  [default: the scene's]")
@click.option("--size", type=Size(), help="Pixels  [default: the scene's, 640x360]")
@click.option("--seed", type=int, default=0, show_default=True, help="Another seed, another noise")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("--crop", type=Crop(), help="Render only this rectangle, in pixels from the top left")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--max-depth", type=int, help="Bounces after the first hit  [default: the scene's, 8]")
@click.option("--min-throughput", type=float, help="Cut rays that carry less than this share  [default: 0.001]")
@click.option("--filter", "filter_name", help="Pixel filter: box, gaussian or blackman-harris")
@click.option("--fresnel", help="exact, or schlick (cheaper, approximate)")
@click.option("--sampler", help="sobol (evenly spread), or independent (random)")
@click.option("--accel", default="bvh", show_default=True, help="Acceleration structure")
@click.option("--aov", type=Names(), default=(), help="Also depth, normal, albedo, prim_id, material_id")
@click.option("--bits", type=int, help="PNG: 8 or 16; EXR: 16 or 32")
@click.option("--tonemap", help="none, reinhard, aces or agx  [default: the scene's]")
@click.option("--exposure", type=float, help="Stops  [default: the scene's, 0]")
@click.option("--time-limit", type=Duration(), help="Stop after 30s, 5m, 1h of tracing, with what there is")
@click.option("--target-error", type=float,
              help="Stop when the picture's estimated error is no larger: the root mean square, over pixels and channels, of"
                   " the standard error in linear radiance (noise alone); --spp is then the most to take  [default: 65536]")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print the statistics as JSON")
def render(scene: Path, output: Path | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Render SCENE (.toml, .gltf, .glb, or a mesh: .obj, .ply, .stl) to a picture."""
    begin = time.perf_counter()
    from wrt.image import check_writable

    output = output or Path(f"{scene.stem or 'picture'}.png")
    bits, aov = options.pop("bits"), options["aov"]
    check_writable(output, bits)
    from wrt.driver import Options, plain_text
    from wrt.driver import render as render_scene
    from wrt.film import aov_path
    from wrt.interrupt import held_interrupts
    from wrt.progress import progress_reporter
    from wrt.scene import Scene

    # Whatever can be wrong with an option is told before a scene is read and a kernel compiled.
    settings = {"filter": options.pop("filter_name")}
    settings |= {name: options.pop(name) for name in (
        "spp", "size", "max_depth", "min_throughput", "fresnel", "sampler", "tonemap", "exposure")}
    Scene().with_settings(**settings)
    Options(**options)
    layers = aov if output.suffix.lower() != ".exr" else None  # in an EXR file they are channels, all of them
    for name in layers or ():
        check_writable(aov_path(output, name))
    clock = {"import": time.perf_counter() - begin}
    loaded = _load(scene, quiet, clock)

    with _warnings_told(quiet), progress_reporter(quiet) as progress:
        with _naming(scene):
            film = render_scene(loaded.with_settings(**settings), spp=settings["spp"], progress=progress, **options)
        if not film.stats["samples"]:
            raise KeyboardInterrupt  # there is nothing to keep
        begin = time.perf_counter()
        film.metadata["scene"] = plain_text(scene.name)
        with held_interrupts() as late:  # a picture that is there is written in any case
            paths = film.save(output, bits=bits, aov=layers)
    film.stats["interrupted"] = film.stats["interrupted"] or bool(late)
    film.stats["seconds"] = clock | film.stats["seconds"] | {"write": time.perf_counter() - begin}
    if as_json:
        _say_json({"output": [str(path) for path in paths], **film.metadata, **film.stats})
    else:
        for path in paths:
            click.echo(path)
    if not quiet:
        _say(_summary(film))
    if film.stats["interrupted"]:
        raise SystemExit(INTERRUPTED)


def _summary(film: Any) -> str:
    s = film.stats
    seconds = ", ".join(f"{name} {value:.2f}" for name, value in s["seconds"].items())
    cut = f"cut: {s['cut_by_depth']} rays by depth, {s['cut_by_throughput']} by throughput"
    note = " (interrupted)" if s["interrupted"] else " (time limit)" if s["timed_out"] else ""
    if film.samples.min() == 0:
        note = f" (interrupted: {(film.samples == 0).mean():.0%} of the pixels are still black)"
    lost = f"; {s['not_finite']} samples were not finite and count as black" if s["not_finite"] else ""
    if s.get("target_error") is not None:
        note += f", estimated error {s['estimated_error']:.3g}"
        note += "" if s["target_reached"] else f" (above the target of {s['target_error']:g})"
    return (f"{film.metadata['spp']} spp{note}, {s['rays'] / 1e6:.2f} M rays, {s['rays_per_second'] / 1e6:.2f} Mray/s; "
            f"{cut}, lost throughput {s['lost_throughput_per_sample']:.2g} a sample{lost}\nseconds: {seconds}")


def _load(path: Path, quiet: bool, clock: dict[str, float] | None = None) -> Any:
    """The scene, with the loader's warnings on stderr."""
    begin = time.perf_counter()
    from wrt.scene_file import load_scene

    with _warnings_told(quiet):
        scene = load_scene(path)
    if clock is not None:
        clock["load"] = time.perf_counter() - begin
    return scene


@contextmanager
def _warnings_told(quiet: bool) -> Iterator[None]:
    """Tell the block's warnings on stderr when it is over, a line each; none where it fails: one message is enough."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SceneWarning)
        yield
    for warning in caught:
        if not (quiet and issubclass(warning.category, SceneWarning)):
            _say(f"warning: {warning.message}")


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """What is found wrong with a scene after it was read is told with its file."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error), path) from error


def _say_json(value: Any) -> None:
    """On stdout; JSON has no NaN and no infinity: they become null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    click.echo(json.dumps(plain(value), default=str, allow_nan=False))


def _say(text: str) -> None:
    click.echo(text, err=True)


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def info(scene: Path, camera: str | None, as_json: bool) -> None:
    """Tell what SCENE holds, and which features its kernel is compiled with."""
    from wrt.features import describe

    loaded = _load(scene, quiet=False)
    with _naming(scene):
        facts = describe(loaded, camera)
    if as_json:
        _say_json(facts)
        return
    features = facts.pop("features")
    for name, value in facts.items():
        shown = "none" if value in (None, []) else ", ".join(map(str, value)) if isinstance(value, list) else value
        click.echo(f"{name}: {shown}")
    for state in (True, False):
        names = [name for name, on in features.items() if on is state]
        click.echo(f"features {'on' if state else 'off'}: {', '.join(names) or 'none'}")


@cli.command()
def schema() -> None:
    """Print the JSON Schema of scene files."""
    from wrt.scene_file import schema as scene_schema

    click.echo(json.dumps(scene_schema(), indent=2))


@cli.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
def validate(scenes: tuple[Path, ...]) -> None:
    """Check SCENES without rendering; exit code 2 where one cannot be used."""
    bad = 0
    for scene in scenes:
        try:
            _load(scene, quiet=False)
            click.echo(f"{scene}: ok")
        except InputError as error:
            bad += 1
            _say(f"error: {error}")
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
@click.option("--tonemap", default="none", show_default=True, help="For PSNR and FLIP, which see what a display shows")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, likewise")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def compare(a: Path, b: Path, output: Path | None, tonemap: str, exposure: float, as_json: bool, **limits: Any) -> None:
    """Measure the error of picture A against the reference B."""
    from wrt import metrics
    from wrt.image import check_writable, read_image, write_codes
    from wrt.scene import Settings

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
        _say_json(result)
    else:
        for name, value in result.items():
            click.echo(f"{name}: {value:.6g}")
    broken = metrics.failures(result, {name.split("_")[1]: limit for name, limit in limits.items()})
    for sentence in broken:
        _say(sentence)
    if broken:
        raise SystemExit(1)


@cli.command()
@click.argument("cases", nargs=-1)
@click.option("--rays", type=click.IntRange(min=1), default=10_000, show_default=True, help="Rays of each case")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("--peers", is_flag=True, help="Also Embree (embreex) and Warp's own mesh_query_ray")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the tables as Markdown (.md)")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON")
def stability(cases: tuple[str, ...], rays: int, seed: int, peers: bool, output: Path | None, as_json: bool) -> None:
    """The hard cases against the intersection tests: rays lost and errors, with the speed beside them.

    CASES: names such as E_grid, or the letters of groups; without any, all.
    """
    from wrt.bench import stability as bench_stability

    def report(row: Any) -> None:
        if not as_json:
            click.echo("  ".join(bench_stability.cells(row)))

    if output is not None:
        bench_stability.check_report(output)
    if not as_json:
        click.echo("  ".join(bench_stability.COLUMNS))
    rows = bench_stability.run(cases, rays, peers=peers, seed=seed, report=report)
    if output is not None:
        bench_stability.write_report(rows, output)
    if as_json:
        _say_json([row.as_dict() for row in rows])


@cli.group()
def bench() -> None:
    """Measure: speed against error, and one method against another."""


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--size", type=int, default=512, show_default=True, help="Pixels a side as triangles grow")
@click.option("--max-size", type=int, default=1024, show_default=True, help="Pixels a side at the end of the sweep from 64 on")
@click.option("--max-triangles", type=int, default=1_500_000, show_default=True, help="Meshes are cut finer up to this many")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each kind, alternating")
@click.option("--accel", default="bvh", show_default=True, help="Acceleration structure")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for a report with plots")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def visibility(meshes: tuple[Path, ...], output: Path | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Rasterising against ray casting, as triangles and pixels grow: the cost of both, and where they differ.

    MESHES: .obj, .ply or .stl files; without any, a sphere and a terrain.
    """
    from wrt.bench import visibility as bench_visibility
    from wrt.bench import visibility_report as report

    plan = bench_visibility.Plan(meshes, **options)
    if output is not None:
        report.check_folder(output)
    told = report.machine(plan)

    def progress(row: Any) -> None:
        if not quiet:
            _say("  ".join(report.cells(row)[:8]))

    with _warnings_told(quiet):
        rows = bench_visibility.run(plan, progress)
    paths = [] if output is None else report.write_report(rows, plan, output, told)
    if as_json:
        _say_json({"machine": told, "rows": [row.as_dict() for row in rows], "exponents": bench_visibility.fits(rows),
                   "crossings": bench_visibility.crossings(rows), "output": paths})
        return
    click.echo(f"{told}\n\n{report.markdown(rows)}\n{report.LEGEND}")
    for path in paths:
        click.echo(path)


@bench.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--knobs", type=Names(), default=(),
              help="Which to turn: sampler, max_depth, triangle ... (a wrong name lists them)  [default: all]")
@click.option("--size", type=Size(), default="128x72", show_default=True, help="Pixels")
@click.option("--max-spp", type=int, default=64, show_default=True, help="Samples a pixel: 1, 2, 4 ... up to this")
@click.option("--repeats", type=int, default=8, show_default=True, help="Seeds of each picture, for the intervals")
@click.option("--reference-spp", type=int, help="Samples of each of the reference's seeds  [default: 8 times --max-spp]")
@click.option("--row-limit", type=Duration(), default="120s", show_default=True,
              help="Leave out what would take longer than this, with all its seeds")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--seed", type=int, default=0, show_default=True, help="Decides on all seeds")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for a report: Markdown, plot and data")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def error(scene: Path, output: Path | None, quiet: bool, as_json: bool, size: tuple[int, int], **options: Any) -> None:
    """Speed against error of SCENE over the knobs that a render has: each picture against a converged reference."""
    from wrt.bench import error as bench_error
    from wrt.bench import error_report as report
    from wrt.driver import Options

    plan = bench_error.Plan(**{name: options.pop(name) for name in (
        "knobs", "max_spp", "repeats", "reference_spp")}, row_seconds=options.pop("row_limit"))
    rendering = Options(**options)
    paths = {} if output is None else report.report_paths(output, scene.stem)
    loaded = _load(scene, quiet).with_settings(size=size)
    with _warnings_told(quiet), _naming(scene):
        result = bench_error.sweep(loaded, plan, rendering, lambda step: None if quiet else _say(step))
    if paths:
        report.write_report(result, paths, f"python -m wrt {click.get_current_context().command_path}")
    if as_json:
        _say_json({**result.as_dict(), "output": [str(path) for path in paths.values()]})
        return
    click.echo(report.text(result))
    for path in paths.values():
        click.echo(path)


@cli.command()
def devices() -> None:
    """List the devices that Warp can compute on."""
    from wrt.device import describe_devices

    for line in describe_devices():
        click.echo(line)


def main() -> None:
    """Entry point: one clear message for a user's mistake, and no traceback for Ctrl-C."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that stdout cannot encode is no reason to fail
    try:
        code = cli(standalone_mode=False)
    except InputError as error:
        _say(f"error: {error}")
        code = 2
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except OSError as error:  # from outside of wrt: a path too long for the system, stdout on a full disk
        _say(f"error: {error}")
        code = 2
    except MemoryError as error:
        _say(f"error: not enough memory: {error}")
        code = 2
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted")
        code = INTERRUPTED
    except SystemExit as error:
        code = error.code
    if code == INTERRUPTED:
        _leave(code)
    sys.exit(code)


def _leave(code: int) -> NoReturn:
    """Exit without waiting for a thread that compiles. Nothing is lost by it: files are whole or were never there."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    os._exit(code)
