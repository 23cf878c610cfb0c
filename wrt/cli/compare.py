"""The command `compare`, which measures the error of a picture."""

from __future__ import annotations

from pathlib import Path

import click

from wrt.cli.common import OneOf, say, say_json, shared
from wrt.core.errors import InputError


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write a picture of the difference (.png)")
@click.option("--max-mse", type=float, help="Fail above this mean squared error")
@click.option("--max-relmse", type=float, help="Fail above this relative mean squared error")
@click.option("--min-psnr", type=float, help="Fail below this many dB")
@click.option("--max-flip", type=float, help="Fail above this mean FLIP error")
@click.option("--tonemap", type=OneOf("wrt.scene.settings:TONEMAPS"), default="none", show_default=True,
              help="For PSNR and FLIP, which see what a display shows")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, likewise")
@shared("as_json")
def compare(a: Path, b: Path, output: Path | None, tonemap: str, exposure: float, as_json: bool, **limits: float | None) -> None:
    """Measure the error of picture A against the reference B."""
    from wrt.picture import metrics
    from wrt.picture.image import check_writable, read_image, write_codes
    from wrt.scene.settings import Settings

    Settings(tonemap=tonemap, exposure=exposure)  # raises before the pictures are read
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
    broken = metrics.failures(result, {name.split("_")[1]: limit for name, limit in limits.items()})
    for sentence in broken:
        say(sentence)
    if broken:
        raise SystemExit(1)
