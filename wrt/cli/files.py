"""Commands that do not render: `info`, `schema` and `validate` of scenes, `compare` of pictures, and slow work in advance: `build`
saves an acceleration structure, `compile` fills the kernel cache."""

import json
import time
from pathlib import Path
from typing import cast

import click

from wrt.cli.common import Assignments, OneOf, Parsed, load, naming, say, say_json, settings_of, shared, warnings_reported
from wrt.core.errors import InputError
from wrt.io.meshes import SUFFIXES
from wrt.scene.settings import TONEMAPS


@click.command()
@shared("scene", "camera", "assignments", "as_json")
def info(scene: Path, camera: str | None, assignments: Assignments, as_json: bool) -> None:
    """Describe SCENE, and list the features of its render kernels."""
    from wrt.renderer.plan import describe

    settings = settings_of(assignments)
    loaded = load(scene, quiet=False).with_settings(**settings)
    with naming(scene):
        facts = describe(loaded, camera)
    if as_json:
        say_json(facts)
        return
    features = cast("dict[str, bool]", facts.pop("features"))
    for name, value in facts.items():
        between = "; " if isinstance(value, list) and value and isinstance(value[0], str) else ", "  # names may contain commas
        shown = "none" if value in (None, []) else between.join(map(str, value)) if isinstance(value, list) else value
        say(f"{name}: {shown}", err=False)
    for state in (True, False):
        names = [name for name, on in features.items() if on is state]
        say(f"features {'on' if state else 'off'}: {', '.join(names) or 'none'}", err=False)


@click.command()
def schema() -> None:
    """Print the JSON Schema of scene files."""
    from wrt.io.load import schema as scene_schema

    click.echo(json.dumps(scene_schema(), indent=2))


@click.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
def validate(scenes: tuple[Path, ...]) -> None:
    """Check SCENES without rendering. Exit code 2 if any of them is invalid."""
    code = 0
    for scene in scenes:
        try:
            load(scene, quiet=False)
            say(f"{scene}: ok", err=False)
        except InputError as error:
            code = 2
            say(f"error: {error}")
    raise SystemExit(code)


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write a picture of the difference (.png)")
@click.option("--max-mse", type=float, help="Fail above this mean squared error")
@click.option("--max-relmse", type=float, help="Fail above this relative mean squared error")
@click.option("--min-psnr", type=float, help="Fail below this PSNR in dB")
@click.option("--max-flip", type=float, help="Fail above this mean FLIP error")
@click.option("--tonemap", type=OneOf(TONEMAPS), default="none", show_default=True,
              help="Tone mapping before PSNR and FLIP, which compare display values")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Exposure in stops before PSNR and FLIP")
@shared("as_json")
def compare(a: Path, b: Path, output: Path | None, tonemap: str, exposure: float, as_json: bool, **limits: float | None) -> None:
    """Measure the error of picture A against the reference B. Exit code 1 if a limit is exceeded."""
    from wrt.picture import metrics
    from wrt.picture.image import check_writable, read_image, write_codes
    from wrt.scene.settings import Settings

    Settings(tonemap=tonemap, exposure=exposure)  # raises InputError before the pictures are read
    if output is not None:
        if output.suffix.lower() != ".png":
            raise InputError("must be a .png: a picture of the difference", path=output)
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
    failures = metrics.failures(result, {name.split("_")[1]: limit for name, limit in limits.items()})
    for sentence in failures:
        say(sentence)
    if failures:
        raise SystemExit(1)


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
