"""The commands that measure: `bench` with its subcommands, `stability`, `profile`, `whatif`, `devices`; and those that show single rays:
`inspect`, every ray of a pixel, and `walk`, the steps of one ray through a structure."""

from pathlib import Path

import click

from wrt.cli.common import (
    DIGITS,
    Assignments,
    Commands,
    Parsed,
    PatternType,
    load,
    naming,
    say,
    say_json,
    settings_of,
    shared,
    warnings_reported,
)
from wrt.cli.reporting import measured
from wrt.core.errors import InputError
from wrt.core.registry import Registry
from wrt.lab.bench import Error, Queries, Visibility
from wrt.lab.claims import Claims
from wrt.lab.hard_cases import Stability
from wrt.lab.mitsuba import Mitsuba
from wrt.lab.rtcore import MODELLED, RtCore, WhatIf

BENCHES: Registry[click.Command] = Registry("bench", {}, "wrt.benches", click.Command)


@click.group(cls=Commands, commands=BENCHES)
def bench() -> None:
    """Measure speed and error of renders, and compare methods."""


for plan in (Queries, Error, Visibility, Mitsuba, RtCore, Claims):
    bench.add_command(measured(plan))
whatif, stability = measured(WhatIf), measured(Stability)


@click.command()
@shared("scene", "size")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples per pixel")
@shared("max_depth", "assignments", "crop", "camera", "accel", "seed", "threads")
@click.option("--gpu", default="rtx2080ti", show_default=True, help=MODELLED)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for heat maps, EXR layers and a report")
@shared("quiet", "as_json")
def profile(scene: Path, assignments: Assignments, gpu: str, output: Path | None, quiet: bool, as_json: bool, **options: Parsed) -> None:
    """Count the work of the rays of SCENE, and model an RT core. Count by pixel, kind of ray and depth; estimate the time on the core."""
    from wrt.core.checks import require_known
    from wrt.lab.rtcore import profile_report as report
    from wrt.lab.rtcore.parameters import GPUS
    from wrt.lab.rtcore.profiler import profile as measure
    from wrt.renderer.progress import progress_reporter

    require_known(gpu, GPUS, "GPU", "gpu")
    if output is not None:
        report.check_folder(output)
    settings = settings_of(assignments, {name: options.pop(name) for name in ("size", "max_depth")}, spp="--spp")
    loaded = load(scene, quiet).with_settings(**settings)
    with warnings_reported(quiet), progress_reporter(quiet) as progress, naming(scene):
        found = measure(loaded, progress=progress, **options)
    rows = report.model_rows(found, GPUS[gpu])
    text = report.summary(found, rows, GPUS[gpu])
    paths = [] if output is None else report.write_report(found, text, output)
    if as_json:
        say_json({"scene": found.scene, "size": found.size, "spp": found.spp, "rays": len(found.rays), "seconds": found.seconds,
                  "by_depth": found.by_depth(), "model": [row.as_dict() for row in rows], "output": paths})
        return
    for line in (text, *paths):
        say(line, err=False)


@click.command()
@click.option("--check", is_flag=True, help="Compare a device with the CPU, bit for bit; exit code 1 if a bit differs. Compiling"
                                            " all kernels takes minutes")
@click.option("--device", help="Device for --check: cuda:0 ...  [default: cuda:0; without a GPU: cpu]")
@click.option("--scene", "scenes", type=click.Path(path_type=Path), multiple=True,
              help="Scene file for --check; repeatable  [default: the scenes of wrt]")
@click.option("--rays", type=int, help="Number of rays for --check, per kind of ray, mesh and structure  [default: 20000]")
@shared("quiet", "as_json")
def devices(check: bool, device: str | None, scenes: tuple[Path, ...], rays: int | None, quiet: bool, as_json: bool) -> None:
    """List the devices, or compare one with the CPU."""
    from wrt.core.device import describe_devices

    if not check:
        if scenes or rays is not None or device is not None:
            raise InputError("need --check", argument="--device, --scene and --rays")
        lines = describe_devices()
        if as_json:
            say_json({"devices": lines})
        else:
            click.echo("\n".join(lines))
        return
    from wrt.lab.device_check import run, text

    without_a_gpu = not any(line.startswith("cuda:0") for line in describe_devices())
    with warnings_reported(quiet):
        result = run(device or ("cpu" if without_a_gpu else "cuda:0"), scenes, 20_000 if rays is None else rays,
                     (lambda line: None) if quiet else say)
    if as_json:
        say_json(result.as_dict())
    else:
        click.echo(text(result))
    if result.differ:
        raise SystemExit(1)


PIXEL = PatternType("X,Y", rf"\s*({DIGITS})\s*,\s*({DIGITS})\s*", "a pixel; write X,Y: column and row, 0,0 is at the top left",
                    lambda *ends: tuple(map(int, ends)))


@click.command()
@shared("scene")
@click.option("--pixel", type=PIXEL, required=True, help="The pixel, from the top left")
@click.option("--sample", type=int, help="Trace only this sample, from 0  [default: all samples of the pixel]")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Drawing of the first sample traced: .png, .svg or .pdf")
@shared("spp", "size", "seed", "threads", "camera", "max_depth", "assignments", "accel", "device", "quiet", "as_json")
def inspect(scene: Path, output: Path | None, assignments: Assignments, quiet: bool, as_json: bool, **options: Parsed) -> None:
    """Print the tree of rays of a pixel of SCENE. It has what each ray hits, why it ends, and what it adds to the pixel."""
    from wrt.core.files import check_writable
    from wrt.renderer.inspector.drawing import require_drawable
    from wrt.renderer.inspector.inspect import inspect as inspect_pixel

    if output is not None:
        check_writable(require_drawable(output))
    settings = settings_of(assignments, options)
    loaded = load(scene, quiet)
    with warnings_reported(quiet), naming(scene):
        found = inspect_pixel(loaded, **settings, **options)
        if output is not None:
            found.save(output)
    if as_json:
        say_json({"output": None if output is None else str(output), **found.to_dict()})
    else:
        say(found, err=False)


@click.command()
@click.argument("mesh", type=click.Path(path_type=Path))
@click.option("--ray", required=True, help="Origin and direction, six numbers: ox,oy,oz,dx,dy,dz")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Also write .gif, .png, .json or .txt")
@shared("accel", "as_json")
def walk(mesh: Path, ray: str, output: Path | None, accel: str, as_json: bool) -> None:
    """List the steps of one ray through a structure over MESH. Steps are nodes, boxes, planes, stack, and triangle tests."""
    import wrt

    try:
        numbers = [float(each) for each in ray.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise InputError(f"must be six numbers ox,oy,oz,dx,dy,dz, got {ray!r}", argument="--ray")
    found = wrt.walk(wrt.build(mesh, accel), numbers[:3], numbers[3:])
    if output is not None:
        found.save(output)
    if as_json:
        say_json(found.as_dict())
    else:
        say(str(found), err=False)
