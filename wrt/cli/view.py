"""The command `view`, which shows a scene in a browser."""

import contextlib
import html
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import click

from wrt.cli.common import STAGING, Assignments, Parsed, load, naming, option_group, say, settings_of, shared
from wrt.viewer.access import Place

PLACE = option_group("place", {
    "allow_origins": click.option("--allow-origin", "allow_origins", multiple=True, metavar="ORIGIN",
                                  help="Another origin under which browsers reach the viewer, such as a proxy's https://example.org;"
                                       " repeatable"),
    "host": click.option("--host", default="127.0.0.1", show_default=True,
                         help="Address to listen on. 127.0.0.1: this machine only; 0.0.0.0: all machines that can reach this machine"),
    "port": click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True,
                         help="Port to listen on; 0 chooses a free port")})


@click.command()
@shared("scene")
@PLACE
@click.option("--open/--no-open", "open_browser", default=True, help="Open a browser  [default: on a desktop]")
@click.option("--spp", type=click.IntRange(1, 1 << 24), default=1024, show_default=True, help="Samples per pixel of the finished picture")
@click.option("--target-error", type=float,
              help="Finish once the estimated error is at most this: root mean square over the picture, linear radiance")
@STAGING
@shared("device", "threads", "camera", "accel", "assignments", "quiet")
def view(scene: Path, place: dict[str, Parsed], open_browser: bool, spp: int, assignments: Assignments, staging: dict[str, Parsed],
         quiet: bool, **options: Parsed) -> None:
    """Show SCENE in a browser with an orbit camera. The picture gets finer while the camera rests.

    The printed address contains a secret token: everybody with the address can watch, and move the camera. Ctrl-C ends the viewer.
    The viewer needs websockets: pip install "wrt[viewer]"."""
    from wrt.viewer.page import Page
    from wrt.viewer.server import import_websockets, listen

    import_websockets()
    where = Place(**place)
    listen(where).close()  # raises InputError before the scene is read
    from wrt.lab.walk.walk import walk
    from wrt.renderer.options import Options

    rendering = Options(**options)
    settings = settings_of(assignments, size="the browser's window", spp="--spp")
    loaded = load(scene, quiet, staging).with_settings(**settings)
    with naming(scene):
        loaded.camera(options["camera"])  # raises InputError with the file's name
    page = Page(loaded, rendering, where, spp, walk_of=walk, warn=(lambda text: None) if quiet else say)
    say(page.url, err=False)
    if not quiet:
        say("Ctrl-C ends the viewer")
    try:
        with in_browser(page.url) if open_browser and has_desktop() else contextlib.nullcontext():
            page.wait()
    except KeyboardInterrupt:
        pass  # the user ends the viewer
    finally:
        page.close()
    raise SystemExit(0)  # main() then exits at once, even while a kernel is being compiled


@contextlib.contextmanager
def in_browser(url: str) -> Iterator[None]:
    """Open a browser at a private file that forwards to `url`.

    The browser's command line, which all users of the machine can read, then does not contain the token of `url`."""
    import webbrowser

    with tempfile.TemporaryDirectory(prefix="wrt-view-") as folder:  # readable by this user only
        path = Path(folder) / "view.html"
        address = html.escape(url)
        path.write_text('<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>wrt</title>'
                        f'<meta http-equiv="refresh" content="0; url={address}"><a href="{address}">wrt</a>\n', encoding="utf-8")
        webbrowser.open(path.as_uri())
        yield


def has_desktop() -> bool:
    """Return True if this machine has a desktop, where a browser opens in a window instead of the terminal."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
