"""The command `walk`, which shows the steps of one ray through a structure."""

from pathlib import Path

import click

from wrt.cli.common import say, say_json, shared
from wrt.core.errors import InputError


@click.command()
@click.argument("mesh", type=click.Path(path_type=Path))
@click.option("--ray", required=True, help="Origin and direction, six numbers: ox,oy,oz,dx,dy,dz")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Also write .gif, .mp4, .png, .json or .txt; a{}.png: all steps")
@shared("accel", "as_json")
def walk(mesh: Path, ray: str, output: Path | None, accel: str, as_json: bool) -> None:
    """List the steps of one ray through a structure over MESH: nodes, boxes, planes, stack, and triangle tests."""
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
