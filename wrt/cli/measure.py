"""The commands that measure scenes and hard cases: `stability`, `bench error`, `bench mitsuba`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import click

from wrt.cli.bench import bench
from wrt.cli.common import SET, Duration, Names, Size, client_of, load, naming, settings_of, warnings_reported
from wrt.cli.reporting import Reporting, reporting


@click.command()
@click.argument("cases", nargs=-1)
@click.option("--rays", type=click.IntRange(min=1), default=10_000, show_default=True, help="Rays of each case, for the default")
@click.option("--sample", type=click.IntRange(min=1), default=10_000, show_default=True,
              help="How many of them the oracle judges, and the other tests and peers get")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("--peers", is_flag=True, help="Also Embree (robust and fast), Warp's mesh_query_ray and Open3D, where installed")
@click.option("--threads", type=int, help="Threads for the rays beyond the sample  [default: all cores]")
@click.option("--runs", type=click.IntRange(min=1), default=7, show_default=True, help="Runs of each for the speed, by turns")
@reporting("Write a report: Markdown with plots beside it (.md), or one page (.html)", cluster=True, quiet="No progress")
def stability(how: Reporting, **options: Any) -> None:
    """The hard cases against the intersection tests: rays lost and errors, with the speed beside them.

    CASES: names such as E_grid, or the letters of groups; without any, all.
    """
    from wrt.lab.hard_cases import report
    from wrt.lab.hard_cases import stability as study

    def row_done(row: Any) -> None:
        if not how.as_json:
            click.echo("  ".join(study.cells(row)))

    plan = study.Plan(**options)
    study.chosen(plan.cases)
    if how.output is not None:
        report.check_report(how.output)
    client = client_of(how.cluster)
    if not how.as_json:
        click.echo("  ".join(study.COLUMNS))
    result = study.run(plan, row_done, how.now_and_then, client)
    paths = [] if how.output is None else report.write_report(result, plan, how.output)
    data = {"machine": report.machine(plan), **result.as_dict(), "output": paths}
    how.end(f"\n{report.summary(result)}", data, paths, result.interrupted)


@bench.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--knobs", type=Names(), default=(),
              help="Which to turn: sampler, max_depth, triangle ... (a wrong name lists them)  [default: all]")
@click.option("--size", type=Size(), default="128x72", show_default=True, help="Pixels")
@click.option("--max-spp", type=int, default=64, show_default=True, help="Samples a pixel: 1, 2, 4 ... up to this")
@click.option("--repeats", type=int, default=8, show_default=True, help="Seeds of each picture, for the intervals")
@click.option("--reference-spp", type=int, help="Samples of each of the reference's seeds  [default: 8 times --max-spp]")
@click.option("--row-limit", "row_seconds", type=Duration(), default="120s", show_default=True,
              help="Leave out what would take longer than this, with all its seeds")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@SET
@click.option("--seed", type=int, default=0, show_default=True, help="Decides on all seeds")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@reporting("Folder for a report: Markdown, plot and data")
def error(how: Reporting, scene: Path, given: tuple[tuple[str, Any], ...], size: tuple[int, int], **options: Any) -> None:
    """Speed against error of SCENE over the knobs that a render has: each picture against a converged reference."""
    from wrt.lab.bench import error as study
    from wrt.lab.bench import error_report as report
    from wrt.renderer.options import Options

    rendering = Options(**{name: options.pop(name) for name in ("camera", "seed", "device", "threads")})
    plan = study.Plan(**options)
    settings = settings_of(given, size="--size", spp="--max-spp")
    paths = {} if how.output is None else report.report_paths(how.output, scene.stem)
    loaded = load(scene, how.quiet).with_settings(size=size, **settings)
    with warnings_reported(how.quiet), naming(scene):
        result = study.sweep(loaded, plan, rendering, how.progress)
    if paths:
        report.write_report(result, paths, f"python -m wrt {click.get_current_context().command_path}")
    how.end(report.text(result), {**result.as_dict(), "output": list(paths.values())}, list(paths.values()), result.interrupted)


@bench.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--spp", type=int, default=64, show_default=True, help="wrt's samples a pixel; its error is what Mitsuba must reach")
@click.option("--size", type=Size(), default="320x180", show_default=True, help="Pixels")
@click.option("--repeats", type=int, default=7, show_default=True, help="Pictures of each, alternating, each with its own seed")
@click.option("--reference-spp", type=int, help="Samples of each of the reference's 8 seeds  [default: 8 times --spp]")
@click.option("--rival-limit", "rival_seconds", type=Duration(), default="60s", show_default=True,
              help="No picture of Mitsuba's takes longer")
@click.option("--integrator", default="auto", show_default=True,
              help="Mitsuba's: path, volpath, direct or whitted (in Python, scalar_rgb only)")
@click.option("--variants", type=Names(), default=("scalar_rgb", "llvm_ad_rgb"),
              help="Mitsuba's; llvm_ad_rgb needs an LLVM library  [default: scalar_rgb,llvm_ad_rgb]")
@click.option("--matte", is_flag=True, help="Make every surface diffuse, for the integrator direct, which draws the same light")
@click.option("--starts", type=int, default=3, show_default=True, help="How often to time whole processes; 0: not at all")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@SET
@click.option("--seed", type=int, default=0, show_default=True, help="Decides on all seeds")
@reporting("Write the table as Markdown (.md)")
def mitsuba(how: Reporting, scene: Path, given: tuple[tuple[str, Any], ...], size: tuple[int, int], matte: bool,
            camera: str | None, **options: Any) -> None:
    """SCENE by wrt and by Mitsuba 3 (scalar_rgb and llvm_ad_rgb), on all threads: time to equal error, process start included and
    excluded.

    llvm_ad_rgb gets the LLVM library that DRJIT_LIBLLVM_PATH names, else the newest in the usual places that passes a trial.
    """
    from wrt.lab.mitsuba import equal_error
    from wrt.renderer.options import Options

    if matte and options["integrator"] == "auto":
        options["integrator"] = "direct"
    plan = equal_error.Plan(**options)
    how.check_markdown()
    settings = settings_of(given, size="--size", spp="--spp")
    loaded = load(scene, how.quiet).with_settings(size=size, **settings)
    with tempfile.TemporaryDirectory() as folder, warnings_reported(how.quiet), naming(scene):
        command = ["render", str(scene), "--spp", "1", "--size", f"{size[0]}x{size[1]}", "-q", "-o", f"{folder}/start.png"]
        command += [f"--set={name}={value}" for name, value in settings.items()]
        result = equal_error.run(equal_error.matte(loaded) if matte else loaded, plan, Options(camera=camera), command,
                                 how.now_and_then)
    text = equal_error.text(result)
    how.write(text)
    how.end(text, {**result.as_dict(), "output": how.output})
