"""The controls of the viewer's panel: what each of them is called, which values it can have, and what it changes."""

import math
from collections.abc import Callable

from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.scene.cameras import Camera
from wrt.scene.model import Scene
from wrt.scene.settings import TONEMAPS
from wrt.viewer.camera import Pose, Steering, pose_of
from wrt.viewer.messages import Control
from wrt.viewer.refine import Viewer

RESOLUTIONS = {"full": 1, "1/2": 2, "1/4": 4}  # pixels of the window per pixel of the picture, along each side
PICTURE = "picture"


class Panel:
    """The controls by name. look: requests the picture of the steered camera. camera_name: the scene's camera that was chosen last."""

    def __init__(self, scene: Scene, viewer: Viewer, steering: Steering, look: Callable[[], object]) -> None:
        self.scene, self.viewer, self.steering, self.look = scene, viewer, steering, look
        self.camera_name, self.resolution = viewer.view.camera.name, "full"
        self.controls = {control.name: control for control in (*self._lens(), *self._light(), *self._picture())}

    def look_or(self, before: Pose) -> None:
        """Request the steered camera. If its numbers overflow, keep the pose `before`, and raise the InputError."""
        try:
            self.look()
        except InputError:
            self.steering.pose = before
            raise

    def _lens(self) -> list[Control]:
        camera, steering = self.viewer.view.camera, self.steering
        names = tuple(each.name or f"camera {i}" for i, each in enumerate(self.scene.cameras))
        unit = steering.pose.distance
        lens = camera if isinstance(camera, Camera) else Camera()
        widest = round_up(max(4.0 * lens.aperture_radius, 0.05 * unit))

        def value(name: str, scale: float = 1.0) -> Callable[[], float]:
            return lambda: round(float(getattr(steering.pose.camera, name, 0.0)) * scale, 6)

        def setter(name: str, scale: float = 1.0) -> Callable[[float], None]:
            def apply(number: float) -> None:
                before, more = steering.pose, {"least_fov_x": 0.0} if name == "fov_y" else {}
                steering.change(**{name: number * scale, **more})
                self.look_or(before)

            return apply

        def is_lens() -> bool:
            return isinstance(steering.pose.camera, Camera)

        cameras = [Control("camera", "Camera", lambda: self.camera_name or names[0], self._choose, choices=names,
                           hint="A camera of the scene")] if names else []
        return cameras + [
            Control("angle of view", "Camera", value("fov_y", 180.0 / math.pi), setter("fov_y", math.pi / 180.0), "°", "Vertical angle",
                    0.1, 170.0, 0.1, is_shown=is_lens),
            Control("aperture", "Camera", value("aperture_radius"), setter("aperture_radius"), "scene units",
                    "Radius of the lens; 0 is a pinhole", 0.0, widest, widest / 200.0, is_shown=is_lens),
            Control("focus", "Camera", value("focus_distance"), setter("focus_distance"), "scene units",
                    "Distance of the plane in focus", 1e-6 * unit, 1e9 * unit, round_up(0.01 * unit), is_shown=is_lens),
        ]

    def _light(self) -> list[Control]:
        viewer = self.viewer
        return [
            Control("bounces", "Light", lambda: viewer.view.max_depth, lambda value: viewer.change(max_depth=int(value)), "",
                    "Bounces after the first hit; 0 is direct light alone", 0, viewer.deepest, 1, whole=True),
            Control("structure", "Light", lambda: viewer.view.accel, lambda value: viewer.change(accel=value), choices=tuple(ACCELERATORS),
                    hint="Acceleration structure: it changes the speed, not the picture"),
        ]

    def _picture(self) -> list[Control]:
        viewer, display = self.viewer, self.viewer.display

        ends = min(-8.0, display.settings.exposure), max(8.0, display.settings.exposure)

        def resize(value: str) -> None:
            self.resolution = value
            self.look()

        return [
            Control("show", "Picture", lambda: viewer.view.cost or PICTURE,
                    lambda value: viewer.change(cost="" if value == PICTURE else value), choices=(PICTURE, *viewer.costs),
                    hint="The picture, or a heat map of a counter, summed over the rays of each pixel"),
            Control("exposure", "Picture", lambda: display.settings.exposure, lambda value: viewer.tone(exposure=float(value)), "stops",
                    "Each stop doubles the displayed values", *ends, 0.1),
            Control("auto exposure", "Picture", lambda: display.settings.auto_exposure, lambda value: viewer.tone(auto_exposure=value),
                    hint="Add the stops that show bright parts just below white"),
            Control("tone mapping", "Picture", lambda: display.settings.tonemap, lambda value: viewer.tone(tonemap=value),
                    choices=tuple(TONEMAPS), hint="Curve from linear radiance to the display"),
            Control("resolution", "Picture", lambda: self.resolution, resize, choices=tuple(RESOLUTIONS),
                    hint="Pixels of the picture per pixel of the window, along each side"),
        ]

    def _choose(self, name: str) -> None:
        """Go to a camera of the scene; `reset` then returns to it."""
        names = self.controls["camera"].choices
        pose = pose_of(self.scene, self.scene.cameras[names.index(name)])
        before = self.steering.pose
        self.steering.put(pose)
        self.steering.start, self.camera_name = pose, name
        self.look_or(before)


def round_up(value: float) -> float:
    """Return the smallest number that is at least `value`, and is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= value * (1.0 - 1e-9))
