"""The command `compile`, which fills the kernel cache in advance."""

import time
from pathlib import Path

import click

from wrt.cli.common import load, naming, say, say_json, shared, warnings_reported


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
