"""The command `devices`, which lists devices or compares a device with the CPU."""

from pathlib import Path

import click

from wrt.cli.common import say, say_json, shared, warnings_reported
from wrt.core.errors import InputError


@click.command()
@click.option("--check", is_flag=True, help="Compare a device with the CPU, bit for bit; exit code 1 if a bit differs. Compiling"
                                            " all kernels takes minutes")
@click.option("--device", help="Device for --check: cuda:0 ...  [default: cuda:0; without a GPU: cpu]")
@click.option("--scene", "scenes", type=click.Path(path_type=Path), multiple=True,
              help="Scene file for --check; repeatable  [default: the scenes of wrt]")
@click.option("--rays", type=int, help="Number of rays for --check, per kind of ray, mesh and structure  [default: 20000]")
@shared("quiet", "as_json")
def devices(check: bool, device: str | None, scenes: tuple[Path, ...], rays: int | None, quiet: bool, as_json: bool) -> None:
    """List the devices, or compare one with the CPU."""
    from wrt.core.device import describe_devices

    if not check:
        if scenes or rays is not None or device is not None:
            raise InputError("need --check", argument="--device, --scene and --rays")
        lines = describe_devices()
        if as_json:
            say_json({"devices": lines})
        else:
            click.echo("\n".join(lines))
        return
    from wrt.lab.device_check import run, text

    without_a_gpu = not any(line.startswith("cuda:0") for line in describe_devices())
    with warnings_reported(quiet):
        result = run(device or ("cpu" if without_a_gpu else "cuda:0"), scenes, 20_000 if rays is None else rays,
                     (lambda line: None) if quiet else say)
    if as_json:
        say_json(result.as_dict())
    else:
        click.echo(text(result))
    if result.differ:
        raise SystemExit(1)
