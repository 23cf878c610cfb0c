"""The commands that measure: `stability` and `bench`. They parse, call and print, as those of wrt.cli.main do."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import click

from wrt.cli.common import (
    ACCEL,
    CLUSTER,
    SET,
    Commands,
    Duration,
    Names,
    Size,
    client_of,
    load,
    naming,
    now_and_then,
    say,
    say_json,
    settings_of,
    warnings_told,
)
from wrt.core.errors import InputError
from wrt.core.interrupts import exit_code


@click.command()
@click.argument("cases", nargs=-1)
@click.option("--rays", type=click.IntRange(min=1), default=10_000, show_default=True, help="Rays of each case, for the default")
@click.option("--sample", type=click.IntRange(min=1), default=10_000, show_default=True,
              help="How many of them the oracle judges, and the other tests and peers get")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("--peers", is_flag=True, help="Also Embree (robust and fast), Warp's mesh_query_ray and Open3D, where installed")
@click.option("--threads", type=int, help="Threads for the rays beyond the sample  [default: all cores]")
@CLUSTER
@click.option("--runs", type=click.IntRange(min=1), default=7, show_default=True, help="Runs of each for the speed, by turns")
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Write a report: Markdown with plots beside it (.md), or one page (.html)")
@click.option("-q", "--quiet", is_flag=True, help="No progress")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def stability(output: Path | None, cluster: str | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """The hard cases against the intersection tests: rays lost and errors, with the speed beside them.

    CASES: names such as E_grid, or the letters of groups; without any, all.
    """
    from wrt.lab.hard_cases import report
    from wrt.lab.hard_cases import stability as bench_stability

    def told(row: Any) -> None:
        if not as_json:
            click.echo("  ".join(report.cells(row)))

    plan = bench_stability.Plan(**options)
    bench_stability.chosen(plan.cases)
    if output is not None:
        report.check_report(output)
    client = client_of(cluster)
    if not as_json:
        click.echo("  ".join(report.COLUMNS))
    result = bench_stability.run(plan, told, now_and_then(quiet), client)
    paths = [] if output is None else report.write_report(result, plan, output)
    if as_json:
        say_json({"machine": report.machine(plan), **result.as_dict(), "output": [str(path) for path in paths]})
    else:
        click.echo(f"\n{report.summary(result)}")
        for path in paths:
            click.echo(path)
    _end(result.interrupted)


def _end(interrupted: int | None) -> None:
    """With a signal's exit code, where one ended the work early and what was done is told."""
    if interrupted is not None:
        say("interrupted: what was done is kept")
        raise SystemExit(exit_code(interrupted))


def by_mesh(run: Callable[..., list[Any]], plan: Any, report: Callable[[Any], None], client: Any) -> list[Any]:
    """As wrt.lab.bench.sweep.by_mesh."""
    from wrt.lab.bench import sweep

    return sweep.by_mesh(run, plan, report, client)


def told_of(client: Any, here: str) -> str:
    """What is measured on: this machine, or a cluster's, each mesh on one worker."""
    if client is None:
        return here
    from wrt.renderer.distributed.dask import machines

    return f"a cluster, each mesh on one worker: {machines(client)}; started from {here}"


@click.group(cls=Commands)
def bench() -> None:
    """Measure: speed against error, and one method against another."""


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--size", type=int, default=512, show_default=True, help="Pixels a side as triangles grow")
@click.option("--max-size", type=int, default=1024, show_default=True, help="Pixels a side at the end of the sweep from 64 on")
@click.option("--max-triangles", type=int, default=1_500_000, show_default=True, help="Meshes are cut finer up to this many")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each kind, alternating")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@CLUSTER
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for a report with plots")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def visibility(meshes: tuple[Path, ...], output: Path | None, cluster: str | None, quiet: bool, as_json: bool,
               **options: Any) -> None:
    """Rasterising against ray casting, as triangles and pixels grow: the cost of both, and where they differ.

    MESHES: mesh files; without any, a sphere and a terrain.
    """
    from wrt.lab.bench import visibility as bench_visibility
    from wrt.lab.bench import visibility_report as report

    plan = bench_visibility.Plan(meshes, **options)
    if output is not None:
        report.check_folder(output)
    client = client_of(cluster)
    told = told_of(client, report.machine(plan))

    def progress(row: Any) -> None:
        if not quiet:
            say("  ".join(report.cells(row)[:8]))

    with warnings_told(quiet):
        rows = by_mesh(bench_visibility.run, plan, progress, client)
    paths = [] if output is None else report.write_report(rows, plan, output, told)
    if as_json:
        say_json({"machine": told, "rows": [row.as_dict() for row in rows], "exponents": bench_visibility.fits(rows),
                   "crossings": bench_visibility.crossings(rows), "output": paths})
        return
    click.echo(f"{told}\n\n{report.markdown(rows)}\n{report.LEGEND}")
    for path in paths:
        click.echo(path)


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--rays", type=int, default=2**17, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=9, show_default=True, help="Runs of each unit, by turns")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the table as Markdown (.md)")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def units(output: Path | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """The default triangle and box tests beside the others: what they cost, as ratios with their spread, on one thread.

    MESHES: mesh files; without any, a sphere, a terrain and a teapot.
    """
    from dataclasses import asdict

    from wrt.lab.bench import units as bench_units

    plan = bench_units.Plan(**options)
    if output is not None and (output.suffix.lower() != ".md" or not output.parent.is_dir()):
        raise InputError("the report is a .md file in a folder that is there", output)
    told = bench_units.machine()
    with warnings_told(quiet):
        rows = bench_units.run(plan, now_and_then(quiet))
    text = bench_units.text(rows, plan, told)
    if output is not None:
        output.write_text(text, encoding="utf-8")
    if as_json:
        say_json({"machine": told, "rows": [asdict(row) for row in rows], "output": output})
        return
    click.echo(text)


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--structures", type=Names(), default=("bvh",), help="Of wrt, by name; ratios are of the first  [default: bvh]")
@click.option("--rivals", type=Names(), default=(), help="embree, embree_fast, warp, open3d  [default: those that are installed]")
@click.option("--kinds", type=Names(), default=("primary", "shadow", "diffuse", "random"), help="Of rays  [default: all]")
@click.option("--rays", type=int, default=100_000, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each, by turns")
@click.option("--threads", default="both", show_default=True, help="one (by its CPU time), all (by the clock) or both")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@CLUSTER
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the tables as Markdown (.md)")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def peers(meshes: tuple[Path, ...], output: Path | None, cluster: str | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """wrt beside Embree (robust and fast) and Warp's mesh_query_ray: the same rays by turns, on one thread and on all, with ratios
    and answers that differ.

    MESHES: mesh files; without any, a sphere.
    """
    from wrt.lab.bench import peers as bench_peers

    plan = bench_peers.Plan(meshes, **options)
    if output is not None and (output.suffix.lower() != ".md" or not output.parent.is_dir()):
        raise InputError("the report is a .md file in a folder that is there", output)
    client = client_of(cluster)
    told = told_of(client, bench_peers.machine(plan))

    def progress(row: Any) -> None:
        if not quiet:
            say(f"{row.mesh}: {'  '.join(bench_peers.cells(row, row))}")

    with warnings_told(quiet):
        rows = by_mesh(bench_peers.run, plan, progress, client)
    text = bench_peers.text(rows, told)
    if output is not None:
        output.write_text(text, encoding="utf-8")
    if as_json:
        say_json({"machine": told, "rows": [row.as_dict() for row in rows], "means": bench_peers.means(rows), "output": output})
        return
    click.echo(text)


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--structures", type=Names(), default=(), help="Which, by name  [default: all but brute_force]")
@click.option("--kinds", type=Names(), default=("primary", "shadow", "diffuse", "random"), help="Of rays  [default: all]")
@click.option("--rays", type=int, default=100_000, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=5, show_default=True, help="Runs of each structure, alternating")
@click.option("--builds", type=int, default=1, show_default=True, help="Builds of each structure")
@click.option("--max-triangles", type=int, default=1_000_000, show_default=True, help="Without meshes, the terrain grows to this")
@click.option("--threads", type=int, default=1, show_default=True, help="Threads to search with (builds use all cores)")
@CLUSTER
@click.option("--stadium", is_flag=True, help="Each mesh in a stadium a thousand times its size, with the rays it has alone")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for a report with plots")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def accel(meshes: tuple[Path, ...], output: Path | None, cluster: str | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Structure against structure: time to build, memory, steps and time to search, and answers that differ (none may).

    MESHES: mesh files; without any, a terrain that grows from a thousand triangles on.
    """
    from dataclasses import asdict

    from wrt.lab.bench import accel as bench_accel
    from wrt.lab.bench import accel_report as report

    plan = bench_accel.Plan(meshes, **options)
    if output is not None:
        report.check_folder(output)
    client = client_of(cluster)
    told = told_of(client, report.machine(plan))

    def progress(row: Any) -> None:
        if not quiet:
            if isinstance(row, bench_accel.Refused):
                say(f"{row.mesh}: {row.structure}: {row.reason}")
            else:
                say(f"{row.mesh}: {row.structure}, {row.kind} rays: {median(row.mrays):.3g} Mray/s, {row.differ} differ")

    with warnings_told(quiet):
        rows = by_mesh(bench_accel.run, plan, progress, client)
    paths = [] if output is None else report.write_report(rows, plan, output, told)
    if as_json:
        say_json({"machine": told, "rows": [row.as_dict() for row in rows if isinstance(row, bench_accel.Row)],
                  "refused": [asdict(row) for row in rows if isinstance(row, bench_accel.Refused)],
                  "growth": bench_accel.growth(rows), "output": paths})
        return
    click.echo(f"{told}\n\n{report.markdown(rows)}\n{report.LEGEND}")
    for path in paths:
        click.echo(path)


@bench.command()
@click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))
@click.option("--builders", type=Names(), default=(), help="Which, by name  [default: all]")
@click.option("--rays", type=int, default=2**18, show_default=True, help="Rays into each mesh")
@click.option("--builds", type=int, default=3, show_default=True, help="Builds of each builder, after the first")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each volume, alternating")
@click.option("--threads", type=int, help="Threads to build with  [default: all cores]")
@CLUSTER
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def bvh(meshes: tuple[Path, ...], cluster: str | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Builders of binary BVHs over MESHES: quality, time and memory; and boxes, spheres and 14-DOPs around the same tree."""
    from dataclasses import asdict

    from wrt.lab.bench import bvh as bench_bvh

    plan = bench_bvh.Plan(meshes, **options)
    client = client_of(cluster)
    told = told_of(client, bench_bvh.machine())

    def progress(row: Any) -> None:
        if not quiet:
            say(f"{row.mesh}: {'  '.join(row.cells())}")

    with warnings_told(quiet):
        rows = by_mesh(bench_bvh.run, plan, progress, client)
    if as_json:
        say_json({"machine": told, "builders": [asdict(row) for row in rows if isinstance(row, bench_bvh.BuilderRow)],
                  "volumes": [asdict(row) for row in rows if isinstance(row, bench_bvh.VolumeRow)]})
        return
    click.echo(f"{told}\n\n{bench_bvh.markdown(rows)}\n{bench_bvh.LEGEND}")


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
@SET
@click.option("--seed", type=int, default=0, show_default=True, help="Decides on all seeds")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for a report: Markdown, plot and data")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def error(scene: Path, output: Path | None, given: tuple[tuple[str, Any], ...], quiet: bool, as_json: bool, size: tuple[int, int],
          **options: Any) -> None:
    """Speed against error of SCENE over the knobs that a render has: each picture against a converged reference."""
    from wrt.lab.bench import error as bench_error
    from wrt.lab.bench import error_report as report
    from wrt.renderer.options import Options

    plan = bench_error.Plan(**{name: options.pop(name) for name in (
        "knobs", "max_spp", "repeats", "reference_spp")}, row_seconds=options.pop("row_limit"))
    rendering = Options(**options)
    settings = settings_of(given, size="--size", spp="--max-spp")
    paths = {} if output is None else report.report_paths(output, scene.stem)
    loaded = load(scene, quiet).with_settings(size=size, **settings)
    with warnings_told(quiet), naming(scene):
        result = bench_error.sweep(loaded, plan, rendering, lambda step: None if quiet else say(step))
    if paths:
        report.write_report(result, paths, f"python -m wrt {click.get_current_context().command_path}")
    if as_json:
        say_json({**result.as_dict(), "output": [str(path) for path in paths.values()]})
    else:
        click.echo(report.text(result))
        for path in paths.values():
            click.echo(path)
    _end(result.interrupted)


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
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the table as Markdown (.md)")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def mitsuba(scene: Path, output: Path | None, given: tuple[tuple[str, Any], ...], quiet: bool, as_json: bool,
            size: tuple[int, int], matte: bool, camera: str | None, **options: Any) -> None:
    """SCENE by wrt and by Mitsuba 3 (scalar_rgb and llvm_ad_rgb), on all threads: time to equal error, process start included and
    excluded.

    llvm_ad_rgb gets the LLVM library that DRJIT_LIBLLVM_PATH names, else the newest in the usual places that passes a trial.
    """
    from wrt.lab.mitsuba import equal_error
    from wrt.renderer.options import Options

    if matte and options["integrator"] == "auto":
        options["integrator"] = "direct"
    plan = equal_error.Plan(**options)
    if output is not None and (output.suffix.lower() != ".md" or not output.parent.is_dir()):
        raise InputError("the report is a .md file in a folder that is there", output)
    settings = settings_of(given, size="--size", spp="--spp")
    loaded = load(scene, quiet).with_settings(size=size, **settings)
    with tempfile.TemporaryDirectory() as folder, warnings_told(quiet), naming(scene):
        command = ["render", str(scene), "--spp", "1", "--size", f"{size[0]}x{size[1]}", "-q", "-o", f"{folder}/start.png"]
        command += [f"--set={name}={value}" for name, value in settings.items()]
        result = equal_error.run(equal_error.matte(loaded) if matte else loaded, plan, Options(camera=camera), command,
                                 now_and_then(quiet))
    told = equal_error.text(result)
    if output is not None:
        output.write_text(told + "\n", encoding="utf-8")
    if as_json:
        say_json({**result.as_dict(), "output": output})
        return
    click.echo(told)
