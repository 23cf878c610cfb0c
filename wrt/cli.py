"""The command line: it parses, calls and prints; it knows nothing of rendering.

stdout is data, stderr is talk. Exit codes: 0; 1 where `compare` finds more difference than allowed; 2 for a user's mistake,
with one message; 130 when interrupted. Whatever takes long to import is imported by the command that needs it.
"""

from __future__ import annotations

import json
import re
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import click

from wrt.errors import InputError, SceneWarning

INTERRUPTED = 130


class Size(click.ParamType):
    """640x360"""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)[xX](\d+)", str(value))
        if not match:
            self.fail(f"{value!r} is not a size; write 640x360", param, ctx)
        return int(match[1]), int(match[2])


class Crop(click.ParamType):
    """X0,Y0,X1,Y1"""

    name = "X0,Y0,X1,Y1"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        numbers = str(value).split(",")
        if len(numbers) != 4 or not all(number.strip().isdigit() for number in numbers):
            self.fail(f"{value!r} is not a rectangle; write X0,Y0,X1,Y1 in pixels from the top left", param, ctx)
        return tuple(int(number) for number in numbers)


class Duration(click.ParamType):
    """30, 30s, 5m or 1h"""

    name = "TIME"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh]?)", str(value))
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
@click.option("--accel", default="bvh", show_default=True, help="Acceleration structure")
@click.option("--aov", type=Names(), default=(), help="Also depth, normal, albedo, prim_id, material_id")
@click.option("--bits", type=int, help="PNG: 8 or 16; EXR: 16 or 32")
@click.option("--tonemap", help="none, reinhard, aces or agx  [default: the scene's]")
@click.option("--exposure", type=float, help="Stops  [default: the scene's, 0]")
@click.option("--time-limit", type=Duration(), help="Stop after 30s, 5m, 1h of tracing, with what there is")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print the statistics as JSON")
def render(scene: Path, output: Path | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Render SCENE (.toml, .gltf, .glb, or a mesh: .obj, .ply, .stl) to a picture."""
    begin = time.perf_counter()
    from wrt.image import check_writable
    from wrt.progress import progress_reporter

    output = output or Path(scene.name).with_suffix(".png")
    check_writable(output, options["bits"])
    clock = {"import": time.perf_counter() - begin}
    loaded = _load(scene, quiet, clock)
    begin = time.perf_counter()
    from wrt.driver import render as render_scene

    clock["import"] += time.perf_counter() - begin
    bits, aov = options.pop("bits"), options.pop("aov")
    settings = {"filter": options.pop("filter_name"), "fresnel": options.pop("fresnel"),
                "tonemap": options.pop("tonemap"), "exposure": options.pop("exposure")}
    with progress_reporter(quiet) as progress:
        film = render_scene(loaded, settings=settings, aov=aov, progress=progress, **options)
    begin = time.perf_counter()
    film.metadata["scene"] = str(scene.name)
    paths = film.save(output, bits=bits, aov=aov if output.suffix.lower() != ".exr" else None)
    film.stats["seconds"] = clock | film.stats["seconds"] | {"write": time.perf_counter() - begin}
    if as_json:
        click.echo(json.dumps({"output": [str(path) for path in paths], **film.metadata, **film.stats}, default=str))
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
    lost = f"; {s['not_finite']} samples were not finite and count as black" if s["not_finite"] else ""
    return (f"{film.metadata['spp']} spp{note}, {s['rays'] / 1e6:.2f} M rays, {s['rays_per_second'] / 1e6:.2f} Mray/s; "
            f"{cut}, lost throughput {s['lost_throughput_per_sample']:.2g} a sample{lost}\nseconds: {seconds}")


def _load(path: Path, quiet: bool, clock: dict[str, float] | None = None) -> Any:
    """The scene, with the loader's warnings on stderr."""
    begin = time.perf_counter()
    from wrt.scene_file import load_scene

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SceneWarning)
        scene = load_scene(path)
    for warning in caught:
        if not (quiet and issubclass(warning.category, SceneWarning)):
            _say(f"warning: {warning.message}")
    if clock is not None:
        clock["load"] = time.perf_counter() - begin
    return scene


def _say(text: str) -> None:
    click.echo(text, err=True)


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def info(scene: Path, camera: str | None, as_json: bool) -> None:
    """Tell what SCENE holds, and which features its kernel is compiled with."""
    from wrt.features import describe

    facts = describe(_load(scene, quiet=False), camera)
    if as_json:
        click.echo(json.dumps(facts))
        return
    features = facts.pop("features")
    for name, value in facts.items():
        click.echo(f"{name}: {', '.join(map(str, value)) if isinstance(value, list) else value}")
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

    if output is not None:
        check_writable(output, 8)
    first, second = read_image(a), read_image(b)
    result = metrics.compare(first, second, exposure=exposure, tonemap=tonemap)
    if output is not None:
        write_codes(output, metrics.difference_image(first, second))
    if as_json:
        click.echo(json.dumps(result))
    else:
        for name, value in result.items():
            click.echo(f"{name}: {value:.6g}")
    broken = metrics.failures(result, {name.split("_")[1]: limit for name, limit in limits.items()})
    for sentence in broken:
        _say(sentence)
    if broken:
        raise SystemExit(1)


@cli.command()
def devices() -> None:
    """List the devices that Warp can compute on."""
    from wrt.device import describe_devices

    for line in describe_devices():
        click.echo(line)


def main() -> None:
    """Entry point: one clear message for a user's mistake, and no traceback for Ctrl-C."""
    try:
        code = cli(standalone_mode=False)
    except InputError as error:
        _say(f"error: {error}")
        code = 2
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted")
        code = INTERRUPTED
    except BrokenPipeError:  # `wrt info scene | head`
        sys.stderr.close()
        code = 0
    sys.exit(code)
