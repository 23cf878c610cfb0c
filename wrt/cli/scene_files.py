"""The commands `info`, `schema` and `validate`, which read scene files without rendering."""

import json
from pathlib import Path
from typing import cast

import click

from wrt.cli.common import Assignments, load, naming, say, say_json, settings_of, shared
from wrt.core.errors import InputError


@click.command()
@shared("scene", "camera", "assignments", "as_json")
def info(scene: Path, camera: str | None, assignments: Assignments, as_json: bool) -> None:
    """Describe SCENE, and list the features of its render kernels."""
    from wrt.renderer.features import describe

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
