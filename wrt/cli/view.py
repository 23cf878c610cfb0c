"""The command `view`, which shows a scene in a browser."""

from __future__ import annotations

import contextlib
import html
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import click

from wrt.cli.common import Given, Parsed, gathering, load, names_of, naming, say, settings_of, shared
from wrt.viewer.access import Place

PLACE = (
    click.option("--allow-origin", "allow_origins", multiple=True, metavar="ORIGIN",
                 help="Another address of the viewer in browsers, such as https://example.org of a proxy; repeatable"),
    click.option("--host", default="127.0.0.1", show_default=True,
                 help="127.0.0.1: this machine only; 0.0.0.0: every machine that reaches it, with the printed address"),
    click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True,
                 help="To listen on; 0 is any free one"),
)


@click.command()
@shared("scene")
@gathering("place", Place, names_of(Place), PLACE)
@click.option("--open/--no-open", "open_browser", default=True, help="Open a browser  [default: where there is a desktop]")
@click.option("--spp", type=click.IntRange(1, 1 << 24), default=1024, show_default=True, help="Samples a pixel to refine until")
@shared("device", "threads", "camera", "accel", "given", "quiet")
def view(scene: Path, place: Place, open_browser: bool, spp: int, given: Given, quiet: bool,
         **options: Parsed) -> None:
    """Show SCENE in a browser with an orbit camera; the picture gets finer while the camera rests.

    The printed address holds a token: everybody with it may look and steer. Needs the extra `viewer`. Ctrl-C ends it.
    """
    from wrt.viewer.page import Page
    from wrt.viewer.server import import_viser, listen

    import_viser()
    listen(place).close()  # raises before the scene is read
    from wrt.lab.costs import CostCounter
    from wrt.renderer.options import Options

    rendering = Options(**options)
    settings = settings_of(given, size="the browser's window", spp="--spp")
    loaded = load(scene, quiet).with_settings(**settings)
    with naming(scene):
        loaded.camera(options["camera"])  # raises with the file's name
    page = Page(loaded, rendering, place, spp, counter_of=CostCounter.beside, warn=(lambda text: None) if quiet else say)
    say(page.url, err=False)
    if not quiet:
        say("Ctrl-C ends it")
    try:
        with in_browser(page.url) if open_browser and has_desktop() else contextlib.nullcontext():
            page.wait()
    except KeyboardInterrupt:
        pass  # the normal end
    finally:
        page.close()
    raise SystemExit(0)  # at once, even if a kernel is being compiled


@contextlib.contextmanager
def in_browser(url: str) -> Iterator[None]:
    """Open a browser through a file in a private folder, because all users of the machine can read a browser's command line.

    The address holds the token."""
    import webbrowser

    with tempfile.TemporaryDirectory(prefix="wrt-view-") as folder:  # no other user may read it
        path = Path(folder) / "view.html"
        address = html.escape(url)
        path.write_text('<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>wrt</title>'
                        f'<meta http-equiv="refresh" content="0; url={address}"><a href="{address}">wrt</a>\n', encoding="utf-8")
        webbrowser.open(path.as_uri())
        yield


def has_desktop() -> bool:
    """Return whether a browser would open in a window and not in the terminal."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
