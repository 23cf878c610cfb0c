"""The command `compare`, which measures the error of a picture."""

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
@click.option("--min-psnr", type=float, help="Fail below this PSNR in dB")
@click.option("--max-flip", type=float, help="Fail above this mean FLIP error")
@click.option("--tonemap", type=OneOf("wrt.scene.settings:TONEMAPS"), default="none", show_default=True,
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
