"""Checks of a browser's messages. A browser may send a camera, a click into the picture, and a control's value; nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

from wrt.viewer.access import Refused, shown

if TYPE_CHECKING:
    import viser

    Control: TypeAlias = viser.GuiInputHandle[Any]

LARGEST_VIEWPORT = 16384  # pixels a side
FARTHEST = 1e9  # largest absolute value of a coordinate, in units of the viewport
NARROWEST, WIDEST = 1e-5, math.pi - 1e-3  # angle of view, radians
CAMERA = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}  # vectors of a camera message, and their lengths
LENS = ("fov", "near", "far")
PIXELS = ("image_width", "image_height")


def check_message(message: object, control_of: Callable[[str], Control | None]) -> None:
    """Raise Refused unless a decoded message is allowed. control_of: function from a uuid to viser's control, or None if unknown."""
    table: dict[str, Any] = message if isinstance(message, dict) else {}
    kind = table.get("type")
    if kind == "ViewerCameraMessage":
        _check_camera(table)
    elif kind == "ScenePointerMessage":
        _check_click(table)
    elif kind == "GuiUpdateMessage":
        _check_update(table, control_of)
    elif kind == "ShareUrlRequest":
        raise Refused("share", "a request to share the viewer on the internet")
    else:
        raise Refused("message", f"a message of the kind {shown(kind)}")


def _check_camera(message: dict[str, Any]) -> None:
    valid = (
        message.keys() == {"type", *CAMERA, *LENS, *PIXELS}
        and all(_is_vector(message[name], length) for name, length in CAMERA.items())
        and abs(math.hypot(*message["wxyz"]) - 1.0) < 0.01
        and all(_is_number(message[name], -math.inf, math.inf) for name in LENS)
        and NARROWEST <= message["fov"] <= WIDEST
        and all(type(message[name]) is int and 0 <= message[name] <= LARGEST_VIEWPORT for name in PIXELS)
    )
    if not valid:
        raise Refused("camera", "an invalid camera")


def _check_click(message: dict[str, Any]) -> None:
    place = message.get("screen_pos")
    valid = (
        message.keys() == {"type", "event_type", "ray_origin", "ray_direction", "screen_pos", "modifier"}
        and message["event_type"] == "click"
        and _is_vector(message["ray_origin"], 3) and _is_vector(message["ray_direction"], 3)
        and isinstance(place, list) and len(place) == 1 and _is_vector(place[0], 2, 0.0, 1.0)
        and (message["modifier"] is None or isinstance(message["modifier"], str))
    )
    if not valid:
        raise Refused("click", "an invalid click")


def _check_update(message: dict[str, Any], control_of: Callable[[str], Control | None]) -> None:
    updates = message.get("updates")
    if message.keys() != {"type", "uuid", "updates"} or not isinstance(message["uuid"], str) or not isinstance(updates, dict):
        raise Refused("control", "an invalid change of a control")
    control = control_of(message["uuid"])
    if control is None:
        raise Refused("no control", "a change of an unknown control")
    if updates.keys() != {"value"}:
        raise Refused(f"control {control.label}", f"{control.label}: a change of another property than the value")
    if not accepts(control, updates["value"]):
        raise Refused(f"control {control.label}", f"{control.label}: the value {shown(updates['value'])} is not allowed")


def accepts(control: Control, value: object) -> bool:
    """Return True if a browser may set `control` to `value`."""
    import viser

    if control.disabled or not control.visible:
        return False
    if isinstance(control, viser.GuiSliderHandle | viser.GuiNumberHandle):
        low, high = (sign * math.inf if end is None else end for end, sign in ((control.min, -1.0), (control.max, 1.0)))
        # The page rounds values to seven decimals, so that they may lie just outside the limits.
        return (_is_number(value, low - 1e-6 * abs(low), high + 1e-6 * abs(high))
                and (not isinstance(control.value, int) or value == int(value)))
    if isinstance(control, viser.GuiDropdownHandle):
        return isinstance(value, str) and value in control.options
    return isinstance(value, bool) if isinstance(control, viser.GuiCheckboxHandle) else value is True  # a button's click


def _is_number(value: object, low: float, high: float) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and low <= value <= high


def _is_vector(value: object, length: int, low: float = -FARTHEST, high: float = FARTHEST) -> bool:
    return isinstance(value, list) and len(value) == length and all(_is_number(each, low, high) for each in value)
