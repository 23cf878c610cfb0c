"""The command `view`: a look around in a scene, in a browser."""

from __future__ import annotations

import contextlib
import html
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from wrt.cli.common import gathering, load, naming, say, settings_of, shared


def place_of(**given: Any) -> Any:
    """Return the viewer's Place of the options below."""
    from wrt.viewer.access import Place

    return Place(**given)


PLACE = (
    click.option("--allow-origin", "allow_origins", multiple=True, metavar="ORIGIN",
                 help="Another address under which browsers find it, such as https://example.org of a proxy; repeatable"),
    click.option("--host", default="127.0.0.1", show_default=True,
                 help="For which machines: 127.0.0.1 is this one only, 0.0.0.0 all that reach it and have the printed address"),
    click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True,
                 help="Where to listen; 0 is any free one"),
)


@click.command()
@shared("scene")
@gathering("place", place_of, ("host", "port", "allow_origins"), PLACE)
@click.option("--open/--no-open", "open_browser", default=True, help="Open a browser  [default: where there is a desktop]")
@click.option("--spp", type=click.IntRange(1, 1 << 24), default=1024, show_default=True, help="Samples a pixel to refine until")
@shared("device", "threads", "camera", "accel", "given", "quiet")
def view(scene: Path, place: Any, open_browser: bool, spp: int, given: tuple[tuple[str, Any], ...], quiet: bool,
         **options: Any) -> None:
    """Look around in SCENE: an orbit camera in the browser, whose picture gets finer while it stands still.

    The address that it prints holds a token: whoever has it may look and steer. Needs the extra `viewer`. Ctrl-C ends it.
    """
    from wrt.viewer.page import Page
    from wrt.viewer.server import import_viser, listen

    import_viser()
    listen(place).close()  # told before the scene is read
    from wrt.lab.costs import CostCounter
    from wrt.renderer.options import Options

    rendering = Options(**options)
    settings = settings_of(given, size="the browser's window", spp="--spp")
    loaded = load(scene, quiet).with_settings(**settings)
    with naming(scene):
        loaded.camera(rendering.camera)  # told with the file's name
    page = Page(loaded, rendering, place, spp, counter_of=CostCounter.beside, warn=(lambda text: None) if quiet else say)
    say(page.url, err=False)
    if not quiet:
        say("Ctrl-C ends it")
    try:
        with in_browser(page.url) if open_browser and has_desktop() else contextlib.nullcontext():
            page.wait()
    except KeyboardInterrupt:
        pass  # this is how it is meant to end
    finally:
        page.close()
    raise SystemExit(0)  # at once, even if a kernel is being compiled


@contextlib.contextmanager
def in_browser(url: str) -> Iterator[None]:
    """With a browser that was sent to the address, through a file in a folder of ours: everybody on the machine can read the
    command line of a browser, and the address holds the token."""
    import webbrowser

    with tempfile.TemporaryDirectory(prefix="wrt-view-") as folder:  # nobody else may look into it
        path = Path(folder) / "view.html"
        address = html.escape(url)
        path.write_text('<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>wrt</title>'
                        f'<meta http-equiv="refresh" content="0; url={address}"><a href="{address}">wrt</a>\n', encoding="utf-8")
        webbrowser.open(path.as_uri())
        yield


def has_desktop() -> bool:
    """Whether a browser would open in a window, and not take over the terminal."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
