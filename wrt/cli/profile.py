"""`profile`: what a picture costs on an RT core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wrt.cli.common import ACCEL, SET, Crop, Size, load, naming, settings_of, warnings_reported
from wrt.cli.reporting import Reporting, reporting


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--size", type=Size(), help="Pixels  [default: the scene's]")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples a pixel")
@click.option("--max-depth", type=int, help="Bounces after the first hit  [default: the scene's]")
@SET
@click.option("--crop", type=Crop(), help="Only this rectangle, in pixels from the top left")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@click.option("--seed", type=int, default=0, show_default=True, help="Other samples")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@reporting("Folder for heat maps, EXR layers, histograms and a report", quiet="No warnings")
def profile(how: Reporting, scene: Path, given: tuple[tuple[str, Any], ...], gpu: str, **options: Any) -> None:
    """What every ray of SCENE costs: counters by pixel, kind and depth, and a model of the RT core."""
    from wrt.core.checks import require_known
    from wrt.lab.bench.report import check_folder
    from wrt.lab.rtcore import profile_report as report
    from wrt.lab.rtcore.parameters import GPUS
    from wrt.lab.rtcore.profiler import profile as measure

    require_known(gpu, GPUS, "GPU")
    if how.output is not None:
        check_folder(how.output, (report.LAYERS, report.HISTOGRAMS))
    settings = settings_of(given, {name: options.pop(name) for name in ("size", "max_depth")}, spp="--spp")
    loaded = load(scene, how.quiet).with_settings(**settings)
    with warnings_reported(how.quiet), naming(scene):
        found = measure(loaded, **options)
    rows = report.model_rows(found, GPUS[gpu])
    text = report.summary(found, rows, GPUS[gpu])
    paths = [] if how.output is None else report.write_report(found, text, how.output)
    how.end(text, {"scene": found.scene, "size": found.size, "spp": found.spp, "rays": len(found.rays), "seconds": found.seconds,
                   "by_depth": found.by_depth(), "model": [row.as_dict() for row in rows], "output": paths}, paths)
