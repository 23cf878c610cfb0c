"""`python -m wrt profile`: what a picture costs, ray by ray, and what a model of the RT core makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wrt.cli_common import Crop, Size, load, naming, say_json, warnings_told
from wrt.errors import InputError


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for heat maps, EXR layers, histograms and a report")
@click.option("--size", type=Size(), help="Pixels  [default: the scene's]")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples a pixel")
@click.option("--max-depth", type=int, help="Bounces after the first hit  [default: the scene's]")
@click.option("--crop", type=Crop(), help="Only this rectangle, in pixels from the top left")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--accel", default="bvh", show_default=True, help="Acceleration structure")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@click.option("--seed", type=int, default=0, show_default=True, help="Other samples")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("-q", "--quiet", is_flag=True, help="No warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def profile(scene: Path, output: Path | None, gpu: str, quiet: bool, as_json: bool, **options: Any) -> None:
    """What every ray of SCENE costs: counters by pixel, kind and depth, and a model of the RT core."""
    from wrt.bench import profile_report as report
    from wrt.profiler import profile as measure
    from wrt.rtcore_parameters import GPUS

    if gpu not in GPUS:
        raise InputError(f"no GPU {gpu!r}; there is {', '.join(GPUS)}")
    if output is not None:
        report.check_folder(output)
    loaded = load(scene, quiet)
    with warnings_told(quiet), naming(scene):
        found = measure(loaded, **options)
    rows = report.model_rows(found, GPUS[gpu])
    text = report.summary(found, rows, GPUS[gpu])
    paths = [] if output is None else report.write_report(found, text, output)
    if as_json:
        say_json({"scene": found.scene, "size": found.size, "spp": found.spp, "rays": len(found.rays), "seconds": found.seconds,
                  "by_depth": found.by_depth(), "model": [row.as_dict() for row in rows], "output": [str(path) for path in paths]})
        return
    click.echo(text)
    for path in paths:
        click.echo(path)
