"""Resume an interrupted measurement from its report.

The report of an interrupted run (.json or .csv) also contains a JSON text: the options, the version of the code, and every finished group
of rows without any loss. A study measures the rows of a group together, because their times are comparable only with each other."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.lab.bench.report import Row, versions
from wrt.lab.plans import Plan
from wrt.renderer.distributed.installed import DIGEST

FIELD = "resume"  # of the JSON object; in CSV the first line is "# resume: TEXT"
SUFFIXES = (".json", ".csv")
LIBRARIES = ("embreex", "open3d", "open3d-cpu", "trimesh", "rtree", "mitsuba")  # measured where they are installed


@dataclass
class Finished:
    """Finished part of a measurement. groups: rows of each group, in the order of measurement; machine: the machine's description."""

    groups: list[list[Any]] = field(default_factory=list)
    machine: str = ""

    @property
    def rows(self) -> list[Any]:
        return [row for group in self.groups for row in group]


def identity(plan: Plan) -> dict[str, str]:
    """Return what must be equal when a run resumes: command, code, libraries, options, and a digest of each file that an option names."""
    found = {"command": plan.COMMAND, "code": DIGEST, "libraries": versions(*LIBRARIES)}
    for each in fields(plan):
        value = getattr(plan, each.name)
        names = [str(name) for name in value] if isinstance(value, Sequence) and not isinstance(value, str) else [str(value)]
        files = [path for name in names if (path := Path(name.rpartition("=")[2])).is_file()]
        found[each.name] = ",".join([*names, *(hashlib.sha256(path.read_bytes()).hexdigest() for path in files)])
    return found


def text_of(finished: Finished, plan: Plan) -> str:
    """Return the text that `load` reads."""
    return json.dumps({"of": identity(plan), "machine": finished.machine, "groups": encoded(finished.groups)}, separators=(",", ":"))


def load(path: Path, plan: Plan, classes: Sequence[type] = ()) -> Finished:
    """Read the finished groups from the report of an interrupted run; without a file, nothing is finished.

    classes: dataclasses of the study that rows contain. Raise InputError if the report has nothing to resume, or has other options."""
    if not path.exists():
        return Finished()
    try:
        text = path.read_text()
        text = json.loads(text)[FIELD] if path.suffix.lower() == ".json" else text.split("\n", 1)[0].removeprefix(f"# {FIELD}: ")
        saved, by_name = json.loads(text), {each.__name__: each for each in classes}
        there, machine, groups = dict(saved["of"]), str(saved["machine"]), decoded(saved["groups"], by_name)
        if not all(isinstance(each, list) for each in (groups, *groups)):
            raise TypeError("groups must be a list of lists")
    except (OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        raise InputError("is not the report of an interrupted run, so there is nothing to resume", path=path,
                         hint="run without --resume to replace it") from error
    here = identity(plan)
    differ = [f"{name} {there.get(name)} (here {value})" for name, value in here.items() if name != "code" and there.get(name) != value]
    if differ:
        raise InputError(f"is the report of other options: {'; '.join(differ)}", path=path)
    if there.get("code") != here["code"]:
        raise InputError("was written by another version of wrt, Python, NumPy or Warp", path=path, hint="run without --resume")
    return Finished(groups, machine)


def encoded(value: object) -> object:
    """Convert rows for JSON without loss. A list stays a list; each other compound value becomes {"is": its type, "of": its parts}."""
    if isinstance(value, list | tuple):
        parts = [encoded(each) for each in value]
        return parts if isinstance(value, list) else {"is": "tuple", "of": parts}
    if isinstance(value, np.ndarray):
        return {"is": value.dtype.str, "of": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {"is": "dict", "of": {name: encoded(each) for name, each in value.items()}}
    if isinstance(value, Row) or is_dataclass(value):
        return {"is": type(value).__name__, "of": {name: encoded(each) for name, each in vars(value).items()}}
    return value


def decoded(value: Any, classes: Mapping[str, type]) -> Any:
    """Return what `encoded` converted. A compound value of a type that `classes` lacks becomes a Row."""
    if isinstance(value, list):
        return [decoded(each, classes) for each in value]
    if not isinstance(value, dict):
        return value
    kind, parts = value["is"], value["of"]
    if isinstance(parts, dict):
        parts = {name: decoded(each, classes) for name, each in parts.items()}
        return parts if kind == "dict" else classes.get(kind, Row)(**parts)
    return tuple(decoded(each, classes) for each in parts) if kind == "tuple" else np.array(parts, np.dtype(kind))
