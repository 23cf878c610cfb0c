"""The commands `inspect`, which shows every ray of a pixel, and `walk`, which shows the steps of one ray through a structure."""

from pathlib import Path

import click

from wrt.cli.common import DIGITS, Assignments, Parsed, PatternType, load, naming, say, say_json, settings_of, shared, warnings_reported
from wrt.core.errors import InputError

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
