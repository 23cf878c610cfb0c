"""Animations: the camera orbits, meshes move, and the acceleration structure is refitted or rebuilt."""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wrt.core.checks import as_integer
from wrt.core.errors import InputError
from wrt.core.files import check_writable, replacing
from wrt.core.packages import needed_by
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.render import Renderer
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.defaults import frame_turn
from wrt.scene.model import Scene, moves, scene_at
from wrt.scene.values import as_number

REBUILD_AT = 1.5  # factor by which refits may raise the SAH cost (docs/moving.md, "Meshes that change shape")
MOVIES = {".gif": "GIF", ".png": "PNG", ".apng": "PNG"}


@dataclass(frozen=True)
class Animation:
    """Parameters of an animation. Raises InputError for values out of range.

    - frames: number of frames, at the times 0, 1 / frames, 2 / frames ... of one period; the animation loops seamlessly.
    - degrees: angle in degrees that the camera orbits in one period. None: 360, or 0 if an object moves.
    - rebuild_at: growth of the SAH cost since the last build, a factor. Above it, the structure is rebuilt instead of refitted.
    """

    frames: int = 36
    degrees: float | None = None
    rebuild_at: float = REBUILD_AT

    def __post_init__(self) -> None:
        as_integer(self.frames, "frames", 1, 100_000)
        if self.degrees is not None:
            as_number(self.degrees, "degrees")
        if not self.rebuild_at >= 1.0:
            raise InputError(f"must be 1 or more, got {self.rebuild_at}", argument="rebuild_at")


def animate(scene: Scene, animation: Animation, options: Options) -> Iterator[Film]:
    """Yield the frames one by one. After Ctrl-C, the interrupted frame is the last.

    Each film has the dict stats["frame"]: "number", "time" (0 to 1 in the period), "structure" ("built", "kept", "refitted" or "rebuilt"),
    its "seconds", and the "growth" of its SAH cost. If an object moves, no mesh is instanced. Raises InputError if nothing moves."""
    degrees = animation.degrees if animation.degrees is not None else (0.0 if moves(scene) else 360.0)
    if animation.frames > 1 and degrees == 0.0 and not moves(scene):
        raise InputError("nothing moves: no object has a motion, and the camera orbits by 0 degrees")
    if moves(scene):
        options = replace(options, instancing="never")
    renderer = Renderer(scene_at(scene, 0.0), options)
    start, middle = renderer.prepared.plan.camera, np.mean(scene.bounds(), axis=0)
    if isinstance(start, Camera) and start.least_fov_x > 0.0 and degrees:  # it frames the first view alone
        start = frame_turn(start, scene)
    done = {"structure": "built", "seconds": renderer.accel.stats.build_seconds, "growth": 1.0}
    exposure = 0.0
    for frame in range(animation.frames):
        time = frame / animation.frames
        if frame and moves(scene):
            done = renderer.move_objects(scene_at(scene, time), animation.rebuild_at)
        elif frame:
            done = {"structure": "kept", "seconds": 0.0, "growth": 1.0}
        renderer.aim(orbited(start, middle, degrees * time))
        film = renderer.run()
        exposure = film.exposure if frame == 0 else exposure  # one for all frames: an automatic one would flicker
        film = replace(film, exposure=exposure)
        film.stats["frame"] = {"number": frame, "time": time, **done}
        yield film
        if film.stats["interrupted"]:
            return


def orbited(camera: CameraKind, middle: np.ndarray, degrees: float) -> CameraKind:
    """Rotate the camera about a vertical (+y) axis, which passes through the point closest to `middle` (3,) on the viewing ray."""
    if degrees == 0.0:
        return camera
    pose = camera.camera_to_world
    origin, forward = pose[:3, 3], -pose[:3, 2]
    pivot = origin + max(float((middle - origin) @ forward), 0.0) * forward
    angle = math.radians(degrees)
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return replace(camera, camera_to_world=turn @ pose)


def check_output(path: str | os.PathLike[str]) -> Path:
    """Check the output path: a movie file with a suffix in MOVIES, or a folder, which is created. Raises InputError if it is unusable."""
    path = Path(path)
    if path.suffix.lower() in MOVIES:
        check_writable(path)
        return path
    if path.suffix and not path.is_dir():
        raise InputError(f"frames go into a folder, or into a {', '.join(MOVIES)} file", path=path)
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder cannot be created: {error.strerror}", path=path) from error
    check_writable(frame_path(path, 0, 1))
    return path


def frame_path(folder: Path, number: int, frames: int) -> Path:
    """Return the file of frame `number` of `frames`. Leading zeros make the names sort in the order of the frames."""
    return folder / f"frame_{number:0{max(len(str(frames - 1)), 3)}d}.png"


def save_movie(path: str | os.PathLike[str], frames: Sequence[np.ndarray], fps: float) -> None:
    """Write pictures, (H, W, 3) uint8 each, as one looping animation. Raises InputError, and leaves no file, if writing fails.

    A .gif has 256 dithered colours per frame, and frame times in hundredths of a second. .png and .apng keep all colours."""
    with needed_by("a movie"):
        from PIL import Image

    kind = MOVIES[Path(path).suffix.lower()]
    pictures = [Image.fromarray(frame) for frame in frames]
    if kind == "GIF":
        pictures = [picture.quantize(256, dither=Image.Dither.FLOYDSTEINBERG) for picture in pictures]
    duration = 1000.0 / fps
    with replacing(path) as file:
        pictures[0].save(file, format=kind, save_all=True, append_images=pictures[1:], loop=0,
                         duration=max(int(round(duration, -1)), 20) if kind == "GIF" else duration)
