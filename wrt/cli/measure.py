"""The commands that measure: `bench` with its subcommands, `stability`, `profile`, `whatif`; and `devices`."""

import tempfile
from dataclasses import replace
from pathlib import Path

import click

from wrt.cli.common import SIZE, Assignments, Commands, Parsed, load, naming, say, say_json, settings_of, shared, warnings_reported
from wrt.cli.reporting import Reporting, measured, planned, reporting
from wrt.core.errors import InputError
from wrt.core.registry import Registry
from wrt.lab.bench import Error, Pictures, Queries, Visibility
from wrt.lab.claims import Claims
from wrt.lab.hard_cases import Closed, Stability
from wrt.lab.mitsuba import Mitsuba
from wrt.lab.rtcore import MODELLED, RtCore, WhatIf

BENCHES: Registry[click.Command] = Registry("bench", {}, "wrt.benches", click.Command)


@click.group(cls=Commands, commands=BENCHES, invoke_without_command=True, no_args_is_help=True)
@click.option("--quick", is_flag=True, help="With a command: pass --quick to it. Without a command: run every command that needs no"
                                            " file with --quick, in a minute on two cores")
@click.pass_context
def bench(context: click.Context, quick: bool) -> None:
    """Measure speed and error of renders, and compare methods."""
    if not quick:
        return
    if context.invoked_subcommand is not None:
        context.default_map = {name: {"quick": True} for name in bench.commands}
        return
    short = [name for name, command in bench.commands.items()
             if any(each.name == "quick" for each in command.params) and not any(each.required for each in command.params)]
    say(f"skipped, without --quick or in need of a file: {', '.join(name for name in bench.commands if name not in short)}")
    for name in short:
        command = bench.commands[name]
        with command.make_context(name, ["--quick"], parent=context) as each:
            command.invoke(each)


for plan in (Queries, Visibility, Pictures, Closed, RtCore, Claims):
    bench.add_command(measured(plan))
whatif, stability = measured(WhatIf), measured(Stability)


@click.command()
@shared("scene", "size")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples per pixel")
@shared("max_depth", "assignments", "crop", "camera", "accel", "seed", "threads")
@click.option("--gpu", default="rtx2080ti", show_default=True, help=MODELLED)
@reporting("Folder for heat maps, EXR layers and a report")
def profile(how: Reporting, scene: Path, assignments: Assignments, gpu: str, **options: Parsed) -> None:
    """Count the work of the rays of SCENE, and model an RT core. Count by pixel, kind of ray and depth; estimate the time on the core."""
    from wrt.core.checks import require_known
    from wrt.lab.rtcore import profile_report as report
    from wrt.lab.rtcore.parameters import GPUS
    from wrt.lab.rtcore.profiler import profile as measure
    from wrt.renderer.progress import progress_reporter

    require_known(gpu, GPUS, "GPU", "gpu")
    if how.output is not None:
        report.check_folder(how.output)
    settings = settings_of(assignments, {name: options.pop(name) for name in ("size", "max_depth")}, spp="--spp")
    loaded = load(scene, how.quiet).with_settings(**settings)
    with warnings_reported(how.quiet), progress_reporter(how.quiet) as progress, naming(scene):
        found = measure(loaded, progress=progress, **options)
    rows = report.model_rows(found, GPUS[gpu])
    text = report.summary(found, rows, GPUS[gpu])
    paths = [] if how.output is None else report.write_report(found, text, how.output)
    how.end(text, {"scene": found.scene, "size": found.size, "spp": found.spp, "rays": len(found.rays), "seconds": found.seconds,
                   "by_depth": found.by_depth(), "model": [row.as_dict() for row in rows], "output": paths}, paths)


@bench.command()
@shared("scene")
@planned(Error)
@click.option("--size", type=SIZE, default="128x72", show_default=True, help="Width and height in pixels")
@shared("camera", "assignments", "seed", "device", "threads")
@reporting()
def error(how: Reporting, plan: Error, scene: Path, assignments: Assignments, size: tuple[int, int],
          **options: Parsed) -> None:
    """Render SCENE with various values of each option. Compare time and error of the pictures with a converged
    reference."""
    from wrt.lab.bench import error as study
    from wrt.renderer.options import Options

    rendering = Options(**options)
    settings = settings_of(assignments, size="--size", spp="--max-spp")
    how.check_markdown()
    loaded = load(scene, how.quiet).with_settings(**settings).with_settings(size=size)
    with warnings_reported(how.quiet), naming(scene):
        result = study.sweep(loaded, plan, rendering, how.progress)
    text = study.text(result)
    how.write(text)
    how.end(text, {**result.as_dict(), "output": how.output}, interrupted=result.interrupted)


@bench.command()
@shared("scene")
@planned(Mitsuba)
@click.option("--size", type=SIZE, default="320x180", show_default=True, help="Width and height in pixels")
@click.option("--matte", is_flag=True, help="Make every surface diffuse, so that Mitsuba's integrator direct computes the same light")
@shared("camera", "assignments")
@reporting()
def mitsuba(how: Reporting, plan: Mitsuba, scene: Path, assignments: Assignments, size: tuple[int, int], matte: bool,
            camera: str | None) -> None:
    """Render SCENE with wrt and with Mitsuba 3. Use scalar_rgb and llvm_ad_rgb, and all threads. Compare the times to equal error,
    with and without the start of the process.

    llvm_ad_rgb needs an LLVM library (19 works), named in the environment variable DRJIT_LIBLLVM_PATH."""
    from wrt.lab.mitsuba import equal_error
    from wrt.renderer.options import Options

    if matte and plan.integrator == "auto":
        plan = replace(plan, integrator="direct")
    how.check_markdown()
    settings = settings_of(assignments, size="--size", spp="--spp")
    loaded = load(scene, how.quiet).with_settings(**settings).with_settings(size=size)
    with tempfile.TemporaryDirectory() as folder, warnings_reported(how.quiet), naming(scene):
        command = ["render", str(scene), "--spp", "1", "--size", f"{size[0]}x{size[1]}", "-q", "-o", f"{folder}/start.png"]
        command += [f"--set={name}={value}" for name, value in settings.items()]
        result = equal_error.run(equal_error.matte(loaded) if matte else loaded, plan, Options(camera=camera), command,
                                 how.progress_writer)
    text = equal_error.text(result)
    how.write(text)
    how.end(text, {**result.as_dict(), "output": how.output})


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
