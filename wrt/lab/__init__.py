"""The laboratory: measurements and models. Of the product, only the command line and lazy public names import it.

A measurement declares its options once, as the fields of a Plan. A field is an argument in Python and an option on the command line.
The __init__ of each room declares the room's measurements. It imports nothing heavy, because the command line reads it for its help."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from wrt.scene.model import Scene

# Names that an option accepts: what messages call such a name, and the table of the names.
STRUCTURES = ("structure", "wrt.accel.structures:ACCELERATORS")


def option(default: Any, text: str = "", between: tuple[int, int] | None = None, of: tuple[str, str] | None = None,
           check: str = "") -> Any:
    """Return a field of a Plan.
    - text: help of the option; "" makes the field a positional argument. between: lowest and highest value (None is always allowed).
    - of: for a field of names: what messages call such a name, and the table of the names as "module:TABLE".
    - check: "module:function" that raises InputError for a wrong value."""
    return field(default=default, metadata={"text": text, "between": between, "of": of, "check": check})


def the_meshes(default: object = ()) -> Sequence[object]:
    return option(default)


def the_kinds(*default: str) -> Sequence[str]:
    return option(default or ("primary", "shadow", "diffuse", "random"), "Kinds of rays: primary, shadow, diffuse, random",
                  of=("kind of ray", "wrt.lab.bench.rays:RAY_KINDS"))


def the_seed() -> int:
    return option(0, "Seed of the random numbers")


def the_device() -> str:
    return option("cpu", "Device to measure on: cpu, cuda:0, ... (`wrt devices` lists them)", check="wrt.core.device:start")


def the_threads() -> int | None:
    return option(None, "Number of CPU threads  [default: all cores]", check="wrt.core.threads:thread_count")


def looked_up(place: str) -> Any:
    """Import and return what "module:name" names."""
    module, name = place.split(":")
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True)
class Plan:
    """Options of a measurement. Raise InputError for a number out of its range and for an unknown name.

    COMMAND: name of the command; STUDY: module that measures (see wrt.lab.bench.report.study_of); QUICK: values that replace the defaults
    under --quick."""

    COMMAND: ClassVar[str] = ""
    STUDY: ClassVar[str] = ""
    QUICK: ClassVar[Mapping[str, Any]] = {}

    def __post_init__(self) -> None:
        from wrt.core.checks import as_integer, require_known
        from wrt.core.errors import InputError

        for each in fields(self):
            value, rules = getattr(self, each.name), each.metadata
            if rules["between"] is not None and value is not None:
                as_integer(value, each.name, *rules["between"])
            if rules["of"] is not None:
                what, table = rules["of"]
                for name in (value,) if isinstance(value, str) else value:
                    require_known(name, looked_up(table), what, each.name)
            if rules["check"]:
                looked_up(rules["check"])(value)
            if isinstance(value, Sequence) and not value and (each.default is MISSING or each.default):
                raise InputError("must name one or more", argument=each.name)


@dataclass(frozen=True)
class OnScene(Plan):
    """A Plan whose measurement renders one scene: a path, or a Scene in Python."""

    scene: Any = option(MISSING)  # noqa: RUF009
    size: str = option("128x72", "Width x height of the picture, in pixels", check="wrt.core.checks:as_size")
    camera: str | None = option(None, "Name or index of a camera in the scene  [default: the first]")
    set: Sequence[str] = option((), "Settings of the scene to change, such as filter=box,max_depth=3 (docs/scene_format.md)")

    def load(self) -> "Scene":
        """Return the scene with its settings and size."""
        from wrt.core.checks import as_size, assigned
        from wrt.io.load import as_scene
        from wrt.io.toml.report import check_settings

        settings = check_settings(assigned(self.set, "--set", {"size": "--size", "spp": "another option"}), "--set")
        return as_scene(self.scene).with_settings(**settings).with_settings(size=as_size(self.size))
