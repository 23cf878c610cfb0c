"""What a browser may send: checked messages, and the controls whose values it may set. Messages are JSON objects.

| type | fields |
|---|---|
| size | width, height: of the picture's area, in device pixels |
| move | kind: one of MOVES; by: three numbers |
| set | name: of a Control; value |
| click | x, y: place in the picture, 0 to 1 from the top left; sample: index of the sample to inspect |
| walk | step: index of the step of the clicked ray's walk to show |
| reset, clear | none: go back to the scene's camera, clear the inspected rays |
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeGuard

from wrt.accel.structures import ACCELERATORS
from wrt.core.types import JsonObject
from wrt.scene.cameras import Camera
from wrt.scene.settings import TONEMAPS
from wrt.viewer.access import Refused, shown
from wrt.viewer.camera import MOVED, Steering
from wrt.viewer.refine import Viewer

LARGEST_SIDE = 16384  # pixels of the picture's area
LONGEST_MOVE = 100.0  # largest absolute value of a number in a move
LAST_SAMPLE = LAST_STEP = (1 << 24) - 1


def is_number(value: object, low: float, high: float) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high and math.isfinite(value)


def _whole(low: int, high: int) -> Callable[[object], bool]:
    return lambda value: type(value) is int and low <= value <= high


def _is_vector(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(is_number(each, -LONGEST_MOVE, LONGEST_MOVE) for each in value)


FIELDS: Mapping[str, Mapping[str, Callable[[object], bool]]] = {
    "size": dict.fromkeys(("width", "height"), _whole(1, LARGEST_SIDE)),
    "move": {"kind": lambda value: isinstance(value, str) and value in MOVED, "by": _is_vector},
    "set": {"name": lambda value: isinstance(value, str), "value": lambda value: isinstance(value, int | float | str)},
    "click": {**dict.fromkeys(("x", "y"), lambda value: is_number(value, 0.0, 1.0)), "sample": _whole(0, LAST_SAMPLE)},
    "walk": {"step": _whole(0, LAST_STEP)},
    "reset": {}, "clear": {},
}


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


@dataclass(frozen=True, eq=False)
class Control:
    """A control of the panel: a slider (with low, high and step), or a choice (with choices).

    get, apply: return and set its value. whole: only whole numbers. is_shown: whether the panel shows it now."""

    name: str
    get: Callable[[], object]
    apply: Callable[..., object]
    hint: str
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0
    whole: bool = False
    choices: tuple[str, ...] = field(default=())
    is_shown: Callable[[], bool] = lambda: True

    def check(self, value: object) -> None:
        """Raise Refused unless a browser may set `value` now."""
        if self.choices:
            good = isinstance(value, str) and value in self.choices
        else:
            good = is_number(value, self.low, self.high) and not (self.whole and value != int(value))
        if not (good and self.is_shown()):
            raise Refused(f"control {self.name}", f"{self.name}: the value {shown(value)} is not allowed")

    def as_json(self) -> JsonObject:
        return {"name": self.name, "hint": self.hint, "value": self.get(), "shown": self.is_shown(), "low": self.low, "high": self.high,
                "step": self.step, "choices": list(self.choices)}


def controls_of(viewer: Viewer, steering: Steering) -> dict[str, Control]:
    """Return the controls by name. Those of the camera change `steering`, the others the viewer."""
    stops = viewer.settings.exposure
    return {control.name: control for control in (
        Control("camera", lambda: steering.name, steering.choose, "A camera of the scene", choices=steering.names),
        Control("angle of view", lambda: round(math.degrees(getattr(steering.pose.camera, "fov_y", 0.0)), 4),
                lambda degrees: steering.change(fov_y=math.radians(degrees), least_fov_x=0.0), "Vertical angle in degrees", 0.1, 170.0, 0.1,
                is_shown=lambda: isinstance(steering.pose.camera, Camera)),
        Control("bounces", lambda: viewer.view.max_depth, lambda value: viewer.change(max_depth=int(value)),
                "Bounces after the first hit; 0 is direct light alone", 0, viewer.deepest, 1, whole=True),
        Control("structure", lambda: viewer.view.accel, lambda value: viewer.change(accel=value),
                "Acceleration structure: it changes the speed, not the picture", choices=tuple(ACCELERATORS)),
        Control("exposure", lambda: viewer.settings.exposure, lambda value: viewer.tone(exposure=float(value)),
                "Stops; each doubles the displayed values", min(-8.0, stops), max(8.0, stops), 0.1),
        Control("tone mapping", lambda: viewer.settings.tonemap, lambda value: viewer.tone(tonemap=value),
                "Curve from linear radiance to the display", choices=tuple(TONEMAPS)),
    ) if control.step or control.choices}
