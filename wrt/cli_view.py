"""The command `view`: a look around in a scene, in a browser."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from wrt.cli_common import ACCEL, SET, load, naming, say, settings_of


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="Where to listen; 0 is any free one")
@click.option("--host", default="127.0.0.1", show_default=True,
              help="For which machines: 127.0.0.1 is this one only, 0.0.0.0 all that reach it, and all of them may steer")
@click.option("--open/--no-open", "open_browser", default=True, help="Open a browser  [default: where there is a desktop]")
@click.option("--spp", type=click.IntRange(1, 1 << 24), default=1024, show_default=True, help="Samples a pixel to refine until")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("--camera", help="A camera's name or number to begin with  [default: the first]")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure to begin with")
@SET
@click.option("-q", "--quiet", is_flag=True, help="No warnings")
def view(scene: Path, port: int, host: str, open_browser: bool, spp: int,
         given: tuple[tuple[str, Any], ...], quiet: bool, **options: Any) -> None:
    """Look around in SCENE: an orbit camera in the browser, whose picture gets finer while it stands still.

    Needs the extra `viewer`. Ctrl-C ends it.
    """
    from wrt.viewer_page import Page, check_address, import_viser

    import_viser()
    check_address(host, port)
    from wrt.options import Options

    rendering = Options(**options)
    settings = settings_of(given, size="the browser's window", spp="--spp")
    loaded = load(scene, quiet).with_settings(**settings)
    with naming(scene):
        loaded.camera(rendering.camera)  # told with the file's name
    page = Page(loaded, rendering, host, port, spp)
    click.echo(page.url)
    if not quiet:
        say("Ctrl-C ends it")
    if open_browser and has_desktop():
        import webbrowser

        webbrowser.open(page.url)
    try:
        page.wait()
    except KeyboardInterrupt:
        pass  # this is how it is meant to end
    finally:
        page.close()
    raise SystemExit(0)  # at once, even if a kernel is being compiled


def has_desktop() -> bool:
    """Whether a browser would open in a window, and not take over the terminal."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
