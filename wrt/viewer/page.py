"""The viewer in a browser: viser's orbit controls and panel over the pictures of a wrt.viewer.refine.Viewer.

Several browsers share the panel. The Viewer renders the camera that moved last, and only that camera's browser gets the picture.
"""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.picture.heatmap import colors, short
from wrt.picture.image import encode_png
from wrt.renderer.options import Options
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.model import Scene
from wrt.scene.settings import TONEMAPS
from wrt.viewer.access import HERE, Place, access_for
from wrt.viewer.camera import camera_toml, from_viewport, orbited_point, unit_of, up_of
from wrt.viewer.refine import Viewer
from wrt.viewer.renderers import CounterOf, Shown
from wrt.viewer.server import Guard, import_viser, listen, to_stderr

if TYPE_CHECKING:
    import viser

Event = TypeVar("Event")

MOST_PIXELS = 1 << 21  # largest number of pixels of a picture; a larger viewport shows the picture enlarged
RESOLUTIONS = {"full": 1, "1/2": 2, "1/4": 4}
PICTURE = "picture"
QUALITY = {True: 92, False: 80}  # JPEG quality of a picture at full resolution, and of a coarse picture
LEGEND_HEIGHT = 12  # pixels
FARTHEST_FOCUS = 1e9  # in units of the viewport


def full_size(size: tuple[int, int], before: tuple[int, int]) -> tuple[int, int]:
    """Return a viewport's size from its canvas's size, which viser shrinks if the browser is slow. before: last viewport size."""
    smaller = size[0] <= before[0] and abs(size[0] * before[1] - size[1] * before[0]) <= max(before)
    return before if smaller else size


def status(shown: Shown, viewer: Viewer, full: tuple[int, int], browsers: int) -> str:
    """Return the panel's text about a picture, as Markdown. full: viewport's size in pixels. browsers: number of connected browsers."""
    height, width = shown.codes.shape[:2]
    rays = f"{shown.speed / 1e6:.2f} Mray/s, {shown.rays_per_sample:.1f} rays per sample"
    if shown.view.cost:
        content = f"**{shown.view.cost}** per pixel: mean {short(shown.mean)}, largest {short(shown.largest)}"
    else:
        content = f"**{shown.spp} of {viewer.spp} spp**"
    viewport = "" if (width, height) == full else f" of {full[0]}x{full[1]}"
    size = f"{width}x{height}{viewport}{', coarse' if shown.scale > 1 else ''}"
    others = f"  \n{browsers} browsers are connected: the picture follows the camera that moved last" if browsers > 1 else ""
    return f"{content}, {size}  \n{rays}  \n{viewer.renderers.describe(shown.view.accel)}{others}"


class Page:
    """A server with the panel and one Viewer. Both run until `close`. `url` is the page's address with the token.

    spp, counter_of: see Viewer. warn: called with one line, once for each kind of refused request or message. Raises InputError if the
    server cannot listen at `place`."""

    def __init__(self, scene: Scene, options: Options, place: Place = HERE, spp: int = 1024, *,
                 counter_of: CounterOf | None = None, warn: Callable[[str], None] = to_stderr) -> None:
        import_viser()
        self.viewer = Viewer(scene, options, self._show, self._report, spp, counter_of)
        start = self.viewer.view.camera
        self.unit, self.watching, self.name = unit_of(scene, start), -1, scene.name or "picture"
        self.full = (0, 0)
        listening = listen(place)
        try:
            address, port = listening.getsockname()[:2]
            access, self.url = access_for(place, address, port)
            self.guard = Guard(access, warn)
            self.server = self.guard.open(listening, "wrt")
        except BaseException:
            listening.close()
            raise
        place_camera(self.server, start, orbited_point(scene, start), self.unit)
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        self._panel(start)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)
        self.thread = threading.Thread(target=self._run, name="wrt viewer", daemon=True)
        self.failure: BaseException | None = None
        self.thread.start()

    def _run(self) -> None:
        try:
            self.viewer.run()
        except BaseException as error:
            self.failure = error

    def wait(self) -> None:
        """Wait until `close`. Raises the error that ends the Viewer's thread."""
        while self.thread.is_alive():
            self.thread.join(0.5)
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        self.viewer.stop()
        self.guard.close()

    # --- the viewport -------------------------------------------------------------------------------------------------

    async def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(self._moved)

    async def _disconnected(self, client: viser.ClientHandle) -> None:
        if client.client_id != self.watching:
            return
        others = self.server.get_clients()
        if others:
            await self._moved(next(iter(others.values())).camera)
        else:
            self.viewer.pause()

    async def _moved(self, viewport: viser.CameraHandle) -> None:
        """Render a browser's new camera. viser runs coroutines in order, but functions in threads."""
        width, height = viewport.image_width, viewport.image_height
        if width < 1 or height < 1:
            return
        newcomer = self.watching != viewport.client.client_id
        self.watching = viewport.client.client_id
        self.full = full_size((width, height), (0, 0) if newcomer else self.full)
        coarser = max(RESOLUTIONS[self.resolution.value], math.sqrt(width * height / MOST_PIXELS))
        size = max(1, round(width / coarser)), max(1, round(height / coarser))
        try:
            changed = self.viewer.change(camera=lambda camera: from_viewport(camera, viewport, self.unit), size=size)
        except InputError as error:  # the position overflows in scene units
            self.guard.report("camera", f"dropped a camera: {error}")
            return
        if newcomer and not changed:
            self.viewer.again()

    def _show(self, shown: Shown) -> None:
        client = self.server.get_clients().get(self.watching)
        if client is None:
            return
        form = {"format": "png"} if shown.done else {"format": "jpeg", "jpeg_quality": QUALITY[shown.scale == 1]}
        client.scene.set_background_image(shown.codes, **form)
        self.status.content = status(shown, self.viewer, self.full, len(self.server.get_clients()))
        self.legend.visible = self.legend_text.visible = bool(shown.view.cost)
        self.exr.disabled = bool(shown.view.cost)
        if shown.view.cost:
            self.legend_text.content = f"0 (dark) to {short(shown.top)} (light)"

    def _report(self, text: str) -> None:
        self.activity.content, self.activity.visible = text, bool(text)

    # --- the panel ----------------------------------------------------------------------------------------------------

    def _panel(self, camera: CameraKind) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("waiting for the first picture")
        self.activity = gui.add_markdown("", visible=False)
        if isinstance(camera, Camera):
            self._lens_folder(camera)
        with gui.add_folder("Light"):
            depth = gui.add_slider("bounces", 0, self.viewer.deepest, 1, self.viewer.view.max_depth, hint="Number after the first hit")
            accel = gui.add_dropdown("structure", tuple(ACCELERATORS), initial_value=self.viewer.view.accel,
                                     hint="Acceleration structure, built at its first use. It changes speed and cost, not the picture")
        depth.on_update(self._safe(lambda event: self.viewer.change(max_depth=int(depth.value))))
        accel.on_update(self._safe(lambda event: self.viewer.change(accel=accel.value)))
        self._picture_folder()
        with gui.add_folder("Save"):
            png = gui.add_button("picture as PNG", hint="The picture as shown")
            self.exr = gui.add_button("picture as EXR", hint="Linear radiance, variance and number of samples")
            toml = gui.add_button("camera as TOML", hint="The camera as a table for a scene file")
        png.on_click(self._safe(lambda event: self._save(event.client, ".png")))
        self.exr.on_click(self._safe(lambda event: self._save(event.client, ".exr")))
        toml.on_click(self._safe(lambda event: show_camera(event.client, self.viewer.view.camera)))

    def _lens_folder(self, camera: Camera) -> None:
        gui, unit = self.server.gui, self.unit
        widest = round_up(max(4.0 * camera.aperture_radius, 0.05 * unit))
        with gui.add_folder("Lens"):
            angle = gui.add_slider("angle of view", 5.0, 120.0, 0.5, min(max(round(math.degrees(camera.fov_y), 2), 5.0), 120.0),
                                   hint="Vertical angle in degrees")
            aperture = gui.add_slider("aperture", 0.0, widest, widest / 200.0, camera.aperture_radius,
                                      hint="Radius of the lens in scene units; 0 is a pinhole")
            self.focus = gui.add_number("focus", camera.focus_distance, min=1e-6 * unit, max=FARTHEST_FOCUS * unit,
                                        step=round_up(0.01 * unit), hint="Distance of the plane in focus, in scene units")
            self.by_click = gui.add_checkbox("click to focus", False, hint="A click into the picture focuses on the surface there")
        angle.on_update(self._safe(lambda event: self._set_angle(math.radians(angle.value))))
        aperture.on_update(self._safe(lambda event: self._set_lens(aperture_radius=float(aperture.value))))
        self.focus.on_update(self._safe(lambda event: self._set_lens(focus_distance=float(self.focus.value))))
        self.server.scene.on_click()(self._safe(self._clicked))

    def _picture_folder(self) -> None:
        gui, viewer = self.server.gui, self.viewer
        with gui.add_folder("Picture"):
            cost = gui.add_dropdown("show", (PICTURE, *viewer.costs), initial_value=PICTURE,
                                    hint="The picture, or a heat map of a cost: a counter summed over the rays of each pixel")
            self.legend = gui.add_image(np.repeat(colors()[None], LEGEND_HEIGHT, axis=0), visible=False)
            self.legend_text = gui.add_markdown("", visible=False)
            exposure = gui.add_slider("exposure", min(-8.0, viewer.exposure), max(8.0, viewer.exposure), 0.1, viewer.exposure,
                                      hint="In stops")
            tonemap = gui.add_dropdown("tone mapping", TONEMAPS, initial_value=viewer.tonemap)
            self.resolution = gui.add_dropdown("resolution", tuple(RESOLUTIONS), initial_value="full",
                                               hint="Pixels of the picture per pixel of the viewport, along each side")
        cost.on_update(self._safe(lambda event: viewer.change(cost="" if cost.value == PICTURE else cost.value)))
        for control in (exposure, tonemap):
            control.on_update(self._safe(lambda event: viewer.tone(float(exposure.value), tonemap.value)))

        @self.resolution.on_update
        async def resized(event: viser.GuiEvent[Any]) -> None:
            client = self.server.get_clients().get(self.watching)
            if client is not None:
                await self._moved(client.camera)

    def _safe(self, action: Callable[[Event], object]) -> Callable[[Event], None]:
        """Return a function that calls `action` with a browser's event, and reports an error in one line in place of raising it."""

        def act(event: Event) -> None:
            try:
                action(event)
            except (InputError, OSError) as error:
                self.guard.report("action", f"error: {error}")

        return act

    def _set_angle(self, fov_y: float) -> None:
        for client in self.server.get_clients().values():
            client.camera.fov = fov_y  # the browser then reports a new camera

    def _set_lens(self, **fields: float) -> None:
        self.viewer.change(camera=lambda camera: replace(camera, **fields))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        distance = self.viewer.renderers.focus_at(self.viewer.view, *event.screen_pos) if self.by_click.value else None
        if distance is not None:
            self.focus.value = distance  # type: ignore[misc]  # viser sets it in __setattr__
            self._set_lens(focus_distance=distance)

    def _save(self, client: viser.ClientHandle | None, suffix: str) -> None:
        picture = self.viewer.picture()
        if client is not None and picture is not None:
            client.send_file_download(f"{self.name}{suffix}", encoded(picture, suffix), save_immediately=True)


def place_camera(server: viser.ViserServer, camera: CameraKind, target: np.ndarray, unit: float) -> None:
    """Set the camera with which every browser starts. It orbits `target` (3,), in world space. unit: viewport's unit in scene units."""
    server.scene.set_up_direction(tuple(up_of(camera)))
    start = server.initial_camera
    start.position = tuple(camera.camera_to_world[:3, 3] / unit)
    start.look_at = tuple(target / unit)
    start.fov = (camera if isinstance(camera, Camera) else Camera()).fov_y


def show_camera(client: viser.ClientHandle | None, camera: CameraKind) -> None:
    """Show a camera in a browser as a table of a TOML scene file, with a button to save the table."""
    if client is None:
        return
    text = camera_toml(camera)
    with client.gui.add_modal("Camera") as modal:
        client.gui.add_markdown(f"```toml\n{text}```")
        save = client.gui.add_button("save as a file")
        close = client.gui.add_button("close")
    save.on_click(lambda event: client.send_file_download("camera.toml", text.encode(), save_immediately=True))
    close.on_click(lambda event: modal.close())


def encoded(picture: Film | np.ndarray, suffix: str) -> bytes:
    """Return the bytes of a picture's file. picture: a Film, or a heat map's display codes (h, w, 3) uint8, which become a PNG."""
    if isinstance(picture, np.ndarray):
        return encode_png(picture)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"picture{suffix}"
        picture.save(path)
        return path.read_bytes()


def round_up(value: float) -> float:
    """Return the smallest number that is at least `value`, and is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= value * (1.0 - 1e-9))
