"""`profile`: what a picture costs on an RT core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wrt.cli.common import load, naming, settings_of, shared, warnings_reported
from wrt.cli.reporting import Reporting, reporting


@click.command()
@shared("scene", "size")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples a pixel")
@shared("max_depth", "given", "crop", "camera", "accel", "seed", "threads")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
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
