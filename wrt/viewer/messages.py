"""Checks of a browser's messages, and the controls whose values a browser may set. Messages are JSON objects.

| type | fields |
|---|---|
| size | width, height: of the picture's area, in device pixels |
| move | kind: one of MOVES; by: three numbers; begin: True for the first move of a gesture |
| set | name: of a Control; value |
| click | x, y: place in the picture, 0 to 1 from the top left; sample: index of the sample to inspect |
| walk | step: index of the step of the clicked ray's walk to show |
| undo, reset, clear | none: undo or reset the camera, clear the inspected rays |
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeGuard

from wrt.core.types import JsonObject
from wrt.viewer.access import Refused, shown

LARGEST_SIDE = 16384  # pixels of the picture's area
LONGEST_MOVE = 100.0  # largest absolute value of a number in a move
LAST_SAMPLE = LAST_STEP = (1 << 24) - 1
MOVES = ("orbit", "pan", "dolly", "walk")


def decoded(data: str | bytes) -> JsonObject:
    """Return a message as a JSON object, after a check of its fields except the value of "set". Raises Refused."""
    try:
        message = json.loads(data) if isinstance(data, str) else None
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise Refused("frame", "a message that is no JSON object")
    kind = message.get("type")
    checks = FIELDS.get(kind) if isinstance(kind, str) else None
    if checks is None:
        raise Refused("message", f"a message of the kind {shown(kind)}")
    if message.keys() != {"type", *checks} or not all(check(message[name]) for name, check in checks.items()):
        raise Refused(str(kind), f"an invalid message of the kind {kind}")
    return message


def is_number(value: object, low: float, high: float) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high and math.isfinite(value)


def _is_whole(value: object, low: int, high: int) -> bool:
    return type(value) is int and low <= value <= high


def _is_side(value: object) -> bool:
    return _is_whole(value, 1, LARGEST_SIDE)


def _is_vector(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(is_number(each, -LONGEST_MOVE, LONGEST_MOVE) for each in value)


FIELDS: Mapping[str, Mapping[str, Callable[[object], bool]]] = {
    "size": {"width": _is_side, "height": _is_side},
    "move": {"kind": lambda value: isinstance(value, str) and value in MOVES, "by": _is_vector,
             "begin": lambda value: isinstance(value, bool)},
    "set": {"name": lambda value: isinstance(value, str), "value": lambda value: isinstance(value, bool | int | float | str)},
    "click": {"x": lambda value: is_number(value, 0.0, 1.0), "y": lambda value: is_number(value, 0.0, 1.0),
              "sample": lambda value: _is_whole(value, 0, LAST_SAMPLE)},
    "walk": {"step": lambda value: _is_whole(value, 0, LAST_STEP)},
    "undo": {}, "reset": {}, "clear": {},
}


@dataclass(frozen=True, eq=False)
class Control:
    """A control of the panel: a slider (with low, high), a choice (with choices), or a flag (with neither).

    get, apply: return and set its value. whole: only whole numbers. is_shown: whether the panel shows it now."""

    name: str
    group: str
    get: Callable[[], object]
    apply: Callable[..., object]
    unit: str = ""
    hint: str = ""
    low: float = -math.inf
    high: float = math.inf
    step: float = 0.0
    whole: bool = False
    choices: tuple[str, ...] = field(default=())
    is_shown: Callable[[], bool] = lambda: True

    @property
    def kind(self) -> str:
        return "choice" if self.choices else "slider" if self.step else "flag"

    def check(self, value: object) -> None:
        """Raise Refused unless a browser may set `value` now."""
        if not (self.is_shown() and self._accepts(value)):
            raise Refused(f"control {self.name}", f"{self.name}: the value {shown(value)} is not allowed")

    def _accepts(self, value: object) -> bool:
        if self.choices:
            return isinstance(value, str) and value in self.choices
        if not self.step:
            return isinstance(value, bool)
        return is_number(value, self.low, self.high) and not (self.whole and value != int(value))

    def as_json(self) -> JsonObject:
        head = {"name": self.name, "group": self.group, "kind": self.kind, "unit": self.unit, "hint": self.hint, "value": self.get(),
                "shown": self.is_shown()}
        ends = {"low": self.low, "high": self.high, "step": self.step} if self.step else {}
        return head | ends | ({"choices": list(self.choices)} if self.choices else {})
