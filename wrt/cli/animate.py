"""The command `animate`, which renders frames of a scene into a folder or an animated picture."""

import time
from pathlib import Path

import click

from wrt.cli.common import Assignments, Parsed, depth_hint, load, naming, say, say_json, settings_of, shared, warnings_reported
from wrt.core.errors import InputError
from wrt.core.interrupts import exit_code


@click.command()
@shared("scene")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="A folder for PNG frames, or one file: .gif, .png or .apng (an animated PNG)")
@click.option("--frames", type=int, default=36, show_default=True, help="Number of frames")
@click.option("--degrees", type=float, help="Orbit of the camera in degrees  [default: 360, or 0 if an object moves]")
@click.option("--fps", type=float, default=24.0, show_default=True, help="Frames per second of a .gif, .png or .apng file")
@click.option("--rebuild-at", type=float, default=1.5, show_default=True,
              help="Rebuild the acceleration structure, instead of refitting it, once its SAH cost has grown by this factor")
@shared("spp", "size", "assignments", "seed", "device", "threads", "camera", "accel", "quiet", "as_json")
def animate(scene: Path, output: Path, fps: float, assignments: Assignments, quiet: bool, as_json: bool,
            **options: Parsed) -> None:
    """Render an animation of SCENE. It is a turntable, or the motion of its objects (`motion` and `morph` in TOML)."""
    from wrt.renderer import animate as animation
    from wrt.renderer.options import Options

    if not 0.1 <= fps <= 100.0:
        raise InputError(f"must be 0.1 to 100, got {fps:g}", argument="fps")
    plan = animation.Animation(*(options.pop(name) for name in ("frames", "degrees", "rebuild_at")))
    settings = settings_of(assignments, {name: options.pop(name) for name in ("spp", "size")})
    rendering = Options(**options)
    target = animation.check_output(output)
    loaded = load(scene, quiet).with_settings(**settings)
    pictures, rows, signal, darkest = [], [], None, {"visibly_cut": 0.0}
    begin = time.perf_counter()
    with warnings_reported(quiet), naming(scene):
        for film in animation.animate(loaded, plan, rendering):
            if film.stats["interrupted"]:
                signal = film.stats["signal"]
                break
            row = film.stats["frame"] | {"trace": film.stats["seconds"]["trace"]}
            rows.append(row)
            darkest = max(darkest, film.stats, key=lambda stats: stats["visibly_cut"])
            if target.is_dir():
                film.save(animation.frame_path(target, row["number"], plan.frames))
            else:
                pictures.append(film.to_srgb8())
            if not quiet:
                say(f"frame {row['number'] + 1} of {plan.frames}: structure {row['structure']} in {row['seconds']:.3f} s,"
                    f" traced in {row['trace']:.2f} s")
    if pictures:
        animation.save_movie(target, pictures, fps)
    if as_json:
        say_json({"output": str(target), "frames": rows, "seconds": time.perf_counter() - begin})
    elif rows:
        say(target, err=False)
    hint = depth_hint(darkest, loaded.settings.max_depth, "--set max_depth=")
    if hint and not quiet:
        say(hint)
    if len(rows) < plan.frames:
        say(f"interrupted after {len(rows)} of {plan.frames} frames")
        raise SystemExit(exit_code(signal))
