"""The commands that do slow work in advance: `build` saves an acceleration structure, `compile` fills the kernel cache."""

import time
from pathlib import Path

import click

from wrt.cli.common import Assignments, Parsed, load, naming, say, say_json, shared, warnings_reported
from wrt.core.errors import InputError
from wrt.io.meshes import SUFFIXES

EVERY = 10.0  # seconds between two lines of progress


@click.command(help="Build an acceleration structure over MESH, and save both."
                    f" MESH is {SUFFIXES}. wrt.load_accel reads the file.")
@click.argument("mesh", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="File to write, with the suffix .accel")
@click.option("--set", "assignments", metavar="NAME=VALUE", multiple=True,
              help="An option of the structure, such as max_leaf=8; repeatable")
@shared("accel", "threads", "quiet", "as_json")
def build(mesh: Path, output: Path, accel: str, assignments: Assignments, threads: int | None, quiet: bool,
          as_json: bool) -> None:
    from dataclasses import asdict

    import wrt
    from wrt.accel.instances import Instances
    from wrt.accel.store import check_target
    from wrt.core.checks import assigned

    check_target(output)
    options: dict[str, Parsed] = dict(assigned(assignments, "--set", {
        "mesh": "MESH", "accel": "--accel", "device": "the CPU", "threads": "--threads", "progress": "-q"}))
    due = time.monotonic() + EVERY

    def progress(done: float) -> None:
        nonlocal due
        if not quiet and time.monotonic() > due:
            due += EVERY
            say(f"{accel}: {100.0 * done:.0f} % built")

    with warnings_reported(quiet):
        structure = wrt.build(mesh, accel, threads=threads, progress=progress, **options)
    if isinstance(structure, Instances):
        raise InputError("a scene with instances has no structure in a file", path=mesh)
    structure.save(output, mesh=True)
    if as_json:
        say_json({"output": output, "accel": structure.name, **asdict(structure.stats)})
        return
    if not quiet:
        say(repr(structure))
    say(output, err=False)


@click.command("compile", help="Fill Warp's kernel cache (WARP_CACHE_PATH) in advance. It gets the kernels that"
               " query a structure, and the kernels that render SCENES with all AOVs. Kernels already in the cache are skipped.")
@click.argument("scenes", nargs=-1, type=click.Path(path_type=Path))
@shared("accel", "device", "threads", "quiet", "as_json")
def compile_kernels(scenes: tuple[Path, ...], accel: str, device: str, threads: int | None, quiet: bool, as_json: bool) -> None:
    from wrt.core.threads import thread_count
    from wrt.renderer.prepare import compile_picture, compile_queries

    count, done = thread_count(threads), list[dict[str, object]]()

    def report(purpose: str, names: list[str], begin: float) -> None:
        done.append({"for": purpose, "kernels": names, "seconds": time.perf_counter() - begin})
        if not as_json:
            say(f"{purpose}: {len(names)} kernels, {time.perf_counter() - begin:.1f} s", err=False)

    begin = time.perf_counter()
    report(f"queries of {accel}", compile_queries(accel, device), begin)
    for path in scenes:
        begin, scene = time.perf_counter(), load(path, quiet)
        with warnings_reported(quiet), naming(path):
            report(str(path), compile_picture(scene, accel, device, count), begin)
    if as_json:
        say_json({"compiled": done})
